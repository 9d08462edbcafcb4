"""Cars of the synthetic street: convex bodies with windows, lights, wheels and plates, and the 24 points of car24.

A car's own frame is x forward, y left, z up, origin on the ground below its middle, metres. It is made of convex parts
that planes separate (what is below the body, body, cabin, mirrors), so that painting parts by the side of those planes
on which the camera lies is exact; flat details lie on a part and are painted right after it.
"""

import functools
from dataclasses import dataclass, field

import numba
import numpy as np
from scipy.spatial import ConvexHull

from dataset.street_car_sizes import SIZES, CarShape, CarSize
from dataset.street_polygons import MAX_CORNERS
from labeling.schemas import keypoint_schema

_GLASS = (44.0, 54.0, 64.0)
_TRIM = (30.0, 31.0, 33.0)
_PLATE = (236.0, 236.0, 226.0)
_CLEARANCE = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CarModel:
    """A car in its own frame, ready to be placed."""

    corners: np.ndarray
    """(F, MAX_CORNERS, 3) float64, metres, counter-clockwise seen from outside."""
    corner_count: np.ndarray
    """(F,) int32."""
    colour: np.ndarray
    """(F, 3) float32, unlit; rows with ``painted`` take the car's colour instead."""
    painted: np.ndarray
    """(F,) bool."""
    brake: np.ndarray
    """(F,) bool: lights that are bright while braking."""
    normal: np.ndarray
    """(F, 3) float64, outward, unit."""
    plane: np.ndarray
    """(F,) float64: ``normal . corner``."""
    gloss: np.ndarray
    """(F,) float32: how much sky it mirrors."""
    area: np.ndarray
    """(F,) float64, square metres."""
    beside: np.ndarray
    """(F, 3) int32: for the triangles of solids, the face across the edge from each corner; -1 for details."""
    part: np.ndarray
    """(F,) int32: 0 below the body, 1 body, 2 cabin, 3 left mirror, 4 right mirror."""
    solids: tuple[np.ndarray, ...]
    """Per part, (E, 4) float64 half-spaces ``n . p + d <= 0`` of the convex solid."""
    keypoints: np.ndarray
    """(24, 3) float64, metres, in the order of car24."""
    size: CarSize

    def part_order(self, eye: np.ndarray) -> tuple[int, ...]:
        """Parts from back to front for an eye at (3,) in the car's frame."""
        mirrors = [(3, eye[1] > self.size.width / 2), (4, eye[1] < -self.size.width / 2)]
        behind = [part for part, in_front in mirrors if not in_front]
        before = [part for part, in_front in mirrors if in_front]
        middle = [1, 2] if eye[2] > self.size.belt else [2, 1]
        stack = [*behind, *middle, *before]
        return (0, *stack) if eye[2] > _CLEARANCE else (*stack, 0)


@dataclass
class _Builder:
    """Collects polygons while a car is put together."""

    corners: list[np.ndarray] = field(default_factory=list)
    rows: list[tuple] = field(default_factory=list)
    solids: list[np.ndarray] = field(default_factory=list)

    def hull(self, points: np.ndarray, part: int, *, colour: tuple | None = None, gloss: float = 0.3) -> np.ndarray:
        """A convex solid; ``colour`` None means the car's paint. Returns its half-spaces (E, 4)."""
        hull = ConvexHull(points)
        first = len(self.corners)
        for triangle, equation, across in zip(hull.simplices, hull.equations, hull.neighbors, strict=True):
            # Qhull names the neighbour opposite to each corner; ours lie across the edge from each corner to the next.
            turned = np.linalg.det([*(points[triangle[1:]] - points[triangle[0]]), equation[:3]]) < 0
            beside = across[[0, 2, 1]] if turned else across[[2, 0, 1]]
            corners = points[triangle[::-1] if turned else triangle]
            self._add(corners, equation[:3], part, colour, gloss, beside=tuple(first + beside))
        return np.unique(np.round(hull.equations, 9), axis=0)

    def detail(
        self, corners: np.ndarray, towards: tuple, part: int, colour: tuple | None, *, gloss: float = 0.0,
        brake: bool = False,
    ) -> None:  # fmt: skip
        """A flat polygon on a part, facing ``towards``."""
        self._add(np.asarray(corners, np.float64), np.asarray(towards, np.float64), part, colour, gloss, brake)

    def _add(self, corners, towards, part, colour, gloss, brake=False, beside=(-1, -1, -1)) -> None:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        if normal @ towards < 0:
            corners, normal = corners[::-1], -normal
        self.corners.append(corners)
        self.rows.append((normal / np.linalg.norm(normal), part, colour, gloss, brake, beside, _area(corners)))


