"""Walking people of the synthetic street: an articulated body of prisms with the 17 joints of COCO.

A person's own frame is x forward, y left, z up, origin on the ground, metres. The gait is a sinusoidal swing of hips
and shoulders with knees that bend while their leg comes forward; phase is driven by the distance walked, so feet do
not slide much.
"""

from dataclasses import dataclass

import numba
import numpy as np

from dataset.street_polygons import ALL_SOFT, MAX_CORNERS, Polygons

_RING = 8
COCO17_NAMES = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle",
    "right_ankle",
)  # fmt: skip
_INDEX = {name: index for index, name in enumerate(COCO17_NAMES)}


@dataclass(frozen=True, slots=True, kw_only=True)
class PersonLook:
    """Size and clothes."""

    height: float
    """Metres."""
    top: tuple[float, float, float]
    """RGB of the jacket."""
    trousers: tuple[float, float, float]
    skin: tuple[float, float, float]
    hair: tuple[float, float, float]
    shoes: tuple[float, float, float]
    sleeves: bool
    """Long sleeves; else forearms are skin."""


_TOPS = ((178, 44, 52), (40, 74, 140), (222, 214, 196), (56, 60, 66), (214, 156, 52), (52, 116, 92), (150, 88, 140),
         (232, 232, 236), (96, 132, 168), (200, 96, 56))  # fmt: skip
_TROUSERS = ((38, 46, 72), (44, 44, 48), (98, 88, 76), (62, 78, 104), (120, 112, 98))
_SKINS = ((232, 190, 160), (206, 158, 124), (150, 104, 78), (104, 70, 54))
_HAIRS = ((40, 32, 28), (86, 60, 40), (24, 22, 24), (168, 134, 84), (140, 136, 132))


def random_look(rng: np.random.Generator) -> PersonLook:
    """Somebody."""

    def pick(table: tuple[tuple[int, int, int], ...]) -> tuple[float, float, float]:
        red, green, blue = table[int(rng.integers(len(table)))]
        return float(red), float(green), float(blue)

    return PersonLook(
        height=float(rng.uniform(1.58, 1.9)), top=pick(_TOPS), trousers=pick(_TROUSERS), skin=pick(_SKINS),
        hair=pick(_HAIRS), shoes=pick(((40, 36, 34), (220, 220, 220), (110, 70, 44))), sleeves=bool(rng.random() < 0.6),
    )  # fmt: skip


def joints_at(look: PersonLook, *, walked_m: float, speed_mps: float) -> np.ndarray:
    """(17, 3) joints in the person's frame after ``walked_m`` at ``speed_mps`` (0 stands still)."""
    h = look.height
    phase = 2 * np.pi * walked_m / (0.82 * h)
    effort = min(1.0, speed_mps / 1.2)
    bob = 0.018 * effort * np.cos(2 * phase)
    points = np.zeros((17, 3))
    for side, word in ((1, "left"), (-1, "right")):
        swing = phase + (0.0 if side > 0 else np.pi)
        hip = np.array([0.0, side * 0.058 * h, 0.53 * h + bob])
        thigh = 0.42 * effort * np.sin(swing)
        bend = effort * (0.10 + 0.85 * max(0.0, np.cos(swing)) ** 1.5) + 0.03
        knee = hip + 0.245 * h * np.array([np.sin(thigh), 0.0, -np.cos(thigh)])
        shin = thigh - bend
        ankle = knee + 0.245 * h * np.array([np.sin(shin), 0.0, -np.cos(shin)])
        shoulder = np.array([0.0, side * 0.118 * h, 0.82 * h + bob])
        arm = -0.38 * effort * np.sin(swing)
        elbow = shoulder + 0.165 * h * np.array([np.sin(arm), side * 0.16, -np.cos(arm)])
        fore = arm + 0.25 + 0.2 * effort
        wrist = elbow + 0.145 * h * np.array([np.sin(fore), 0.0, -np.cos(fore)])
        eye = np.array([0.052 * h, side * 0.018 * h, 0.936 * h + bob])
        ear = np.array([0.0, side * 0.044 * h, 0.928 * h + bob])
        for name, point in (("hip", hip), ("knee", knee), ("ankle", ankle), ("shoulder", shoulder), ("elbow", elbow),
                            ("wrist", wrist), ("eye", eye), ("ear", ear)):  # fmt: skip
            points[_INDEX[f"{word}_{name}"]] = point
    points[_INDEX["nose"]] = (0.062 * h, 0.0, 0.915 * h + bob)
    points[:, 2] -= max(0.0, points[[15, 16], 2].min() - 0.056 * h)
    return points


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Limbs:
    """A body as tapered prisms."""

    start: np.ndarray
    """(P, 3) centres of the lower rings."""
    end: np.ndarray
    """(P, 3)."""
    radii: np.ndarray
    """(P, 4): start forward, start sideways, end forward, end sideways; metres."""
    colour: np.ndarray
    """(P, 3)."""
    head: np.ndarray
    """(P,) bool: prisms that are hair on top and behind, skin in front."""


