"""Moments of a run: which frames show a picture that is new, and what time it is at each.

A picture that is shown again is the same moment: a camera that froze, or a source of fewer frames than the grid.
Nothing moves in it, nothing need be looked at, and what follows does not start from rest.
"""

from collections.abc import Sequence

import cv2
import numpy as np

_SAMPLE_ROWS, _SAME_LEVELS = 64, 2
"""One row in so many is compared before all are; and by how many levels pixels may differ."""
_PACE_MOMENTS = 9
"""So many moments tell how fast the source runs: a camera that froze is none of fewer frames."""
_USUAL_GAPS = 2
"""A picture that is shown for more than so many times as long as is usual froze: sources of 17 or 20 fps show some for
one frame of the grid and some for two."""


class Moments:
    """The moments of a run, frame after frame.

    Attributes:
        frames: grid number of the first frame of each moment.
        clocks: time of each moment in frames of the grid, but for what a camera froze: nothing grows old in it.
        shown: moment of each frame.
    """

    def __init__(self) -> None:
        self.frames: list[int] = []
        self.clocks: list[int] = []
        self.shown: list[int] = []

    @property
    def latest(self) -> int:
        """Number of the last moment."""
        return len(self.frames) - 1

    @property
    def pace(self) -> int:
        """For how many frames a picture is usually shown."""
        return usual_gap(self.frames)

    def new(self, frame: int) -> None:
        """Frame ``frame`` of the grid shows a picture of its own."""
        if self.frames:
            usual, gap = usual_gap([*self.frames[-_PACE_MOMENTS:], frame]), frame - self.frames[-1]
            self.clocks.append(self.clocks[-1] + (gap if gap <= _USUAL_GAPS * usual else usual))
        else:
            self.clocks.append(0)
        self.frames.append(frame)
        self.again()

    def again(self) -> None:
        """The next frame shows the last picture once more."""
        self.shown.append(self.latest)


def usual_gap(frames: Sequence[int]) -> int:
    """For how many frames a picture is usually shown: more than one where the source has fewer than the grid.

    One gap tells nothing, since a camera that stands at a run's start shows one picture for long; of two the lesser
    does.

    Args:
        frames: of the grid, in which new pictures appear.
    """
    gaps = np.sort(np.diff(frames))
    return int(gaps[(len(gaps) - 1) // 2]) if len(gaps) > 1 else 1


def same_picture(picture: np.ndarray, other: np.ndarray) -> bool:
    """Whether two uint8 pictures, (H, W) or (H, W, 3), are one that is shown again.

    A decoder may be off by a level or two; a camera's own noise, or coding again, is off by more.
    """
    if picture.shape != other.shape:
        return False
    few, others = (one[::_SAMPLE_ROWS] for one in (picture, other))
    if cv2.norm(np.ascontiguousarray(few), np.ascontiguousarray(others), cv2.NORM_INF) > _SAME_LEVELS:
        return False
    return cv2.norm(picture, other, cv2.NORM_INF) <= _SAME_LEVELS
