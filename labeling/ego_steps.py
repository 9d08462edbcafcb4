"""From a run's tracks to what each step says: which frames count, which corners belong to the scene, and the ladder's
fits.

A step leads from one frame that shows something new to the next. Where one step's parallax is short, a window of
several steps around it is fitted too: it tells standing from creeping, and fixes the direction that the step alone
cannot see.
"""

from dataclasses import dataclass

import numpy as np

from labeling.camera import Intrinsics
from labeling.ego_corners import FrameTracks
from labeling.ego_ladder import Corners, PairMotion, explain_pair
from labeling.ego_settings import EgoSettings
from labeling.ego_tracks import RunTracks, matched

FORWARD = np.array([0.0, 0.0, -1.0])
"""Translation of ``x2 = R x1 + t`` of a camera that moves along its axis: the scene comes nearer."""
_WIDEST_AXIS = 0.35
_OVERLAY_CELL = 16
_DOUBT_GAIN = 0.35
_LEAST_REPEATS = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """One step, between two frames that show something new."""

    corners: Corners
    pair: PairMotion
    window: PairMotion | None
    """Fit over several steps around this one, where its own parallax is short."""
    window_corners: Corners | None
    reach: int = 0
    """Steps on either side that the window takes in; 0 without one."""

    @property
    def measured(self) -> tuple[PairMotion, Corners]:
        """What tells mode, sign and length: the window where there is one."""
        if self.window is not None and self.window_corners is not None:
            return self.window, self.window_corners
        return self.pair, self.corners


def shown_frames(tracks: RunTracks) -> tuple[np.ndarray, np.ndarray]:
    """(m,) indices of frames that show something new, and (m,) the times at which their pictures were taken.

    A repeated picture is left out when its neighbours move (a standing camera repeats itself too, and says so). Where
    repeats come regularly, as in 20 pictures a second stretched to 24, the pictures are spread evenly again; one or two
    that a recorder showed twice say nothing of the others' times.
    """
    times = tracks.times_s
    flow = _median_flow(tracks)
    same_time = np.diff(times, prepend=-np.inf) == 0
    left_out = same_time.copy()
    stretched = 0
    for index in np.flatnonzero([frame.repeated for frame in tracks.frames] | (flow < 0.1)):
        if left_out[index] or tracks.frames[index].cut or index == 0:
            continue
        before, after = flow[max(1, index - 3) : index], flow[index + 1 : index + 4]
        least = max(0.5, 6.0 * flow[index])
        sides = [side.max() > least for side in (before, after) if len(side)]
        if sides and all(sides):
            left_out[index] = True
            usual = np.median(np.concatenate([before, after]))
            # After a picture shown in place of one that is lost, the next step is two long; nothing follows the last.
            stretched += len(after) > 0 and after[0] < 1.6 * max(usual, 1e-6)
    kept = np.flatnonzero(~left_out)
    taken = times[kept].astype(np.float64)
    return kept, _evenly_spread(taken) if stretched >= _LEAST_REPEATS else taken


def _median_flow(tracks: RunTracks) -> np.ndarray:
    """(T,) median length of the corners' motion into each frame, pixels; 0 where none are shared."""
    flow = np.zeros(len(tracks.frames))
    for index in range(1, len(tracks.frames)):
        before, after = tracks.frames[index - 1], tracks.frames[index]
        one, two = matched(before, after)
        if len(one):
            flow[index] = np.median(np.linalg.norm(after.points_px[two] - before.points_px[one], axis=1))
    return flow


def _evenly_spread(times_s: np.ndarray, *, reach: int = 6) -> np.ndarray:
    """Times averaged over up to ``reach`` neighbours on either side; ends stay, order is kept."""
    count = len(times_s)
    total = np.concatenate([[0.0], np.cumsum(times_s)])
    at = np.arange(count)
    half = np.minimum(reach, np.minimum(at, count - 1 - at))
    mean = (total[at + half + 1] - total[at - half]) / (2 * half + 1)
    return np.maximum.accumulate(mean + 1e-9 * at)


