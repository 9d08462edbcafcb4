"""The label record that every stage shares: one object's keypoints in one frame.

Keypoints are the truth; skeleton, object and caption are views of them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from labeling.errors import DataError
from labeling.schemas import Category, keypoint_schema

POINT_ABSENT, POINT_DETECTED, POINT_CARRIED, POINT_INTERPOLATED = 0, 1, 2, 3
"""Where a point came from (``point_source``): nowhere, a network, optical flow, its neighbours in time."""

UNTRACKED = -1
"""``track_id`` before tracking."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keypoints:
    """One object in one frame. Coordinates are pixels of the run's picture, pixel centres on integers.

    Raises:
        DataError: a shape disagrees with the schema, or a number is not finite.
    """

    frame: int
    """Index on the video's 24 fps grid (not in the run)."""
    track_id: int = UNTRACKED
    """Same object, same id, within a run; ``UNTRACKED`` before tracking."""
    category: Category
    schema: str
    score: float
    """0 to 1."""
    box_xyxy: np.ndarray
    """(4,) float32: left, top, right, bottom."""
    points: np.ndarray
    """(K, 3) float32: x, y, score; a point with score 0 is absent."""
    point_source: np.ndarray
    """(K,) int8: 0 absent, 1 detected, 2 carried by flow, 3 interpolated."""

    def __post_init__(self) -> None:
        shapes = self.box_xyxy.shape, self.points.shape, self.point_source.shape
        _check(self, shapes, float(self.points.sum(dtype=np.float64)) + float(self.box_xyxy.sum()) + self.score)

    def renumbered(self, *, frame: int | None = None, track_id: int | None = None) -> "Keypoints":
        """The same sighting under another frame or track. What was checked once is not checked again: a run's labels
        are renumbered several times each."""
        return self._twin(
            self.frame if frame is None else frame, self.track_id if track_id is None else track_id, self.score,
            self.box_xyxy, self.points, self.point_source,
        )  # fmt: skip

    def elsewhere(
        self, frames: Sequence[int], *, boxes_xyxy: np.ndarray, points: np.ndarray, point_source: np.ndarray,
        scores: np.ndarray,
    ) -> "list[Keypoints]":  # fmt: skip
        """The same object in T other frames; all are checked at once, which is what most of making a label costs.

        Args:
            frames: T numbers.
            boxes_xyxy: (T, 4) float32.
            points: (T, K, 3) float32.
            point_source: (T, K) int8.
            scores: (T,).

        Raises:
            DataError: as for one.
        """
        shapes = boxes_xyxy.shape[1:], points.shape[1:], point_source.shape[1:]
        _check(self, shapes, float(points.sum(dtype=np.float64)) + float(boxes_xyxy.sum()) + float(scores.sum()))
        return [
            self._twin(frame, self.track_id, score, *arrays)
            for frame, score, *arrays in zip(frames, scores.tolist(), boxes_xyxy, points, point_source, strict=True)
        ]

    def _twin(
        self, frame: int, track_id: int, score: float, box_xyxy: np.ndarray, points: np.ndarray,
        point_source: np.ndarray,
    ) -> "Keypoints":  # fmt: skip
        """``dataclasses.replace`` without a check, and in a fifth of the time: labels are made by the thousand."""
        twin = object.__new__(Keypoints)
        values = frame, track_id, self.category, self.schema, score, box_xyxy, points, point_source
        for write, value in zip(_WRITERS, values, strict=True):
            write(twin, value)
        return twin

    @property
    def present(self) -> np.ndarray:
        """(K,) bool: the points that were seen."""
        return self.points[:, 2] > 0


_WRITERS = tuple(vars(Keypoints)[field.name].__set__ for field in fields(Keypoints))
"""Of the fields, in their order."""


def _check(label: Keypoints, shapes: tuple[tuple[int, ...], ...], total: float) -> None:
    """Of box, points and sources: their shapes, and the sum of all numbers, which is finite only where each of them is:
    one check instead of three, for every label made."""
    count = keypoint_schema(label.schema).point_count
    if shapes != ((4,), (count, 3), (count,)):
        raise DataError(
            f"{label.schema} needs box_xyxy (4,), points ({count}, 3) and point_source ({count},), got "
            f"{shapes[0]}, {shapes[1]}, {shapes[2]}; check the extractor's schema"
        )
    if not math.isfinite(total):
        raise DataError(f"frame {label.frame}: a {label.category} has coordinates or scores that are not finite")
