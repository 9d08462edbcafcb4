"""Which box of this frame is which object of the last: one category, boxes alone.

Constant-velocity prediction, association in two steps by score (Zhang et al. 2022, ByteTrack) on boxes that are grown
so that small and fast ones still meet their predictions (Yang et al. 2023, C-BIoU), an optimal assignment, and the
camera's own turn taken out of the prediction where it is known. What goes behind something goes on as it went before.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count

import numpy as np
from scipy.optimize import linear_sum_assignment

from labeling import box_motion as motion
from labeling.boxes import iou
from labeling.labels import UNTRACKED

_UNMATCHED = 1.0
"""Cost of a box or a track that is left alone: what a match of no overlap would cost. Were it more, a whole row of
parked cars would change places rather than leave one out."""
_COST_DIGITS = 6
"""Of costs that are told apart."""
_PAST_FRAMES = 36
"""Frames over which a track remembers where it was seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerSettings:
    """What makes two boxes the same object. Times are in frames of the 24 fps grid."""

    high_score: float = 0.5
    """A box at least this sure may start a track and is matched first; the others only continue one."""
    buffer: float = 0.3
    """Boxes grow by this share of their size on each side before they are compared."""
    lost_buffer: float = 0.6
    """The same for tracks that have not been seen for a while: their prediction is less sure."""
    lost_cost: float = 0.1
    """Added to what it costs to match a lost track: between equals, the one that was just seen goes first."""
    back_cost: float = 0.8
    """Added for a track that is lost or seen in part and would have had to turn back by its own size: people come out
    where they went to, and of one who goes behind a column, the last that shows is where the next comes out."""
    min_overlap: float = 0.15
    """Least IoU of the buffered boxes."""
    max_lost_frames: int = 36
    """An object that was hidden for longer comes back as a new one: one second, and as long for both its borders to
    pass."""
    max_size_ratio: float = 1.9
    """A box may not be that much larger or smaller than its prediction (its height, whichever way)."""


@dataclass(slots=True, kw_only=True)
class _Track:
    track_id: int
    mean: np.ndarray
    """(4, 2): centre x, centre y, log width, log height, each with its change per frame."""
    covariance: np.ndarray
    """(4, 2, 2)."""
    past: np.ndarray
    """(n, 5): frames since each sighting of the last ``_PAST_FRAMES``, then centre x, y, log width and height."""
    lost_frames: int

    def coast(self) -> None:
        """Let an object that went behind something go on as it went before."""
        known, state = motion.line(self.past)
        if known:
            self.mean = state


