"""Frames of a run to tracked keypoints: detection, keypoint heads, fields, tracks."""

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from typing import Literal

import numpy as np

from labeling.detection import Detections
from labeling.extractors import Extractors
from labeling.labels import POINT_ABSENT, POINT_DETECTED, Keypoints
from labeling.schemas import CATEGORIES, Category, keypoint_schema
from labeling.tracking import assign_tracks

Effort = Literal["fast", "balanced", "exact"]

_BATCH_FRAMES = 8
_BOX_SCHEMA: dict[Category, str] = {"car": "car24", "person": "coco17"}
"""The schema of an object whose keypoints no network gives: a box with absent points still has a track."""


def label_frames(
    frames: Iterable[np.ndarray],
    *,
    first_frame: int,
    extractors: Extractors,
    effort: Effort = "balanced",
    breaks: frozenset[int] = frozenset(),
) -> list[Keypoints]:
    """Tracked labels of the consecutive frames of one run.

    Args:
        frames: (H, W, 3) uint8 RGB.
        first_frame: number of the first on the video's 24 fps grid.
        extractors: the opened networks.
        effort: how much is looked at, and how much carried from frame to frame.
        breaks: grid numbers of frames before which nothing may be carried over (a hard cut, a hole).

    Returns:
        Labels in the order of frames, then of categories and tracks. Objects whose category has no keypoint network
        have a box, a track and absent points.

    Raises:
        ModelError: a network's output that is not finite.
    """
    observed: list[list[Keypoints]] = []
    for batch in _batches(frames, _BATCH_FRAMES):
        observed += observe(batch, extractors, first_frame=first_frame + len(observed))
    tracked = assign_tracks(observed, breaks=frozenset(frame - first_frame for frame in breaks))
    return [label for labels in tracked for label in labels]


def observe(frames: Sequence[np.ndarray], extractors: Extractors, *, first_frame: int = 0) -> list[list[Keypoints]]:
    """Untracked labels of each frame, everything looked at."""
    labels: list[list[Keypoints]] = [[] for _ in frames]
    if extractors.detector:
        detections = extractors.detector.detect(frames)
        for category in CATEGORIES:
            if category in _BOX_SCHEMA and not _from_fields(category, extractors):
                _add_top_down(labels, frames, detections, extractors, category=category, first_frame=first_frame)
    for model in extractors.fields:
        for found, objects in zip(labels, model.estimate(frames, first_frame=first_frame), strict=True):
            found += [label for label in objects if label.category not in extractors.heads]
    return labels


def _from_fields(category: Category, extractors: Extractors) -> bool:
    """Whether a category's objects come from a bottom-up network alone."""
    schemas = [name for model in extractors.fields for name in model.schema_names]
    return category not in extractors.heads and any(keypoint_schema(name).category == category for name in schemas)


def _add_top_down(
    labels: list[list[Keypoints]],
    frames: Sequence[np.ndarray],
    detections: Sequence[Detections],
    extractors: Extractors,
    *,
    category: Category,
    first_frame: int,
) -> None:
    chosen = [found.of_category(category) for found in detections]
    head = extractors.heads.get(category)
    schema = head.schema_name if head else _BOX_SCHEMA[category]
    if head:
        points = head.estimate(frames, [found.boxes_xyxy for found in chosen])
    else:
        points = [np.zeros((len(found), keypoint_schema(schema).point_count, 3), np.float32) for found in chosen]
    for index, (found, bodies) in enumerate(zip(chosen, points, strict=True)):
        labels[index] += [
            Keypoints(
                frame=first_frame + index, category=category, schema=schema, score=float(score),
                box_xyxy=box.astype(np.float32), points=body.astype(np.float32),
                point_source=np.where(body[:, 2] > 0, POINT_DETECTED, POINT_ABSENT).astype(np.int8),
            )
            for box, score, body in zip(found.boxes_xyxy, found.scores, bodies, strict=True)
        ]  # fmt: skip


def _batches(frames: Iterable[np.ndarray], size: int) -> Iterator[list[np.ndarray]]:
    source = iter(frames)
    while batch := list(islice(source, size)):
        yield batch