def limbs(look: PersonLook, points: np.ndarray) -> Limbs:
    """The prisms of a body with the given joints (17, 3)."""
    h = look.height

    def at(name: str) -> np.ndarray:
        return points[_INDEX[name]]

    rows: list[tuple] = []
    for word in ("left", "right"):
        shoulder, elbow, wrist = at(f"{word}_shoulder"), at(f"{word}_elbow"), at(f"{word}_wrist")
        hip, knee, ankle = at(f"{word}_hip"), at(f"{word}_knee"), at(f"{word}_ankle")
        fore = look.top if look.sleeves else look.skin
        hand = wrist + (wrist - elbow) * 0.42
        toe = ankle + np.array([0.10 * h, 0.0, -0.028 * h])
        heel = ankle + np.array([-0.025 * h, 0.0, -0.022 * h])
        rows += [
            (hip, knee, (0.053, 0.050, 0.038, 0.036), look.trousers),
            (knee, ankle, (0.038, 0.036, 0.026, 0.025), look.trousers),
            (heel, toe, (0.024, 0.026, 0.014, 0.026), look.shoes),
            (shoulder, elbow, (0.034, 0.032, 0.027, 0.025), look.top),
            (elbow, wrist, (0.026, 0.024, 0.020, 0.018), fore), (wrist, hand, (0.018, 0.014, 0.016, 0.010), look.skin),
        ]  # fmt: skip
    middle = 0.5 * (at("left_hip") + at("right_hip"))
    chest = 0.5 * (at("left_shoulder") + at("right_shoulder"))
    waist, top = middle + (chest - middle) * 0.38, chest + np.array([0, 0, 0.022 * h])
    breast = middle + (chest - middle) * 0.86
    crown = chest + np.array([0.004 * h, 0.0, 0.0])

    def lift(share: float) -> np.ndarray:
        return crown + np.array([0.006 * h, 0.0, share * h])

    rows += [
        (middle + np.array([0, 0, -0.035 * h]), waist, (0.062, 0.094, 0.058, 0.084), look.trousers),
        (middle + np.array([0, 0, 0.03 * h]), breast, (0.064, 0.092, 0.066, 0.116), look.top),
        (breast, top, (0.066, 0.116, 0.040, 0.074), look.top),
        (chest, chest + np.array([0, 0, 0.075 * h]), (0.032, 0.032, 0.030, 0.030), look.skin),
    ]  # fmt: skip
    body = len(rows)
    for low, high, wide, next_wide in ((0.050, 0.078, 0.030, 0.046), (0.078, 0.122, 0.046, 0.053),
                                       (0.122, 0.154, 0.053, 0.043), (0.154, 0.172, 0.043, 0.016)):  # fmt: skip
        rows.append((lift(low), lift(high), (wide, wide * 0.82, next_wide, next_wide * 0.82), look.skin))
    start, end, radii, colour = zip(*rows, strict=True)
    head = np.zeros(len(rows), bool)
    head[body:] = True
    return Limbs(
        start=np.array(start),
        end=np.array(end),
        radii=np.array(radii) * h,
        colour=np.array(colour, np.float32),
        head=head,
    )


def _rings(parts: Limbs) -> tuple[np.ndarray, np.ndarray]:
    """(P, 8, 3) lower and upper rings."""
    along = parts.end - parts.start
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.array([0.0, 1.0, 0.0]) - along * along[:, 1:2]
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    front = np.cross(side, along)
    angle = (np.arange(_RING) + 0.5) * 2 * np.pi / _RING
    c, s = np.cos(angle)[None, :, None], np.sin(angle)[None, :, None]

    def ring(centre: np.ndarray, forward: np.ndarray, sideways: np.ndarray) -> np.ndarray:
        return (
            centre[:, None] + c * front[:, None] * forward[:, None, None] + s * side[:, None] * sideways[:, None, None]
        )

    return ring(parts.start, *parts.radii[:, :2].T), ring(parts.end, *parts.radii[:, 2:].T)


