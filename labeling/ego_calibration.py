"""One camera per video: focal length from its turns, pitch from its road, pooled over all of its runs.

While the camera turns, the picture's middle and its edges move by different amounts, and near and far corners agree on
one epipolar geometry only if the focal length is right. So the robust cost of the moving model over the video's
sharpest turns is summed for a ladder of focal lengths; its lowest point is the answer, resampled turns give its sigma,
and the prior keeps a video that never turns where it was. The camera's height cannot be seen by one camera: it is
given, or assumed with a sigma that says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from labeling.camera import Intrinsics
from labeling.ego_ladder import sign_evidence
from labeling.ego_models import fit_moving, fit_turning, parallaxes, sampson_residuals, turning_residuals
from labeling.ego_motion import RoadView, solve_run
from labeling.ego_settings import EgoSettings
from labeling.ego_tracks import RunTracks, matched
from labeling.errors import DataError

_SCALES = np.geomspace(0.5, 2.0, 29)
"""Focal lengths that are tried, times the prior."""
_REACHES = (2, 4, 6, 8, 12, 16)
_NOISE_PX = 0.2
_LEAST_SHIFT, _MOST_SHIFT = 0.04, 0.2
_LEAST_CORNERS = 60
_LOW_ROW = 0.08
"""Tangent below the horizon, at the prior's focal length, from which corners may be road."""
ROAD_FRAMES = 2880
"""Frames of a video that its road is read from, spread over its runs: two minutes tell a pitch to a hundredth of a
degree."""
_LEAST_WINDOW = 48
_ASSUMED_HEIGHT_SIGMA, _GIVEN_HEIGHT_SIGMA = 0.15, 0.01

PitchSource = Literal["given", "estimated", "prior"]
HeightSource = Literal["given", "prior"]


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownMounting:
    """How a camera is mounted, as far as a person has said."""

    height_m: float | None = None
    """Over the road."""
    pitch_rad: float | None = None
    """Positive looks down."""
    assumed_height_m: float = 1.5
    """Taken where no height is given."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraCalibration:
    """The one camera of a video."""

    intrinsics: Intrinsics
    """In pixels of the runs' picture; its ``source`` and ``focal_sigma`` say how far to trust it."""
    road: RoadView
    turns: int
    """Pairs of frames that spoke for the focal length."""
    pitch_source: PitchSource
    """``prior``: no road was seen, so every run keeps to itself."""
    height_source: HeightSource
    height_sigma: float
    """One sigma of the height, relative to it: metric scale cannot be surer."""

    @property
    def pitch_rad(self) -> float | None:
        """The pitch that holds for all runs; None where the video has not told it."""
        return None if self.pitch_source == "prior" else self.road.pitch_rad


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Turn:
    """Corners of two frames between which the camera turned, about the principal point, working pixels."""

    first_px: np.ndarray
    second_px: np.ndarray
    run: int
    frame: int
    shift: float
    """Median shift as a share of the picture's width."""


def calibrate_camera(
    runs: Sequence[RunTracks],
    *,
    intrinsics: Intrinsics,
    mounting: KnownMounting | None = None,
    settings: EgoSettings | None = None,
    most_turns: int = 160,
) -> CameraCalibration:
    """What all runs of a video say about its camera: given before metadata before estimated before the prior.

    Args:
        runs: the video's runs, all of one picture size.
        intrinsics: of the runs' pictures. A focal length that was given or read from metadata is kept.
        mounting: height and pitch where they are known.
        settings: of the estimator that the calibration will be used with.
        most_turns: pairs of frames to look at; the sharpest turns are taken.

    Raises:
        DataError: no runs, or runs of different pictures.
    """
    settings, mounting = settings or EgoSettings(), mounting or KnownMounting()
    # Once over the runs in order: each may be read from its file.
    if len({(run.width, run.height) for run in runs}) != 1:
        raise DataError(
            "a camera is calibrated from one or more runs of one picture size; track the video's runs again"
        )
    turns: list[_Turn] = []
    if intrinsics.source in ("prior", "estimated"):
        turns = find_turns(runs, intrinsics, most=most_turns)
    if turns:
        camera = intrinsics.resized(runs[0].width, runs[0].height)
        horizon_px = camera.fy * np.tan(_road(runs, intrinsics, mounting, settings).pitch_rad)
        intrinsics = _with_focal(intrinsics, *focal_from_turns(turns, camera, horizon_px=horizon_px))
    return _calibration(intrinsics, mounting, _road(runs, intrinsics, mounting, settings), len(turns))


def known_camera(intrinsics: Intrinsics, mounting: KnownMounting | None = None) -> CameraCalibration:
    """The camera of a video of which no run is looked at: what is given, else the prior."""
    mounting = mounting or KnownMounting()
    return _calibration(intrinsics, mounting, pooled_road([], _height_m(mounting)), 0)


