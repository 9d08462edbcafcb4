"""Points carried from frame to frame by optical flow, with a check that says when they cannot be.

Sparse Lucas-Kanade on half-size grey pictures, forward and backward (Kalal et al. 2010: what does not come back to
where it started was not followed). An object is followed as a whole: points that lost their ground move with the rest.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from labeling.labels import POINT_ABSENT, POINT_CARRIED, POINT_INTERPOLATED, Keypoints
from labeling.schemas import Category

_WINDOW = (13, 13)
_LEVELS = 3
_MAX_RETURN_PX = 0.7
"""Half-size pixels by which a point may miss its start after going there and back."""
_MIN_FOLLOWED_SHARE = 0.4
"""An object of which less is followed is lost."""
_MIN_CORNERS = 4
"""Points on an even surface follow nothing: an object needs this many that return."""
_SLACK: dict[Category, float] = {"car": 0.01, "person": 0.04, "lane": 0.01}
"""Share of the box diagonal by which a point's own flow may differ from the object's in one frame: limbs swing."""
_MAX_CLOSING = 0.15
"""Share of the box diagonal by which a carried point may miss its next detection before the flow is not believed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Carried:
    """An object as far as flow could take it."""

    label: Keypoints
    followed: bool
    """False: too little of it could be followed; the points are where the last motion leaves them."""


