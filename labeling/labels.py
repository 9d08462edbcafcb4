"""The label record that every stage shares: one object's keypoints in one frame.

Keypoints are the truth; skeleton, object and caption are views of them.
"""

import math
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
        count = keypoint_schema(self.schema).point_count
        if self.box_xyxy.shape != (4,) or self.points.shape != (count, 3) or self.point_source.shape != (count,):
            raise DataError(
                f"{self.schema} needs box_xyxy (4,), points ({count}, 3) and point_source ({count},), got "
                f"{self.box_xyxy.shape}, {self.points.shape}, {self.point_source.shape}; check the extractor's schema"
            )
        # A sum is finite only where all that went into it is: one check instead of three, for every label made.
        if not math.isfinite(float(self.points.sum(dtype=np.float64)) + float(self.box_xyxy.sum()) + self.score):
            raise DataError(f"frame {self.frame}: a {self.category} has coordinates or scores that are not finite")

    def renumbered(self, *, frame: int | None = None, track_id: int | None = None) -> "Keypoints":
        """The same sighting under another frame or track. What was checked once is not checked again: a run's labels
        are renumbered several times each."""
        twin = object.__new__(Keypoints)
        for name in _FIELDS:
            object.__setattr__(twin, name, getattr(self, name))
        if frame is not None:
            object.__setattr__(twin, "frame", frame)
        if track_id is not None:
            object.__setattr__(twin, "track_id", track_id)
        return twin

    @property
    def present(self) -> np.ndarray:
        """(K,) bool: the points that were seen."""
        return self.points[:, 2] > 0


_FIELDS = tuple(field.name for field in fields(Keypoints))