def _area(corners: np.ndarray) -> float:
    fan = np.cross(corners[1:-1] - corners[0], corners[2:] - corners[0])
    return float(0.5 * np.linalg.norm(fan.sum(axis=0)))


def _surface(half_spaces: np.ndarray, axis: int, sign: float, fixed: np.ndarray) -> np.ndarray:
    """(n, 3) points on a convex solid: where the line through ``fixed`` along ``axis`` leaves it on side ``sign``."""
    out = np.array(fixed, np.float64)
    out[:, axis] = 0.0
    facing = half_spaces[half_spaces[:, axis] * sign > 1e-9]
    reach = -(out @ facing[:, :3].T + facing[:, 3]) / facing[:, axis]
    out[:, axis] = reach.min(axis=1) if sign > 0 else reach.max(axis=1)
    return out


def _both(points: list[tuple[float, float, float]]) -> np.ndarray:
    """Points mirrored to both sides."""
    half = np.array(points, np.float64)
    return np.concatenate([half, half * (1, -1, 1)])


def _body(size: CarSize) -> np.ndarray:
    front, rear, half = size.length / 2, -size.length / 2, size.width / 2
    low, belt, hood = _CLEARANCE, size.belt, size.hood
    return _both([
        (front - 0.10, half * 0.70, low + 0.02), (front - 0.02, half * 0.66, 0.36), (front, half * 0.64, 0.50),
        (front - 0.06, half * 0.66, hood - 0.10), (front - 0.18, half * 0.64, hood),
        (front - 0.24, half * 0.90, low + 0.02), (front - 0.20, half * 0.90, 0.48),
        (front - 0.26, half * 0.88, hood - 0.1),
        (front - 0.44, half * 0.80, hood + 0.02),
        (front - 0.62, half, low + 0.06), (front - 0.62, half, hood - 0.16),
        (size.screen_base, half * 0.9, belt), (size.screen_base - 0.1, half, belt - 0.13),
        (rear + 0.55, half, low + 0.06), (rear + 0.55, half, belt - 0.13), (rear + 0.40, half * 0.92, belt),
        (rear + 0.16, half * 0.88, low + 0.04), (rear + 0.12, half * 0.90, 0.52),
        (rear + 0.16, half * 0.88, belt - 0.06),
        (rear + 0.05, half * 0.70, low + 0.06), (rear, half * 0.68, 0.52), (rear + 0.05, half * 0.68, belt - 0.08),
        (rear + 0.14, half * 0.72, belt),
    ])  # fmt: skip


def _cabin(size: CarSize) -> np.ndarray:
    half, top = size.width / 2, size.height
    return _both([
        (size.screen_base, half * 0.86, size.belt - 0.01), (size.rear_base, half * 0.86, size.belt - 0.01),
        (size.roof_front, half * 0.70, top - 0.03), (size.roof_rear, half * 0.70, top - 0.03),
        (size.roof_front - 0.15, half * 0.55, top), (size.roof_rear + 0.15, half * 0.55, top),
    ])  # fmt: skip


