"""Points carried by optical flow between two looks, with a check that says when they cannot be.

Sparse Lucas-Kanade on half-size grey pictures, forward and backward (Kalal et al. 2010: what does not come back to
where it started was not followed). An object is followed as a whole, by a few of its points; someone's limbs are
followed each for itself as well, and a joint that lost its ground moves with the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from labeling.labels import POINT_ABSENT, POINT_CARRIED, POINT_INTERPOLATED, Keypoints
from labeling.medians import masked_median

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


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowWindow:
    """What of a half-size picture Lucas-Kanade compares."""

    side: int
    """Pixels, odd."""
    levels: int
    """Halvings of the picture at which it begins."""


FINE, COARSE = FlowWindow(side=11, levels=3), FlowWindow(side=9, levels=2)
"""The coarse one takes two thirds of the time. Its single points are worse, which objects that are followed as a whole
hardly notice."""


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


def carry(
    previous: np.ndarray, current: np.ndarray, labels: Sequence[Keypoints], *, frame: int, window: FlowWindow = FINE
) -> list[Carried]:
    """Objects moved from one frame into one of its next neighbours, before or after.

    Args:
        previous: (h, w) uint8, ``small_grey`` of the frame that ``labels`` belong to.
        current: (h, w) uint8, the same of the frame to carry into.
        labels: objects with some present points, or a box alone (whose corners' inside is then followed).
        frame: grid number of the frame to carry into.
        window: what is compared.
    """
    if not labels:
        return []
    starts = [_points_to_follow(label) for label in labels]
    counts = np.array([len(start) for start in starts])
    used = np.arange(counts.max()) < counts[:, None]
    start, end = np.zeros((*used.shape, 2), np.float32), np.zeros((*used.shape, 2), np.float32)
    good = np.zeros(used.shape, bool)
    start[used] = np.concatenate(starts)
    end[used], good[used] = _follow(previous, current, start[used], window)
    scales, shifts = _shared_motion(start, end, good)
    followed = (good.sum(axis=1) >= _MIN_CORNERS) & (good.sum(axis=1) >= _MIN_FOLLOWED_SHARE * counts)
    carried: dict[int, Keypoints] = {}
    for schema in {label.schema for label in labels}:
        rows = [i for i, label in enumerate(labels) if label.schema == schema]
        moved = _moved([labels[i] for i in rows], scales[rows], shifts[rows], end[rows], good[rows], frame=frame)
        carried |= zip(rows, moved, strict=True)
    return [Carried(label=carried[i], followed=bool(followed[i])) for i in range(len(labels))]


def close_gaps(paths: Sequence[Sequence[Keypoints]], ends: Sequence[Keypoints]) -> list[Keypoints]:
    """Carried objects, corrected by where they were next detected.

    What was missed at the end is spread evenly over the way, so that the path meets both detections. A point that was
    missed by far was not followed: it is interpolated between the detections instead. A point that only the first end
    knows is left as carried for as long as it may be shown; one that only the other knows is absent.

    Args:
        paths: of M objects of one schema that flow carried together: each at the first detection, then wherever it was
            carried to, last into the ends' own frame.
        ends: (M) the same objects as detected there.

    Returns:
        A label of each object for every frame between the detections; those that the paths pass over are interpolated.
    """
    nodes, arrived = _nodes([[*path[:-1], end] for path, end in zip(paths, ends, strict=True)]), _nodes(paths)
    since = nodes.frames - nodes.frames[0]
    shares = (since[1:-1] / since[-1]).astype(np.float32)[:, None]
    points, came_to = nodes.points, arrived.points[:, -1]
    start, end = points[:, 0], points[:, -1]
    miss = end[..., :2] - came_to[..., :2]
    near = np.linalg.norm(miss, axis=2) <= _MAX_CLOSING * np.array([[box_diagonal(one.box_xyxy)] for one in ends])
    both = (start[..., 2] > 0) & (end[..., 2] > 0)
    believed = both & (came_to[..., 2] > 0) & near
    rough = (both & ~believed)[:, None]
    inner, source = points[:, 1:-1], nodes.point_source[:, 1:-1]
    inner[..., :2] += shares[..., None] * np.where(believed[..., None], miss, 0)[:, None]
    np.copyto(inner, _straight(start, end, shares), where=rough[..., None])
    np.copyto(inner[..., 2], np.minimum(start[..., 2], end[..., 2])[:, None], where=both[:, None])
    np.copyto(source, POINT_INTERPOLATED, where=rough)
    unseen = (since[1:-1] > UNSEEN_FRAMES)[:, None] & ~both[:, None]
    inner[unseen], source[unseen] = 0, POINT_ABSENT
    nodes.boxes_xyxy[:, 1:-1] += shares * (nodes.boxes_xyxy[:, -1] - arrived.boxes_xyxy[:, -1])[:, None]
    nodes.scores[:, 1:-1] = _straight(nodes.scores[:, 0], nodes.scores[:, -1], shares[:, 0])
    return _between([path[0] for path in paths], nodes)


def along_path(path: Sequence[Keypoints]) -> list[Keypoints]:
    """The labels of a path after its first, those between its nodes interpolated."""
    return [*_between(path[:1], _nodes([path])), path[-1]] if len(path) > 1 else []


def interpolate_gaps(starts: Sequence[Keypoints], ends: Sequence[Keypoints]) -> list[Keypoints]:
    """The labels of objects of one schema between two frames, on straight lines; points that only one end knows are
    absent."""
    return _between(starts, _nodes(list(zip(starts, ends, strict=True)))) if ends[0].frame - starts[0].frame > 1 else []


class _Nodes(NamedTuple):
    """Paths of M objects of one schema over the same N frames, side by side: what is done to all of them costs hardly
    more than what is done to one."""

    frames: np.ndarray
    """(N,) int64, rising."""
    boxes_xyxy: np.ndarray
    """(M, N, 4) float32."""
    points: np.ndarray
    """(M, N, K, 3) float32."""
    point_source: np.ndarray
    """(M, N, K) int8."""
    scores: np.ndarray
    """(M, N) float64."""


def _nodes(paths: Sequence[Sequence[Keypoints]]) -> _Nodes:
    return _Nodes(
        frames=np.array([label.frame for label in paths[0]]),
        boxes_xyxy=np.array([[label.box_xyxy for label in path] for path in paths]),
        points=np.array([[label.points for label in path] for path in paths]),
        point_source=np.array([[label.point_source for label in path] for path in paths]),
        scores=np.array([[label.score for label in path] for path in paths]),
    )


def _straight(start: np.ndarray, end: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """(M, T, ...) values at T shares, (T, 1...), of the way from (M, ...) to (M, ...)."""
    shares = shares.reshape(-1, *(1,) * (start.ndim - 1))
    return (1 - shares) * start[:, None] + shares * end[:, None]


def _between(starts: Sequence[Keypoints], nodes: _Nodes) -> list[Keypoints]:
    """The labels of M objects in every frame between the first node and the last: the nodes as they are, the others on
    straight lines between their neighbours."""
    frames = np.arange(nodes.frames[0] + 1, nodes.frames[-1])
    last = np.searchsorted(nodes.frames, frames, side="right") - 1
    following = last + 1
    gone = frames - nodes.frames[last]
    at_node = (gone == 0)[:, None]
    after = (gone / (nodes.frames[following] - nodes.frames[last])).astype(np.float32)[:, None]
    before = 1 - after
    point_scores = nodes.points[..., 2]
    least = np.minimum(point_scores[:, last], point_scores[:, following])
    known = (least > 0) | at_node
    points = before[..., None] * nodes.points[:, last] + after[..., None] * nodes.points[:, following]
    points[..., 2] = np.where(at_node, point_scores[:, last], least)
    points *= known[..., None]
    sources = np.where(at_node, nodes.point_source[:, last], np.int8(POINT_INTERPOLATED)) * known
    boxes = before * nodes.boxes_xyxy[:, last] + after * nodes.boxes_xyxy[:, following]
    scores = before[:, 0] * nodes.scores[:, last] + after[:, 0] * nodes.scores[:, following]
    numbers = frames.tolist()
    return [
        label
        for start, *of_one in zip(starts, boxes, points, sources, scores, strict=True)
        for label in start.elsewhere(
            numbers, boxes_xyxy=of_one[0], points=of_one[1], point_source=of_one[2], scores=of_one[3]
        )
    ]


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


def _follow(
    previous: np.ndarray, current: np.ndarray, points: np.ndarray, window: FlowWindow
) -> tuple[np.ndarray, np.ndarray]:
    """Where (N, 2) full-size points went, and (N,) bool: those that come back when followed backwards."""
    # Pixel centres lie on integers: full-size x is 2 x' + 0.5 for half-size x'.
    start = ((points - 0.5) / 2)[:, None]
    options = {
        "winSize": (window.side, window.side), "maxLevel": window.levels, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW
    }  # fmt: skip
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
    labels: Sequence[Keypoints], scales: np.ndarray, shifts: np.ndarray, ends: np.ndarray, good: np.ndarray, *,
    frame: int,
) -> list[Keypoints]:  # fmt: skip
    """Objects of one schema after their (N,) ``scales`` and (N, 2) ``shifts``, of whose points (N, P, 2) ``ends`` are
    where those that were followed came to."""
    points = np.array([label.points for label in labels])
    present = points[..., 2] > 0
    places = points[..., :2] * scales[:, None, None] + shifts[:, None]
    if labels[0].category == "person":
        # A joint that slipped along an edge returns to its start and is wrong all the same: the body bounds it.
        diagonals = np.array([box_diagonal(label.box_xyxy) for label in labels])
        slack = _LIMB_SLACK * np.array([abs(frame - label.frame) for label in labels]) * diagonals + 0.25
        own = np.arange(ends.shape[1]) < present.sum(axis=1)[:, None]
        came_to = np.zeros_like(places)
        came_to[present] = ends[own]
        found = np.zeros_like(present)
        found[present] = good[own]
        near = found & (np.linalg.norm(came_to - places, axis=2) <= slack[:, None])
        places[near] = came_to[near]
    points[..., :2] = np.where(present[..., None], places, points[..., :2])
    boxes = np.array([label.box_xyxy for label in labels]).reshape(-1, 2, 2) * scales[:, None, None] + shifts[:, None]
    return [
        replace(
            label, frame=frame, points=points[i], box_xyxy=boxes[i].reshape(4).astype(np.float32),
            point_source=np.where(present[i], np.int8(POINT_CARRIED), label.point_source),
        )
        for i, label in enumerate(labels)
    ]  # fmt: skip
