"""How well labels that were found agree with labels that were wanted: boxes by overlap, points by PCK.

Objects of one frame and category are paired one to one so that the summed overlap is largest (Kuhn 1955). What is
wanted and not found counts as a miss, and the number of misses stays beside every mean.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from labeling.boxes import best_pairs
from labeling.camera import PictureMap
from labeling.errors import DataError
from labeling.labels import Keypoints
from labeling.skeleton_video import DEFAULT_STYLE
from training.criteria import MATCH_IOU, PCK_SHARE
from training.metrics import pck

LEAST_POINTS = 4
"""Objects that show fewer points are not compared."""
LEAST_SCORE = DEFAULT_STYLE.min_score
"""Points that score less count as absent: they are not drawn either."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxAgreement:
    """Found boxes against wanted ones; sums, so that frames and clips add up."""

    wanted: int = 0
    """Wanted boxes, over all frames."""
    matched: int = 0
    """Of these, found with an overlap of ``MATCH_IOU``."""
    found: int = 0
    """Found boxes, over all frames."""
    iou_sum: float = 0.0
    """Of the matched ones; a miss adds nothing."""

    def __add__(self, other: "BoxAgreement") -> "BoxAgreement":
        return BoxAgreement(
            wanted=self.wanted + other.wanted, matched=self.matched + other.matched, found=self.found + other.found,
            iou_sum=self.iou_sum + other.iou_sum,
        )  # fmt: skip

    @property
    def mean_iou(self) -> float:
        """Mean overlap over all wanted boxes, a miss counting 0; NaN where none is wanted."""
        return self.iou_sum / self.wanted if self.wanted else float("nan")

    @property
    def recall(self) -> float:
        """Share of the wanted boxes that were found; NaN where none is wanted."""
        return self.matched / self.wanted if self.wanted else float("nan")


@dataclass(frozen=True, slots=True, kw_only=True)
class PointAgreement:
    """Found keypoints against wanted ones; sums, so that frames and clips add up."""

    wanted: int = 0
    """Wanted objects, over all frames."""
    matched: int = 0
    """Of these, found with an overlap of ``MATCH_IOU``."""
    found: int = 0
    """Found objects, over all frames."""
    shown: int = 0
    """Points of the wanted objects; those of missed objects count."""
    right: int = 0
    """Of these, found within ``PCK_SHARE`` of the box diagonal."""
    distances: tuple[float, ...] = ()
    """Of the points that both sides show, in box diagonals."""

    def __add__(self, other: "PointAgreement") -> "PointAgreement":
        return PointAgreement(
            wanted=self.wanted + other.wanted, matched=self.matched + other.matched, found=self.found + other.found,
            shown=self.shown + other.shown, right=self.right + other.right,
            distances=self.distances + other.distances,
        )  # fmt: skip

    @property
    def pck(self) -> float:
        """Share of the wanted points that are right, a missed object's points being wrong; NaN where none is wanted."""
        return self.right / self.shown if self.shown else float("nan")

    @property
    def recall(self) -> float:
        """Share of the wanted objects that were found; NaN where none is wanted."""
        return self.matched / self.wanted if self.wanted else float("nan")

    @property
    def precision(self) -> float:
        """Share of the found objects that are wanted ones; NaN where none is found."""
        return self.matched / self.found if self.found else float("nan")

    @property
    def median_distance(self) -> float:
        """Of the points that both sides show, in box diagonals; NaN where there is none."""
        return float(np.median(self.distances)) if self.distances else float("nan")


def box_agreement(found: Sequence[Keypoints], wanted: Sequence[Keypoints]) -> BoxAgreement:
    """Boxes of all frames, in the same picture; each category among itself.

    Args:
        found: what the extractors see; track ids do not matter.
        wanted: what should be there.
    """
    pairs = match_objects(found, wanted)
    overlaps = [overlap for _, _, overlap in pairs]
    return BoxAgreement(wanted=len(wanted), matched=len(pairs), found=len(found), iou_sum=float(sum(overlaps)))


