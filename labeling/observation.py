"""What the networks see in one frame: detection with keypoint heads, and bottom-up fields."""

from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

import numpy as np

from labeling.detection import Detections
from labeling.extractors import Extractors
from labeling.fields import FieldModel
from labeling.labels import POINT_ABSENT, POINT_DETECTED, Keypoints
from labeling.schemas import CATEGORIES, Category, keypoint_schema

_BOX_SCHEMA: dict[Category, str] = {"car": "car24", "person": "coco17"}
"""The schema of an object whose keypoints no network gives: a box with absent points still has a track."""


_SURE_OBJECT_SCORE = 0.25
"""A mean over all points, hidden ones too: a car seen whole scores about 0.5, one half seen about 0.3."""


class Look(Protocol):
    """Something that tells what is in a frame."""

    carries: bool
    """Whether the points it gives lie on things that optical flow can follow."""
    sure_scores: Mapping[str, float]
    """Objects of each category that score at least this are surely there; a category that is not named has no doubt."""
    decided: Collection[str]
    """Categories of which what is plainly seen scores near 1: what does not is hardly in view."""

    def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
        """Untracked labels of an (H, W, 3) uint8 RGB frame, numbered ``number``."""
        ...


def looks_of(extractors: Extractors) -> list[Look]:
    """The looks that the opened networks allow, each independent of the others."""
    looks: list[Look] = []
    bottom_up = set[Category]().union(*(_categories(model) for model in extractors.fields))
    if extractors.detector:
        categories: list[Category] = [c for c in _BOX_SCHEMA if c in extractors.heads or c not in bottom_up]
        looks.append(ObjectLook(extractors, categories))
    taken: set[Category] = set(extractors.heads) if extractors.detector else set()
    for model in extractors.fields:
        given = _categories(model)
        wanted: list[Category] = [category for category in CATEGORIES if category in given - taken]
        looks.append(FieldLook(model, wanted))
        taken |= given
    return looks


def _categories(model: FieldModel) -> set[Category]:
    found: set[Category] = set()
    for name in model.schema_names:
        found.add(keypoint_schema(name).category)
    return found


class ObjectLook:
    """Boxes of a detector, with the points of the heads in them."""

    carries = True

    def __init__(self, extractors: Extractors, categories: Sequence[Category]) -> None:
        assert extractors.detector is not None
        self.extractors, self.categories = extractors, categories
        self.sure_scores: Mapping[str, float] = extractors.detector.card.category_sure_scores
        self.decided: Collection[str] = extractors.detector.card.decided_categories

    def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
        """As ``Look.see``."""
        assert self.extractors.detector is not None
        (detections,) = self.extractors.detector.detect([frame])
        return [
            label for category in self.categories for label in self._of_category(frame, detections, category, number)
        ]

    def _of_category(
        self, frame: np.ndarray, detections: Detections, category: Category, number: int
    ) -> Sequence[Keypoints]:
        found = detections.of_category(category)
        head = self.extractors.heads.get(category)
        schema = head.schema_name if head else _BOX_SCHEMA[category]
        if head:
            (bodies,) = head.estimate([frame], [found.boxes_xyxy])
        else:
            bodies = np.zeros((len(found), keypoint_schema(schema).point_count, 3), np.float32)
        return [
            Keypoints(
                frame=number, category=category, schema=schema, score=float(score),
                box_xyxy=box.astype(np.float32), points=body.astype(np.float32),
                point_source=np.where(body[:, 2] > 0, POINT_DETECTED, POINT_ABSENT).astype(np.int8),
            )
            for box, score, body in zip(found.boxes_xyxy, found.scores, bodies, strict=True)
        ]  # fmt: skip


class FieldLook:
    """Objects of a bottom-up network."""

    decided: Collection[str] = ()

    def __init__(self, model: FieldModel, categories: Sequence[Category]) -> None:
        self.model, self.categories = model, categories
        self.carries = list(categories) != ["lane"]
        bodies = [category for category in categories if category != "lane"]
        self.sure_scores: Mapping[str, float] = dict.fromkeys(bodies, _SURE_OBJECT_SCORE)

    def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
        """As ``Look.see``."""
        (objects,) = self.model.estimate([frame], first_frame=number, categories=self.categories)
        return objects
