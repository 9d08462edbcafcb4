"""How the camera turned between two looks, told from the pictures alone and cheaply enough for every look.

Ego-motion is estimated later, with cars and people masked; a tracker that runs before it only needs to know where far
things went. Phase correlation of the upper part of the picture, where far things are (Kuglin and Hines 1975), gives
their shift; a camera of the assumed focal length makes a turn of it.
"""

import cv2
import numpy as np

from labeling.camera import prior_intrinsics

_VIEW_SIZE = (128, 48)
"""Width and height, whole powers of two (and 3): transforms of other sizes are padded, which moves the peak."""
_UPPER_SHARE = 0.56
"""The lower part is road, which moves with the car rather than with the camera's turn."""
_LEAST_RESPONSE = 0.45
"""Below it no shift stands out: the pictures have nothing far in common (noise alone reaches 0.4)."""


def turn_view(frame: np.ndarray) -> np.ndarray:
    """(48, 128) float32 picture of the upper part of an (H, W, 3) uint8 RGB frame, for ``picture_turn``."""
    # One channel and half of its rows and columns tell as much and cost a fifth.
    upper = np.ascontiguousarray(frame[: round(frame.shape[0] * _UPPER_SHARE) : 2, ::2, 1])
    return cv2.resize(upper, _VIEW_SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)


def picture_turn(before: np.ndarray, after: np.ndarray, *, width: int, height: int) -> np.ndarray:
    """(3, 3) homography of frame pixels that the camera's turn makes of far points; the identity where none is seen.

    Args:
        before: ``turn_view`` of the earlier frame.
        after: of the later one.
        width: of the frames, pixels.
        height: of the frames, pixels.
    """
    # OpenCV multiplies what it is given by a window where it lies, and views are compared more than once. Squared, a
    # Hann window leaves more of what enters and leaves out.
    window = cv2.createHanningWindow(_VIEW_SIZE, cv2.CV_32F) ** 2
    shift, response = cv2.phaseCorrelate(before * window, after * window)
    if response < _LEAST_RESPONSE:
        return np.eye(3)
    camera = prior_intrinsics(width, height)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    pixels = np.array(shift) * (width, round(height * _UPPER_SHARE)) / _VIEW_SIZE
    yaw, pitch = np.arctan(pixels / (camera.fx, camera.fy))
    across = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    down = np.array([[1, 0, 0], [0, np.cos(pitch), np.sin(pitch)], [0, -np.sin(pitch), np.cos(pitch)]])
    return matrix @ across @ down @ np.linalg.inv(matrix)
