"""Accuracy of cars found bottom-up, by the same rules as those found in boxes (``training.street_scores``)."""

from collections.abc import Sequence

import numpy as np

from labeling.labels import Keypoints
from training.street_pool import ObjectTruth
from training.street_scores import HIDDEN_SCORE, PCK_SHARE, SURE_SCORE, Tally, is_judged, match_boxes


def judge_car_fields(found: Sequence[Keypoints], truths: tuple[ObjectTruth, ...], tally: Tally) -> None:
    """Add one frame's outcomes to ``tally``; a car's box is that around the points that were found."""
    found = [item for item in found if item.category == "car"]
    cars = tuple(truth for truth in truths if truth.category == "car")
    partner, phantoms = match_boxes(np.array([item.box_xyxy for item in found]).reshape(-1, 4), cars)
    wanted = [index for index, truth in enumerate(cars) if is_judged(truth)]
    tally.add("fields_car_recall", [partner[index] >= 0 for index in wanted])
    tally.add("fields_car_phantoms_per_frame", [len(phantoms)])
    tally.add("fields_car_count_exact", [not len(phantoms) and all(partner[index] >= 0 for index in wanted)])
    for index in wanted:
        match, truth = int(partner[index]), cars[index]
        if match < 0:
            tally.add("fields_car_pck10", np.zeros(int(truth.visible.sum())))
        else:
            _judge_points(found[match].points, truth, tally)


def _judge_points(points: np.ndarray, truth: ObjectTruth, tally: Tally) -> None:
    diagonal = float(np.hypot(*(truth.box_xyxy[2:] - truth.box_xyxy[:2])))
    near = np.hypot(*(points[:, :2] - truth.points_xy).T) <= PCK_SHARE * diagonal
    right = near & (points[:, 2] > 0)
    tally.add("fields_car_pck10", right[truth.visible])
    tally.add("fields_car_hidden_below_0.3", points[~truth.visible, 2] < HIDDEN_SCORE)
    tally.add("fields_car_right_above_0.9", right[points[:, 2] >= SURE_SCORE])
