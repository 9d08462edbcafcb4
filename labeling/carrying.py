"""Points carried by optical flow between two looks, with a check that says when they cannot be.

Sparse Lucas-Kanade on half-size grey pictures, forward and backward (Kalal et al. 2010: what does not come back to
where it started was not followed). An object is followed as a whole, by a few of its points; someone's limbs are
followed each for itself as well, and a joint that lost its ground moves with the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from labeling.labels import POINT_ABSENT, POINT_CARRIED, POINT_INTERPOLATED, Keypoints
from labeling.medians import masked_median

_WINDOW = (11, 11)
_LEVELS = 3
_MAX_RETURN_PX = 0.7
"""Half-size pixels by which a point may miss its start after going there and back."""
_MIN_FOLLOWED_SHARE = 0.4
"""An object of which less is followed is lost."""
_MIN_CORNERS = 4
"""Points on an even surface follow nothing: an object needs this many that return."""
_RIGID_POINTS = 12
"""As many keypoints of what does not bend are followed: the cost of flow goes with the number of points."""
_LIMB_SLACK = 0.04
"""Share of the box diagonal by which a joint's own flow may differ from the body's in one frame: limbs swing."""
_MAX_CLOSING = 0.15
"""Share of the box diagonal by which a carried point may miss its next detection before the flow is not believed."""
UNSEEN_FRAMES = 6
"""Nothing is shown that was not seen within a quarter of a second."""


_FEW, _MANY = (
    np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    for places in (np.linspace(0.3, 0.7, 2), np.linspace(0.2, 0.8, 4))
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Carried:
    """An object as far as flow could take it."""

    label: Keypoints
    followed: bool
    """False: too little of it could be followed; the points are where the motion of what could be takes them, or where
    they were."""


def small_grey(frame: np.ndarray) -> np.ndarray:
    """(H/2, W/2) uint8 grey picture of an (H, W, 3) uint8 RGB frame."""
    grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
    return cv2.resize(grey, (grey.shape[1] // 2, grey.shape[0] // 2), interpolation=cv2.INTER_AREA)


def carry(previous: np.ndarray, current: np.ndarray, labels: Sequence[Keypoints], *, frame: int) -> list[Carried]:
    """Objects moved from one frame into one of its next neighbours, before or after.

    Args:
        previous: (h, w) uint8, ``small_grey`` of the frame that ``labels`` belong to.
        current: (h, w) uint8, the same of the frame to carry into.
        labels: objects with some present points, or a box alone (whose corners' inside is then followed).
        frame: grid number of the frame to carry into.
    """
    if not labels:
        return []
    starts = [_points_to_follow(label) for label in labels]
    counts = np.array([len(start) for start in starts])
    used = np.arange(counts.max()) < counts[:, None]
    start, end = np.zeros((*used.shape, 2), np.float32), np.zeros((*used.shape, 2), np.float32)
    good = np.zeros(used.shape, bool)
    start[used] = np.concatenate(starts)
    end[used], good[used] = _follow(previous, current, start[used])
    scales, shifts = _shared_motion(start, end, good)
    followed = (good.sum(axis=1) >= _MIN_CORNERS) & (good.sum(axis=1) >= _MIN_FOLLOWED_SHARE * counts)
    return [
        Carried(
            label=_moved(label, float(scales[i]), shifts[i], end[i], good[i], frame=frame), followed=bool(followed[i])
        )
        for i, label in enumerate(labels)
    ]


def close_gap(path: Sequence[Keypoints], end: Keypoints) -> list[Keypoints]:
    """A carried object, corrected by where it was next detected.

    What was missed at the end is spread evenly over the way, so that the path meets both detections. A point that was
    missed by far was not followed: it is interpolated between the detections instead. A point that only the first end
    knows is left as carried for as long as it may be shown; one that only the other knows is absent.

    Args:
        path: the object at the first detection, then wherever it was carried to, last into ``end``'s own frame.
        end: the same object as detected there.

    Returns:
        A label for every frame between the detections; those that the path passes over are interpolated.
    """
    start, arrived = path[0], path[-1]
    gap = end.frame - start.frame
    miss = end.points[:, :2] - arrived.points[:, :2]
    both = start.present & end.present
    believed = both & arrived.present & (np.linalg.norm(miss, axis=1) <= _MAX_CLOSING * box_diagonal(end.box_xyxy))
    rough = both & ~believed
    nodes = [start]
    for label in path[1:-1]:
        share = np.float32((label.frame - start.frame) / gap)
        points, source = label.points.copy(), label.point_source.copy()
        points[believed, :2] += share * miss[believed]
        points[rough] = (1 - share) * start.points[rough] + share * end.points[rough]
        points[both, 2] = np.minimum(start.points[both, 2], end.points[both, 2])
        source[rough] = POINT_INTERPOLATED
        if label.frame - start.frame > UNSEEN_FRAMES:
            points[~both], source[~both] = 0, POINT_ABSENT
        box = label.box_xyxy + share * (end.box_xyxy - arrived.box_xyxy)
        score = float((1 - share) * start.score + share * end.score)
        nodes.append(replace(label, points=points, point_source=source, box_xyxy=box, score=score))
    return along_path([*nodes, end])[:-1]


def along_path(path: Sequence[Keypoints]) -> list[Keypoints]:
    """The labels of a path after its first, those between its nodes interpolated."""
    return [label for a, b in pairwise(path) for label in (*interpolate_gap(a, b), b)]


def interpolate_gap(start: Keypoints, end: Keypoints) -> list[Keypoints]:
    """The labels between two labels of one object, on straight lines; points that only one knows are absent."""
    gap = end.frame - start.frame
    if gap == 1:
        return []
    both = start.present & end.present
    shares = (np.arange(1, gap) / gap).astype(np.float32)
    first, last = (1 - shares)[:, None], shares[:, None]
    points = (first[..., None] * start.points + last[..., None] * end.points) * both[:, None]
    points[..., 2] = np.where(both, np.minimum(start.points[:, 2], end.points[:, 2]), 0)
    source = np.where(both, POINT_INTERPOLATED, POINT_ABSENT).astype(np.int8)
    return start.elsewhere(
        range(start.frame + 1, end.frame), boxes_xyxy=first * start.box_xyxy + last * end.box_xyxy, points=points,
        point_source=np.broadcast_to(source, points.shape[:2]),
        scores=(1 - shares) * start.score + shares * end.score,
    )  # fmt: skip


def box_diagonal(box_xyxy: np.ndarray) -> float:
    """Length of a box's diagonal, pixels, at least 1."""
    return max(1.0, float(np.hypot(*(box_xyxy[2:] - box_xyxy[:2]))))


def _points_to_follow(label: Keypoints) -> np.ndarray:
    """(N, 2) float32 full-size pixels: present points, and a grid inside the box that helps when they are few."""
    left, top, right, bottom = label.box_xyxy
    own = label.points[label.present, :2]
    if label.category != "person":
        own = own[:: max(1, -(-len(own) // _RIGID_POINTS))]
    grid = _FEW if len(own) > _MIN_CORNERS else _MANY
    return np.concatenate([own, (left, top) + grid * (right - left, bottom - top)]).astype(np.float32)


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


def _shared_motion(start: np.ndarray, end: np.ndarray, good: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The motion ``end = scale start + shift`` that most of each object's points share: medians, half may err.

    Args:
        start: (N, P, 2).
        end: (N, P, 2).
        good: (N, P) bool: which to trust; an object with fewer than two stays where it is.

    Returns:
        (N,) scales, and (N, 2) shifts.
    """
    arms = start - masked_median(start, good)[:, None]
    moved_arms = end - masked_median(end, good)[:, None]
    lengths = np.linalg.norm(arms, axis=2)
    far = good & (lengths > masked_median(lengths, good)[:, None])
    ratios = (arms * moved_arms).sum(axis=2) / np.maximum(lengths**2, 1e-9)
    scales = np.where(far.any(axis=1), np.clip(masked_median(ratios, far), 0.8, 1.25), 1.0)
    shifts = masked_median(end - scales[:, None, None] * start, good)
    still = good.sum(axis=1) < 2
    scales[still], shifts[still] = 1.0, 0.0
    return scales, shifts


def _moved(
    label: Keypoints, scale: float, shift: np.ndarray, end: np.ndarray, good: np.ndarray, *, frame: int
) -> Keypoints:
    points, source = label.points.copy(), label.point_source.copy()
    present = label.present
    count = int(present.sum())
    points[present, :2] = points[present, :2] * scale + shift
    if label.category == "person":
        # A joint that slipped along an edge returns to its start and is wrong all the same: the body bounds it.
        slack = _LIMB_SLACK * abs(frame - label.frame) * box_diagonal(label.box_xyxy) + 0.25
        own = good[:count] & (np.linalg.norm(end[:count] - points[present, :2], axis=1) <= slack)
        points[np.flatnonzero(present)[own], :2] = end[:count][own]
    source[present] = POINT_CARRIED
    box = (label.box_xyxy.reshape(2, 2) * scale + shift).reshape(4).astype(np.float32)
    return replace(label, frame=frame, points=points, point_source=source, box_xyxy=box)
