"""Which lane line of this frame is which of the last: lines are compared where both reach."""

from collections.abc import Iterator, Sequence
from itertools import count

import numpy as np
from scipy.optimize import linear_sum_assignment

from labeling.labels import UNTRACKED

_ROWS = np.linspace(0, 1, 12)
_ROW_WEIGHTS = np.linspace(0.5, 1.5, 12) / 12
"""Where two lines are compared, as shares of the rows that both cross, from the top, and what each row weighs."""


class LaneTracker:
    """Ids for lane lines: the nearest line of the last frames, compared where both reach, bottom weighted most.

    Args:
        ids: where new lines get theirs; from 0 by default.
        max_distance_px: between a line and itself in the next frame.
        max_lost_frames: for so long a line that is not seen is remembered.
    """

    def __init__(
        self, *, ids: Iterator[int] | None = None, max_distance_px: float = 60.0, max_lost_frames: int = 24
    ) -> None:
        self._ids = count() if ids is None else ids
        self.max_distance_px, self.max_lost_frames = max_distance_px, max_lost_frames
        self._lines: dict[int, tuple[np.ndarray, int]] = {}

    @property
    def following(self) -> int:
        """How many lines it follows, lost ones counted."""
        return len(self._lines)

    def update(
        self, lines: Sequence[np.ndarray], *, frame_step: int = 1, previous_to_current: np.ndarray | None = None
    ) -> np.ndarray:
        """Ids for the lines of the next frame, each (K, 3) x, y, score in pixels; absent points have score 0.

        ``frame_step`` and ``previous_to_current`` are as ``BoxTracker.update`` takes them.
        """
        if previous_to_current is not None:
            self._lines = {i: (_turned(line, previous_to_current), age) for i, (line, age) in self._lines.items()}
        ids = np.full(len(lines), UNTRACKED)
        known = sorted(self._lines)
        if known and len(lines):
            before, now = [downwards(self._lines[i][0]) for i in known], [downwards(line) for line in lines]
            cost = np.array([[_gap_px(a, b) for b in now] for a in before])
            rows, columns = linear_sum_assignment(np.minimum(cost, self.max_distance_px))
            for row, column in zip(rows, columns, strict=True):
                if cost[row, column] <= self.max_distance_px:
                    ids[column] = known[row]
        for column in np.flatnonzero(ids == UNTRACKED):
            ids[column] = next(self._ids)
        self._lines = {
            i: (line, age + frame_step)
            for i, (line, age) in self._lines.items()
            if age + frame_step <= self.max_lost_frames
        }
        self._lines |= {int(i): (np.asarray(line), 0) for i, line in zip(ids, lines, strict=True)}
        return ids


def line_distance(line_a: np.ndarray, line_b: np.ndarray) -> float:
    """Mean horizontal distance of two lines over the rows that both cross, pixels; infinite where they share none.

    Args:
        line_a: (K, 3) x, y, score.
        line_b: (K, 3).
    """
    return _gap_px(downwards(line_a), downwards(line_b))


def downwards(line: np.ndarray) -> np.ndarray:
    """The present points of a line (K, 3), from the top of the picture down."""
    present = line[line[:, 2] > 0]
    return present[np.argsort(present[:, 1], kind="stable")]


def _gap_px(line_a: np.ndarray, line_b: np.ndarray) -> float:
    """``line_distance`` of lines that go downwards."""
    if min(len(line_a), len(line_b)) < 2:
        return float("inf")
    top = max(line_a[0, 1], line_b[0, 1])
    bottom = min(line_a[-1, 1], line_b[-1, 1])
    if bottom <= top:
        return float("inf")
    rows = top + (bottom - top) * _ROWS
    apart = np.abs(np.interp(rows, line_a[:, 1], line_a[:, 0]) - np.interp(rows, line_b[:, 1], line_b[:, 0]))
    # Lines fan out towards the camera: the lower rows tell them apart, the upper ones all meet.
    return float(apart @ _ROW_WEIGHTS)


def _turned(line: np.ndarray, previous_to_current: np.ndarray) -> np.ndarray:
    """A line (K, 3) of x, y, score where the camera's turn takes it."""
    moved = np.concatenate([line[:, :2], np.ones((len(line), 1))], axis=1) @ previous_to_current.T
    return np.concatenate([moved[:, :2] / moved[:, 2:], line[:, 2:]], axis=1)
