"""Frames of a run to tracked, steady keypoints, looking no more often than the scene needs.

The networks are nearly all the cost. With ``exact`` they see every frame; with the other efforts they see some, and
between these points are carried by optical flow. Lanes of a network that gives nothing else have no points to follow
and go by straight lines. How often they look is ``efforts``'; what is shown in between is ``between_looks``'.

Flow and smoothing count moments (``moments``): a picture that is shown again is not looked at, and its labels are shown
again. Tracks, how long until the next look, how long something must last, and how long after its last sight it may be
shown, go by the moments' clocks.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import count

import numpy as np

from labeling.backward_tracking import reach_back
from labeling.between_looks import BetweenLooks, cut_at_border
from labeling.boxes import inside
from labeling.carrying import small_grey
from labeling.detection import suppress_overlaps
from labeling.efforts import EFFORTS, Effort, EffortSettings, Rhythm
from labeling.extractors import Extractors
from labeling.labels import UNTRACKED, Keypoints
from labeling.moments import Moments, same_picture
from labeling.observation import Look, looks_of
from labeling.picture_turn import TurnMeter
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


def label_frames(
    frames: Iterable[np.ndarray],
    *,
    first_frame: int,
    extractors: Extractors,
    effort: Effort | EffortSettings = "balanced",
    breaks: frozenset[int] = frozenset(),
    repeats: frozenset[int] = frozenset(),
) -> list[Keypoints]:
    """Tracked labels of the consecutive frames of one run.

    Args:
        frames: (H, W, 3) uint8 RGB, all of one size.
        first_frame: number of the first on the video's 24 fps grid.
        extractors: the opened networks.
        effort: how much is looked at, and how much carried from frame to frame.
        breaks: grid numbers of frames before which nothing may be carried over (a hard cut, a hole).
        repeats: grid numbers of frames known to show the picture of the one before again. Where pictures were not
            coded again since, it is seen as well.

    Returns:
        Labels in the order of frames, then of tracks, whose ids count from 0 as objects appear. Objects whose category
        has no keypoint network have a box, a track and absent points.

    Raises:
        ModelError: a network's output that is not finite.
    """
    return label_with(
        looks_of(extractors), frames, first_frame=first_frame, effort=effort, breaks=breaks, repeats=repeats
    )


def label_with(
    looks: Iterable[Look],
    frames: Iterable[np.ndarray],
    *,
    first_frame: int,
    effort: Effort | EffortSettings = "balanced",
    breaks: frozenset[int] = frozenset(),
    repeats: frozenset[int] = frozenset(),
) -> list[Keypoints]:
    """As ``label_frames``, for anything that looks at a frame and tells what it sees."""
    settings = effort if isinstance(effort, EffortSettings) else EFFORTS[effort]
    ids, moments, turns = count(), Moments(), TurnMeter()
    channels = [_Channel(look, settings, clocks=moments.clocks, ids=ids, turns=turns) for look in looks]
    latest = None
    for number, frame in enumerate(frames, start=first_frame):
        if latest is not None and number not in breaks and (number in repeats or same_picture(latest, frame)):
            moments.again()
            continue
        moments.new(number)
        views, latest = _Views(frame, number), frame
        if number in breaks:
            for channel in channels:
                channel.restart()
        if not any(channel.follows for channel in channels):
            turns.forget()
        elif turns.due(moments.latest):
            turns.reach(frame, moments.latest)
        for channel in channels:
            channel.push(views, number=moments.latest)
    for channel in channels:
        channel.finish()
    labels = [label for channel in channels for label in channel.labels]
    if latest is None or not labels:
        return []
    fresh = frozenset(moment for moment, number in enumerate(moments.frames) if number in breaks)
    labels = smooth_tracks(labels, settings=SmoothingSettings().at_pace(moments.pace), breaks=fresh)
    labels = cut_at_border(labels, width=latest.shape[1], height=latest.shape[0])
    doubts = {category: score for channel in channels for category, score in channel.doubts.items()}
    labels = drop_unseen(without_doubles(labels, doubts=doubts), moments.clocks)
    ends = {0, moments.latest, *fresh, *(moment - 1 for moment in fresh)}
    labels = drop_brief_tracks(labels, moments.clocks, pace=moments.pace, min_frames=_MIN_FRAMES, open_at=ends)
    return _counted_from_0(_on_grid(labels, moments.shown, first_frame=first_frame))


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
        shown: list[int] = []
        for i in suppress_overlaps(boxes, np.zeros(len(boxes)), _COVERED_IOU):
            doubtful = ordered[i].score < doubts.get(category, 0.0)
            if not doubtful or not shown or inside(boxes[shown], boxes[i : i + 1]).max() < _HALF_COVERED:
                shown.append(i)
        kept += [ordered[i] for i in shown]
    return sorted(kept, key=lambda label: (label.frame, label.track_id))


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
    """A frame and its small picture, made once, when somebody first needs it."""

    def __init__(self, frame: np.ndarray, number: int) -> None:
        self.frame, self.number = frame, number

    @cached_property
    def grey(self) -> np.ndarray:
        """For flow."""
        return small_grey(self.frame)


class _Channel:
    """One kind of look (objects, or a bottom-up network's) with its own rhythm, tracks and carried points."""

    def __init__(
        self, look: Look, settings: EffortSettings, *, clocks: Sequence[int], ids: Iterator[int], turns: TurnMeter
    ) -> None:
        self.look, self.settings, self._clocks, self._turns = look, settings, clocks, turns
        self.labels: list[Keypoints] = []
        self.looks = 0
        self.sure_scores = {category: settings.sure_share * score for category, score in look.sure_scores.items()}
        self._tracker = RunTracker(start_scores=self._scores(_BEGIN_SHARE), ids=ids)
        self._begin()

    @property
    def follows(self) -> bool:
        """Whether it has tracks, which want to know how the camera turns."""
        return not self._tracker.idle

    @property
    def doubts(self) -> Mapping[str, float]:
        """By category, the score below which a label needs room of its own."""
        return self._decided(_DOUBT_SHARE)

    def _decided(self, share: float) -> dict[str, float]:
        return {category: score for category, score in self._scores(share).items() if category in self.look.decided}

    def _scores(self, share: float) -> dict[str, float]:
        return {category: share * score for category, score in self.sure_scores.items()}

    def _begin(self) -> None:
        flows = self.look.carries and self.settings.flow_step > 0
        self._rhythm = Rhythm(self.settings, flows=flows)
        self._between = BetweenLooks(
            flow_step=self.settings.flow_step, flow_window=self.settings.flow_window,
            shown_frames=self.settings.max_gap // 2, clocks=self._clocks,
        )  # fmt: skip
        self._latest: tuple[_Views, int] | None = None
        self._looks: list[TrackedLook] = []
        self._labels: list[Keypoints] = []

    def restart(self) -> None:
        """Nothing of what came before holds any more."""
        self.finish()
        self._tracker.restart()
        self._begin()

    def push(self, views: _Views, *, number: int) -> None:
        """The next moment of the run.

        Args:
            views: its picture.
            number: of the moment.
        """
        self._latest = (views, number)
        last = self._between.frame
        due = last is None or self._since_look(number) >= self._rhythm.gap
        if not due and self._between.due(number):
            due = not self._between.carry(views.grey, frame=number)
        if due:
            self._look(views, number)

    def finish(self) -> None:
        """The run, or what came before a cut, ends: its last frame is looked at unless the last look was just before,
        so that nothing carried stays open, and what is known by then is found in earlier looks."""
        if self._latest and self._latest[1] != self._between.frame and not self._run_out(*self._latest):
            self._look(*self._latest)
        # One look is all that a still picture gets.
        most = len(self._looks)
        believed = believed_tracks(
            self._looks, min_looks=min(_MIN_LOOKS, most), sure_looks=min(self.settings.sure_looks, most),
            sure_scores=self.sure_scores,
        )  # fmt: skip
        self._labels = [label for label in self._labels if label.track_id in believed]
        known = {(label.frame, label.track_id) for label in self._labels}
        back = [label for label in reach_back(self._looks, believed) if (label.frame, label.track_id) not in known]
        self.labels += trim_doubt(self._labels + back, least_scores=self._decided(_PLAIN_SHARE))

    def _run_out(self, views: _Views, number: int) -> bool:
        """Whether flow takes what the last look saw to the run's end. Who was seen in no look before needs another."""
        before = {label.track_id for look in self._looks[-2:-1] for label in look.labels}
        new = any(label.track_id not in before for label in self._between.seen)
        if new or self._since_look(number) > self._between.shown:
            return False
        labels = self._between.run_out(views.grey, frame=number)
        self._labels += labels or []
        return labels is not None

    def _since_look(self, number: int) -> int:
        """Time from the last look, which there is, to a moment."""
        assert self._between.frame is not None
        return self._clocks[number] - self._clocks[self._between.frame]

    def _look(self, views: _Views, number: int) -> None:
        clock, turn = self._clocks[number], np.eye(3)
        if self._between.arriving(number):
            self._between.carry(views.grey, frame=number)
        if self.follows and self._between.frame is not None:
            self._turns.reach(views.frame, number)
            turn = self._turns.since(self._between.frame)
        seen = [label.renumbered(frame=number) for label in self.look.see(views.frame, views.number)]
        carried = self._between.carried(number)
        named = self._tracker.update(seen, frame=clock, previous_to_current=turn, carried=carried)
        self._looks.append(TrackedLook(frame=clock, labels=tuple(named), turn=turn))
        seen = [label for label in named if label.track_id != UNTRACKED]
        if self.follows:
            self._turns.reach(views.frame, number)
        self.looks += 1
        between, miss = self._between.close(seen, frame=number)
        self._labels += between + seen
        self._rhythm.after(seen, self._between.seen, miss=miss, frame=clock)
        follow = seen and self._rhythm.flows and self._rhythm.gap > 1
        self._between.start(seen, frame=number, grey=views.grey if follow else None)


def _counted_from_0(labels: Iterable[Keypoints]) -> list[Keypoints]:
    """Labels, in the order of frames, with ids that count from 0 as objects appear; in that order in each frame."""
    numbers: dict[int, int] = {}
    named = [label.renumbered(track_id=numbers.setdefault(label.track_id, len(numbers))) for label in labels]
    return sorted(named, key=lambda label: (label.frame, label.track_id))
