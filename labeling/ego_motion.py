"""Ego-motion: a camera trajectory from a run's frames, with no more of a model than the frames need.

``estimate_ego_motion`` tracks corners (``ego_tracks``), explains each step by the lowest sufficient rung of a ladder of
models (``ego_ladder``, ``ego_steps``, ``ego_modes``), takes metric scale from the road (``ego_scale``, ``ego_speed``),
smooths and chains the steps. ``solve_run`` does all but the first on stored tracks, so that a better focal length
(``ego_calibration``) costs no second look at the pictures.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from labeling.camera import Intrinsics, Trajectory, rebased_trajectory
from labeling.ego_chain import (
    chained,
    interpolated,
    length_evidence,
    moves,
    output_times,
    smoothed_steps,
    turns_and_directions,
)
from labeling.ego_ladder import sideways
from labeling.ego_modes import MODES, MOVING, cheapest_path, travel_signs
from labeling.ego_scale import Depths, corner_depths, pooled_pitch, road_part
from labeling.ego_settings import EgoSettings
from labeling.ego_speed import Speeds, run_speeds
from labeling.ego_steps import Step, StepSolver
from labeling.ego_tracks import RunTracks, track_run
from labeling.errors import DataError

__all__ = ["EgoMotion", "EgoSettings", "RoadView", "estimate_ego_motion", "solve_run"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadView:
    """How the camera looks at the road."""

    height_m: float
    """Over the road; metric scale is proportional to it."""
    pitch_rad: float
    """Positive looks down."""
    pitch_sigma_rad: float
    """Infinite where no road was seen."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EgoMotion:
    """A run's camera trajectory and how far to trust it, frame by frame."""

    trajectory: Trajectory
    """In the run's first camera, metres."""
    mode: np.ndarray
    """(T,) str: still | turning | moving | held | cut: how frame i was reached from i - 1; frame 0 repeats frame
    1's. Or missing: an imported trajectory says nothing of it."""
    confidence: np.ndarray
    """(T,) float32, 0 to 1."""
    scale_source: np.ndarray
    """(T,) str: road | held | default, or given: imported."""
    scale_sigma: np.ndarray
    """(T,) float32: one sigma of the metric scale, relative."""
    intrinsics: Intrinsics
    """The camera that was assumed, in pixels of the run's picture."""
    road: RoadView
    """How the camera was found to look at the road."""


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
        DataError: frames, times and boxes that do not agree, or intrinsics of another picture.
    """
    settings = settings or EgoSettings()
    tracks = track_run(frames, times_s, boxes=boxes, breaks=breaks, settings=settings.tracks)
    return solve_run(tracks, intrinsics=intrinsics, camera_height_m=camera_height_m, settings=settings)


def solve_run(
    tracks: RunTracks,
    *,
    intrinsics: Intrinsics,
    camera_height_m: float = 1.5,
    pitch_rad: float | None = None,
    settings: EgoSettings | None = None,
) -> EgoMotion:
    """The geometry of ``estimate_ego_motion`` on stored tracks.

    Args:
        tracks: of ``track_run``.
        intrinsics: of the run's pictures.
        camera_height_m: over the road.
        pitch_rad: the camera's pitch against the road where the whole video has told it; otherwise this run's own.
        settings: how to estimate.

    Raises:
        DataError: intrinsics of another picture.
    """
    settings = settings or EgoSettings()
    if (intrinsics.width, intrinsics.height) != (tracks.source_width, tracks.source_height):
        raise DataError(
            f"intrinsics are for {intrinsics.width}x{intrinsics.height}, the run's pictures are "
            f"{tracks.source_width}x{tracks.source_height}; map them with Intrinsics.mapped first"
        )
    solver = StepSolver(tracks, intrinsics.resized(tracks.width, tracks.height), settings)
    steps, cuts = solver.solve()
    kept, times = solver.shown
    states = _states(steps, settings)
    signs = _signs(steps, settings)
    depths = [
        corner_depths(step.corners, step.pair, sign=sign) if step else None
        for step, sign in zip(steps, signs, strict=True)
    ]
    roads = [_road_of(step, sign) for step, sign in zip(steps, signs, strict=True)]
    road = _road_view(roads, states, camera_height_m, pitch_rad)
    rotations, directions = turns_and_directions(steps, states, signs, cuts)
    rotations, directions = smoothed_steps(steps, states, cuts, rotations, directions, settings)
    moving = moves(steps, states, cuts)
    evidence = length_evidence(steps, depths, roads, directions, times, moving, road.pitch_rad)
    speeds = run_speeds(
        evidence, moving, height_m=camera_height_m, scale_walk=settings.scale_walk,
        default_depth_heights=settings.default_depth_heights,
    )  # fmt: skip
    lengths = speeds.metres_per_s * np.diff(times, prepend=times[0])
    poses = chained(rotations, directions * lengths[:, None])
    mode = np.array(
        [_mode_name(step, state, cut) for step, state, cut in zip(steps, states, cuts, strict=True)], dtype="<U8"
    )
    confidence = np.array([_confidence(step, state) for step, state in zip(steps, states, strict=True)], np.float32)
    return _on_all_frames(tracks, kept, times, poses, mode, confidence, speeds, intrinsics, road)


def _states(steps: list[Step | None], settings: EgoSettings) -> np.ndarray:
    """(m,) int: index into ``MODES``."""
    costs = np.zeros((len(steps), len(MODES)))
    for index, step in enumerate(steps):
        if step is not None:
            motion, corners = step.measured
            costs[index] = (motion.costs - motion.costs.min()) * min(len(corners.ids), 120)
    return cheapest_path(costs, switch_cost=settings.switch_cost)


def _signs(steps: list[Step | None], settings: EgoSettings) -> np.ndarray:
    """(m,) -1 or 1 for each step's own axis."""
    axes, evidence = np.zeros((len(steps), 3)), np.zeros(len(steps))
    for index, step in enumerate(steps):
        if step is not None:
            motion = step.measured[0]
            axes[index] = step.pair.axis
            evidence[index] = motion.evidence * (1.0 if motion.axis @ step.pair.axis >= 0 else -1.0)
    return travel_signs(axes, evidence, turn_back_cost=settings.turn_back_cost)


