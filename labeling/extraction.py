"""Frames of a run to tracked, steady keypoints, looking no more often than the scene needs.

The networks are nearly all the cost. With ``exact`` they see every frame; with the other efforts they see some, and
between these the points of cars and people are carried by optical flow, and lanes, which have no points of their own to
follow, by straight lines. Looks come closer together when objects grow fast, appear, vanish, or are not where flow put
them; a network that has seen nothing for a second looks twice per second.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from labeling.carrying import UNSEEN_FRAMES, along_path, box_diagonal, carry, close_gap, interpolate_gap, small_grey
from labeling.extractors import Extractors
from labeling.labels import Keypoints
from labeling.observation import Look, looks_of
from labeling.picture_turn import picture_turn, turn_view
from labeling.smoothing import smooth_tracks
from labeling.tracking import RunTracker, TrackerSettings, drop_passing_tracks

Effort = Literal["fast", "balanced", "exact"]


@dataclass(frozen=True, slots=True, kw_only=True)
class EffortSettings:
    """How often the networks look. Gaps are in frames of the 24 fps grid; 1 is every frame."""

    max_gap: int
    """Longest time between two looks: half a second at most, so that nothing is shown that was not seen 0.25 s away."""
    max_person_gap: int
    """The same while someone walks: legs swing at about 1 Hz and do not go straight."""
    max_lane_gap: int
    """The same for lane lines, which have no points to follow."""
    flow_step: int = 1
    """Frames between two steps of the optical flow that carries points; 0 for none: points go straight then."""
    max_bend: float = 0.03
    """Share of its size by which an object's growth may depart from a straight line where no flow follows it."""
    max_miss: float = 0.03
    """Share of the box diagonal by which carried points may miss the next look before looks come closer together."""
    quiet_frames: int = 24
    """A network that has seen nothing for so long looks only every ``quiet_gap`` frames."""
    quiet_gap: int = 12


EFFORTS: dict[Effort, EffortSettings] = {
    "exact": EffortSettings(max_gap=1, max_person_gap=1, max_lane_gap=1, flow_step=0, quiet_gap=1),
    "balanced": EffortSettings(max_gap=8, max_person_gap=4, max_lane_gap=12, flow_step=2),
    "fast": EffortSettings(max_gap=12, max_person_gap=8, max_lane_gap=12, flow_step=3, max_bend=0.05, max_miss=0.05),
}

_WAITING_GAP = 6
"""While nothing has been seen for a moment only."""
_MIN_LOOKS = 2
_MIN_FRAMES = 6
"""What lasts less than a quarter of a second, or was seen once, is taken for a mistake."""
_TURN_STEP = 4
"""Frames after which two pictures of a camera that turns sharply have too little in common."""
_NEAR_PX = 48.0
"""Objects at least this high bring looks closer together when they come or go; what is far may be seen later."""
_BORDER_PX = 4.0
"""What is nearer to the picture's border is expected to leave it."""