def _windows(make: _Builder, size: CarSize) -> None:
    half, low, high = size.width / 2, size.belt - 0.01, size.height - 0.03
    corners = {
        (x, side): np.array([position, side * half * (0.86 if "low" in x else 0.70), low if "low" in x else high])
        for side in (1, -1)
        for x, position in (("front_low", size.screen_base), ("rear_low", size.rear_base),
                            ("front_high", size.roof_front), ("rear_high", size.roof_rear))
    }  # fmt: skip

    def pane(quad: list[np.ndarray], box: tuple[float, float, float, float]) -> np.ndarray:
        """Part of the quad a-b (below) to d-c (above), by shares."""
        a, b, c, d = quad

        def spot(u: float, v: float) -> np.ndarray:
            return (a + (b - a) * u) * (1 - v) + (d + (c - d) * u) * v

        left, bottom, right, top = box
        return np.array([spot(left, bottom), spot(right, bottom), spot(right, top), spot(left, top)])

    for low_name, high_name, towards in (("front_low", "front_high", 1.0), ("rear_low", "rear_high", -1.0)):
        quad = [corners[low_name, 1], corners[low_name, -1], corners[high_name, -1], corners[high_name, 1]]
        make.detail(pane(quad, (0.05, 0.06, 0.95, 0.92)), (towards, 0, 0), 2, _GLASS, gloss=0.8)
        sheen = tuple(c + 26 for c in _GLASS)
        make.detail(pane(quad, (0.10, 0.58, 0.62, 0.88)), (towards, 0, 0), 2, sheen, gloss=0.8)
    pillar = 0.52 if size.length < 4.8 else 0.66
    for side in (1, -1):
        quad = [corners[n, side] for n in ("rear_low", "front_low", "front_high", "rear_high")]
        for left, right in ((0.05, pillar - 0.02), (pillar + 0.02, 0.94)):
            make.detail(pane(quad, (left, 0.08, right, 0.88)), (0, side, 0), 2, _GLASS, gloss=0.7)


def _ends(make: _Builder, size: CarSize, body: np.ndarray) -> dict[str, np.ndarray]:
    """Lights, grille, plates and trim at both ends; returns named points."""
    half = size.width / 2
    named: dict[str, np.ndarray] = {}

    def patch(
        sign: float, y: tuple[float, float], z: tuple[float, float], colour: tuple | None, **options
    ) -> np.ndarray:
        flat = np.array([(0, y[0], z[0]), (0, y[1], z[0]), (0, y[1], z[1]), (0, y[0], z[1])])
        corners = _surface(body, 0, sign, flat) + (sign * 0.012, 0, 0)
        triangles = [corners[[0, 1, 2]], corners[[0, 2, 3]]]
        for triangle in triangles:  # A quad laid on a curved end need not be planar; its halves are.
            make.detail(triangle, (sign, 0, 0), 1, colour, **options)
        return corners

    light_top = size.hood - 0.06
    patch(1, (-half * 0.86, half * 0.86), (0.24, 0.34), _TRIM)
    patch(1, (-half * 0.42, half * 0.42), (light_top - 0.15, light_top - 0.01), (24, 25, 28))
    patch(1, (-half * 0.40, half * 0.40), (light_top - 0.09, light_top - 0.07), (150, 152, 156))
    patch(-1, (-half * 0.84, half * 0.84), (0.24, 0.36), _TRIM)
    for side, word in ((1, "left"), (-1, "right")):
        inner, outer = side * half * 0.48, side * half * 0.86
        patch(1, (inner, outer), (light_top - 0.17, light_top + 0.01), (120, 124, 130))
        patch(1, (inner + side * 0.03, outer - side * 0.04), (light_top - 0.15, light_top - 0.01), (244, 244, 232))
        rear_top = size.belt - 0.10
        patch(-1, (side * half * 0.52, side * half * 0.88), (rear_top - 0.19, rear_top), (168, 18, 24), brake=True)
        patch(-1, (side * half * 0.54, side * half * 0.66), (rear_top - 0.17, rear_top - 0.11), (236, 190, 180))
        spots = np.array([(0, side * half * 0.67, light_top - 0.08), (0, side * half * 0.74, 0.26)])
        named[f"front_light_{word}"], named[f"front_low_{word}"] = _surface(body, 0, 1, spots)
        spots = np.array([
            (0, side * half * 0.70, rear_top - 0.095), (0, side * half * 0.74, 0.27), (0, side * 0.26, rear_top - 0.3),
            (0, side * half * 0.76, size.belt - 0.07),
        ])  # fmt: skip
        on_rear = _surface(body, 0, -1, spots)
        for name, spot in zip(("rear_light", "rear_low", "rear_plate", "rear_corner"), on_rear, strict=True):
            named[f"{name}_{word}"] = spot
    plate = size.belt - 0.40
    for sign, height in ((1, 0.40), (-1, plate)):
        patch(sign, (-0.28, 0.28), (height - 0.075, height + 0.075), (60, 62, 66))
        patch(sign, (-0.26, 0.26), (height - 0.058, height + 0.058), _PLATE)
        for at in (-0.19, -0.08, 0.05, 0.16):  # The number, or what passes for one.
            patch(sign, (at, at + 0.06), (height - 0.035, height + 0.035), (44, 46, 60))
    return named


