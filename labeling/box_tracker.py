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

from labeling.boxes import iou
from labeling.labels import UNTRACKED

_UNMATCHED = 1.0
"""Cost of a box or a track that is left alone: what a match of no overlap would cost. Were it more, a whole row of
parked cars would change places rather than leave one out."""
_PAST_FRAMES = 36
"""Frames over which a track remembers where it was seen."""
_LEVER_FRAMES = 8
"""Two sightings tell a speed when they are at least so far apart: boxes shake, and a walker's swings with the legs."""
_SLOW_PX = 0.5
"""Per frame: what is slower has no direction."""
_WHOLE_SHARE = 0.75
"""A box of less than this share of its usual width or height shows a part: the picture's border or a column cuts it."""
_STEADY_GROWTH = 0.01
"""Share by which the height of what comes neither nearer nor goes may change per frame: such objects move evenly."""


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

    @property
    def box_xyxy(self) -> np.ndarray:
        centre, size = self.mean[:2, 0], np.exp(np.clip(self.mean[2:, 0], -3, 9))
        return np.concatenate([centre - size / 2, centre + size / 2])


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
            _predict(track, frame_step)
            if previous_to_current is not None:
                _move_with_camera(track, previous_to_current)
            if carried and track.track_id in carried:
                _correct(track, carried[track.track_id])
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
                _coast(track)
        self._tracks = [track for track in self._tracks if track.lost_frames <= self.settings.max_lost_frames]
        return ids

    def _associate(
        self, tracks: list[_Track], boxes: np.ndarray, ids: np.ndarray, chosen: np.ndarray, frame_step: int
    ) -> np.ndarray:
        """Match ``chosen`` boxes to tracks, update both; returns the boxes that found none."""
        if not tracks or not len(chosen):
            return chosen
        predicted = np.stack([track.box_xyxy for track in tracks])
        lost = np.array([track.lost_frames > frame_step for track in tracks])[:, None]
        settings = self.settings
        near, far = (
            iou(_grown(predicted, buffer), _grown(boxes[chosen], buffer))
            for buffer in (settings.buffer, settings.lost_buffer)
        )
        overlap = np.where(lost, far, near)
        heights = np.log(_heights(boxes[chosen])[None] / _heights(predicted)[:, None])
        allowed = (overlap >= settings.min_overlap) & (np.abs(heights) <= np.log(settings.max_size_ratio))
        back = np.stack(
            [_turned_back(track, boxes[chosen], lost=bool(gone)) for track, gone in zip(tracks, lost, strict=True)]
        )
        cost = np.minimum(1 - overlap + lost * settings.lost_cost + settings.back_cost * back, _UNMATCHED)
        rows, columns = linear_sum_assignment(np.where(allowed, cost, _UNMATCHED))
        taken = np.zeros(len(chosen), bool)
        for row, column in zip(rows, columns, strict=True):
            if allowed[row, column]:
                taken[column] = True
                _correct(tracks[row], boxes[chosen[column]])
                _remember(tracks[row], boxes[chosen[column]])
                tracks[row].lost_frames = 0
                ids[chosen[column]] = tracks[row].track_id
        return chosen[~taken]

    def _start(self, box_xyxy: np.ndarray) -> int:
        mean = np.zeros((4, 2))
        mean[:, 0] = _measurement(box_xyxy)
        spread = np.array([_size_px(box_xyxy) * 0.1, _size_px(box_xyxy) * 0.1, 0.1, 0.1])
        covariance = np.zeros((4, 2, 2))
        covariance[:, 0, 0], covariance[:, 1, 1] = spread**2, spread**2
        self._tracks.append(
            _Track(
                track_id=next(self._ids), mean=mean, covariance=covariance, past=_sighting(box_xyxy), lost_frames=0
            )
        )  # fmt: skip
        return self._tracks[-1].track_id


def _turned_back(track: _Track, boxes_xyxy: np.ndarray, *, lost: bool) -> np.ndarray:
    """(N,) by how much of its size each of (N, 4) boxes lies behind where a track is expected, against its motion.

    What was just seen whole may turn: 0.
    """
    state = track.mean if lost else _line_while_partly_hidden(track)
    if state is None:
        return np.zeros(len(boxes_xyxy))
    (centre, velocity), size = state[:2].T, np.exp(np.clip(state[2:, 0], -3, 9))
    speed = float(np.hypot(*velocity))
    if speed < _SLOW_PX:
        return np.zeros(len(boxes_xyxy))
    ahead = ((boxes_xyxy[:, :2] + boxes_xyxy[:, 2:]) / 2 - centre) @ velocity / speed
    return np.clip(-ahead / size.min(), 0, 1)


def _grown(boxes_xyxy: np.ndarray, buffer: float) -> np.ndarray:
    margin = (boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]) * buffer
    return np.concatenate([boxes_xyxy[:, :2] - margin, boxes_xyxy[:, 2:] + margin], axis=1)


