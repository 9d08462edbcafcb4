"""Accuracy of cars found bottom-up, by the same rules as those found in boxes (``training.street_scores``)."""

import numpy as np

from labeling.fields import FieldModel
from training.street_pool import ObjectTruth
from training.street_scores import HIDDEN_SCORE, PCK_SHARE, SURE_SCORE, Tally, is_judged, match_boxes

LEAST_SURE = 0.3
"""Score from which a bottom-up car counts as found."""


def judge_car_fields(model: FieldModel, rgb: np.ndarray, truths: tuple[ObjectTruth, ...], tally: Tally) -> None:
    """Add one frame's outcomes to ``tally``; a car's box is that around the points that were found."""
    cars = tuple(truth for truth in truths if truth.category == "car" and truth.visible.sum() >= 2)
    found = [item for item in model.estimate([rgb])[0] if item.category == "car" and item.score >= LEAST_SURE]
    boxes = np.array([item.box_xyxy for item in found]).reshape(-1, 4)
    partner, phantoms = match_boxes(boxes, cars)
    wanted = [index for index, truth in enumerate(cars) if is_judged(truth)]
    tally.add("fields_car_recall", [partner[index] >= 0 for index in wanted])
    tally.add("fields_car_phantoms_per_frame", [len(phantoms)])
    for index in wanted:
        truth = cars[index]
        if partner[index] < 0:
            tally.add("fields_car_pck10", np.zeros(int(truth.visible.sum())))
            continue
        points = found[int(partner[index])].points
        diagonal = float(np.hypot(*(truth.box_xyxy[2:] - truth.box_xyxy[:2])))
        right = (np.hypot(*(points[:, :2] - truth.points_xy).T) <= PCK_SHARE * diagonal) & (points[:, 2] > 0)
        tally.add("fields_car_pck10", right[truth.visible])
        tally.add("fields_car_hidden_below_0.3", points[~truth.visible, 2] < HIDDEN_SCORE)
        tally.add("fields_car_right_above_0.9", right[points[:, 2] >= SURE_SCORE])