def _calibration(intrinsics: Intrinsics, mounting: KnownMounting, seen: RoadView, turns: int) -> CameraCalibration:
    given = mounting.height_m is not None
    pitch_source: PitchSource = "estimated" if np.isfinite(seen.pitch_sigma_rad) else "prior"
    if mounting.pitch_rad is not None:
        pitch_source, seen = "given", replace(seen, pitch_rad=mounting.pitch_rad, pitch_sigma_rad=0.0)
    return CameraCalibration(
        intrinsics=intrinsics, road=seen, turns=turns, pitch_source=pitch_source,
        height_source="given" if given else "prior",
        height_sigma=_GIVEN_HEIGHT_SIGMA if given else _ASSUMED_HEIGHT_SIGMA,
    )  # fmt: skip


def _height_m(mounting: KnownMounting) -> float:
    return mounting.assumed_height_m if mounting.height_m is None else mounting.height_m


def _road(
    runs: Sequence[RunTracks], intrinsics: Intrinsics, mounting: KnownMounting, settings: EgoSettings
) -> RoadView:
    height_m, pitch_rad = _height_m(mounting), mounting.pitch_rad
    if pitch_rad is not None:
        return RoadView(height_m=height_m, pitch_rad=pitch_rad, pitch_sigma_rad=0.0)
    frames = max(_LEAST_WINDOW, ROAD_FRAMES // len(runs))
    views = [
        solve_run(run.middle(frames), intrinsics=intrinsics, camera_height_m=height_m, settings=settings)
        for run in runs
    ]
    return pooled_road([view.road for view in views], height_m)


def find_turns(runs: Sequence[RunTracks], intrinsics: Intrinsics, *, most: int) -> list[_Turn]:
    """The pairs of frames with the largest shift of the whole picture, spread over the runs."""
    found = []
    for number, run in enumerate(runs):
        camera = intrinsics.resized(run.width, run.height)
        centre = np.array([camera.cx, camera.cy])
        for start in range(0, len(run.frames) - _REACHES[0], 4):
            turn = _turn_from(run, start, centre, number)
            if turn is not None:
                found.append(turn)
        # After each run, so that a video of hours does not pile up.
        found = sorted(found, key=lambda turn: -turn.shift)[:most]
    return found


def _turn_from(run: RunTracks, start: int, centre: np.ndarray, number: int) -> _Turn | None:
    """The longest pair from this frame on that still shares enough corners, if the picture shifted between them."""
    best = None
    for reach in _REACHES:
        if start + reach >= len(run.frames) or any(f.cut for f in run.frames[start + 1 : start + reach + 1]):
            break
        first, second = run.frames[start], run.frames[start + reach]
        one, two = matched(first, second)
        if len(one) < _LEAST_CORNERS:
            break
        here, there = first.points_px[one] - centre, second.points_px[two] - centre
        shift = float(np.abs(np.median(there - here, axis=0)).max()) / run.width
        if shift > _MOST_SHIFT:
            break
        if shift > _LEAST_SHIFT:
            best = _Turn(
                first_px=here.astype(np.float64), second_px=there.astype(np.float64), run=number, frame=start,
                shift=shift,
            )  # fmt: skip
    return best


def focal_from_turns(turns: list[_Turn], camera: Intrinsics, *, horizon_px: float = 0.0) -> tuple[float, float]:
    """Focal length over the given camera's, and its relative sigma; the camera's own where turns do not say.

    Args:
        turns: of ``find_turns``.
        camera: in working pixels, with the prior's sigma.
        horizon_px: how far the road's horizon lies above the principal point; this much a straight road tells whatever
            the focal length.
    """
    if len(turns) < 3:
        return 1.0, camera.focal_sigma
    road_px = _LOW_ROW * camera.fx - horizon_px
    costs = np.array([
        [_turn_cost(turn, camera.fx * scale, horizon_px, road_px) for scale in _SCALES] for turn in turns
    ])  # fmt: skip
    logs = np.log(_SCALES)
    # Pairs that overlap in time share their corners: they are drawn together, second by second.
    blocks = np.unique(np.array([(turn.run, turn.frame // 24) for turn in turns]), axis=0, return_inverse=True)[1]
    sums = np.array([costs[blocks.ravel() == block].sum(axis=0) for block in range(blocks.max() + 1)])
    prior = (logs / max(camera.focal_sigma, 0.05)) ** 2
    best = _lowest(sums.sum(axis=0) + prior, logs)
    rng = np.random.default_rng(0)
    draws = rng.integers(0, len(sums), (200, len(sums)))
    spread = np.array([_lowest(sums[draw].sum(axis=0) + prior, logs) for draw in draws])
    bend = _curvature(sums.sum(axis=0) + prior, logs)
    sigma = float(np.sqrt(np.mean((spread - best) ** 2) + 1.0 / bend + 0.01**2))
    return float(np.exp(best)), min(sigma, max(camera.focal_sigma, 0.05))


def _turn_cost(turn: _Turn, focal_px: float, horizon_px: float, road_px: float) -> float:
    """Robust squared distances, in units of the noise, from epipolar geometry and level road, at a focal length.

    Corners below row ``road_px`` may be road: the same ones at every focal length, or fewer votes would look like fewer
    errors.
    """
    first, second = turn.first_px / focal_px, turn.second_px / focal_px
    weight = np.ones(len(first))
    identity, ahead = np.eye(3), np.array([0.0, 0.0, -1.0])
    widest = 2.0 * float(np.median(np.linalg.norm(turning_residuals(first, second, identity), axis=1)))
    noise = _NOISE_PX / focal_px
    rotation = fit_turning(first, second, weight, identity, np.geomspace(max(widest, 20 * noise), 10 * noise, 8))
    scales = np.concatenate([np.geomspace(60 * noise, 3 * noise, 10), np.full(3, 3 * noise)])
    # Along an arc the chord points half the turn away from where the car looks at its end.
    chord = (Rotation.from_matrix(rotation) ** 0.5).apply(ahead)
    rotation, axis, _ = fit_moving(first, second, weight, rotation, chord, scales, noise, chord, 0.2)
    square = (sampson_residuals(first, second, rotation, axis) / noise) ** 2
    along, gain = parallaxes(first, second, rotation, axis).T
    along = along * (1.0 if sign_evidence(along[square < 9], noise) >= 0 else -1.0)
    behind = np.minimum(along / noise, 0.0) ** 2
    total = _bounded(square) + _bounded(behind)
    level = (second - turning_residuals(first, second, rotation))[:, 1] + horizon_px / focal_px
    low = (square < 9) & (turn.second_px[:, 1] > road_px) & (level > 0.01) & (along > 3 * noise)
    if low.sum() >= 12:
        total[low] += _bounded(_road_distance(along[low] / gain[low], noise / gain[low], level[low]))
    # Corners of one turn share their errors: at most some thirty of them are worth a vote of their own.
    return float(total.sum()) * min(1.0, 30.0 / len(square))


def _bounded(square: np.ndarray) -> np.ndarray:
    return square / (1.0 + square / 9.0)


def _road_distance(inverse_depth: np.ndarray, sigma: np.ndarray, level: np.ndarray) -> np.ndarray:
    """(n,) squared distance from the level road that most of these corners lie on, in units of the noise."""
    step = float(np.median(inverse_depth / level))
    for _ in range(5):
        # A road is never quite flat: two hundredths of the distance are forgiven.
        width = np.hypot(sigma, 0.02 * step * level)
        weight = (level / width) ** 2 / (1 + ((inverse_depth - step * level) / (3 * width)) ** 2) ** 2
        step = float((weight * inverse_depth / level).sum() / max(weight.sum(), 1e-12))
    return ((inverse_depth - step * level) / np.hypot(sigma, 0.02 * abs(step) * level)) ** 2


def _lowest(cost: np.ndarray, at: np.ndarray) -> float:
    """Where the parabola through the lowest value and its neighbours is lowest."""
    index = int(np.clip(cost.argmin(), 1, len(at) - 2))
    left, middle, right = cost[index - 1 : index + 2]
    bend = left - 2 * middle + right
    shift = 0.5 * (left - right) / bend if bend > 1e-12 else 0.0
    return float(at[index] + np.clip(shift, -1, 1) * (at[1] - at[0]))


def _curvature(cost: np.ndarray, at: np.ndarray) -> float:
    """Half the second derivative around the lowest value: the inverse variance of a sum of squares."""
    index = int(np.clip(cost.argmin(), 2, len(at) - 3))
    return max(float(np.polyfit(at[index - 2 : index + 3] - at[index], cost[index - 2 : index + 3], 2)[0]), 1e-3)


def _with_focal(intrinsics: Intrinsics, scale: float, sigma: float) -> Intrinsics:
    if sigma >= intrinsics.focal_sigma:
        return intrinsics
    return replace(
        intrinsics, fx=intrinsics.fx * scale, fy=intrinsics.fy * scale, source="estimated", focal_sigma=sigma
    )


def pooled_road(views: Sequence[RoadView], height_m: float) -> RoadView:
    """Pitch pooled by its runs' sigmas; the spread between runs, where it is larger, is the sigma that counts."""
    seen = [view for view in views if np.isfinite(view.pitch_sigma_rad)]
    if not seen:
        return RoadView(height_m=height_m, pitch_rad=0.0, pitch_sigma_rad=float("inf"))
    pitch = np.array([view.pitch_rad for view in seen])
    sigma = np.array([max(view.pitch_sigma_rad, 1e-4) for view in seen])
    weight = 1.0 / sigma**2
    mean = float((weight * pitch).sum() / weight.sum())
    within = 1.0 / weight.sum()
    between = float((weight * (pitch - mean) ** 2).sum() / weight.sum()) / max(len(seen) - 1, 1)
    return RoadView(height_m=height_m, pitch_rad=mean, pitch_sigma_rad=float(np.sqrt(max(within, between))))
