"""Ego-motion: a camera trajectory from a run's frames, with no more of a model than the frames need.

``estimate_ego_motion`` tracks corners (``ego_tracks``), explains each pair of frames by the lowest sufficient rung of
a ladder of models (``ego_models``), takes metric scale from the road (``ego_scale``) and chains the steps.
``solve_run`` does the last three on stored tracks, so that a better focal length costs no second look at the pictures.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from labeling.camera import Intrinsics, Trajectory, rigid
from labeling.ego_models import (
    PairMotion,
    fit_moving,
    fit_turning,
    five_point,
    gric,
    parallaxes,
    sampson_residuals,
    sign_evidence,
    turning_residuals,
)
from labeling.ego_scale import NO_ROAD, RoadSamples, pooled_pitch, road_samples, step_in_heights
from labeling.ego_tracks import RunTracks, TrackSettings, matched, track_run


class EgoSettings(BaseModel):
    """How ego-motion is estimated."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    tracks: TrackSettings = TrackSettings()
    noise_px: float = Field(default=0.2, gt=0)
    """Least standard deviation of a tracked corner, pixels of the working picture."""
    least_corners: int = Field(default=20, ge=8)
    """With fewer the last motion is held."""
    least_inlier_share: float = Field(default=0.6, gt=0, lt=1)
    """Below it five-point RANSAC proposes another start."""
    default_speed_m_s: float = Field(default=8.0, ge=0)
    """Speed while moving where no road has been seen anywhere in the run."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EgoMotion:
    """A run's camera trajectory and how far to trust it, frame by frame."""

    trajectory: Trajectory
    """In the run's first camera, metres."""
    mode: np.ndarray
    """(T,) str: still | turning | moving | held | cut: how frame i was reached from frame i - 1; frame 0 repeats frame
    1's."""
    confidence: np.ndarray
    """(T,) float32, 0 to 1."""
    scale_source: np.ndarray
    """(T,) str: road | held | default."""
    scale_sigma: np.ndarray
    """(T,) float32: one sigma of the metric scale, relative."""
    intrinsics: Intrinsics
    """The camera that was assumed, in pixels of the run's picture."""
    camera_height_m: float
    pitch_rad: float
    """Pitch against the road, pooled over the run; positive looks down."""
    pitch_sigma_rad: float
    """Infinite where no road was seen."""


def estimate_ego_motion(
    frames: Iterable[np.ndarray],
    times_s: np.ndarray,
    *,
    intrinsics: Intrinsics,
    boxes: Sequence[np.ndarray] | None = None,
    camera_height_m: float = 1.5,
    settings: EgoSettings | None = None,
    breaks: Collection[int] = (),
) -> EgoMotion:
    """The camera's trajectory over a run.

    Args:
        frames: (H, W, 3) uint8 RGB pictures of one size, in time order.
        times_s: (T,) source times, seconds, not decreasing; equal times are repeated frames.
        intrinsics: of these pictures.
        boxes: per frame (n, 4) xyxy of cars and people, pixels of these pictures.
        camera_height_m: over the road; metric scale is proportional to it.
        settings: how to estimate.
        breaks: frames, counted from the run's first, before which a cut or a hole lies.

    Raises:
        DataError: frames, times and boxes that do not agree.
    """
    settings = settings or EgoSettings()
    tracks = track_run(frames, times_s, boxes=boxes, breaks=breaks, settings=settings.tracks)
    return solve_run(tracks, intrinsics=intrinsics, camera_height_m=camera_height_m, settings=settings)


def solve_run(
    tracks: RunTracks, *, intrinsics: Intrinsics, camera_height_m: float = 1.5, settings: EgoSettings | None = None
) -> EgoMotion:
    """The geometry of ``estimate_ego_motion`` on stored tracks."""
    settings = settings or EgoSettings()
    camera = intrinsics.resized(tracks.width, tracks.height)
    solver = _PairSolver(camera, settings)
    count = len(tracks.frames)
    steps = np.tile(np.eye(4), (count, 1, 1))
    mode, confidence = np.full(count, "held", "<U8"), np.zeros(count, np.float32)
    roads: list[RoadSamples] = [NO_ROAD] * count
    directions = np.zeros((count, 3))
    for index in range(1, count):
        frame = tracks.frames[index]
        if frame.cut:
            mode[index] = "cut"
            solver.forget()
            continue
        motion, roads[index] = solver.step(tracks, index)
        mode[index] = motion.mode if motion is not None else "held"
        steps[index, :3, :3] = solver.rotation
        directions[index] = solver.direction
        confidence[index] = 0.0 if motion is None else motion.inlier_share
    pitch, pitch_sigma = pooled_pitch([road for road in roads if len(road.row)])
    lengths, sigma, source = _lengths(roads, mode, tracks.times_s, pitch, camera_height_m, settings)
    steps[:, :3, 3] = directions * lengths[:, None]
    poses = np.tile(np.eye(4), (count, 1, 1))
    for index in range(1, count):
        # A step takes the first camera's coordinates to the second's; cam_to_world runs the other way.
        rotation = steps[index, :3, :3].T
        poses[index] = poses[index - 1] @ rigid(rotation, -rotation @ steps[index, :3, 3])
    if count > 1:
        mode[0], confidence[0], source[0], sigma[0] = mode[1], confidence[1], source[1], sigma[1]
    return EgoMotion(
        trajectory=Trajectory(timestamps_s=_output_times(tracks.times_s), cam_to_world=poses),
        mode=mode, confidence=confidence, scale_source=source, scale_sigma=sigma.astype(np.float32),
        intrinsics=intrinsics, camera_height_m=camera_height_m, pitch_rad=pitch, pitch_sigma_rad=pitch_sigma,
    )  # fmt: skip


