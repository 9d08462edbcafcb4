"""Frames of a run to tracked, steady keypoints, looking no more often than the scene needs.

The networks are nearly all the cost. With ``exact`` they see every frame; with the other efforts they see some, and
between these the points of cars and people are carried by optical flow, and lanes, which have no points of their own to
follow, by straight lines. How often they look is ``efforts``'; what is shown in between is ``between_looks``'.

A picture that is shown again is the same moment: nothing moves, nothing is looked at, and what follows it does not
start from rest. Flow and smoothing therefore count moments. Tracks, how long until the next look, how long something
must last, and how long after its last sight it may be shown, go by time: they count frames of the grid, but for those
of a picture that is shown for longer than is usual in its source.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import count

import cv2
import numpy as np

from labeling.backward_tracking import reach_back
from labeling.between_looks import BetweenLooks
from labeling.boxes import inside
from labeling.carrying import small_grey
from labeling.detection import suppress_overlaps
from labeling.efforts import EFFORTS, Effort, EffortSettings, Rhythm
from labeling.extractors import Extractors
from labeling.labels import UNTRACKED, Keypoints
from labeling.observation import Look, looks_of
from labeling.picture_turn import picture_turn, turn_view
from labeling.smoothing import SmoothingSettings, drop_unseen, smooth_tracks
from labeling.tracking import RunTracker, TrackedLook, believed_tracks, drop_brief_tracks, trim_doubt

_COVERED_IOU = 0.7
"""Overlap of two labels of one category of which the lesser is not in view. Visible parts overlap by up to 0.55, boxes
that a detector tells apart by somewhat more."""
_MIN_LOOKS = 2
_MIN_FRAMES = 6
"""What was seen once, or lasts less than a quarter of a second, is taken for a mistake."""
_BEGIN_SHARE, _PLAIN_SHARE, _DOUBT_SHARE = 0.9, 0.8, 0.95
"""Of sure scores. A track begins with a look that is nearly sure: the first sure one at what comes out from behind
something is late. Where scores are decided, it is shown from one plain look to another; and what is not quite sure and
half behind a better label of its kind is that one's double, or hardly in view."""
_HALF_COVERED = 0.5
_SAMPLE_ROWS, _SAME_LEVELS = 64, 2
"""One row in so many is compared before all are; and by how many levels pixels may differ."""
_PACE_MOMENTS = 9
"""So many moments tell how fast the source runs: a camera that froze is none of fewer frames."""
_TURN_STEP = 4
"""Frames after which two pictures of a camera that turns sharply have too little in common."""


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
    ids = count()
    channels = [_Channel(look, settings, ids=ids) for look in looks]
    moments: list[int] = []
    shown: list[int] = []
    clocks: list[int] = []
    latest = None
    for number, frame in enumerate(frames, start=first_frame):
        if latest is None or number in breaks or not same_picture(latest, frame):
            views, latest = _Views(frame, number), frame
            clocks.append((clocks[-1] if clocks else 0) + _pace([*moments[-_PACE_MOMENTS:], number]))
            for channel in channels:
                channel.push(views, number=len(moments), clock=clocks[-1], fresh=number in breaks)
            moments.append(number)
        shown.append(len(moments) - 1)
    for channel in channels:
        channel.finish()
    labels = [label for channel in channels for label in channel.labels]
    fresh = frozenset(moment for moment, number in enumerate(moments) if number in breaks)
    windows = SmoothingSettings().at_pace(_pace(moments))
    smooth = smooth_tracks(labels, settings=windows, breaks=fresh)
    doubts = {category: score for channel in channels for category, score in channel.doubts.items()}
    labels = drop_unseen(without_doubles(smooth, doubts=doubts), clocks)
    labels = _on_grid(labels, shown, first_frame=first_frame)
    last = first_frame + len(shown) - 1
    ends = {first_frame, last, *breaks, *(number - 1 for number in breaks)}
    return _counted_from_0(drop_brief_tracks(labels, min_frames=_MIN_FRAMES, open_at=ends))


