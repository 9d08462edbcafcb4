"""The released renderer's ego video, for the released adapters, which were trained on its look and its quirks.

A coarse raster sampled with truncation, a lens that ignores the camera's, and 500 speed lines that follow the flow of a
plane 15 m ahead rather than points of a world. All of it is as the design describes; nothing here is meant to be right.
"""

from collections.abc import Iterator

import cv2
import numpy as np

from labeling.camera import Trajectory, invert
from labeling.ego_sphere import CHECKS_AROUND, CHECKS_DOWN, CheckRaster, Lens, checkered, draw_sphere

_SEED = 42
_LINES = 500
_LINE_COLOUR = (255, 255, 200)
_LINE_WIDTH = 5
_PLANE_M = 15.0
# Ends farther out are drawn no differently, and OpenCV's fixed-point lines overflow beyond.
_FARTHEST_PIXEL = 16_000


def released_frames(
    trajectory: Trajectory, *, width: int, height: int, step: int | None = None
) -> Iterator[np.ndarray]:
    """Frames of the released look: T - 1 are rendered, the last is shown twice.

    Args:
        trajectory: T poses; a single one counts as standing still.
        width: of the picture, pixels.
        height: of the picture, pixels.
        step: as in ``draw_sphere``.

    Yields:
        (height, width, 3) uint8, RGB, T of them.

    Raises:
        TrajectoryError: the camera leaves the sphere.
    """
    lens = released_lens(width, height)
    raster = released_raster(width, height)
    poses = trajectory.cam_to_world
    if len(poses) == 1:
        poses = np.repeat(poses, 2, axis=0)
    lines = _SpeedLines(width, height, lens)
    picture = np.zeros((height, width, 3), np.uint8)
    for now, following in zip(poses[:-1], poses[1:], strict=True):
        picture = draw_sphere(now, raster=raster, lens=lens, width=width, height=height, step=step)
        lines.draw_and_move(picture, invert(following) @ now)
        yield picture
    if len(trajectory) > 1:
        yield picture.copy()


def released_lens(width: int, height: int) -> Lens:
    """Focal length max(width, height), centre (width / 2, height / 2): half a pixel off the true middle."""
    focal = float(max(width, height))
    return Lens(fx=focal, fy=focal, cx=width / 2, cy=height / 2)


def released_raster(width: int, height: int) -> CheckRaster:
    """Checks at twice the picture's size over linspaces that include both ends, padded by their border."""
    colours = np.random.default_rng(_SEED).integers(0, 256, (CHECKS_AROUND + 1, CHECKS_DOWN + 1, 3), np.uint8)
    # The included end makes a last column and row of the 65th and 33rd check, one texel wide.
    columns = np.linspace(0.0, CHECKS_AROUND, 2 * width).astype(np.int64)
    rows = np.linspace(0.0, CHECKS_DOWN, 2 * height).astype(np.int64)
    return CheckRaster(
        columns=np.pad(columns, 1, mode="edge"), rows=np.pad(rows, 1, mode="edge"), palette=checkered(colours),
        rounding=0.0,
    )  # fmt: skip


class _SpeedLines:
    """500 points of the picture that move with a plane's flow and start anew, at random, when they leave."""

    def __init__(self, width: int, height: int, lens: Lens) -> None:
        self._size = np.array([width, height], np.float64)
        self._lens = lens
        self._rng = np.random.default_rng(_SEED)
        self._points = self._rng.uniform([0.0, 0.0], self._size, (_LINES, 2))

    def draw_and_move(self, picture: np.ndarray, now_to_following: np.ndarray) -> None:
        """Draw each point's way to the next frame on ``picture``, and take it."""
        ends = self._points + self._flow(now_to_following)
        inside = ((ends >= 0) & (ends < self._size)).all(axis=1)
        drawn = np.clip(np.nan_to_num(ends), -_FARTHEST_PIXEL, _FARTHEST_PIXEL)
        segments = np.stack([self._points, drawn], axis=1).astype(np.int32)
        cv2.polylines(picture, list(segments), False, _LINE_COLOUR, _LINE_WIDTH, cv2.LINE_AA)
        ends[~inside] = self._rng.uniform([0.0, 0.0], self._size, (int((~inside).sum()), 2))
        self._points = ends

    def _flow(self, now_to_following: np.ndarray) -> np.ndarray:
        """(500, 2) flow of the plane at the truncated pixel of each point."""
        lens = self._lens
        pixels = np.trunc(self._points)
        centre, focal = np.array([lens.cx, lens.cy]), np.array([lens.fx, lens.fy])
        plane = np.concatenate([(pixels - centre) / focal, np.ones((len(pixels), 1))], axis=1) * _PLANE_M
        seen = plane @ now_to_following[:3, :3].T + now_to_following[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            return seen[:, :2] / seen[:, 2:] * focal + centre - pixels
