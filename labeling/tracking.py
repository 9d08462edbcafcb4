"""Track ids of a run: every category with its tracker, and what is too short to be believed."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from labeling.box_tracker import BoxTracker, TrackerSettings
from labeling.labels import UNTRACKED, Keypoints
from labeling.lane_tracker import LaneTracker


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedLook:
    """Everything that one look saw, after the association with earlier ones."""

    frame: int
    labels: tuple[Keypoints, ...]
    """With the ids of their tracks, or ``UNTRACKED``."""
    turn: np.ndarray
    """(3, 3) homography that the camera's turn since the look before makes of far points."""


class RunTracker:
    """Ids for all categories of a run: they count from 0 in the order in which objects appear.

    Args:
        settings: of every category.
        start_scores: a ``high_score`` of its own for each category, in place of the settings'.
        ids: where new tracks get theirs, where others share them; from 0 by default.
    """

    def __init__(
        self, settings: TrackerSettings | None = None, *, start_scores: Mapping[str, float] | None = None,
        ids: Iterator[int] | None = None,
    ) -> None:  # fmt: skip
        self._settings, self._start_scores = settings or TrackerSettings(), dict(start_scores or {})
        self._trackers: dict[str, BoxTracker | LaneTracker] = {}
        self._ids = count() if ids is None else ids
        self._frame: int | None = None

    @property
    def idle(self) -> bool:
        """Whether it follows nothing."""
        return not any(tracker.following for tracker in self._trackers.values())

    def restart(self) -> None:
        """Forget all objects: what comes after a cut or a hole is new. Ids go on counting."""
        self._trackers, self._frame = {}, None

    def update(
        self,
        labels: Sequence[Keypoints],
        *,
        frame: int,
        previous_to_current: np.ndarray | None = None,
        carried: Mapping[int, np.ndarray] | None = None,
    ) -> list[Keypoints]:
        """One frame's labels with their ids, ``UNTRACKED`` where they belong to no track.

        Args:
            labels: everything seen in the frame.
            frame: its grid number, later than the last call's.
            previous_to_current: as ``BoxTracker.update`` takes it.
            carried: as ``BoxTracker.update`` takes it.
        """
        step = frame - self._frame if self._frame is not None else 1
        self._frame = frame
        out: list[Keypoints] = []
        for category in sorted({label.category for label in labels} | set(self._trackers)):
            group = [label for label in labels if label.category == category]
            tracker = self._trackers.get(category) or self._new_tracker(category)
            self._trackers[category] = tracker
            ids = _update(tracker, group, step, previous_to_current, carried)
            out += [label.renumbered(track_id=int(i)) for label, i in zip(group, ids, strict=True)]
        return out

    def _new_tracker(self, category: str) -> "BoxTracker | LaneTracker":
        if category == "lane":
            return LaneTracker(ids=self._ids)
        least = self._start_scores.get(category, self._settings.high_score)
        return BoxTracker(replace(self._settings, high_score=least), ids=self._ids)


def believed_tracks(
    looks: Iterable[TrackedLook], *, min_looks: int, sure_looks: int = 0, sure_scores: Mapping[str, float] | None = None
) -> frozenset[int]:
    """Ids of the tracks that are more than a network's mistake: seen often enough, and surely enough.

    Args:
        looks: with their tracks; what was carried or lent between them is no look.
        min_looks: how often it must have been seen.
        sure_looks: how many of the looks, one after another, must have been sure: of a mistake that is looked at often
            some are, now and then.
        sure_scores: by category, the score from which a look is sure; any score where nothing is said.
    """
    sure_scores = sure_scores or {}
    seen: Counter[int] = Counter()
    longest: Counter[int] = Counter()
    run: dict[int, int] = {}
    for look in looks:
        tracked = [label for label in look.labels if label.track_id != UNTRACKED]
        seen.update(label.track_id for label in tracked)
        # Who is not in this look begins anew.
        run = {
            label.track_id: run.get(label.track_id, 0) + 1
            if label.score >= sure_scores.get(label.category, 0.0) else 0
            for label in tracked
        }  # fmt: skip
        for track_id, length in run.items():
            longest[track_id] = max(longest[track_id], length)
    return frozenset(i for i, count in seen.items() if count >= min_looks and longest[i] >= sure_looks)


def trim_doubt(labels: Iterable[Keypoints], *, least_scores: Mapping[str, float]) -> list[Keypoints]:
    """Each track from the first frame in which it is plain to the last.

    Where something comes into view or goes out of it little of it shows, and a box is as often beside it as on it. What
    is doubtful in between is kept: it was there before and is there again.

    Args:
        labels: tracked.
        least_scores: by category, the score from which a label is plain; any score where nothing is said.
    """
    labels = list(labels)
    plain: dict[int, list[int]] = {}
    for label in labels:
        if label.score >= least_scores.get(label.category, 0.0):
            plain.setdefault(label.track_id, []).append(label.frame)
    spans = {track_id: (min(frames), max(frames)) for track_id, frames in plain.items()}
    return [
        label for label in labels
        if label.track_id in spans and spans[label.track_id][0] <= label.frame <= spans[label.track_id][1]
    ]  # fmt: skip


def drop_brief_tracks(
    labels: Sequence[Keypoints], clocks: Sequence[int], *, min_frames: int, pace: int = 1, open_at: Collection[int] = ()
) -> list[Keypoints]:
    """Without tracks that last less than ``min_frames`` from their first moment to the end of their last.

    Args:
        labels: tracked, by moment.
        clocks: time of each moment, frames of the grid.
        min_frames: least length, frames of the grid.
        pace: for how many of them a moment lasts.
        open_at: the moments at which a run begins and ends: who is there has been, or will be, for longer than it
            shows.
    """
    open_at = frozenset(open_at)
    moments: dict[int, list[int]] = {}
    for label in labels:
        moments.setdefault(label.track_id, []).append(label.frame)
    lasting = {
        i for i, shown in moments.items()
        if clocks[max(shown)] - clocks[min(shown)] + pace >= min_frames or not open_at.isdisjoint(shown)
    }  # fmt: skip
    return [label for label in labels if label.track_id in lasting]


def _update(
    tracker: BoxTracker | LaneTracker,
    group: list[Keypoints],
    step: int,
    turn: np.ndarray | None,
    carried: Mapping[int, np.ndarray] | None,
) -> np.ndarray:
    if isinstance(tracker, LaneTracker):
        return tracker.update([label.points for label in group], frame_step=step, previous_to_current=turn)
    boxes = np.array([label.box_xyxy for label in group], np.float64).reshape(-1, 4)
    scores = np.array([label.score for label in group])
    return tracker.update(boxes, scores, frame_step=step, previous_to_current=turn, carried=carried)