def point_agreement(
    found: Sequence[Keypoints], wanted: Sequence[Keypoints], *, threshold: float = PCK_SHARE
) -> PointAgreement:
    """Keypoints of all frames; objects with fewer than ``LEAST_POINTS`` sure points are left out on both sides.

    Objects are paired by the hulls of their points: what is read back from a drawn skeleton has no other box.

    Args:
        found: cars and people as the extractors, or a skeleton video, show them.
        wanted: what should be there; their boxes' diagonals are the unit of length.
        threshold: share of the diagonal within which a point is right.

    Raises:
        DataError: the two sides know a category by different points.
    """
    found, wanted = _with_points(found), _with_points(wanted)
    pairs = match_objects([_hulled(one) for one in found], [_hulled(one) for one in wanted])
    total = PointAgreement(
        wanted=len(wanted), matched=len(pairs), found=len(found), shown=sum(int(one.present.sum()) for one in wanted)
    )
    return sum((_of_pair(found[i], wanted[j], threshold) for i, j, _ in pairs), total)


def match_objects(found: Sequence[Keypoints], wanted: Sequence[Keypoints]) -> list[tuple[int, int, float]]:
    """Pairs (index of the found, index of the wanted, overlap), frame by frame and category by category."""
    groups: dict[tuple[int, str], tuple[list[int], list[int]]] = {}
    for side, labels in enumerate((found, wanted)):
        for index, label in enumerate(labels):
            groups.setdefault((label.frame, label.category), ([], []))[side].append(index)
    pairs = []
    for ours, theirs in groups.values():
        if not ours or not theirs:
            continue
        found_boxes = np.stack([found[i].box_xyxy for i in ours]).astype(np.float64)
        wanted_boxes = np.stack([wanted[j].box_xyxy for j in theirs]).astype(np.float64)
        pairs += [
            (ours[row], theirs[column], overlap)
            for row, column, overlap in best_pairs(found_boxes, wanted_boxes, least_iou=MATCH_IOU)
        ]
    return pairs


def mapped_labels(labels: Sequence[Keypoints], picture: PictureMap) -> list[Keypoints]:
    """Labels in the pixels of a picture that was scaled and cropped; what lies outside it is left out.

    Boxes are cut at the border, points beyond it are absent.
    """
    scale, offset = np.array([picture.scale_x, picture.scale_y]), np.array([picture.crop_x, picture.crop_y])
    last = np.array([picture.width - 1.0, picture.height - 1.0])
    mapped = []
    for label in labels:
        corners = (label.box_xyxy.reshape(2, 2).astype(np.float64) + 0.5) * scale - 0.5 - offset
        box = np.clip(corners, 0.0, last)
        if (box[1] - box[0]).min() <= 0:
            continue
        points = label.points.copy()
        points[:, :2] = (points[:, :2] + 0.5) * scale - 0.5 - offset
        outside = ((points[:, :2] < -0.5) | (points[:, :2] > last + 0.5)).any(axis=1)
        points[outside] = 0.0
        sources = np.where(points[:, 2] > 0, label.point_source, 0).astype(np.int8)
        mapped.append(replace(label, box_xyxy=box.reshape(4).astype(np.float32), points=points, point_source=sources))
    return mapped


def _with_points(labels: Sequence[Keypoints]) -> list[Keypoints]:
    """Cars and people with enough points, those that score too little absent."""
    sure = []
    for label in labels:
        kept = label.points[:, 2] >= LEAST_SCORE
        if label.category != "lane" and kept.sum() >= LEAST_POINTS:
            sure.append(replace(label, points=np.where(kept[:, None], label.points, 0.0).astype(np.float32)))
    return sure


def _hulled(label: Keypoints) -> Keypoints:
    shown = label.points[label.present, :2]
    return replace(label, box_xyxy=np.concatenate([shown.min(axis=0), shown.max(axis=0)]).astype(np.float32))


def _of_pair(found: Keypoints, wanted: Keypoints, threshold: float) -> PointAgreement:
    """What a matched pair adds: right points and distances."""
    count = min(len(found.points), len(wanted.points))
    if found.schema != wanted.schema and {found.schema, wanted.schema} != {"wholebody133", "coco17"}:
        raise DataError(
            f"points of {found.schema} and {wanted.schema} cannot be compared; use the extractors that labelled the job"
        )
    # The first 17 points of a whole body are COCO's; its others cannot be right when nobody looked for them.
    ours, theirs = found.points[:count], wanted.points[:count]
    right, _ = pck(ours, theirs, wanted.box_xyxy, threshold=threshold)
    both = (ours[:, 2] > 0) & (theirs[:, 2] > 0)
    diagonal = float(np.hypot(*(wanted.box_xyxy[2:] - wanted.box_xyxy[:2])))
    gaps = np.linalg.norm(ours[both, :2] - theirs[both, :2], axis=1) / max(diagonal, 1e-9)
    return PointAgreement(right=right, distances=tuple(gaps.tolist()))