class BoxTracker:
    """Gives ids to boxes, frame after frame, one category at a time.

    The state is four independent constant-velocity Kalman filters (centre and log size), so that a box that grows as it
    comes nearer keeps its rate of growth.

    Args:
        settings: when a box belongs to a track.
        ids: where new tracks get theirs; from 0 by default.
    """

    def __init__(self, settings: TrackerSettings | None = None, *, ids: Iterator[int] | None = None) -> None:
        self.settings = settings or TrackerSettings()
        self._ids = count() if ids is None else ids
        self._tracks: list[_Track] = []

    @property
    def following(self) -> int:
        """How many objects it follows, lost ones counted."""
        return len(self._tracks)

    def update(
        self,
        boxes_xyxy: np.ndarray,
        scores: np.ndarray,
        *,
        frame_step: int = 1,
        previous_to_current: np.ndarray | None = None,
        carried: Mapping[int, np.ndarray] | None = None,
    ) -> np.ndarray:
        """Ids for the boxes of the next frame.

        Args:
            boxes_xyxy: (N, 4) pixels.
            scores: (N,) 0 to 1.
            frame_step: frames since the last call.
            previous_to_current: (3, 3) homography that the camera's turn since the last call makes of far points.
            carried: where flow took the boxes of some tracks, (4,) by id.

        Returns:
            (N,) int ids; ``UNTRACKED`` for boxes too unsure to start a track.
        """
        boxes = np.asarray(boxes_xyxy, np.float64).reshape(-1, 4)
        for track in self._tracks:
            motion.predict(track.mean, track.covariance, frame_step, track.lost_frames == 0)
            track.lost_frames += frame_step
            track.past[:, 0] += frame_step
            if previous_to_current is not None:
                motion.move_with_camera(track.mean, track.past, previous_to_current)
            if carried and track.track_id in carried:
                motion.correct(track.mean, track.covariance, np.asarray(carried[track.track_id], np.float64))
        ids = np.full(len(boxes), UNTRACKED)
        high = np.flatnonzero(scores >= self.settings.high_score)
        low = np.flatnonzero(scores < self.settings.high_score)
        seen = [track for track in self._tracks if track.lost_frames <= frame_step]
        # Lost ones have a say too: where one person goes behind a column another may just come out.
        high = self._associate(self._tracks, boxes, ids, high, frame_step)
        unmatched = [track for track in self._tracks if track.lost_frames]
        self._associate(unmatched, boxes, ids, low, frame_step)
        for index in high:
            ids[index] = self._start(boxes[index])
        for track in seen:
            # Even where flow holds it: flow may hold the edge of what hides it.
            if track.lost_frames:
                track.coast()
        self._tracks = [track for track in self._tracks if track.lost_frames <= self.settings.max_lost_frames]
        return ids

    def _associate(
        self, tracks: list[_Track], boxes: np.ndarray, ids: np.ndarray, chosen: np.ndarray, frame_step: int
    ) -> np.ndarray:
        """Match ``chosen`` boxes to tracks, update both; returns the boxes that found none."""
        if not tracks or not len(chosen):
            return chosen
        predicted = _boxes(np.stack([track.mean[:, 0] for track in tracks]))
        lost = np.array([track.lost_frames > frame_step for track in tracks])[:, None]
        settings = self.settings
        near, far = (
            iou(_grown(predicted, buffer), _grown(boxes[chosen], buffer))
            for buffer in (settings.buffer, settings.lost_buffer)
        )
        overlap = np.where(lost, far, near)
        heights = np.log(_heights(boxes[chosen])[None] / _heights(predicted)[:, None])
        allowed = (overlap >= settings.min_overlap) & (np.abs(heights) <= np.log(settings.max_size_ratio))
        turns = (
            motion.turned_back(track.mean, track.past, boxes[chosen], gone)
            for track, (gone,) in zip(tracks, lost, strict=True)
        )
        cost = 1 - overlap + lost * settings.lost_cost + settings.back_cost * np.stack(list(turns))
        # Rounded: which of two equals the solver takes must not hang on a last digit, which differs between machines.
        cost = np.minimum(np.round(cost, _COST_DIGITS), _UNMATCHED)
        rows, columns = linear_sum_assignment(np.where(allowed, cost, _UNMATCHED))
        taken = np.zeros(len(chosen), bool)
        for row, column in zip(rows, columns, strict=True):
            if allowed[row, column]:
                taken[column] = True
                motion.correct(tracks[row].mean, tracks[row].covariance, boxes[chosen[column]])
                _remember(tracks[row], boxes[chosen[column]])
                tracks[row].lost_frames = 0
                ids[chosen[column]] = tracks[row].track_id
        return chosen[~taken]

    def _start(self, box_xyxy: np.ndarray) -> int:
        mean, covariance = motion.start(box_xyxy)
        track_id = next(self._ids)
        self._tracks.append(
            _Track(track_id=track_id, mean=mean, covariance=covariance, past=_sighting(box_xyxy), lost_frames=0)
        )
        return track_id


def _boxes(places: np.ndarray) -> np.ndarray:
    """(N, 4) left, top, right, bottom of (N, 4) centres and log sizes."""
    centres, halves = places[:, :2], np.exp(np.clip(places[:, 2:], -3, 9)) / 2
    return np.concatenate([centres - halves, centres + halves], axis=1)


def _grown(boxes_xyxy: np.ndarray, buffer: float) -> np.ndarray:
    margin = (boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]) * buffer
    return np.concatenate([boxes_xyxy[:, :2] - margin, boxes_xyxy[:, 2:] + margin], axis=1)


def _heights(boxes_xyxy: np.ndarray) -> np.ndarray:
    return np.maximum(boxes_xyxy[:, 3] - boxes_xyxy[:, 1], 1e-3)


def _sighting(box_xyxy: np.ndarray) -> np.ndarray:
    """(1, 5) row of ``_Track.past``."""
    return np.concatenate([[0.0], motion.measurement(box_xyxy)])[None]


def _remember(track: _Track, box_xyxy: np.ndarray) -> None:
    track.past = np.concatenate([track.past[track.past[:, 0] < _PAST_FRAMES], _sighting(box_xyxy)])
