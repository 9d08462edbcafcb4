"""Dust that is really in the world: near and far specks show true parallax, and a turn alone shows none.

Specks fill a cube of space that repeats in every direction, so wherever the camera drives there is dust; those within
``REACH_M`` of it are seen. They fade out towards that reach, which hides where the cube repeats.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from labeling.camera import Intrinsics

REACH_M = 20.0
"""No speck farther from the camera is drawn; the cube's side is twice this."""
NEAR_M = 1.0
"""The near plane: no speck less deep is drawn."""
SPECK_RADIUS_M = 0.035
SPECK_PIXELS = (1.3, 6.0)
"""Least and largest drawn radius, pixels of a picture 1056 wide."""
SPECKS_IN_VIEW = 500
"""Expected number; it follows from the field of view how many the cube holds."""
SPECK_COLOUR = (255, 255, 200)

_FADE_FROM = 0.7
_MOST_SPECKS = 400_000
_REFERENCE_WIDTH = 1056


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Specks:
    """What a camera sees of the dust, n specks from far to near."""

    index: np.ndarray
    """(n,) int64, which speck of the cube."""
    x: np.ndarray
    """(n,) float64, pixels."""
    y: np.ndarray
    """(n,) float64, pixels."""
    depth_m: np.ndarray
    """(n,) float64."""
    radius: np.ndarray
    """(n,) float64, pixels."""
    opacity: np.ndarray
    """(n,) float64, 0 to 1."""


def fill_cube(intrinsics: Intrinsics, *, seed: int) -> np.ndarray:
    """Specks of one cube of space, as many as put ``SPECKS_IN_VIEW`` into the field of view.

    Args:
        intrinsics: of the picture to draw.
        seed: the same seed gives the same dust.

    Returns:
        (N, 3) float64, metres, each in [0, 2 * REACH_M).
    """
    half_x = math.atan(intrinsics.width / 2 / intrinsics.fx)
    half_y = math.atan(intrinsics.height / 2 / intrinsics.fy)
    solid_angle = 4 * math.asin(math.sin(half_x) * math.sin(half_y))
    share = solid_angle / 3 * (REACH_M**3 - NEAR_M**3) / (2 * REACH_M) ** 3
    count = min(round(SPECKS_IN_VIEW / share), _MOST_SPECKS)
    return np.random.default_rng(seed).uniform(0.0, 2 * REACH_M, (count, 3))


def specks_in_view(cube: np.ndarray, cam_to_world: np.ndarray, *, intrinsics: Intrinsics) -> Specks:
    """The specks that a camera sees.

    Args:
        cube: (N, 3) float64 from ``fill_cube``.
        cam_to_world: (4, 4) float64, metres.
        intrinsics: of the picture to draw.
    """
    view = np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy])
    size = np.array([intrinsics.width, intrinsics.height], np.float64)
    least, largest = (pixels * intrinsics.width / _REFERENCE_WIDTH for pixels in SPECK_PIXELS)
    index, x, y, depth, distance = _project(cube, np.ascontiguousarray(cam_to_world), view, size, largest)
    order = np.argsort(-depth, kind="stable")
    depth, faded = depth[order], np.clip((distance[order] / REACH_M - _FADE_FROM) / (1 - _FADE_FROM), 0.0, 1.0)
    radius = np.clip(math.sqrt(intrinsics.fx * intrinsics.fy) * SPECK_RADIUS_M / depth, least, largest)
    return Specks(index=index[order], x=x[order], y=y[order], depth_m=depth, radius=radius, opacity=1.0 - faded)


def draw_specks(picture: np.ndarray, specks: Specks) -> None:
    """Blend antialiased discs into ``picture`` (H, W, 3) uint8, in place, far ones first."""
    colour = np.array(SPECK_COLOUR, np.float64)
    _blend(picture, specks.x, specks.y, specks.radius, specks.opacity, colour)


@njit(cache=True, error_model="numpy")
def _project(cube, motion, view, size, margin):  # pragma: no cover - compiled
    """Wrap the cube around the camera, keep what is within reach and before the near plane, and project it."""
    side = 2 * REACH_M
    index = np.empty(len(cube), np.int64)
    found = np.empty((4, len(cube)))
    count = 0
    for i in range(len(cube)):
        dx, dy, dz = cube[i, 0] - motion[0, 3], cube[i, 1] - motion[1, 3], cube[i, 2] - motion[2, 3]
        dx -= side * math.floor(dx / side + 0.5)
        dy -= side * math.floor(dy / side + 0.5)
        dz -= side * math.floor(dz / side + 0.5)
        depth = motion[0, 2] * dx + motion[1, 2] * dy + motion[2, 2] * dz
        squared = dx * dx + dy * dy + dz * dz
        if depth < NEAR_M or squared >= REACH_M * REACH_M:
            continue
        x = view[0] * (motion[0, 0] * dx + motion[1, 0] * dy + motion[2, 0] * dz) / depth + view[2]
        y = view[1] * (motion[0, 1] * dx + motion[1, 1] * dy + motion[2, 1] * dz) / depth + view[3]
        if -margin - 1 < x < size[0] + margin and -margin - 1 < y < size[1] + margin:
            index[count] = i
            found[0, count], found[1, count], found[2, count], found[3, count] = x, y, depth, math.sqrt(squared)
            count += 1
    return index[:count], found[0, :count], found[1, :count], found[2, :count], found[3, :count]


@njit(cache=True, error_model="numpy")
def _blend(picture, xs, ys, radii, opacities, colour):  # pragma: no cover - compiled
    height, width = picture.shape[:2]
    for i in range(len(xs)):
        reach = radii[i] + 0.5
        top, bottom = max(math.ceil(ys[i] - reach), 0), min(math.floor(ys[i] + reach) + 1, height)
        left, right = max(math.ceil(xs[i] - reach), 0), min(math.floor(xs[i] + reach) + 1, width)
        for y in range(top, bottom):
            for x in range(left, right):
                distance = math.sqrt((x - xs[i]) ** 2 + (y - ys[i]) ** 2)
                covered = min(max(reach - distance, 0.0), 1.0) * opacities[i]
                for channel in range(3):
                    below = float(picture[y, x, channel])
                    picture[y, x, channel] = int(below + (colour[channel] - below) * covered + 0.5)
