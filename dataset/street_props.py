"""What stands on the synthetic street: textured walls, trees, lamps, an advertising column."""

import numpy as np

from dataset.street_drives import StreetPath
from dataset.street_polygons import Polygons, join, make_polygons
from dataset.street_textures import TEXTURE_METRES, TextureName, texture_index, texture_size


def sunlight(normal: np.ndarray, sun: np.ndarray) -> float:
    """Brightness of a face with a unit normal under a sun in direction ``sun``."""
    return float(0.80 + 0.26 * max(-0.5, normal @ sun))


def wall_polygon(
    foot: np.ndarray, along: np.ndarray, *, outward: np.ndarray, width: float, bottom: float, top: float,
    name: TextureName, tint: np.ndarray, shift_m: float = 0.0,
) -> Polygons:  # fmt: skip
    """An upright textured rectangle from ``foot`` (3,) along the unit vector ``along`` (3,); heights above the foot.

    It is wound so that it is seen from the side that ``outward`` (3,) points to.
    """
    up = np.array([0.0, -1.0, 0.0])
    if np.cross(along, up) @ outward < 0:
        foot, along = foot + along * width, -along
    corners = np.array([
        foot + up * bottom, foot + along * width + up * bottom, foot + along * width + up * top, foot + up * top
    ])  # fmt: skip
    size, metres = texture_size(name), TEXTURE_METRES[name]
    per_m = (size[0] / metres[0], size[1] / metres[1])
    gradient = np.array([
        [*(along * per_m[0]), (shift_m - foot @ along) * per_m[0]],
        [0, per_m[1], 0, -(foot[1] - bottom) * per_m[1]],
    ], np.float32)  # fmt: skip
    return make_polygons([corners], colour=tint, texture=texture_index(name), gradient=gradient)


def frontal_wall(path: StreetPath) -> Polygons:
    """A wide brick wall across the road, 14 m ahead of the camera's start."""
    spot, heading = path.at(14.0)
    right = np.array([np.cos(heading), 0.0, -np.sin(heading)])
    ahead = np.array([np.sin(heading), 0.0, np.cos(heading)])
    common = {"width": 240.0, "tint": np.full(3, 245.0), "outward": -ahead}
    foot = spot - right * 120
    return join([
        wall_polygon(foot, right, bottom=3.6, top=30.0, name="brick", **common),
        wall_polygon(foot, right, bottom=0.0, top=3.6, name="shutters", **common),
    ])  # fmt: skip


COLUMN_AHEAD_M, COLUMN_LATERAL_M, COLUMN_RADIUS_M = 8.5, -1.9, 0.7
"""Where the advertising column stands, from the camera's start."""


def column(path: StreetPath, sun: np.ndarray) -> Polygons:
    """An advertising column between the lanes."""
    foot, _ = path.at(COLUMN_AHEAD_M, COLUMN_LATERAL_M)
    post = upright_prism(foot, radius=COLUMN_RADIUS_M, height=3.0, colour=(200, 196, 184), sun=sun, sides=12)
    posters = np.array([(198, 66, 58), (232, 204, 90), (66, 120, 168), (236, 232, 222)], np.float32)
    sheets = upright_prism(
        foot - (0.0, 0.7, 0.0), radius=COLUMN_RADIUS_M + 0.01, height=1.8, colour=posters[np.arange(12) % 4], sun=sun,
        sides=12,
    )  # fmt: skip
    return join([post, sheets])


def upright_prism(
    foot: np.ndarray, *, radius: float, height: float, colour: np.ndarray | tuple[float, float, float], sun: np.ndarray,
    top_radius: float | None = None, sides: int = 6,
) -> Polygons:  # fmt: skip
    """An upright tapered prism with all its sides, so that it can be painted from anywhere (see ``facing``)."""
    angle = np.arange(sides + 1) * 2 * np.pi / sides
    ring = np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], -1)
    upper = foot + ring * (radius if top_radius is None else top_radius) - (0.0, height, 0.0)
    lower = foot + ring * radius
    quads = [np.array([lower[k], lower[k + 1], upper[k + 1], upper[k]]) for k in range(sides)]
    middle = angle[:-1] + np.pi / sides
    shade = np.array([sunlight(np.array([np.cos(m), 0.0, np.sin(m)]), sun) for m in middle])
    return make_polygons(quads, colour=np.asarray(colour, np.float32) * shade[:, None].astype(np.float32), grow_px=0.4)