def _disc(x: float, y: float, radius: float, height: float) -> np.ndarray:
    angle = np.arange(MAX_CORNERS) * 2 * np.pi / MAX_CORNERS
    up = np.maximum(height + radius * np.sin(angle), 0.004)
    return np.stack([x + radius * np.cos(angle), np.full(MAX_CORNERS, y), up], -1)


def _sides(make: _Builder, size: CarSize) -> dict[str, np.ndarray]:
    """Wheels, door lines and handles; returns the wheels' hubs."""
    half, radius = size.width / 2, size.wheel
    axles = {"front_wheel": size.length / 2 - 0.86, "rear_wheel": -size.length / 2 + 0.84}
    named: dict[str, np.ndarray] = {}
    for side, word in ((1, "left"), (-1, "right")):
        out = (0, side, 0)
        sill = side * (half + 0.006)
        for x in (size.screen_base - 0.25, -0.12, -1.05 if size.length > 4 else -0.95):
            make.detail(np.array([(x, sill, 0.34), (x + 0.014, sill, 0.34), (x + 0.014, sill, size.belt - 0.14),
                                  (x, sill, size.belt - 0.14)]), out, 1, _TRIM)  # fmt: skip
        for x in (-0.02, -0.92):
            make.detail(np.array([(x, sill, size.belt - 0.24), (x + 0.17, sill, size.belt - 0.24),
                                  (x + 0.17, sill, size.belt - 0.205), (x, sill, size.belt - 0.205)]), out, 1,
                        (190, 192, 196))  # fmt: skip
        for name, x in axles.items():
            make.detail(_disc(x, side * (half + 0.008), radius * 1.16, radius * 1.04), out, 1, (20, 20, 22))
            make.detail(_disc(x, side * (half + 0.012), radius, radius), out, 1, (36, 36, 38))
            make.detail(_disc(x, side * (half + 0.016), radius * 0.64, radius), out, 1, (168, 172, 178), gloss=0.2)
            for spoke in range(5):
                a = spoke * 2 * np.pi / 5 + 0.3
                ring = np.array([(np.cos(t), np.sin(t)) for t in (a - 0.3, a + 0.3)]) * radius * 0.56
                tip = np.array(
                    [(x + np.cos(a) * radius * 0.16, side * (half + 0.02), radius + np.sin(a) * radius * 0.16)]
                )
                fan = np.array([(x + px, side * (half + 0.02), radius + pz) for px, pz in ring])
                make.detail(np.concatenate([tip, fan]), out, 1, (70, 72, 76))
            make.detail(_disc(x, side * (half + 0.024), radius * 0.13, radius), out, 1, (200, 202, 206))
            named[f"{name}_{word}"] = np.array([x, side * half, radius])
    for x in axles.values():  # Tyres as seen from ahead or behind, under the body.
        for side in (1, -1):
            box = [(x + dx, side * (half - dy), z) for dx, z in ((-0.22, 0.02), (0.22, 0.02), (-0.3, 0.2), (0.3, 0.2))
                   for dy in (0.02, 0.24)]  # fmt: skip
            make.hull(np.array(box), 0, colour=(30, 30, 32), gloss=0.0)
    return named


def _mirrors(make: _Builder, size: CarSize) -> dict[str, np.ndarray]:
    half = size.width / 2
    named: dict[str, np.ndarray] = {}
    for part, side, word in ((3, 1, "left"), (4, -1, "right")):
        x, inner, outer, low = size.screen_base - 0.32, side * half * 0.9, side * (half + 0.20), size.belt + 0.0
        box = [(x + dx, y, z) for y, dz in ((inner, 0.03), (outer, 0.0)) for dx in (-0.05, 0.07)
               for z in (low + dz, low + 0.15 - dz / 2)]  # fmt: skip
        make.solids.append(make.hull(np.array(box), part, gloss=0.3))
        back, near, far = x - 0.052, inner + side * 0.03, outer - side * 0.02
        glass = np.array([(back, near, low + 0.04), (back, far, low + 0.02), (back, far, low + 0.13),
                          (back, near, low + 0.12)])  # fmt: skip
        make.detail(glass, (-1, 0, 0), part, (78, 88, 100), gloss=0.2)
        named[f"mirror_edge_{word}"] = np.array([x + 0.01, outer, low + 0.075])
    return named


