"""Accuracy of the shipped street models on held-out streets, measured through the code that labels real videos.

Judged are objects at least 32 px high of which at least 30 % is visible; others may be found or not. A point of an
object that was missed counts as wrong.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from labeling.boxes import inside, iou
from labeling.detection import Detections, Detector
from labeling.fields import FieldModel
from labeling.keypoints import KeypointHead
from labeling.labels import Keypoints
from training.criteria import (
    EXCUSED_SHARE,
    HIDDEN_SCORE,
    JUDGED_HEIGHT_PX,
    JUDGED_SHARE,
    LANE_MATCH_PX,
    MATCH_IOU,
    PCK_SHARE,
    SURE_SCORE,
)
from training.street_pool import ObjectTruth


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetModels:
    """The extractors to judge; any may be absent."""

    detector: Detector | None = None
    heads: dict[str, KeypointHead] = field(default_factory=dict)
    """By category."""
    fields: FieldModel | None = None


class BoxTruth(Protocol):
    """What an object must tell to be judged: ``ObjectTruth`` and ``dataset.street_labels.StreetObject`` do."""

    @property
    def box_xyxy(self) -> np.ndarray:
        """(4,) of what is visible."""
        ...

    @property
    def visible_share(self) -> float:
        """0 to 1."""
        ...


@dataclass(slots=True)
class Tally:
    """Sums over frames; ``figures`` gives the shares."""

    hits: dict[str, list[float]] = field(default_factory=dict)

    def add(self, name: str, values: Iterable[float] | np.ndarray) -> None:
        """Append single outcomes (0 or 1, or pixels) to the figure called ``name``."""
        self.hits.setdefault(name, []).extend(float(value) for value in values)

    def figures(self) -> dict[str, float]:
        """The mean of every figure, rounded to 4 digits, by name."""
        return {name: round(float(np.mean(values)), 4) for name, values in sorted(self.hits.items()) if values}


def is_judged(truth: BoxTruth) -> bool:
    """High and visible enough to be asked for."""
    return bool(truth.box_xyxy[3] - truth.box_xyxy[1] >= JUDGED_HEIGHT_PX and truth.visible_share >= JUDGED_SHARE)


def grouped_standard_error(values: Sequence[float], size: int) -> float:
    """Standard error of the mean of values that come in groups of ``size``: groups are independent, their members not.

    Args:
        values: two groups or more, one after the other.
        size: of each group.
    """
    means = np.reshape(values, (-1, size)).mean(axis=1)
    return float(means.std(ddof=1) / np.sqrt(len(means)))


def judge_frame(models: StreetModels, rgb: np.ndarray, truths: tuple[ObjectTruth, ...], tally: Tally) -> None:
    """Add one frame's outcomes to ``tally``."""
    if models.detector is not None:
        found = models.detector.detect([rgb])[0]
        exact = True
        for category in ("car", "person"):
            mine = tuple(truth for truth in truths if truth.category == category)
            seen = found.select(found.categories == category)
            partner, phantoms = match_boxes(seen.boxes_xyxy, mine)
            wanted = [index for index, truth in enumerate(mine) if is_judged(truth)]
            tally.add(f"{category}_recall", [partner[index] >= 0 for index in wanted])
            tally.add(f"{category}_phantoms_per_frame", [len(phantoms)])
            exact &= not len(phantoms) and all(partner[index] >= 0 for index in wanted)
            if category in models.heads:
                _judge_points(models.heads[category], rgb, seen, [mine[i] for i in wanted], partner[wanted], tally)
        tally.add("count_exact", [exact])
    if models.fields is not None:
        (objects,) = models.fields.estimate([rgb])
        lanes = tuple(truth for truth in truths if truth.category == "lane")
        judge_lanes([item.points for item in objects if item.category == "lane"], lanes, tally)
        if "car24" in models.fields.schema_names:
            judge_car_fields(objects, truths, tally)


def match_boxes(boxes_xyxy: np.ndarray, truths: Sequence[BoxTruth]) -> tuple[np.ndarray, np.ndarray]:
    """Greedy one-to-one matches, in the order given: best first.

    Args:
        boxes_xyxy: (m, 4) what was found.
        truths: n objects, judged or not.

    Returns:
        (n,) the box of each truth or -1; and the indices of phantoms: boxes high enough to be judged that match nothing
        and do not lie on an object that is not judged.
    """
    partner = np.full(len(truths), -1)
    phantoms = []
    boxes = np.array([truth.box_xyxy for truth in truths]).reshape(-1, 4)
    for index, box in enumerate(boxes_xyxy):
        overlap, covered = box_overlaps(box, boxes)
        overlap[partner >= 0] = 0
        best = int(overlap.argmax()) if len(overlap) else -1
        if best >= 0 and overlap[best] >= MATCH_IOU:
            partner[best] = index
        elif not is_excused(box, truths, covered):
            phantoms.append(index)
    return partner, np.array(phantoms, np.int64)