def _heights(boxes_xyxy: np.ndarray) -> np.ndarray:
    return np.maximum(boxes_xyxy[:, 3] - boxes_xyxy[:, 1], 1e-3)


def _size_px(box_xyxy: np.ndarray) -> float:
    return float(np.maximum(box_xyxy[2:] - box_xyxy[:2], 1e-3).mean())


def _measurement(box_xyxy: np.ndarray) -> np.ndarray:
    size = np.maximum(box_xyxy[2:] - box_xyxy[:2], 1e-3)
    return np.concatenate([(box_xyxy[:2] + box_xyxy[2:]) / 2, np.log(size)])


def _sighting(box_xyxy: np.ndarray) -> np.ndarray:
    """(1, 5) row of ``_Track.past``."""
    return np.concatenate([[0.0], _measurement(box_xyxy)])[None]


def _remember(track: _Track, box_xyxy: np.ndarray) -> None:
    track.past = np.concatenate([track.past[track.past[:, 0] < _PAST_FRAMES], _sighting(box_xyxy)])


def _coast(track: _Track) -> None:
    """Let an object that went behind something go on as it went before."""
    line = _line(track)
    if line is not None:
        track.mean = line


def _line_while_partly_hidden(track: _Track) -> np.ndarray | None:
    """The line of a track whose last sighting was of a part; None for one that was seen whole, or has no line."""
    return None if _seen_whole(track)[-1] else _line(track)


def _seen_whole(track: _Track) -> np.ndarray:
    """(n,) which sightings are of the whole object."""
    usual = np.median(track.past[:, 3:], axis=0)
    return (track.past[:, 3:] >= usual + np.log(_WHOLE_SHARE)).all(axis=1)


def _line(track: _Track) -> np.ndarray | None:
    """(4, 2) state of an object that goes on as it went while it was seen whole; None where nothing tells how.

    Its last boxes before something hides it are what was left in view: their middle stops at the edge of that. The line
    through most sightings does not (Theil 1950, Sen 1968: the median of the slopes of pairs, of which three in ten may
    be wrong).
    """
    whole = _seen_whole(track)
    ago, places = -track.past[whole, 0], track.past[whole, 1:]
    first, second = np.triu_indices(len(ago), 1)
    apart = ago[second] - ago[first]
    far = apart >= _LEVER_FRAMES
    if not far.any():
        return None
    slopes = np.median((places[second] - places[first])[far] / apart[far, None], axis=0)
    if abs(slopes[3]) > _STEADY_GROWTH:
        return None
    centre = np.median(places[:, :2] - slopes[:2] * ago[:, None], axis=0)
    size = np.median(places[:, 2:], axis=0)
    return np.stack([np.concatenate([centre, size]), np.array([*slopes[:2], 0.0, 0.0])], axis=1)


def _predict(track: _Track, steps: int) -> None:
    transition = np.array([[1.0, steps], [0.0, 1.0]])
    if track.lost_frames:
        # A rate of growth is measured badly: it is not trusted once nothing confirms it.
        track.mean[2:, 1] *= 0.8**steps
    track.mean = track.mean @ transition.T
    # White acceleration (Bar-Shalom et al. 2001, eq. 6.3.2-4), in shares of the object's size per frame squared.
    size = float(np.exp(np.clip(track.mean[2:, 0].mean(), -3, 9)))
    strength = np.array([0.012 * size, 0.012 * size, 0.006, 0.006]) ** 2
    noise = np.array([[steps**3 / 3, steps**2 / 2], [steps**2 / 2, steps]])
    track.covariance = transition @ track.covariance @ transition.T + strength[:, None, None] * noise
    track.lost_frames += steps
    track.past = track.past + np.array([steps, 0, 0, 0, 0])


def _correct(track: _Track, box_xyxy: np.ndarray) -> None:
    sigma = np.array([0.03 * _size_px(box_xyxy), 0.03 * _size_px(box_xyxy), 0.04, 0.04])
    innovation = _measurement(box_xyxy) - track.mean[:, 0]
    gain = track.covariance[:, :, 0] / (track.covariance[:, 0, 0] + sigma**2)[:, None]
    track.mean = track.mean + gain * innovation[:, None]
    track.covariance = track.covariance - gain[:, :, None] * track.covariance[:, :1, :]


def _move_with_camera(track: _Track, previous_to_current: np.ndarray) -> None:
    centres = np.concatenate([track.mean[None, :2, 0], track.past[:, 1:3]])
    moved = np.concatenate([centres, np.ones((len(centres), 1))], axis=1) @ previous_to_current.T
    centres = moved[:, :2] / moved[:, 2:]
    track.mean[:2, 0], track.past[:, 1:3] = centres[0], centres[1:]
