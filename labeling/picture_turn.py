"""How the camera turned between two looks, told from the pictures alone and cheaply enough for every look.

Ego-motion is estimated later, with cars and people masked; a tracker that runs before it only needs to know where far
things went. Phase correlation of the upper part of the picture, where far things are (Kuglin and Hines 1975), gives
their shift; a camera of the assumed focal length makes a turn of it.
"""

import functools

import cv2
import numpy as np

from labeling.camera import prior_intrinsics

_VIEW_SIZE = (128, 48)
"""Width and height, whole powers of two (and 3): transforms of other sizes are padded, which moves the peak."""
_UPPER_SHARE = 0.56
"""The lower part is road, which moves with the car rather than with the camera's turn."""
_LEAST_RESPONSE = 0.45
"""Below it no shift stands out: the pictures have nothing far in common (noise alone reaches 0.4)."""
_MAX_STEP = 4
"""Moments after which two pictures of a camera that turns sharply have too little in common."""


class TurnMeter:
    """How the camera of a run turned, measured once for all who ask."""

    def __init__(self) -> None:
        self._latest: tuple[np.ndarray, int] | None = None
        self._steps: list[tuple[int, np.ndarray]] = []
        """Moments, and the homography from the one before to each."""

    def forget(self) -> None:
        """What comes next has nothing to do with what was, or nobody asks."""
        self._latest, self._steps = None, []

    def due(self, moment: int) -> bool:
        """Whether the turn up to ``moment`` must be measured so as not to lose it."""
        return self._latest is not None and moment - self._latest[1] >= _MAX_STEP

    def reach(self, frame: np.ndarray, moment: int) -> None:
        """Measure the turn up to ``moment``, whose picture is (H, W, 3) uint8 RGB; the first time it begins there."""
        if self._latest is not None and self._latest[1] == moment:
            return
        view = turn_view(frame)
        if self._latest is not None:
            height, width = frame.shape[:2]
            self._steps.append((moment, picture_turn(self._latest[0], view, width=width, height=height)))
        self._latest = (view, moment)

    def since(self, moment: int) -> np.ndarray:
        """(3, 3) homography of frame pixels that the turn from ``moment``, a measured one, to the last measured one
        makes of far points."""
        turned = np.eye(3)
        for reached, step in reversed(self._steps):
            if reached <= moment:
                break
            turned = turned @ step
        return turned


def turn_view(frame: np.ndarray) -> np.ndarray:
    """(48, 128) float32 picture of the upper part of an (H, W, 3) uint8 RGB frame, for ``picture_turn``: dark towards
    its borders, so that what enters and leaves says little."""
    # One channel and half of its rows and columns tell as much and cost a fifth.
    upper = np.ascontiguousarray(frame[: round(frame.shape[0] * _UPPER_SHARE) : 2, ::2, 1])
    return cv2.resize(upper, _VIEW_SIZE, interpolation=cv2.INTER_AREA) * _window()


def picture_turn(before: np.ndarray, after: np.ndarray, *, width: int, height: int) -> np.ndarray:
    """(3, 3) homography of frame pixels that the camera's turn makes of far points; the identity where none is seen.

    Args:
        before: ``turn_view`` of the earlier frame.
        after: of the later one.
        width: of the frames, pixels.
        height: of the frames, pixels.
    """
    shift, response = cv2.phaseCorrelate(before, after)
    if response < _LEAST_RESPONSE:
        return np.eye(3)
    matrix, inverse = _camera(width, height)
    pixels = np.array(shift) * (width, round(height * _UPPER_SHARE)) / _VIEW_SIZE
    yaw, pitch = np.arctan(pixels / (matrix[0, 0], matrix[1, 1]))
    across = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    down = np.array([[1, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]])
    return matrix @ across @ down @ inverse


@functools.cache
def _window() -> np.ndarray:
    """Squared, a Hann window leaves more of what enters and leaves out."""
    return cv2.createHanningWindow(_VIEW_SIZE, cv2.CV_32F) ** 2


@functools.lru_cache(maxsize=8)
def _camera(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """(3, 3) calibration matrix of the assumed camera, and its inverse."""
    camera = prior_intrinsics(width, height)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return matrix, np.linalg.inv(matrix)