class _PairSolver:
    """Explains one pair of frames after another, starting each from the last motion."""

    def __init__(self, camera: Intrinsics, settings: EgoSettings) -> None:
        self._settings = settings
        self._focal, self._centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        self._noise = settings.noise_px / camera.fx
        self._scales = self._noise * np.maximum(3.0, 15.0 * 0.7 ** np.arange(10))
        self.forget()

    def forget(self) -> None:
        """Start afresh: no turn, forward."""
        self.rotation = np.eye(3)
        self._forward = np.array([0.0, 0.0, -1.0])
        self.direction = np.zeros(3)

    def step(self, tracks: RunTracks, index: int) -> tuple[PairMotion | None, RoadSamples]:
        """The motion from frame ``index - 1`` to ``index``; None where too little is seen and the last motion is
        held."""
        before, after = tracks.frames[index - 1], tracks.frames[index]
        at_first, at_second = matched(before, after)
        if len(at_first) < self._settings.least_corners:
            return None, NO_ROAD
        first = (before.points_px[at_first] - self._centre) / self._focal
        second = (after.points_px[at_second] - self._centre) / self._focal
        motion = self._ladder(first, second)
        self.rotation, self.direction = motion.rotation, motion.direction
        if motion.mode != "moving":
            return motion, NO_ROAD
        self._forward = motion.direction
        inlier = motion.inlier
        road = road_samples(first[inlier], second[inlier], motion.rotation, motion.direction, noise=self._noise)
        return motion, road

    def _ladder(self, first: np.ndarray, second: np.ndarray) -> PairMotion:
        weight = np.ones(len(first))
        still = ((second - first) ** 2).sum(axis=1) / self._noise**2
        turn = fit_turning(first, second, weight, self.rotation, self._scales)
        turning = (turning_residuals(first, second, turn) ** 2).sum(axis=1) / self._noise**2
        rotation, direction, information = self._moving(first, second, weight)
        moving = sampson_residuals(first, second, rotation, direction) ** 2 / self._noise**2
        costs = (
            gric(still, dimension=2, parameters=0),
            gric(turning, dimension=2, parameters=3),
            gric(moving, dimension=3, parameters=5),
        )
        best = int(np.argmin(costs))
        share = float((np.array([still, turning, moving])[best] < 9.0).mean())
        along = parallaxes(first, second, rotation, direction)[:, 0]
        evidence = sign_evidence(along[moving < 9.0], self._noise)
        if evidence < 0:
            direction = -direction
        return PairMotion(
            mode=("still", "turning", "moving")[best],
            rotation=(np.eye(3), turn, rotation)[best],
            direction=direction if best == 2 else np.zeros(3),
            information=information,
            inlier=(still, turning, moving)[best] < 9.0,
            inlier_share=share, costs=costs, sign_margin=abs(evidence),
        )  # fmt: skip

    def _moving(self, first: np.ndarray, second: np.ndarray, weight: np.ndarray):
        nothing = np.zeros(3)
        fitted = fit_moving(
            first, second, weight, self.rotation, self._forward, self._scales, self._noise, nothing, 0.0
        )
        share = np.mean(np.abs(sampson_residuals(first, second, fitted[0], fitted[1])) < 3 * self._noise)
        if share >= self._settings.least_inlier_share:
            return fitted
        proposal = five_point(first, second, self._noise)
        if proposal is None:
            return fitted
        other = fit_moving(first, second, weight, *proposal, self._scales, self._noise, nothing, 0.0)
        other_share = np.mean(np.abs(sampson_residuals(first, second, other[0], other[1])) < 3 * self._noise)
        return other if other_share > share else fitted


def _lengths(
    roads: list[RoadSamples],
    mode: np.ndarray,
    times_s: np.ndarray,
    pitch: float,
    height_m: float,
    settings: EgoSettings,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Metres of each step, their relative sigma and where they came from."""
    count = len(roads)
    heights, sigma = np.array([step_in_heights(road, pitch) for road in roads]).reshape(-1, 2).T
    moving = (mode == "moving") | (mode == "held")
    seen = np.isfinite(sigma) & (heights > 0)
    source = np.where(seen, "road", "held").astype("<U8")
    elapsed = np.diff(times_s, prepend=times_s[0])
    if seen.any():
        speeds = np.interp(
            np.arange(count), np.flatnonzero(seen), heights[seen] * height_m / np.maximum(elapsed[seen], 1e-6)
        )
        sigma = np.where(seen, sigma, 0.3)
    else:
        speeds = np.full(count, settings.default_speed_m_s)
        source[:], sigma = "default", np.ones(count)
    return np.where(moving, speeds * elapsed, 0.0), sigma, source


def _output_times(times_s: np.ndarray) -> np.ndarray:
    """The given times, or an even grid over their span where some repeat (a trajectory's times must increase)."""
    if len(times_s) < 2 or (np.diff(times_s) > 0).all():
        return times_s.copy()
    span = max(times_s[-1] - times_s[0], 1e-3 * (len(times_s) - 1))
    return times_s[0] + np.arange(len(times_s)) * span / (len(times_s) - 1)
