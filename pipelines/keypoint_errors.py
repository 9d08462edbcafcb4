"""How far found keypoints are from the street's truth, in the terms of the charts and stability tables.

Judged are objects at least 32 px high of which at least 30 % is visible (``training.street_scores``); others may be
found or not. A point of an object that was missed counts as wrong.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dataset.street_labels import StreetObject
from labeling.labels import Keypoints
from labeling.schemas import Category
from training.criteria import JUDGED_HEIGHT_PX, JUDGED_SHARE, LANE_MATCH_PX
from training.metrics import pck
from training.street_scores import distance_to_curve, is_judged, match_boxes

BODIES: tuple[Category, ...] = ("car", "person")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchedFrame:
    """What was found in one frame, laid beside the truth."""

    frame: int
    pairs: tuple[tuple[StreetObject, Keypoints | None], ...]
    """Every true object of the categories asked for, judged or not, with what was found of it."""
    phantoms: tuple[Keypoints, ...]
    """Found, at least 32 px high, matching nothing, and not lying on an object that is not judged."""

    @property
    def judged(self) -> list[tuple[StreetObject, Keypoints | None]]:
        """The pairs that count."""
        return [pair for pair in self.pairs if is_judged(pair[0])]


@dataclass(frozen=True, slots=True, kw_only=True)
class PointScore:
    """Visible points of judged objects, and those that were found within 0.1 of the box diagonal."""

    right: int
    shown: int

    @property
    def pck(self) -> float:
        """0 to 1; NaN where no point was asked for."""
        return self.right / self.shown if self.shown else float("nan")


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneScore:
    """Lane lines against the truth."""

    error_px: float
    """Mean distance of found points from their line; NaN where none was found."""
    recall: float
    phantoms_per_frame: float


def by_frame(found: Iterable[Keypoints], count: int, *, first_frame: int = 0) -> list[list[Keypoints]]:
    """Labels of each of ``count`` consecutive frames, numbered from ``first_frame``."""
    frames: list[list[Keypoints]] = [[] for _ in range(count)]
    for label in found:
        frames[label.frame - first_frame].append(label)
    return frames


def match_frames(
    found: Iterable[Keypoints], truth: Sequence[Sequence[StreetObject]], *, first_frame: int = 0,
    categories: Sequence[Category] = BODIES,
) -> list[MatchedFrame]:  # fmt: skip
    """Found cars and people laid beside the truth: greedy by score, boxes that overlap by an IoU of 0.3 or more.

    Args:
        found: labels, tracked or not.
        truth: the objects of each frame; the first is numbered ``first_frame``.
        first_frame: grid number.
        categories: which are compared, each with its like.
    """
    matched = []
    frames = by_frame(found, len(truth), first_frame=first_frame)
    for number, (labels, objects) in enumerate(zip(frames, truth, strict=True), start=first_frame):
        pairs: list[tuple[StreetObject, Keypoints | None]] = []
        phantoms: list[Keypoints] = []
        for category in categories:
            mine = sorted((label for label in labels if label.category == category), key=lambda label: -label.score)
            true = [thing for thing in objects if thing.category == category]
            partner, unmatched = match_boxes(np.array([label.box_xyxy for label in mine]).reshape(-1, 4), true)
            pairs += [(thing, mine[i] if i >= 0 else None) for thing, i in zip(true, partner, strict=True)]
            phantoms += [mine[i] for i in unmatched]
        matched.append(MatchedFrame(frame=number, pairs=tuple(pairs), phantoms=tuple(phantoms)))
    return matched


def point_score(matched: Iterable[MatchedFrame], *, category: Category | None = None) -> PointScore:
    """PCK@0.1 of the box diagonal on the visible points of judged objects, of one category or all."""
    right, shown = 0, 0
    for frame in matched:
        for thing, label in frame.judged:
            if category in (None, thing.category):
                near, asked = _points_near(thing, label)
                right, shown = right + near, shown + asked
    return PointScore(right=right, shown=shown)


def recall(
    matched: Iterable[MatchedFrame], *, category: Category | None = None, from_px: float = JUDGED_HEIGHT_PX,
    to_px: float = np.inf, least_share: float = JUDGED_SHARE,
) -> tuple[int, int]:  # fmt: skip
    """Objects found, and objects asked for: of a height in ``[from_px, to_px)``, ``least_share`` of them visible."""
    asked = [
        label is not None
        for frame in matched
        for thing, label in frame.pairs
        if category in (None, thing.category)
        and from_px <= thing.box_xyxy[3] - thing.box_xyxy[1] < to_px
        and thing.visible_share >= least_share
    ]
    return sum(asked), len(asked)


def phantom_frames(matched: Sequence[MatchedFrame]) -> float:
    """Share of the frames that have a phantom, 0 to 1."""
    return sum(bool(frame.phantoms) for frame in matched) / max(1, len(matched))


def track_spans(labels: Iterable[Keypoints]) -> dict[int, int]:
    """By track, the frames from its first label to its last, gaps counted."""
    shown: dict[int, list[int]] = defaultdict(list)
    for label in labels:
        shown[label.track_id].append(label.frame)
    return {track: max(frames) - min(frames) + 1 for track, frames in shown.items()}


def lane_score(
    found: Iterable[Keypoints], truth: Sequence[Sequence[StreetObject]], *, first_frame: int = 0
) -> LaneScore:
    """Lane lines: each found line with the nearest true one, within 20 px on average."""
    errors: list[float] = []
    missed, asked, phantoms = 0, 0, 0
    for labels, objects in zip(by_frame(found, len(truth), first_frame=first_frame), truth, strict=True):
        free = [thing for thing in objects if thing.category == "lane"]
        asked += sum(map(is_judged, free))
        for label in labels:
            if label.category != "lane" or not label.present.any():
                continue
            gaps = [float(distance_to_curve(label.points[label.present, :2], line.points_xy).mean()) for line in free]
            best = int(np.argmin(gaps)) if gaps else -1
            if best < 0 or gaps[best] > LANE_MATCH_PX:
                phantoms += 1
                continue
            errors.append(gaps[best])
            free.pop(best)
        missed += sum(map(is_judged, free))
    return LaneScore(
        error_px=float(np.mean(errors)) if errors else float("nan"),
        recall=1 - missed / asked if asked else float("nan"),
        phantoms_per_frame=phantoms / max(1, len(truth)),
    )


def _points_near(thing: StreetObject, label: Keypoints | None) -> tuple[int, int]:
    """Right points and visible points of one object."""
    seen = thing.visible & np.isfinite(thing.points_xy).all(axis=1)
    if label is None:
        return 0, int(seen.sum())
    truth = np.concatenate([np.nan_to_num(thing.points_xy), seen[:, None]], axis=1)
    # ``wholebody133`` begins with the street's ``coco17``.
    return pck(label.points[: len(truth)], truth, thing.box_xyxy)