def _blob(centre: np.ndarray, radius: float, rng: np.random.Generator, sun: np.ndarray, green: np.ndarray) -> Polygons:
    """A crown: a ball of triangles with shades of leaf, slightly out of round."""
    rows, around = 5, 9
    polar = np.linspace(0, np.pi, rows + 1)
    turn = np.arange(around) * 2 * np.pi / around
    nodes = np.stack([
        np.sin(polar)[:, None] * np.cos(turn), np.broadcast_to(-np.cos(polar)[:, None] * 0.9, (rows + 1, around)),
        np.sin(polar)[:, None] * np.sin(turn),
    ], -1)  # fmt: skip
    size = radius * rng.uniform(0.86, 1.1, (rows + 1, around))
    size[0], size[-1] = size[0, 0], size[-1, 0]
    nodes = centre + nodes * size[..., None]
    after = np.roll(nodes, -1, axis=1)
    upper = np.stack([nodes[1:-1], after[1:-1], after[2:]], axis=2)
    lower = np.stack([nodes[:-2], after[1:-1], nodes[1:-1]], axis=2)
    faces = np.concatenate([upper.reshape(-1, 3, 3), lower.reshape(-1, 3, 3)])
    normal = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    inward = np.einsum("ij,ij->i", normal, faces.mean(axis=1) - centre) < 0
    faces[inward] = faces[inward][:, ::-1]
    normal[inward] *= -1
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    shade = 0.95 + 0.35 * np.clip(normal @ sun, -0.8, 1) - 0.12 * np.clip(normal[:, 1], 0, 1)
    shade += rng.normal(0, 0.02, len(faces))
    across = np.cross(normal, (0.0, 1.0, 0.0)) + (1e-6, 0.0, 0.0)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    per_m = texture_size("leaves")[0] / TEXTURE_METRES["leaves"][0]
    gradient = np.zeros((len(faces), 2, 4))
    gradient[:, 0, :3], gradient[:, 1, :3] = across * per_m, np.cross(normal, across) * per_m
    gradient[:, :, 3] = -np.einsum("nij,j->ni", gradient[:, :, :3], centre) + rng.uniform(0, 256, (1, 2))
    return make_polygons(
        faces, colour=green * shade[:, None], texture=texture_index("leaves"), gradient=gradient, soft=0
    )


def tree(spot: np.ndarray, rng: np.random.Generator, sun: np.ndarray) -> Polygons:
    """A trunk and three crowns of leaves."""
    height = float(rng.uniform(2.2, 3.2))
    green = np.array([134, 158, 104]) * rng.uniform(0.85, 1.2) + rng.normal(0, 6, 3)
    parts = [upright_prism(spot, radius=0.16, top_radius=0.10, height=height + 0.6, colour=(96, 78, 62), sun=sun)]
    for _ in range(3):
        centre = spot + (rng.normal(0, 0.45), -height - rng.uniform(0.5, 1.8), rng.normal(0, 0.45))
        parts.append(_blob(centre, float(rng.uniform(1.0, 1.5)), rng, sun, green))
    return join(parts)


def lamp_post(spot: np.ndarray, to_road: np.ndarray, sun: np.ndarray) -> Polygons:
    """A street lamp whose arm reaches over the road."""
    grey = (92.0, 98.0, 100.0)
    pole = upright_prism(spot, radius=0.085, top_radius=0.055, height=6.4, colour=grey, sun=sun)
    tip = spot - (0.0, 6.35, 0.0)
    side = np.array([to_road[2], 0.0, -to_road[0]])
    arm = [np.array([tip, tip + to_road * 1.6, tip + to_road * 1.6 + (0, 0.1, 0), tip + (0, 0.1, 0)])]
    head = tip + to_road * 1.5
    near, far = np.array([head - side * 0.12, head + side * 0.12]), to_road * 0.6
    lamp = [np.array([near[0], near[1], near[1] + far, near[0] + far])]
    arm += [arm[0][::-1]]
    lamp += [lamp[0][::-1]]
    return join([pole, make_polygons(arm, colour=grey), make_polygons(lamp, colour=(236.0, 232.0, 214.0))])