def person_polygons(
    look: PersonLook, points: np.ndarray, *, own_to_street: np.ndarray, eye: np.ndarray, sun: np.ndarray, owner: int
) -> Polygons:
    """The faces towards an eye at (3,) in street axes, back to front, lit by a sun in direction (3,)."""
    parts = limbs(look, points)
    low, high = _rings(parts)
    count = len(low)
    after = np.roll(np.arange(_RING), -1)
    corners = np.zeros((count, _RING + 2, MAX_CORNERS, 3))
    corners[:, :_RING, :4] = np.stack([low, low[:, after], high[:, after], high], axis=2)
    corners[:, _RING, :_RING] = low[:, ::-1]
    corners[:, _RING + 1, :_RING] = high
    number = np.full((count, _RING + 2), 4, np.int32)
    number[:, _RING:] = _RING
    colour = np.broadcast_to(parts.colour[:, None], (count, _RING + 2, 3)).copy()
    facing = np.cos((np.arange(_RING) + 1) * 2 * np.pi / _RING)
    hairy = np.nonzero(parts.head)[0]
    for order, part in enumerate(hairy):
        colour[part, :_RING][facing < (-0.5, 0.1, 0.5, 2.0)[order]] = look.hair
        colour[part, _RING + 1] = look.hair
    order = np.argsort(
        -np.linalg.norm(0.5 * (parts.start + parts.end) @ own_to_street[:3, :3].T + own_to_street[:3, 3] - eye, axis=1),
        kind="stable",
    )
    face = _face(look, points)
    corners = np.concatenate([corners[order].reshape(-1, MAX_CORNERS, 3), face])
    number = np.concatenate([number[order].reshape(-1), np.full(len(face), 4, np.int32)])
    colour = np.concatenate([colour[order].reshape(-1, 3), _face_colours(look)])
    placed = corners @ own_to_street[:3, :3].T + own_to_street[:3, 3]
    normal = np.cross(placed[:, 1] - placed[:, 0], placed[:, 2] - placed[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    outward = np.einsum("ij,ij->i", normal, placed[:, 0] - eye) < 0
    light = 0.62 + 0.38 * np.clip(normal @ sun, -0.4, 1.0) - 0.10 * np.clip(normal[:, 1], 0, 1)
    lit = np.clip(colour * light[:, None], 0, 255).astype(np.float32)
    total = len(lit)
    return Polygons(
        corners=placed.astype(np.float32), corner_count=number, colour=lit, texture=np.full(total, -1, np.int32),
        gradient=np.zeros((total, 2, 4), np.float32), owner=np.full(total, owner, np.int32),
        alpha=np.ones(total, np.float32), grow_px=np.zeros(total, np.float32), soft=_outline(outward, count),
        fog=np.ones(total, np.float32),
    ).take(np.flatnonzero(outward))  # fmt: skip


def _outline(outward: np.ndarray, prisms: int) -> np.ndarray:
    """Soft edges (bit masks) of prism faces: those whose neighbour looks away; all of the details that follow."""
    seen = outward[: prisms * (_RING + 2)].reshape(prisms, _RING + 2)
    away, low, high = ~seen[:, :_RING], ~seen[:, _RING], ~seen[:, _RING + 1]
    soft = np.empty((prisms, _RING + 2), np.int32)
    soft[:, :_RING] = low[:, None] + 2 * np.roll(away, -1, axis=1) + 4 * high[:, None] + 8 * np.roll(away, 1, axis=1)
    soft[:, _RING] = (away[:, (_RING - 2 - np.arange(_RING)) % _RING] << np.arange(_RING)).sum(axis=1)
    soft[:, _RING + 1] = (away << np.arange(_RING)).sum(axis=1)
    return np.concatenate([soft.ravel(), np.full(len(outward) - soft.size, ALL_SOFT, np.int32)])


def _face(look: PersonLook, points: np.ndarray) -> np.ndarray:
    """Eyes, nose and ears as small quads just off the head: (5, MAX_CORNERS, 3)."""
    h = look.height
    quads = np.zeros((5, MAX_CORNERS, 3))
    for row, name, half_y, half_z in (
        (0, "left_eye", 0.007, 0.0045),
        (1, "right_eye", 0.007, 0.0045),
        (2, "nose", 0.007, 0.011),
    ):
        x, y, z = points[_INDEX[name]]
        a, b = half_y * h, half_z * h
        quads[row, :4] = [(x, y - a, z - b), (x, y + a, z - b), (x, y + a, z + b), (x, y - a, z + b)]
    for row, side, name in ((3, 1, "left_ear"), (4, -1, "right_ear")):
        x, y, z = points[_INDEX[name]]
        y += side * 0.004 * h
        quad = [(x + 0.010 * h, y, z - 0.015 * h), (x - 0.010 * h, y, z - 0.015 * h), (x - 0.012 * h, y, z + 0.015 * h),
                (x + 0.010 * h, y, z + 0.015 * h)]  # fmt: skip
        quads[row, :4] = quad if side > 0 else quad[::-1]
    return quads


def _face_colours(look: PersonLook) -> np.ndarray:
    skin = np.array(look.skin)
    return np.array([(40, 34, 34), (40, 34, 34), skin * 0.86, skin * 0.9, skin * 0.9], np.float32)


_BONES = (
    ("left_shoulder", "left_elbow", 0.03), ("right_shoulder", "right_elbow", 0.03), ("left_elbow", "left_wrist", 0.022),
    ("right_elbow", "right_wrist", 0.022), ("left_hip", "left_knee", 0.044), ("right_hip", "right_knee", 0.044),
    ("left_knee", "left_ankle", 0.030), ("right_knee", "right_ankle", 0.030),
)  # fmt: skip


def hidden_by_itself(look: PersonLook, points: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """(17,) bool: joints that other limbs hide from an eye at (3,) in the person's frame.

    A joint lies inside its own limb; it is hidden when the line of sight passes through the torso, the head or a limb
    that it does not belong to, nearer to the eye. Face points are hidden when they look away.
    """
    h = look.height
    hidden = np.zeros(17, bool)
    for row, (a, b, radius) in enumerate(_BONES):
        hidden |= _through(points[_INDEX[a]], points[_INDEX[b]], radius * h, points, eye) & ~_OWN[row]
    hip, chest = points[[11, 12]].mean(axis=0), points[[5, 6]].mean(axis=0)
    ahead = np.array([0.0, 0.05 * h, 0.0])
    torso = np.zeros(17, bool)
    for share in (-1.0, 0.0, 1.0):
        torso |= _through(hip + ahead * (0.8 * share), chest + ahead * (1.1 * share), 0.052 * h, points, eye)
    # Shoulders and hips lie in the torso's own edge: they are hidden only from the far side.
    hidden |= torso & ~_IN_TORSO
    for left, right in ((5, 6), (11, 12)):
        across = (points[left] - points[right]) @ (eye - points[[left, right]].mean(axis=0))
        share = across / np.linalg.norm(points[left] - points[right]) / np.linalg.norm(eye - points[left])
        if abs(share) > 0.87:
            hidden[right if share > 0 else left] = True
    look_at = eye - points[0]
    look_at /= np.linalg.norm(look_at)
    hidden[0] |= look_at[0] < -0.05
    for eye_index, ear_index, side in ((1, 3, 1.0), (2, 4, -1.0)):
        hidden[eye_index] |= look_at[0] + 0.5 * side * look_at[1] < 0.15
        hidden[ear_index] |= side * look_at[1] < (0.12 if look_at[0] > 0 else 0.25)
    return hidden


_OWN = np.array([[name in bone[:2] for name in COCO17_NAMES] for bone in _BONES])
_IN_TORSO = np.array([name.endswith(("shoulder", "hip")) for name in COCO17_NAMES])


@numba.njit(cache=True)
def _through(a, b, radius, points, eye):
    """(n,) bool: the segment from ``eye`` to each of (n, 3) points passes within ``radius`` of the bone a-b, in front.

    Closest approach of two segments (Ericson 2004, section 5.1.9), the sight line taken as a line.
    """
    out = np.zeros(len(points), np.bool_)
    bone, offset = b - a, eye - a
    bb, bo = (bone * bone).sum(), (bone * offset).sum()
    for p in range(len(points)):
        sight = points[p] - eye
        ss, sb, so = (sight * sight).sum(), (sight * bone).sum(), (sight * offset).sum()
        t = min(1.0, max(0.0, (bo * ss - so * sb) / max(ss * bb - sb * sb, 1e-12)))
        s = (t * sb - so) / ss
        gap = offset + sight * s - bone * t
        front = (1.0 - s) * np.sqrt(ss)
        out[p] = (gap * gap).sum() < radius * radius and front > radius + 0.03 and s > 0
    return out
