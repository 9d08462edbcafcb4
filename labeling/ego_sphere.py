"""The checkerboard sphere around the first camera, seen from any camera inside it.

A pixel's direction meets the sphere in one point, whose azimuth and polar angle are the place to look up in a raster of
checks. The arc functions are the cost, so they are evaluated on every 8th pixel of each row and column (oftener in
small pictures) and interpolated linearly between; a block that holds the seam of the azimuth or comes near a pole is
evaluated at each of its pixels. The raster is never stored as pixels: a column and a row name their check, and the
check its colour, so that a block inside one check is filled without a look-up.

Axes are OpenCV's, in the first camera: with x right, y down, z forward, the azimuth is ``atan2(-z, x)`` and the polar
angle ``acos(y / radius)``; the pole is the first camera's vertical.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from labeling.camera import Intrinsics
from labeling.errors import TrajectoryError

SPHERE_RADIUS_M = 500.0
CHECKS_AROUND, CHECKS_DOWN = 64, 32

_PALETTE_SEED = 42
_EDGE_PIXELS = 1.5
_LARGEST_STEP = 8
# Pixels of focal length per pixel of step: so linear interpolation is as good in a small picture as in a large one.
_FOCAL_PER_STEP = 60.0
# Linear interpolation over 8 pixels is off by 0.1 pixel where a block spans this much azimuth; elsewhere by less.
_LARGEST_TURN = 0.1 / (2 * math.pi)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CheckRaster:
    """A raster of checks as a table: texel (row j, column i) is ``palette[columns[i + 1], rows[j + 1]]``."""

    columns: np.ndarray
    """(w + 2,) int64, check index of each texel column from azimuth -180 to 180 degrees; one more at either end."""
    rows: np.ndarray
    """(h + 2,) int64, check index of each texel row by polar angle, 0 to 180 degrees; one more at either end."""
    palette: np.ndarray
    """(columns of checks, rows of checks, 3) uint8 RGB; cells with an even sum of indices are black."""
    rounding: float
    """Added before a blended colour is truncated: 0.5 rounds, 0 truncates."""

    def picture(self) -> np.ndarray:
        """(h, w, 3) uint8, the raster as pixels."""
        return self.palette[self.columns[None, 1:-1], self.rows[1:-1, None]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """Where pixel (x, y) looks: ``((x - cx) / fx, (y - cy) / fy, 1)``."""

    fx: float
    fy: float
    cx: float
    cy: float


def checkered(colours: np.ndarray) -> np.ndarray:
    """``colours`` (n, m, 3) uint8 with the cells whose indices have an even sum made black."""
    i, j = np.indices(colours.shape[:2])
    return np.where(((i + j) % 2 == 0)[..., None], 0, colours).astype(np.uint8)


def world_raster(intrinsics: Intrinsics) -> CheckRaster:
    """Checks whose texels are about 1.5 pixels wide, so that their edges look antialiased in any picture size."""
    colours = np.random.default_rng(_PALETTE_SEED).integers(0, 256, (CHECKS_AROUND, CHECKS_DOWN, 3), np.uint8)
    focal = math.sqrt(intrinsics.fx * intrinsics.fy)
    texels = max(4, round(focal * 2 * math.pi / CHECKS_AROUND / _EDGE_PIXELS))
    columns, rows = np.repeat(np.arange(CHECKS_AROUND), texels), np.repeat(np.arange(CHECKS_DOWN), texels)
    return CheckRaster(
        columns=np.pad(columns, 1, mode="wrap"), rows=np.pad(rows, 1, mode="edge"), palette=checkered(colours),
        rounding=0.5,
    )  # fmt: skip


def draw_sphere(
    cam_to_world: np.ndarray, *, raster: CheckRaster, lens: Lens, width: int, height: int, step: int | None = None
) -> np.ndarray:
    """The sphere as a camera inside it sees it, sampled bilinearly from the raster.

    Args:
        cam_to_world: (4, 4) float64, relative to the clip's first camera, metres.
        raster: the checks.
        lens: the camera's.
        width: of the picture, pixels.
        height: of the picture, pixels.
        step: pixels between exact coordinates, 1 for every pixel; by default ``grid_step``.

    Returns:
        (height, width, 3) uint8, RGB.

    Raises:
        TrajectoryError: the camera has left the sphere.
    """
    away = float(np.linalg.norm(cam_to_world[:3, 3]))
    if away >= SPHERE_RADIUS_M:
        raise TrajectoryError(
            f"the camera is {away:.0f} m from where it started, outside the sphere of {SPHERE_RADIUS_M:g} m; "
            "render clips of some seconds, each re-based to its first camera, or check the trajectory's scale"
        )
    picture = np.empty((height, width, 3), np.uint8)
    view = np.array([lens.fx, lens.fy, lens.cx, lens.cy])
    size = np.array([len(raster.columns) - 2, len(raster.rows) - 2], np.float64)
    motion = np.ascontiguousarray(cam_to_world, dtype=np.float64)
    step = step or grid_step(lens)
    _draw_blocks(picture, step, motion, view, size, raster.columns, raster.rows, raster.palette, raster.rounding)
    return picture


def grid_step(lens: Lens) -> int:
    """Pixels between exact coordinates where linear interpolation between them is good enough."""
    return int(min(max(2, min(lens.fx, lens.fy) // _FOCAL_PER_STEP), _LARGEST_STEP))


@njit(cache=True, error_model="numpy", inline="always")
def _texel(x, y, motion, view, size):  # pragma: no cover - compiled
    """Where pixel (x, y) meets the sphere, in texels whose centres lie on integers."""
    a, b = (x - view[2]) / view[0], (y - view[3]) / view[1]
    dx = motion[0, 0] * a + motion[0, 1] * b + motion[0, 2]
    dy = motion[1, 0] * a + motion[1, 1] * b + motion[1, 2]
    dz = motion[2, 0] * a + motion[2, 1] * b + motion[2, 2]
    px, py, pz = motion[0, 3], motion[1, 3], motion[2, 3]
    squared, along = dx * dx + dy * dy + dz * dz, dx * px + dy * py + dz * pz
    inside = SPHERE_RADIUS_M * SPHERE_RADIUS_M - px * px - py * py - pz * pz
    reach = (math.sqrt(along * along + squared * inside) - along) / squared
    azimuth = math.atan2(-(pz + reach * dz), px + reach * dx)
    polar = math.acos(min(max((py + reach * dy) / SPHERE_RADIUS_M, -1.0), 1.0))
    return (azimuth / (2 * math.pi) + 0.5) * size[0] - 0.5, polar / math.pi * size[1] - 0.5


@njit(cache=True, error_model="numpy", inline="always")
def _put(picture, y, x, u, v, columns, rows, palette, rounding):  # pragma: no cover - compiled
    """Bilinear sample of the raster at texel (u, v), which lies in [-0.5, size - 0.5]."""
    i, j = int(u + 1.0), int(v + 1.0)
    across, down = u + 1.0 - i, v + 1.0 - j
    left, right, top, bottom = columns[i], columns[i + 1], rows[j], rows[j + 1]
    if left == right and top == bottom:
        for channel in range(3):
            picture[y, x, channel] = palette[left, top, channel]
        return
    for channel in range(3):
        above = palette[left, top, channel] * (1.0 - across) + palette[right, top, channel] * across
        below = palette[left, bottom, channel] * (1.0 - across) + palette[right, bottom, channel] * across
        picture[y, x, channel] = int(above * (1.0 - down) + below * down + rounding)


@njit(cache=True, error_model="numpy", inline="always")
def _spread(near, far, i, axis):  # pragma: no cover - compiled
    """Least and largest coordinate of a block's corners."""
    a, b, c, d = near[i, axis], near[i + 1, axis], far[i, axis], far[i + 1, axis]
    return min(min(a, b), min(c, d)), max(max(a, b), max(c, d))