@functools.cache
def car_model(shape: CarShape) -> CarModel:
    """The model of a body shape, built once."""
    size, make = SIZES[shape], _Builder()
    half = size.width / 2
    named = {}
    below = np.array([[0.0, 0.0, 1.0, 0.0]])  # Nothing hides behind the tyres' inner sides: an empty solid.
    body = make.hull(_body(size), 1, gloss=0.35)
    named |= _ends(make, size, body)
    named |= _sides(make, size)
    cabin = make.hull(_cabin(size), 2, gloss=0.35)
    _windows(make, size)
    make.solids += [below, body, cabin]
    named |= _mirrors(make, size)
    for side, word in ((1, "left"), (-1, "right")):
        named[f"front_up_{word}"] = np.array([size.roof_front, side * half * 0.70, size.height - 0.03])
        named[f"rear_up_{word}"] = np.array([size.roof_rear, side * half * 0.70, size.height - 0.03])
        middle = 0.5 * (size.roof_front + size.roof_rear)
        named[f"central_up_{word}"] = np.array([middle, side * half * 0.70, size.height - 0.03])
    return _finished(make, named, size)


def _finished(make: _Builder, named: dict[str, np.ndarray], size: CarSize) -> CarModel:
    count = len(make.corners)
    corners = np.zeros((count, MAX_CORNERS, 3))
    for row, polygon in zip(corners, make.corners, strict=True):
        row[: len(polygon)] = polygon
    normals, parts, colours, gloss, brake, beside, area = zip(*make.rows, strict=True)
    normal = np.array(normals)
    return CarModel(
        corners=corners, corner_count=np.array([len(c) for c in make.corners], np.int32),
        colour=np.array([(255, 255, 255) if c is None else c for c in colours], np.float32),
        painted=np.array([c is None for c in colours]), brake=np.array(brake), normal=normal,
        plane=np.einsum("ij,ij->i", normal, corners[:, 0]), gloss=np.array(gloss, np.float32),
        part=np.array(parts, np.int32), area=np.array(area), beside=np.array(beside, np.int32),
        solids=tuple(make.solids),
        keypoints=np.array([named[name] for name in keypoint_schema("car24").point_names]), size=size,
    )  # fmt: skip


def hidden_by_itself(model: CarModel, eye: np.ndarray) -> np.ndarray:
    """(24,) bool: the points that the car's own solids hide from an eye at (3,) in the car's frame.

    The segment from the eye to a point, ended 3 cm short of it, is cut with the half-spaces of each convex part
    (Cyrus and Beck 1978); a stretch of over 1 cm inside hides the point.
    """
    hidden = np.zeros(len(model.keypoints), np.bool_)
    for solid in model.solids:
        if len(solid) >= 4:
            _mark_hidden(model.keypoints, eye, solid, hidden)
    return hidden


@numba.njit(cache=True)
def _mark_hidden(points, eye, solid, hidden):
    """Set ``hidden`` where the sight line to a point runs through one convex solid (E, 4)."""
    for p in range(len(points)):
        dx, dy, dz = points[p, 0] - eye[0], points[p, 1] - eye[1], points[p, 2] - eye[2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        enter, leave = 0.0, 1.0 - 0.03 / length
        for e in range(len(solid)):
            slope = solid[e, 0] * dx + solid[e, 1] * dy + solid[e, 2] * dz
            offset = solid[e, 0] * eye[0] + solid[e, 1] * eye[1] + solid[e, 2] * eye[2] + solid[e, 3]
            if abs(slope) < 1e-12:
                if offset > 0:
                    leave = -1.0
            elif slope < 0:
                enter = max(enter, -offset / slope)
            else:
                leave = min(leave, -offset / slope)
        if (leave - enter) * length > 0.01:
            hidden[p] = True