def is_excused(box_xyxy: np.ndarray, truths: Sequence[BoxTruth], covered: np.ndarray) -> bool:
    """Whether a box that matches nothing is no mistake: too low, or on an object that is not judged.

    Args:
        box_xyxy: (4,).
        truths: n objects.
        covered: (n,) share of the box that each covers.
    """
    if box_xyxy[3] - box_xyxy[1] < JUDGED_HEIGHT_PX:
        return True
    return any(not is_judged(truth) and share > EXCUSED_SHARE for truth, share in zip(truths, covered, strict=True))


def box_overlaps(box: np.ndarray, boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) IoU of a box (4,) with boxes (n, 4), and (n,) share of it that each covers."""
    return iou(box[None], boxes)[0], inside(boxes, box[None])[:, 0]


def _judge_points(
    head: KeypointHead,
    rgb: np.ndarray,
    seen: Detections,
    truths: list[ObjectTruth],
    partner: np.ndarray,
    tally: Tally,
) -> None:
    if not truths:
        return
    category = truths[0].category
    points = head.estimate([rgb], [seen.boxes_xyxy])[0]
    for truth, match in zip(truths, partner, strict=True):
        if match < 0:
            tally.add(f"{category}_pck10", np.zeros(int(truth.visible.sum())))
            continue
        mine = points[match]
        diagonal = float(np.hypot(*(truth.box_xyxy[2:] - truth.box_xyxy[:2])))
        right = np.hypot(*(mine[:, :2] - truth.points_xy).T) <= PCK_SHARE * diagonal
        tally.add(f"{category}_pck10", right[truth.visible])
        tally.add(f"{category}_shown", mine[truth.visible, 2] >= HIDDEN_SCORE)
        tally.add(f"{category}_hidden_below_0.3", mine[~truth.visible, 2] < HIDDEN_SCORE)
        tally.add(f"{category}_right_above_0.9", right[mine[:, 2] >= SURE_SCORE])


def judge_lanes(found: list[np.ndarray], truths: tuple[ObjectTruth, ...], tally: Tally) -> None:
    """Add the outcomes of a frame's lanes, (24, 3) points each, to ``tally``."""
    wanted = [truth for truth in truths if is_judged(truth)]
    curves = [truth.points_xy for truth in truths]
    free, errors = set(range(len(curves))), []
    phantoms = 0
    for points in found:
        shown = points[points[:, 2] > 0, :2]
        gaps = {index: float(np.mean(distance_to_curve(shown, curves[index]))) for index in free}
        best = min(gaps, key=lambda index: gaps[index], default=-1)
        if best < 0 or gaps[best] > LANE_MATCH_PX:
            phantoms += 1
            continue
        free.remove(best)
        errors.append(gaps[best])
        tally.add("lane_points_shown", [min(1.0, len(shown) / max(1, int(truths[best].visible.sum())))])
    missed = [truth for index, truth in enumerate(truths) if index in free and is_judged(truth)]
    tally.add("lane_error_px", errors)
    tally.add("lane_recall", [1.0] * (len(wanted) - len(missed)) + [0.0] * len(missed))
    tally.add("lane_phantoms_per_frame", [phantoms])
    tally.add("lane_count_exact", [not missed and not phantoms])


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
            _judge_field_points(found[match].points, truth, tally)


def _judge_field_points(points: np.ndarray, truth: ObjectTruth, tally: Tally) -> None:
    diagonal = float(np.hypot(*(truth.box_xyxy[2:] - truth.box_xyxy[:2])))
    near = np.hypot(*(points[:, :2] - truth.points_xy).T) <= PCK_SHARE * diagonal
    right = near & (points[:, 2] > 0)
    tally.add("fields_car_pck10", right[truth.visible])
    tally.add("fields_car_hidden_below_0.3", points[~truth.visible, 2] < HIDDEN_SCORE)
    tally.add("fields_car_right_above_0.9", right[points[:, 2] >= SURE_SCORE])


def distance_to_curve(points_xy: np.ndarray, curve_xy: np.ndarray) -> np.ndarray:
    """(n,) distance of each point from a polyline (m, 2), pixels."""
    start, step = curve_xy[:-1], np.diff(curve_xy, axis=0)
    lengths = np.maximum((step**2).sum(axis=1), 1e-9)
    along = ((points_xy[:, None] - start) * step).sum(axis=2) / lengths
    nearest = start + np.clip(along, 0, 1)[..., None] * step
    return np.hypot(*np.moveaxis(points_xy[:, None] - nearest, 2, 0)).min(axis=1)