def _pace(moments: Sequence[int]) -> int:
    """For how many frames a picture is usually shown: more than one where the source has fewer than the grid.

    One gap tells nothing, since a camera that stands at a run's start shows one picture for long; of two the lesser
    does.
    """
    gaps = np.sort(np.diff(moments))
    return int(gaps[(len(gaps) - 1) // 2]) if len(gaps) > 1 else 1


def without_doubles(labels: Iterable[Keypoints], *, doubts: Mapping[str, float] | None = None) -> list[Keypoints]:
    """Labels of which none is covered by a better one of its category in the same frame.

    Objects in view never cover each other so; what is carried or smoothed on while something steps before it does.

    Args:
        labels: of any frames.
        doubts: by category, the score below which to be half covered is enough.
    """
    doubts = doubts or {}
    groups: dict[tuple[int, str], list[Keypoints]] = {}
    for label in labels:
        groups.setdefault((label.frame, label.category), []).append(label)
    kept: list[Keypoints] = []
    for (_, category), group in groups.items():
        if category == "lane" or len(group) < 2:
            kept += group
            continue
        ordered = sorted(group, key=lambda label: -label.score)
        boxes = np.stack([label.box_xyxy for label in ordered])
        kept += [
            ordered[i] for i in suppress_overlaps(boxes, np.zeros(len(boxes)), _COVERED_IOU)
            if i == 0 or ordered[i].score >= doubts.get(category, 0.0)
            or inside(boxes[:i], boxes[i : i + 1]).max() < _HALF_COVERED
        ]  # fmt: skip
    return sorted(kept, key=lambda label: (label.frame, label.track_id))


def same_picture(picture: np.ndarray, other: np.ndarray) -> bool:
    """Whether two (H, W, 3) uint8 frames show the same moment: a camera that froze, or a source of fewer frames.

    Coding again may move a level or two; a camera's own noise moves more.
    """
    if picture.shape != other.shape:
        return False
    few, others = (one[::_SAMPLE_ROWS] for one in (picture, other))
    if cv2.norm(np.ascontiguousarray(few), np.ascontiguousarray(others), cv2.NORM_INF) > _SAME_LEVELS:
        return False
    return cv2.norm(picture, other, cv2.NORM_INF) <= _SAME_LEVELS


def _on_grid(labels: Sequence[Keypoints], shown: Sequence[int], *, first_frame: int) -> list[Keypoints]:
    """Labels of moments for every frame that shows them; ``shown`` has the moment of each frame."""
    by_moment: dict[int, list[Keypoints]] = {}
    for label in labels:
        by_moment.setdefault(label.frame, []).append(label)
    return [
        label if label.frame == number else label.renumbered(frame=number)
        for number, moment in enumerate(shown, start=first_frame)
        for label in by_moment.get(moment, [])
    ]


class _Views:
    """A frame and its small pictures, each made once, when somebody first needs it."""

    def __init__(self, frame: np.ndarray, number: int) -> None:
        self.frame, self.number = frame, number

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

    def __init__(self, look: Look, settings: EffortSettings, *, ids: Iterator[int]) -> None:
        self.look, self.settings = look, settings
        self.labels: list[Keypoints] = []
        self.looks = 0
        self.sure_scores = {category: settings.sure_share * score for category, score in look.sure_scores.items()}
        self._tracker = RunTracker(start_scores=self._scores(_BEGIN_SHARE), ids=ids)
        self._forget()

    @property
    def doubts(self) -> Mapping[str, float]:
        """By category, the score below which a label needs room of its own."""
        return self._decided(_DOUBT_SHARE)

    def _decided(self, share: float) -> dict[str, float]:
        return {category: score for category, score in self._scores(share).items() if category in self.look.decided}

    def _scores(self, share: float) -> dict[str, float]:
        return {category: share * score for category, score in self.sure_scores.items()}

    def _forget(self) -> None:
        flows = self.look.carries and self.settings.flow_step > 0
        self._tracker.restart()
        self._rhythm = Rhythm(self.settings, flows=flows)
        self._between = BetweenLooks(flow_step=self.settings.flow_step, shown_frames=self.settings.max_gap // 2)
        self._far: tuple[np.ndarray, int] | None = None
        self._turned = np.eye(3)
        self._latest: tuple[_Views, int] | None = None
        self._clock = self._looked_at = 0
        self._looks: list[TrackedLook] = []
        self._labels: list[Keypoints] = []

    def push(self, views: _Views, *, number: int, clock: int, fresh: bool) -> None:
        """The next moment of the run.

        Args:
            views: its picture.
            number: of the moment.
            clock: frames of the grid up to here, had no picture been shown for longer than is usual in this source.
            fresh: nothing of what came before holds any more.
        """
        if fresh:
            self.finish()
            self._forget()
        self._latest, self._clock = (views, number), clock
        if self._far and number - self._far[1] >= _TURN_STEP:
            self._turn(views, number)
        last = self._between.frame
        due = last is None or clock - self._looked_at >= self._rhythm.gap
        if not due and self._between.due(number):
            due = not self._between.carry(views.grey, frame=number)
        if due:
            self._look(views, number)

    def finish(self) -> None:
        """The run, or what came before a cut, ends: its last frame is looked at unless the last look was just before,
        so that nothing carried stays open, and what is known by then is found in earlier looks."""
        if self._latest and self._latest[1] != self._between.frame and not self._run_out(*self._latest):
            self._look(*self._latest)
        believed = believed_tracks(
            self._looks, min_looks=_MIN_LOOKS, sure_looks=self.settings.sure_looks, sure_scores=self.sure_scores
        )
        self._labels = [label for label in self._labels if label.track_id in believed]
        found = self._labels + reach_back(self._looks, believed)
        self.labels += trim_doubt(found, least_scores=self._decided(_PLAIN_SHARE))

    def _run_out(self, views: _Views, number: int) -> bool:
        """Whether flow takes what the last look saw to the run's end. Who was seen in no look before needs another."""
        before = {label.track_id for look in self._looks[-2:-1] for label in look.labels}
        new = any(label.track_id not in before for label in self._between.seen)
        if new or self._clock - self._looked_at > self._between.shown:
            return False
        labels = self._between.run_out(views.grey, frame=number)
        self._labels += labels or []
        return labels is not None

    def _look(self, views: _Views, number: int) -> None:
        if self._between.arriving(number):
            self._between.carry(views.grey, frame=number)
        self._turn(views, number)
        seen = [label.renumbered(frame=number) for label in self.look.see(views.frame, views.number)]
        carried = self._between.carried(number)
        named = self._tracker.update(seen, frame=self._clock, previous_to_current=self._turned, carried=carried)
        self._looks.append(TrackedLook(frame=self._clock, labels=tuple(named), turn=self._turned))
        seen = [label for label in named if label.track_id != UNTRACKED]
        self._turned = np.eye(3)
        if self._far is None and not self._tracker.idle:
            self._far = (views.far, number)
        self.looks += 1
        between, miss = self._between.close(seen, frame=number)
        self._labels += between + seen
        self._rhythm.after(seen, self._between.seen, miss=miss, frame=self._clock)
        self._looked_at = self._clock
        follow = seen and self._rhythm.flows and self._rhythm.gap > 1
        self._between.start(seen, frame=number, grey=views.grey if follow else None)

    def _turn(self, views: _Views, number: int) -> None:
        """Add the camera's turn up to this frame to what it turned since the last look; of no use without tracks."""
        if self._tracker.idle:
            self._far = None
            return
        if self._far is not None:
            height, width = views.frame.shape[:2]
            self._turned = picture_turn(self._far[0], views.far, width=width, height=height) @ self._turned
        self._far = (views.far, number)


def _counted_from_0(labels: Iterable[Keypoints]) -> list[Keypoints]:
    """Labels with ids that count from 0 as objects appear."""
    numbers: dict[int, int] = {}
    return [label.renumbered(track_id=numbers.setdefault(label.track_id, len(numbers))) for label in labels]
