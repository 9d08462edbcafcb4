"""The synthetic street's still world: ground, road markings, buildings, trees and poles, laid along a path.

Everything is a pure function of the path, the plan and the seed.
"""

from dataclasses import dataclass

import numpy as np

from dataset.street_drives import StreetPath
from dataset.street_polygons import ALL_SOFT, Polygons, join, make_polygons
from dataset.street_props import column, frontal_wall, lamp_post, sunlight, tree, wall_polygon
from dataset.street_textures import FACADES, GROUND_FLOORS, TEXTURE_METRES, TextureName, texture_index, texture_size

LANE_WIDTH_M = 3.5
_MARK_HALF_M = 0.075
_DASH_M, _GAP_M = 3.0, 6.0
_WHITE, _YELLOW = (226.0, 226.0, 222.0), (220.0, 182.0, 74.0)
_BASE_DROP_M = 0.3
_SIDES = 0b0101


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneLine:
    """A line painted along the road."""

    lateral_m: float
    """To the right of the camera's path."""
    dashed: bool
    yellow: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetPlan:
    """The cross-section of the road and what stands beside it; lateral metres, positive to the right."""

    lines: tuple[LaneLine, ...]
    lanes: tuple[tuple[float, int], ...]
    """Middle and direction (1 with the camera, -1 against it) of every lane but the camera's own."""
    left_m: float
    """Kerb on the left, negative."""
    right_m: float
    """Kerb on the right."""
    pavement_m: float
    buildings: bool
    trees: bool
    wall: bool
    """A textured wall across the road, 14 m ahead of the camera's start."""
    column: bool
    """An advertising column between the lanes, behind which people can disappear."""


