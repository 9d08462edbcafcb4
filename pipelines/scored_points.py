"""Points with their scores, right or wrong: what a reliability curve is made of."""

from collections.abc import Iterable

import numpy as np

from dataset.street_labels import StreetObject
from labeling.labels import Keypoints
from pipelines.keypoint_errors import MatchedFrame
from training.criteria import PCK_SHARE
from training.street_scores import is_judged


def scored_points(matched: Iterable[MatchedFrame]) -> np.ndarray:
    """(N, 3) float64: score, 1 or 0 for right or wrong, 1 or 0 for hidden or not, of every point that is present.

    Counted are judged objects that were found, hidden points too: a place is right wherever the car's own point lies.
    All points of phantoms are wrong, and none is hidden.
    """
    rows = [np.zeros((0, 3))]
    for frame in matched:
        rows += [_of_object(thing, label) for thing, label in frame.pairs if label is not None and is_judged(thing)]
        for label in frame.phantoms:
            nothing = np.zeros(label.present.sum())
            rows.append(np.column_stack([label.points[label.present, 2], nothing, nothing]))
    return np.concatenate(rows)


def _of_object(thing: StreetObject, label: Keypoints) -> np.ndarray:
    count = len(thing.points_xy)
    known = np.isfinite(thing.points_xy).all(axis=1) & label.present[:count]
    distance = np.linalg.norm(label.points[:count, :2] - np.nan_to_num(thing.points_xy), axis=1)
    right = distance <= PCK_SHARE * np.hypot(*(thing.box_xyxy[2:] - thing.box_xyxy[:2]))
    return np.column_stack([label.points[:count, 2], right, ~thing.visible])[known]
