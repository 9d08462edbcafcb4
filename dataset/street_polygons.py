"""What the synthetic street is painted from and on: lists of convex polygons in 3-D, an atlas of textures, a canvas."""

from dataclasses import dataclass

import numpy as np

MAX_CORNERS = 12
NO_OWNER = 0
NO_TEXTURE = -1
ALL_SOFT = (1 << MAX_CORNERS) - 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Polygons:
    """Convex planar polygons in world coordinates, in painting order."""

    corners: np.ndarray
    """(N, MAX_CORNERS, 3) float32, metres; rows past ``corner_count`` are ignored."""
    corner_count: np.ndarray
    """(N,) int32, 3 to MAX_CORNERS."""
    colour: np.ndarray
    """(N, 3) float32, 0 to 255; a texture is multiplied by ``colour / 255``."""
    texture: np.ndarray
    """(N,) int32 index in the atlas, or NO_TEXTURE."""
    gradient: np.ndarray
    """(N, 2, 4) float32: u = g[:3].X + g[3] in texels of level 0, likewise v."""
    owner: np.ndarray
    """(N,) int32: who the pixels belong to; NO_OWNER for the static scene."""
    alpha: np.ndarray
    """(N,) float32: opacity; below 1 neither owner nor depth is written."""
    grow_px: np.ndarray
    """(N,) float32: edges are moved out by this much (0.5 closes the seams of a mesh, 0 is exact)."""
    soft: np.ndarray
    """(N,) int32: bit k is set where the edge from corner k blends into what lies behind; other edges are cut at the
    pixel's centre, as between the pieces of a strip."""
    fog: np.ndarray
    """(N,) float32: share of the haze that applies (0 for the sky)."""

    def __len__(self) -> int:
        return len(self.corners)

    def take(self, index: np.ndarray) -> "Polygons":
        """The polygons at ``index`` (integers or a mask), in that order."""
        return Polygons(**{name: getattr(self, name)[index] for name in Polygons.__slots__})


def join(parts: list[Polygons]) -> Polygons:
    """All polygons, one list after the other."""
    return Polygons(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in Polygons.__slots__})


def make_polygons(
    corners: list[np.ndarray] | np.ndarray,
    *,
    colour: np.ndarray | tuple[float, float, float] = (255.0, 255.0, 255.0),
    texture: np.ndarray | int = NO_TEXTURE,
    gradient: np.ndarray | None = None,
    owner: int = NO_OWNER,
    alpha: float = 1.0,
    grow_px: float = 0.0,
    soft: int = ALL_SOFT,
    fog: float = 1.0,
) -> Polygons:
    """Polygons from (n, 3) corners each, a list or one (N, n, 3); other arguments are one value or one per polygon."""
    count = len(corners)
    padded = np.zeros((count, MAX_CORNERS, 3), np.float32)
    if isinstance(corners, np.ndarray):
        padded[:, : corners.shape[1]] = corners
        numbers = np.full(count, corners.shape[1], np.int32)
    else:
        numbers = np.array([len(polygon) for polygon in corners], np.int32).reshape(count)
        for row, polygon in zip(padded, corners, strict=True):
            row[: len(polygon)] = polygon
    return Polygons(
        corners=padded,
        corner_count=numbers,
        colour=np.broadcast_to(np.asarray(colour, np.float32), (count, 3)).copy(),
        texture=np.broadcast_to(np.asarray(texture, np.int32), (count,)).copy(),
        gradient=np.broadcast_to(
            np.zeros((2, 4), np.float32) if gradient is None else np.asarray(gradient, np.float32), (count, 2, 4)
        ).copy(),
        owner=np.full(count, owner, np.int32),
        alpha=np.full(count, alpha, np.float32),
        grow_px=np.full(count, grow_px, np.float32),
        soft=np.full(count, soft, np.int32),
        fog=np.full(count, fog, np.float32),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Atlas:
    """Mip chains of all textures in one array; sides are powers of two, so that coordinates wrap by masks."""

    texels: np.ndarray
    """(M,) int64: red, green and blue in lanes of 21 bits, see ``pack_rgb``."""
    taps: np.ndarray
    """(T,) int32: samples along the longer axis of a pixel's footprint, at most."""
    offset: np.ndarray
    """(T, LEVELS) int64: where a level starts."""
    log_width: np.ndarray
    """(T, LEVELS) int32: log2 of a level's width."""
    log_height: np.ndarray
    """(T, LEVELS) int32."""
    levels: np.ndarray
    """(T,) int32: how many levels a texture has."""


def pack_rgb(rgb: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 to (...) int64 with a lane of 21 bits for each colour."""
    wide = rgb.astype(np.int64)
    return wide[..., 0] | wide[..., 1] << 21 | wide[..., 2] << 42


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Canvas:
    """What the scan converter paints on; all (H, W)."""

    rgb: np.ndarray
    """(H, W, 3) uint8."""
    inverse_depth: np.ndarray
    """(H, W) float32, 1/m; 0 is infinitely far."""
    owner: np.ndarray
    """(H, W) uint8."""


def blank_canvas(width: int, height: int, colour: tuple[float, float, float]) -> Canvas:
    """A canvas of one colour, infinitely far."""
    rgb = np.empty((height, width, 3), np.uint8)
    rgb[0] = np.asarray(colour, np.uint8)
    rgb[1:] = rgb[0]
    return Canvas(
        rgb=rgb, inverse_depth=np.zeros((height, width), np.float32), owner=np.zeros((height, width), np.uint8)
    )