@njit(cache=True, error_model="numpy")
def _fill_linear(
    picture, step, x0, y0, x1, y1, near, far, i, columns, rows, palette, rounding
):  # pragma: no cover - compiled
    """One block with coordinates linear between its corners."""
    for y in range(y0, y1):
        down = (y - y0) / step
        u, v = near[i, 0] + (far[i, 0] - near[i, 0]) * down, near[i, 1] + (far[i, 1] - near[i, 1]) * down
        step_u = (near[i + 1, 0] + (far[i + 1, 0] - near[i + 1, 0]) * down - u) / step
        step_v = (near[i + 1, 1] + (far[i + 1, 1] - near[i + 1, 1]) * down - v) / step
        for x in range(x0, x1):
            _put(picture, y, x, u + (x - x0) * step_u, v + (x - x0) * step_v, columns, rows, palette, rounding)


@njit(cache=True, error_model="numpy")
def _fill_flat(picture, x0, y0, x1, y1, red, green, blue):  # pragma: no cover - compiled
    for y in range(y0, y1):
        for x in range(x0, x1):
            picture[y, x, 0], picture[y, x, 1], picture[y, x, 2] = red, green, blue


@njit(cache=True, error_model="numpy")
def _fill_exact(
    picture, x0, y0, x1, y1, motion, view, size, columns, rows, palette, rounding
):  # pragma: no cover - compiled
    for y in range(y0, y1):
        for x in range(x0, x1):
            u, v = _texel(float(x), float(y), motion, view, size)
            _put(picture, y, x, u, v, columns, rows, palette, rounding)


@njit(cache=True, error_model="numpy")
def _draw_blocks(picture, step, motion, view, size, columns, rows, palette, rounding):  # pragma: no cover - compiled
    height, width = picture.shape[:2]
    across, down = (width + step - 1) // step, (height + step - 1) // step
    near, far = np.empty((across + 1, 2)), np.empty((across + 1, 2))
    for i in range(across + 1):
        near[i, 0], near[i, 1] = _texel(float(i * step), 0.0, motion, view, size)
    for j in range(down):
        y0, y1 = j * step, min((j + 1) * step, height)
        for i in range(across + 1):
            far[i, 0], far[i, 1] = _texel(float(i * step), float(y0 + step), motion, view, size)
        for i in range(across):
            x0, x1 = i * step, min((i + 1) * step, width)
            low_u, high_u = _spread(near, far, i, 0)
            low_v, high_v = _spread(near, far, i, 1)
            if high_u - low_u > _LARGEST_TURN * size[0]:
                _fill_exact(picture, x0, y0, x1, y1, motion, view, size, columns, rows, palette, rounding)
                continue
            column, row = columns[int(low_u + 1.0)], rows[int(low_v + 1.0)]
            # A check is many texels wide, a block few: the same check at both ends means the same between.
            if column == columns[int(high_u + 1.0) + 1] and row == rows[int(high_v + 1.0) + 1]:
                red, green, blue = palette[column, row, 0], palette[column, row, 1], palette[column, row, 2]
                _fill_flat(picture, x0, y0, x1, y1, red, green, blue)
            else:
                _fill_linear(picture, step, x0, y0, x1, y1, near, far, i, columns, rows, palette, rounding)
        near, far = far, near