def label_frames(
    frames: Iterable[np.ndarray],
    *,
    first_frame: int,
    extractors: Extractors,
    effort: Effort | EffortSettings = "balanced",
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
        Labels in the order of frames, then of tracks, whose ids count from 0 as objects appear. Objects whose category
        has no keypoint network have a box, a track and absent points.

    Raises:
        ModelError: a network's output that is not finite.
    """
    return label_with(looks_of(extractors), frames, first_frame=first_frame, effort=effort, breaks=breaks)


def label_with(
    looks: Iterable[Look],
    frames: Iterable[np.ndarray],
    *,
    first_frame: int,
    effort: Effort | EffortSettings = "balanced",
    breaks: frozenset[int] = frozenset(),
) -> list[Keypoints]:
    """As ``label_frames``, for anything that looks at a frame and tells what it sees."""
    settings = effort if isinstance(effort, EffortSettings) else EFFORTS[effort]
    channels = [_Channel(look, settings) for look in looks]
    for number, frame in enumerate(frames, start=first_frame):
        views = _Views(frame)
        for channel in channels:
            channel.push(views, number=number, fresh=number in breaks)
    for channel in channels:
        channel.finish()
    labels = _renumbered([channel.labels for channel in channels])
    labels = drop_passing_tracks(labels, min_looks=_MIN_LOOKS, min_frames=_MIN_FRAMES)
    return smooth_tracks(labels, breaks=breaks)


class _Views:
    """A frame and its small pictures, each made once, when somebody first needs it."""

    def __init__(self, frame: np.ndarray) -> None:
        self.frame = frame

    @cached_property
    def grey(self) -> np.ndarray:
        """For flow."""
        return small_grey(self.frame)

    @cached_property
    def far(self) -> np.ndarray:
        """For the camera's turn."""
        return turn_view(self.frame)


class _Channel:
    """One kind of look (objects, or a bottom-up network's) with its own rhythm, tracks and carried points."""

    def __init__(self, look: Look, settings: EffortSettings) -> None:
        self.look, self.settings = look, settings
        self.labels: list[Keypoints] = []
        self.looks = 0
        self._tracker = RunTracker(TrackerSettings(high_score=look.sure_score))
        self._forget()

    def _forget(self) -> None:
        self._tracker.restart()
        self._key: list[Keypoints] = []
        self._key_frame: int | None = None
        self._paths: dict[int, list[Keypoints]] = {}
        self._grey: tuple[np.ndarray, int] | None = None
        self._far: tuple[np.ndarray, int] | None = None
        self._turned = np.eye(3)
        self._latest: tuple[_Views, int] | None = None
        self._slippery: set[int] = set()
        self._gap = 1
        self._last_seen: int | None = None

    @property
    def _flows(self) -> bool:
        return self.look.carries and self.settings.flow_step > 0

    def push(self, views: _Views, *, number: int, fresh: bool) -> None:
        """The next frame of the run; ``fresh`` when nothing of the one before it holds any more."""
        if fresh:
            self.finish()
            self._forget()
        self._latest = (views, number)
        if self._far and number - self._far[1] >= _TURN_STEP:
            self._turn(views, number)
        due = self._key_frame is None or number - self._key_frame >= self._gap
        if due or not self._carry(views, number):
            self._look(views, number)

    def finish(self) -> None:
        """The run, or what came before a cut, ends: its last frame is looked at, so that nothing carried stays open."""
        if self._latest and self._latest[1] != self._key_frame:
            self._look(*self._latest)

    def _carry(self, views: _Views, number: int, *, arriving: bool = False) -> bool:
        """Carry the last look's objects on where a step is due; False when one of them was lost on the way."""
        if not self._grey or not self._paths:
            return True
        previous, since = self._grey
        if number - since < (1 if arriving else self.settings.flow_step):
            return True
        carried = carry(previous, views.grey, [path[-1] for path in self._paths.values()], frame=number)
        self._grey = (views.grey, number)
        for path, moved in zip(self._paths.values(), carried, strict=True):
            path.append(moved.label)
        if arriving:
            return True
        lost = {moved.label.track_id for moved in carried if not moved.followed} - self._slippery
        height, width = (2 * side for side in previous.shape)
        inside = [
            moved.label.track_id
            for moved in carried
            if (moved.label.box_xyxy[:2] > _BORDER_PX).all()
            and (moved.label.box_xyxy[2:] < np.array([width, height]) - _BORDER_PX).all()
        ]
        # Flow that loses what the next look finds again has nothing to hold on to there: it is not asked again.
        self._slippery |= lost
        return not lost & set(inside)

    def _look(self, views: _Views, number: int) -> None:
        if self._key_frame is not None and number - self._key_frame > 1:
            self._carry(views, number, arriving=True)
        self._turn(views, number)
        seen = self.look.see(views.frame, number)
        seen = self._tracker.update(seen, frame=number, previous_to_current=self._turned)
        self._turned = np.eye(3)
        self.looks += 1
        miss = self._close(seen, number)
        self.labels += seen
        if seen or self._last_seen is None:
            self._last_seen = number
        self._gap = self._next_gap(seen, miss, number)
        self._key, self._key_frame = seen, number
        self._paths = {label.track_id: [label] for label in seen}
        self._grey = (views.grey, number) if self._flows and self._gap > 1 and seen else None

    def _turn(self, views: _Views, number: int) -> None:
        """Add the camera's turn up to this frame to what it turned since the last look."""
        if self._far is not None:
            height, width = views.frame.shape[:2]
            self._turned = picture_turn(self._far[0], views.far, width=width, height=height) @ self._turned
        self._far = (views.far, number)

    def _close(self, seen: list[Keypoints], number: int) -> float:
        """Labels between the last look and this one; returns the median miss of carried points, in box diagonals."""
        now = {label.track_id: label for label in seen}
        misses = []
        for label in self._key:
            path, end = self._paths[label.track_id], now.get(label.track_id)
            if end is None:
                # Lost from sight: kept for as long as flow may be believed without a second look.
                limit = min(number - 1, label.frame + min(self.settings.max_gap // 2, UNSEEN_FRAMES))
                self.labels += [step for step in along_path(path) if step.frame <= limit]
            elif len(path) > 1 and path[-1].frame == number:
                misses.append(_miss(path[-1], end))
                self.labels += close_gap(path, end)
            else:
                self.labels += interpolate_gap(label, end)
        return float(np.median(misses)) if misses else 0.0

    def _next_gap(self, seen: list[Keypoints], miss: float, number: int) -> int:
        settings = self.settings
        if not seen:
            quiet = number - (self._last_seen or 0) >= settings.quiet_frames
            return settings.quiet_gap if quiet else min(settings.max_gap, _WAITING_GAP)
        gap = float(self._gap + 2 if miss <= settings.max_miss else self._gap // 2)
        before = {label.track_id: label for label in self._key}
        now = {label.track_id: label for label in seen}
        near = [i for i in set(before) ^ set(now) if _height(now.get(i) or before[i]) >= _NEAR_PX]
        if near:
            gap = min(gap, settings.max_gap // 2)
        for label in seen:
            gap = min(gap, self._longest_gap(label, before.get(label.track_id)))
        return max(1, int(gap))

    def _longest_gap(self, label: Keypoints, before: Keypoints | None) -> float:
        """How long one object may go without a look."""
        if label.category == "lane":
            return self.settings.max_lane_gap
        longest = self.settings.max_person_gap if label.category == "person" else self.settings.max_gap
        if self._flows or before is None:
            return longest
        return min(longest, straight_gap(before, label, max_bend=self.settings.max_bend))


def straight_gap(before: Keypoints, after: Keypoints, *, max_bend: float) -> float:
    """How many frames an object may be taken to grow evenly: size is 1 / distance, which bends by (rate gap)^2 / 4."""
    frames = after.frame - before.frame
    rate = abs(math.log(box_diagonal(after.box_xyxy) / box_diagonal(before.box_xyxy))) / max(1, frames)
    return math.sqrt(4 * max_bend) / rate if rate > 0 else math.inf


def _height(label: Keypoints) -> float:
    return float(label.box_xyxy[3] - label.box_xyxy[1])


def _miss(carried: Keypoints, seen: Keypoints) -> float:
    both = carried.present & seen.present
    if not both.any():
        return 0.0
    distance = np.linalg.norm(carried.points[both, :2] - seen.points[both, :2], axis=1)
    return float(np.median(distance)) / box_diagonal(seen.box_xyxy)


def _renumbered(channels: list[list[Keypoints]]) -> list[Keypoints]:
    """All channels' labels by frame, with ids that count from 0 as objects appear."""
    ordered = sorted(
        ((label, index) for index, labels in enumerate(channels) for label in labels),
        key=lambda pair: (pair[0].frame, pair[1], pair[0].track_id),
    )
    ids: dict[tuple[int, int], int] = {}
    return [replace(label, track_id=ids.setdefault((i, label.track_id), len(ids))) for label, i in ordered]