def _road_of(step: Step | None, sign: float) -> Depths | None:
    if step is None:
        return None
    motion, corners = step.measured
    sign = sign if motion.axis @ step.pair.axis >= 0 else -sign
    return road_part(corner_depths(corners, motion, sign=sign))


def _road_view(roads: list[Depths | None], states: np.ndarray, height_m: float, pitch_rad: float | None) -> RoadView:
    if pitch_rad is not None:
        return RoadView(height_m=height_m, pitch_rad=pitch_rad, pitch_sigma_rad=0.0)
    seen = [road for road, state in zip(roads, states, strict=True) if road is not None and state == MOVING]
    pitch, sigma = pooled_pitch(seen)
    return RoadView(height_m=height_m, pitch_rad=pitch, pitch_sigma_rad=sigma)


def _mode_name(step: Step | None, state: int, cut: bool) -> str:
    if cut:
        return "cut"
    return "held" if step is None else MODES[state]


def _confidence(step: Step | None, state: int) -> float:
    """0 to 1: how many corners agree, how many there are, and whether another motion has as many."""
    if step is None:
        return 0.0
    motion = step.measured[0]
    share = float(motion.inlier_shares[state])
    agreement = np.clip((share - 0.4) / 0.4, 0.0, 1.0)
    enough = min(1.0, len(step.corners.ids) / 60.0)
    undisputed = np.clip(1.3 - 1.6 * motion.second_share / max(share, 1e-3), 0.0, 1.0)
    plausible = 1.0 - (sideways(motion.axis) if state == MOVING else 0.0)
    return float(agreement * enough * undisputed * plausible)


def _on_all_frames(
    tracks: RunTracks,
    kept: np.ndarray,
    times: np.ndarray,
    poses: np.ndarray,
    mode: np.ndarray,
    confidence: np.ndarray,
    speeds: Speeds,
    intrinsics: Intrinsics,
    road: RoadView,
) -> EgoMotion:
    """Bring what was found at the shown frames to every frame of the run."""
    count = len(tracks.frames)
    out_times = output_times(tracks.times_s)
    # A frame that shows nothing new belongs to the step that leads past it.
    owner = np.minimum(np.searchsorted(kept, np.arange(count)), len(kept) - 1)
    if len(kept) > 1:
        owner[0] = 1
    if len(kept) < count or not np.array_equal(times, out_times):
        poses = interpolated(times, poses, out_times)
    return EgoMotion(
        trajectory=rebased_trajectory(out_times, poses),
        mode=mode[owner], confidence=confidence[owner], scale_source=speeds.source[owner],
        scale_sigma=speeds.sigma[owner].astype(np.float32), intrinsics=intrinsics, road=road,
    )  # fmt: skip