def plan_street(
    rng: np.random.Generator, *, parking: bool, buildings: bool, trees: bool, wall: bool = False, column: bool = False
) -> StreetPlan:
    """A road of one or two lanes each way with the camera in a lane of the right half."""
    right_lanes = int(rng.integers(0, 2))
    left_lanes = int(rng.integers(1, 3))
    yellow = bool(rng.random() < 0.5)
    half = LANE_WIDTH_M / 2
    lines = [LaneLine(lateral_m=-half, dashed=bool(rng.random() < 0.4), yellow=yellow)]
    lanes = []
    for index in range(right_lanes):
        lines.append(LaneLine(lateral_m=half + index * LANE_WIDTH_M, dashed=True, yellow=False))
        lanes.append(((index + 1) * LANE_WIDTH_M, 1))
    for index in range(left_lanes):
        lanes.append((-(index + 1) * LANE_WIDTH_M, -1))
        if index:
            lines.append(LaneLine(lateral_m=-half - index * LANE_WIDTH_M, dashed=True, yellow=False))
    edge_right, edge_left = half + right_lanes * LANE_WIDTH_M, -half - left_lanes * LANE_WIDTH_M
    lines += [LaneLine(lateral_m=edge, dashed=False, yellow=False) for edge in (edge_right, edge_left)]
    strip = 2.4 if parking else 0.5
    return StreetPlan(
        lines=tuple(lines), lanes=tuple(lanes), left_m=edge_left - strip, right_m=edge_right + strip,
        pavement_m=float(rng.uniform(2.8, 4.2)), buildings=buildings, trees=trees, wall=wall, column=column,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StillWorld:
    """Polygons of the still world with what is needed to choose and order them per frame."""

    ground: Polygons
    """Painted first, in this order."""
    ground_middle: np.ndarray
    """(N, 3) float64."""
    ground_is_base: np.ndarray
    """(N,) bool: too large to be chosen by its middle."""
    things: tuple[Polygons, ...]
    """Houses, trees, poles; the polygons of each in painting order."""
    thing_middle: np.ndarray
    """(G, 3) float64."""
    thing_radius: np.ndarray
    """(G,) float64."""


def build_world(path: StreetPath, plan: StreetPlan, rng: np.random.Generator, *, sun: np.ndarray) -> StillWorld:
    """The still world along a path."""
    base = _base_ground(path)
    ground = join([base, *_ribbons(path, plan), *_markings(path, plan)])
    things: list[Polygons] = []
    if plan.buildings:
        things += _buildings(path, plan, rng, sun)
    if plan.trees:
        things += _furniture(path, plan, rng, sun)
    if plan.wall:
        things.append(frontal_wall(path))
    if plan.column:
        things.append(column(path, sun))
    boxes = np.array([_box(thing) for thing in things]).reshape(-1, 2, 3)
    return StillWorld(
        ground=ground, ground_middle=_middles(ground), things=tuple(things),
        ground_is_base=np.arange(len(ground)) < (len(base) if len(base) == 1 else 0),
        thing_middle=boxes.mean(axis=1), thing_radius=0.5 * np.linalg.norm(boxes[:, 1] - boxes[:, 0], axis=1),
    )  # fmt: skip


def _middles(polygons: Polygons) -> np.ndarray:
    used = np.arange(polygons.corners.shape[1])[None] < polygons.corner_count[:, None]
    return (polygons.corners * used[..., None]).sum(axis=1) / polygons.corner_count[:, None]


def _box(thing: Polygons) -> tuple[np.ndarray, np.ndarray]:
    used = np.arange(thing.corners.shape[1])[None] < thing.corner_count[:, None]
    corners = thing.corners[used].astype(np.float64)
    return corners.min(axis=0), corners.max(axis=0)


def ground_gradient(name: TextureName) -> np.ndarray:
    """(2, 4): a ground texture laid over the street's x and z."""
    width, height = texture_size(name)
    metres = TEXTURE_METRES[name]
    return np.array([[width / metres[0], 0, 0, 0], [0, 0, height / metres[1], 0]], np.float32)


def _base_ground(path: StreetPath) -> Polygons:
    """Grass under everything: one level square, or patches that follow the path's elevation."""
    gradient = ground_gradient("grass")
    if np.ptp(path.elevation) < 1e-6:
        reach = 4000.0
        square = np.array([(-reach, 0, -reach), (reach, 0, -reach), (reach, 0, reach), (-reach, 0, reach)])
        return make_polygons([square], texture=texture_index("grass"), gradient=gradient, soft=0)
    step = 24.0
    low = path.points_xz.min(axis=0) - 360
    nodes = [np.arange(low[axis], path.points_xz[:, axis].max() + 360, step) for axis in (0, 1)]
    grid = np.stack(np.meshgrid(*nodes, indexing="ij"), -1)
    knots = path.points_xz[::16]
    flat = grid.reshape(-1, 2)
    nearest = np.concatenate([
        np.argmin(np.linalg.norm(rows[:, None] - knots[None], axis=-1), axis=1) for rows in np.array_split(flat, 64)
    ])  # fmt: skip
    height = path.elevation[::16][nearest].reshape(grid.shape[:2]) - _BASE_DROP_M
    patches = []
    for i in range(grid.shape[0] - 1):
        for j in range(grid.shape[1] - 1):
            ring = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
            corners = np.array([(grid[a][0], -height[a], grid[a][1]) for a in ring])
            patches += [corners[[0, 1, 2]], corners[[0, 2, 3]]]
    return make_polygons(patches, texture=texture_index("grass"), gradient=gradient, soft=0)


def _stations(path: StreetPath, start: float, end: float, *, longest: float = 8.0) -> np.ndarray:
    """Arc lengths that cut the path into pieces, shorter where it bends (chords stay within 1 cm of it)."""
    out = [start]
    while out[-1] < end - 1e-6:
        ahead = np.abs(path.curvature(out[-1] + np.linspace(0, longest, 9))).max()
        out.append(min(end, out[-1] + min(longest, np.sqrt(8 * 0.01 / max(ahead, 1e-6)))))
    return np.array(out)


def _ribbon(path: StreetPath, arcs: np.ndarray, left: float, right: float) -> list[np.ndarray]:
    """Quads between two lateral offsets, cut where the inner side of a bend would fold over."""
    bend = path.curvature(arcs)
    with np.errstate(divide="ignore"):
        limit = np.where(np.abs(bend) > 1e-4, 0.92 / np.maximum(np.abs(bend), 1e-9), np.inf)
    a = np.where(bend < 0, np.maximum(left, -limit), left)
    b = np.where(bend > 0, np.minimum(right, limit), right)
    first, _ = path.at(arcs, np.minimum(a, b))
    second, _ = path.at(arcs, b)
    return [np.array([first[k], first[k + 1], second[k + 1], second[k]]) for k in range(len(arcs) - 1)]


def _ribbons(path: StreetPath, plan: StreetPlan) -> list[Polygons]:
    arcs = _stations(path, path.start_m + 1, path.end_m - 1)
    kerb, gutter, yard = 0.28, 0.12, 9.0 if plan.buildings else 0.0  # In the open the verge is grass.
    strips: list[tuple[TextureName, float, float, float]] = [("asphalt", 255.0, plan.left_m, plan.right_m)]
    beside: tuple[tuple[TextureName, float], ...] = (("asphalt", 140.0), ("pavement", 290.0), ("pavement", 250.0))
    for side, edge in ((-1, plan.left_m), (1, plan.right_m)):
        cuts = (edge, edge + side * gutter, edge + side * (gutter + kerb), edge + side * (plan.pavement_m + yard))
        for (name, shade), a, b in zip(beside, cuts[:-1], cuts[1:], strict=True):
            if abs(b - a) > 0.05 and (plan.buildings or shade != 250.0):
                strips.append((name, shade, min(a, b), max(a, b)))
    return [
        make_polygons(
            _ribbon(path, arcs, left, right), colour=(shade, shade, shade), texture=texture_index(name),
            gradient=ground_gradient(name), soft=_SIDES,
        )
        for name, shade, left, right in strips
    ]  # fmt: skip


def _markings(path: StreetPath, plan: StreetPlan) -> list[Polygons]:
    parts = []
    for line in plan.lines:
        edges = (line.lateral_m - _MARK_HALF_M, line.lateral_m + _MARK_HALF_M)
        quads: list[np.ndarray] = []
        if line.dashed:
            for start in np.arange(path.start_m + 1, path.end_m - 8, _DASH_M + _GAP_M):
                quads += _ribbon(path, _stations(path, start, start + _DASH_M, longest=1.5), *edges)
        else:
            quads = _ribbon(path, _stations(path, path.start_m + 1, path.end_m - 1, longest=4.0), *edges)
        colour = _YELLOW if line.yellow else _WHITE
        parts.append(
            make_polygons(
                quads, colour=colour, grow_px=0.3 if line.dashed else 0.0, soft=ALL_SOFT if line.dashed else _SIDES
            )
        )
    return parts


def _building(
    path: StreetPath, arc: float, side: int, offset: float, width: float, rng: np.random.Generator, sun: np.ndarray
) -> Polygons:
    """A house with its front to the road: shop, floors, cornice, and the two walls towards its gaps."""
    middle, heading = path.at(arc + width / 2, side * offset)
    forward = np.array([np.sin(heading), 0.0, np.cos(heading)])
    right = np.array([np.cos(heading), 0.0, -np.sin(heading)])
    floors = int(rng.integers(2, 6))
    ground_m, floor_m = 3.6, 3.2
    top = ground_m + floors * floor_m
    depth = float(rng.uniform(6, 11))
    foot = middle - forward * width / 2
    tint = np.clip(rng.normal(1.0, 0.09) + rng.normal(0, 0.05, 3), 0.7, 1.15) * 255
    front = tint * sunlight(-side * right, sun)
    name = FACADES[int(rng.integers(len(FACADES)))]
    below = GROUND_FLOORS[int(rng.random() < 0.45)]
    shift = float(rng.integers(0, 4)) * 3.2
    parts = []
    for start, direction in ((foot, -forward), (foot + forward * width, forward)):
        parts.append(
            wall_polygon(
                start,
                right * side,
                outward=direction,
                width=depth,
                bottom=0,
                top=top,
                name="wall",
                tint=tint * sunlight(direction, sun),
            )
        )
    common = {"tint": front, "shift_m": shift, "outward": -side * right}
    parts.append(wall_polygon(foot, forward, width=width, bottom=ground_m, top=top, name=name, **common))
    parts.append(wall_polygon(foot, forward, width=width, bottom=0, top=ground_m, name=below, **common))
    ledge = foot - right * side * 0.05
    for bottom, high, share in ((ground_m - 0.12, ground_m + 0.12, 0.8), (top - 0.05, top + 0.45, 0.7)):
        parts.append(
            wall_polygon(
                ledge,
                forward,
                outward=-side * right,
                width=width,
                bottom=bottom,
                top=high,
                name="wall",
                tint=front * share,
            )
        )
    return join(parts)


def _buildings(path: StreetPath, plan: StreetPlan, rng: np.random.Generator, sun: np.ndarray) -> list[Polygons]:
    houses = []
    for side, kerb in ((-1, -plan.left_m), (1, plan.right_m)):
        arc = path.start_m + 4
        while arc < path.end_m - 30:
            width = float(rng.uniform(9, 17))
            offset = kerb + plan.pavement_m + float(rng.uniform(0.1, 0.8))
            # On the outside of a bend the fronts fan out, on the inside they crowd: steps follow the fronts' length.
            stretch = 1.0 - float(path.curvature(np.linspace(arc, arc + width, 5)).mean()) * side * offset
            step = width / max(stretch, 0.25)
            house = _building(path, arc + (step - width) / 2, side, offset, width, rng, sun)
            if stretch > 0.3 and not _on_road(path, plan, house):
                houses.append(house)
            arc += step + (0.3 if rng.random() < 0.8 else float(rng.uniform(2, 7)))
    return houses


def _on_road(path: StreetPath, plan: StreetPlan, thing: Polygons) -> bool:
    """Whether a thing's foot (corners and the middles between them) stands on the road, on any stretch of it."""
    corners = thing.corners[:, :4, [0, 2]].reshape(-1, 2).astype(np.float64)
    spots = np.unique(np.round(np.concatenate([corners, 0.5 * (corners + np.roll(corners, 1, axis=0))]), 1), axis=0)
    return not _beside_road(path, plan, spots, margin_m=0.9)


def _beside_road(path: StreetPath, plan: StreetPlan, spots_xz: np.ndarray, *, margin_m: float) -> bool:
    """Whether all spots (n, 2) lie outside the kerbs of every stretch of the road, by a margin."""
    line, heading = path.points_xz[::2], path.heading[::2]
    offset = spots_xz[:, None] - line
    lateral = offset[..., 0] * np.cos(heading) - offset[..., 1] * np.sin(heading)
    along = offset[..., 0] * np.sin(heading) + offset[..., 1] * np.cos(heading)
    on_road = (np.abs(along) < 1.0) & (lateral > plan.left_m - margin_m) & (lateral < plan.right_m + margin_m)
    return not on_road.any()


def _furniture(path: StreetPath, plan: StreetPlan, rng: np.random.Generator, sun: np.ndarray) -> list[Polygons]:
    """Trees and lamps along both kerbs, never on another stretch of the road."""
    things = []
    for side, kerb in ((-1, -plan.left_m), (1, plan.right_m)):
        arc = path.start_m + 6 + float(rng.uniform(0, 8))
        while arc < path.end_m - 10:
            lamp = rng.random() < 0.3
            spot, heading = path.at(arc, side * (kerb + (0.6 if plan.buildings else float(rng.uniform(1.0, 6.0)))))
            right = np.array([np.cos(heading), 0.0, -np.sin(heading)])
            thing = lamp_post(spot, -side * right, sun) if lamp else tree(spot, rng, sun)
            bends = float(path.curvature(np.array(arc))) * side
            if bends < 0.5 / kerb and _beside_road(path, plan, spot[None, [0, 2]], margin_m=0.2):
                things.append(thing)
            arc += float(rng.uniform(9, 17))
    return things


def facing(polygons: Polygons, eye: np.ndarray) -> np.ndarray:
    """(N,) bool: faces that turn towards ``eye``."""
    a = polygons.corners[:, 0]
    ab, ac, back = polygons.corners[:, 1] - a, polygons.corners[:, 2] - a, a - eye.astype(np.float32)
    normal_x = ab[:, 1] * ac[:, 2] - ab[:, 2] * ac[:, 1]
    normal_y = ab[:, 2] * ac[:, 0] - ab[:, 0] * ac[:, 2]
    normal_z = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    return normal_x * back[:, 0] + normal_y * back[:, 1] + normal_z * back[:, 2] < 0