class StepSolver:
    """Fits the steps of one run in order."""

    def __init__(self, tracks: RunTracks, camera: Intrinsics, settings: EgoSettings) -> None:
        """``camera`` is given in pixels of the working picture."""
        self._tracks, self._settings = tracks, settings
        self._focal, self._centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        self._floor = settings.noise_px / camera.fx
        self._kept, self._times = shown_frames(tracks)
        self._all_ids = np.unique(np.concatenate([frame.ids for frame in tracks.frames]))
        self._doubt = np.zeros(len(self._all_ids))
        self._overlay = overlay_cells(tracks, self._kept, horizon_px=camera.cy, focal_px=camera.fx)

    @property
    def shown(self) -> tuple[np.ndarray, np.ndarray]:
        """As ``shown_frames``."""
        return self._kept, self._times

    def solve(self) -> tuple[list[Step | None], np.ndarray]:
        """For every shown frame its step (None: too little was seen, or a cut, or the first), and (m,) bool: a cut."""
        count = len(self._kept)
        steps: list[Step | None] = [None] * count
        cuts = np.zeros(count, bool)
        rotation, axis, axis_sigma = np.eye(3), FORWARD, _WIDEST_AXIS
        for index in range(1, count):
            frames = self._tracks.frames[self._kept[index - 1] + 1 : self._kept[index] + 1]
            cuts[index] = any(frame.cut for frame in frames)
            corners = None if cuts[index] else self._shared(index - 1, index)
            if cuts[index]:
                rotation, axis, axis_sigma = np.eye(3), FORWARD, _WIDEST_AXIS
            elapsed = self._times[index] - self._times[index - 1]
            walk = self._settings.axis_walk_rad * np.sqrt(elapsed)
            axis_sigma = float(min(np.hypot(axis_sigma, walk), _WIDEST_AXIS))
            if corners is None:
                continue
            pair = self._explain(corners, rotation, axis, axis_sigma)
            best = int(pair.costs.argmin())
            rotation = (np.eye(3), pair.turn, pair.rotation)[best]
            if best == 2 and pair.axis_sigma < _WIDEST_AXIS:
                axis, axis_sigma = pair.axis, pair.axis_sigma
            if best == 2:
                self._remember(corners, pair)
            steps[index] = Step(corners=corners, pair=pair, window=None, window_corners=None)
        return [self._widened(steps, cuts, index) for index in range(count)], cuts

    def _remember(self, corners: Corners, pair: PairMotion) -> None:
        """Doubt corners that would not fit: what moved by itself a moment ago will again."""
        if pair.inlier_shares[2] > 0.5:
            at = np.searchsorted(self._all_ids, corners.ids)
            self._doubt[at] += _DOUBT_GAIN * (~pair.inlier - self._doubt[at])

    def _explain(
        self, corners: Corners, rotation: np.ndarray, axis: np.ndarray, axis_sigma: float, *, restarts: bool = True
    ) -> PairMotion:
        return explain_pair(
            corners, rotation=rotation, axis=axis, axis_sigma=axis_sigma, noise_floor=self._floor,
            least_inlier_share=self._settings.least_inlier_share if restarts else 0.0,
        )  # fmt: skip

    def _widened(self, steps: list[Step | None], cuts: np.ndarray, index: int) -> Step | None:
        """The step with a window around it, where its own parallax is short."""
        step = steps[index]
        wanted = self._settings.parallax_px / self._focal[0]
        if step is None or step.pair.parallax >= wanted:
            return step
        half = int(np.ceil((wanted / max(step.pair.parallax, 1e-6) - 1) / 2))
        for reach in range(min(half, self._settings.window_reach), 0, -1):
            first, last = index - 1 - reach, index + reach
            if first < 0 or last >= len(steps) or cuts[first + 1 : last + 1].any():
                continue
            inside = steps[first + 1 : last + 1]
            if any(one is None for one in inside):
                continue
            corners = self._shared(first, last)
            if corners is None or len(corners.ids) < 0.4 * len(step.corners.ids):
                continue
            return self._with_window(step, [one for one in inside if one is not None], corners)
        return step

    def _with_window(self, step: Step, inside: list[Step], corners: Corners) -> Step:
        turns = [one.pair.rotation if one.pair.costs.argmin() == 2 else one.pair.turn for one in inside]
        rotation, half_turn = np.eye(3), np.eye(3)
        for place, turn in enumerate(turns):
            rotation = turn @ rotation
            if place > len(turns) // 2:
                half_turn = turn @ half_turn
        window = self._explain(corners, rotation, half_turn @ step.pair.axis, 3 * _WIDEST_AXIS, restarts=False)
        # The chord's direction in the last frame, turned back to the frame that this step ends in.
        axis = half_turn.T @ window.axis
        pair = self._explain(step.corners, turns[len(turns) // 2], axis, max(window.axis_sigma, 2e-3), restarts=False)
        return Step(corners=step.corners, pair=pair, window=window, window_corners=corners, reach=len(inside) // 2)

    def _shared(self, first: int, last: int) -> Corners | None:
        before, after = self._tracks.frames[self._kept[first]], self._tracks.frames[self._kept[last]]
        one, two = matched(before, after)
        if self._overlay.any() and len(one):
            scene = ~self._overlay[_cells(after.points_px[two], self._overlay.shape)]
            one, two = one[scene], two[scene]
        if len(one) < self._settings.least_corners:
            return None
        doubt = self._doubt[np.searchsorted(self._all_ids, after.ids[two])]
        return Corners(
            ids=after.ids[two],
            first=(before.points_px[one] - self._centre) / self._focal,
            second=(after.points_px[two] - self._centre) / self._focal,
            weight=_balanced(after, two, self._tracks) * np.maximum((1.0 - doubt) ** 2, 0.02),
        )


def overlay_cells(tracks: RunTracks, kept: np.ndarray, *, horizon_px: float, focal_px: float) -> np.ndarray:
    """(rows, columns) bool: 16-pixel cells that rest while the scene moves: bonnet, bars, burnt-in text, a car ahead.

    Rest is evidence only where motion is due: anywhere while the picture shifts as a whole, low and high in the picture
    while anything moves. So neither a standing camera nor the horizon of a straight road is taken for an overlay.
    """
    shape = (-(-tracks.height // _OVERLAY_CELL), -(-tracks.width // _OVERLAY_CELL))
    resting, due = np.zeros(shape), np.zeros(shape)
    for first, last in zip(kept[:-1], kept[1:], strict=True):
        one, two = matched(tracks.frames[first], tracks.frames[last])
        if len(one) < 20:
            continue
        points = tracks.frames[last].points_px[two]
        flow = points - tracks.frames[first].points_px[one]
        length = np.linalg.norm(flow, axis=1)
        if np.median(length) < 1.5:
            continue
        shifts = np.linalg.norm(np.median(flow, axis=0)) > 1.5
        row = (points[:, 1] - horizon_px) / focal_px
        counts = shifts | (row > 0.12) | (row < -0.3)
        cells = _cells(points[counts], shape)
        np.add.at(due, cells, 1)
        np.add.at(resting, cells, length[counts] < 0.25)
    return (due >= 12) & (resting > 0.7 * due)


def _cells(points_px: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    cell = np.clip(points_px // _OVERLAY_CELL, 0, np.array(shape[::-1]) - 1).astype(int)
    return cell[:, 1], cell[:, 0]


def _balanced(frame: FrameTracks, at: np.ndarray, tracks: RunTracks) -> np.ndarray:
    """(n,) weights: a corner counts less where more than the usual number share its eighth of the picture's width."""
    side = max(tracks.width / 8.0, 1.0)
    place = (frame.points_px[at] // side).astype(int)
    index = place[:, 1] * 1000 + place[:, 0]
    _, inverse, counts = np.unique(index, return_inverse=True, return_counts=True)
    weight = np.minimum(1.0, np.median(counts) / counts)[inverse]
    return weight / max(weight.mean(), 1e-9)