def small_grey(frame: np.ndarray) -> np.ndarray:
    """(H/2, W/2) uint8 grey picture of an (H, W, 3) uint8 RGB frame."""
    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    return cv2.resize(grey, (grey.shape[1] // 2, grey.shape[0] // 2), interpolation=cv2.INTER_AREA)


def carry(previous: np.ndarray, current: np.ndarray, labels: list[Keypoints], *, frame: int) -> list[Carried]:
    """Objects moved from one frame into its neighbour, before or after.

    Args:
        previous: (h, w) uint8, ``small_grey`` of the frame that ``labels`` belong to.
        current: (h, w) uint8, the same of the frame to carry into.
        labels: objects with some present points, or a box alone (whose corners' inside is then followed).
        frame: grid number of the frame to carry into.
    """
    starts = [_points_to_follow(label) for label in labels]
    if not labels:
        return []
    moved, returned = _follow(previous, current, np.concatenate(starts))
    ends = np.cumsum([len(start) for start in starts])[:-1]
    carried = []
    for label, start, end, good in zip(labels, starts, np.split(moved, ends), np.split(returned, ends), strict=True):
        carried.append(_moved(label, start, end, good, frame=frame))
    return carried


def close_gap(path: list[Keypoints], end: Keypoints) -> list[Keypoints]:
    """A carried object, corrected by where it was next detected.

    What was missed at the end is spread evenly over the way, so that the path meets both detections. A point that was
    missed by far was not followed: it is interpolated between the detections instead. A point that only one end knows
    is left as carried, or absent.

    Args:
        path: the object at the first detection, then in every frame up to the last before ``end``, then carried into
            ``end``'s own frame: G + 1 labels for a gap of G frames.
        end: the same object as detected there.

    Returns:
        The G - 1 labels between the detections.
    """
    start, arrived = path[0], path[-1]
    miss = end.points[:, :2] - arrived.points[:, :2]
    both = start.present & end.present
    believed = both & arrived.present & (np.linalg.norm(miss, axis=1) <= _MAX_CLOSING * box_diagonal(end.box_xyxy))
    out = []
    for step, label in enumerate(path[1:-1], start=1):
        share = np.float32(step / (len(path) - 1))
        points, source = label.points.copy(), label.point_source.copy()
        points[believed, :2] += share * miss[believed]
        rough = both & ~believed
        points[rough] = (1 - share) * start.points[rough] + share * end.points[rough]
        points[both, 2] = np.minimum(start.points[both, 2], end.points[both, 2])
        source[rough] = POINT_INTERPOLATED
        box = label.box_xyxy + share * (end.box_xyxy - arrived.box_xyxy)
        score = float((1 - share) * start.score + share * end.score)
        out.append(replace(label, points=points, point_source=source, box_xyxy=box, score=score))
    return out


def interpolate_gap(start: Keypoints, end: Keypoints) -> list[Keypoints]:
    """The labels between two detections of one object, on straight lines; points that only one knows are absent."""
    gap = end.frame - start.frame
    both = start.present & end.present
    out = []
    for step in range(1, gap):
        share = np.float32(step / gap)
        points = ((1 - share) * start.points + share * end.points) * both[:, None]
        points[both, 2] = np.minimum(start.points[both, 2], end.points[both, 2])
        out.append(
            replace(
                start, frame=start.frame + step, points=points,
                point_source=np.where(both, POINT_INTERPOLATED, POINT_ABSENT).astype(np.int8),
                box_xyxy=(1 - share) * start.box_xyxy + share * end.box_xyxy,
                score=float((1 - share) * start.score + share * end.score),
            )
        )  # fmt: skip
    return out


def box_diagonal(box_xyxy: np.ndarray) -> float:
    """Length of a box's diagonal, pixels, at least 1."""
    return max(1.0, float(np.hypot(*(box_xyxy[2:] - box_xyxy[:2]))))


def _points_to_follow(label: Keypoints) -> np.ndarray:
    """(N, 2) float32 full-size pixels: the present points, and a grid inside the box that helps when they are few."""
    left, top, right, bottom = label.box_xyxy
    columns, rows = np.meshgrid(np.linspace(0.2, 0.8, 4), np.linspace(0.2, 0.8, 4))
    grid = np.stack([left + columns * (right - left), top + rows * (bottom - top)], axis=-1).reshape(-1, 2)
    return np.concatenate([label.points[label.present, :2], grid]).astype(np.float32)


def _follow(previous: np.ndarray, current: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where (N, 2) full-size points went, and (N,) bool: those that come back when followed backwards."""
    # Pixel centres lie on integers: full-size x is 2 x' + 0.5 for half-size x'.
    start = ((points - 0.5) / 2)[:, None]
    options = {"winSize": _WINDOW, "maxLevel": _LEVELS, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    there, found, _ = cv2.calcOpticalFlowPyrLK(previous, current, start, start.copy(), **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(current, previous, there, start.copy(), **options)
    distance = np.linalg.norm((back - start)[:, 0], axis=1)
    good = (found[:, 0] > 0) & (returned[:, 0] > 0) & (distance < _MAX_RETURN_PX)
    height, width = current.shape
    inside = (there[:, 0] >= 0).all(axis=1) & (there[:, 0, 0] <= width - 1) & (there[:, 0, 1] <= height - 1)
    return there[:, 0] * 2 + 0.5, good & inside


def _moved(label: Keypoints, start: np.ndarray, end: np.ndarray, good: np.ndarray, *, frame: int) -> Carried:
    count = int(label.present.sum())
    followed = good.sum() >= _MIN_CORNERS and good.mean() >= _MIN_FOLLOWED_SHARE
    scale, shift = _scale_and_shift(start[good], end[good]) if good.sum() >= 2 else (1.0, np.zeros(2))
    modelled = start * scale + shift
    # A point that slipped along an edge returns to its start and is wrong all the same: the object's motion bounds it.
    slack = _SLACK[label.category] * box_diagonal(label.box_xyxy) + 0.25
    trusted = good & (np.linalg.norm(end - modelled, axis=1) <= slack)
    new = np.where(trusted[:, None], end, modelled).astype(np.float32)
    points, source = label.points.copy(), label.point_source.copy()
    points[label.present, :2] = new[:count]
    source[label.present] = POINT_CARRIED
    box = (label.box_xyxy.reshape(2, 2) * scale + shift).reshape(4).astype(np.float32)
    return Carried(
        label=replace(label, frame=frame, points=points, point_source=source, box_xyxy=box), followed=bool(followed)
    )


def _scale_and_shift(start: np.ndarray, end: np.ndarray) -> tuple[float, np.ndarray]:
    """The motion ``end = scale start + shift`` that most points share: medians, so that half of them may err."""
    middle = np.median(start, axis=0)
    arms, moved_arms = start - middle, end - np.median(end, axis=0)
    lengths = np.linalg.norm(arms, axis=1)
    far = lengths > np.median(lengths)
    ratio = np.median((arms[far] * moved_arms[far]).sum(axis=1) / (lengths[far] ** 2)) if far.any() else 1.0
    scale = float(np.clip(ratio, 0.8, 1.25))
    return scale, np.median(end - scale * start, axis=0)
