"""Trajectories from elsewhere (GPS and IMU, a SLAM system, a learned model) in place of estimated ones."""

from pathlib import Path
from typing import Literal

import numpy as np

from labeling.camera import Intrinsics, Trajectory, prior_intrinsics, read_kitti, read_tum, resample
from labeling.ego_motion import EgoMotion, RoadView
from labeling.errors import TrajectoryError

TrajectoryFormat = Literal["tum", "kitti"]
_LONGEST_GAP_S = 0.25
_STILL_M_S, _TURNING_RAD_S = 0.05, 0.01


def import_trajectory(
    path: Path,
    format: TrajectoryFormat,
    times_s: np.ndarray,
    *,
    fps: float = 24.0,
    intrinsics: Intrinsics | None = None,
    camera_height_m: float = 1.5,
) -> EgoMotion:
    """A run's ego-motion from a file: camera to world, metres, OpenCV axes.

    A TUM file brings its own times, of the same clock as ``times_s``, and is resampled to them. A KITTI file has a row
    for each frame of the run.

    Args:
        path: the file.
        format: tum (``timestamp_s tx ty tz qx qy qz qw``) or kitti (3x4 row-major).
        times_s: (T,) times of the run's frames, increasing.
        fps: of a KITTI file's rows, for messages about its length in seconds.
        intrinsics: of the run's pictures, kept with the result.
        camera_height_m: kept with the result.

    Raises:
        TrajectoryError: not rotations, time that runs backwards, gaps of more than a quarter second, or another span
            or length than the run's.
    """
    times = np.asarray(times_s, dtype=np.float64)
    if format == "tum":
        trajectory = _resampled(read_tum(path), times, path)
    elif format == "kitti":
        trajectory = _per_frame(read_kitti(path, fps=fps), times, path, fps)
    else:
        raise TrajectoryError(f"trajectory format {format!r} is not known; give tum or kitti")
    count = len(times)
    return EgoMotion(
        trajectory=trajectory, mode=motion_modes(trajectory), confidence=np.ones(count, np.float32),
        scale_source=np.full(count, "given", "<U8"), scale_sigma=np.zeros(count, np.float32),
        intrinsics=intrinsics or prior_intrinsics(1056, 704),
        road=RoadView(height_m=camera_height_m, pitch_rad=0.0, pitch_sigma_rad=float("inf")),
    )  # fmt: skip


def motion_modes(trajectory: Trajectory) -> np.ndarray:
    """(T,) str still | turning | moving, from speed and turn rate."""
    if len(trajectory) < 2:
        return np.full(len(trajectory), "still", "<U8")
    elapsed = np.diff(trajectory.timestamps_s)
    speed = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1) / elapsed
    before, after = trajectory.cam_to_world[:-1, :3, :3], trajectory.cam_to_world[1:, :3, :3]
    cosine = (np.einsum("tij,tij->t", before, after) - 1) / 2
    rate = np.arccos(np.clip(cosine, -1, 1)) / elapsed
    mode = np.where(speed > _STILL_M_S, "moving", np.where(rate > _TURNING_RAD_S, "turning", "still")).astype("<U8")
    return np.concatenate([mode[:1], mode])


def _resampled(trajectory: Trajectory, times: np.ndarray, path: Path) -> Trajectory:
    given = trajectory.timestamps_s
    inside = (given[:-1] < times[-1]) & (given[1:] > times[0])
    gaps = np.where(inside, np.diff(given), 0.0)
    if len(gaps) and gaps.max() > _LONGEST_GAP_S:
        at = int(gaps.argmax())
        raise TrajectoryError(
            f"{path}: {gaps[at]:.2f} s without a row after {given[at]:g} s; fill gaps of over {_LONGEST_GAP_S} s, or "
            "leave that part of the video out"
        )
    # A file may begin or end between two of its own rows' times and the frames': half a gap is forgiven.
    slack = min(_LONGEST_GAP_S, float(np.median(np.diff(given))) if len(given) > 1 else 0.0)
    if times[0] < given[0] - slack or times[-1] > given[-1] + slack:
        raise TrajectoryError(
            f"{path}: covers {given[0]:g} to {given[-1]:g} s, the run needs {times[0]:g} to {times[-1]:g} s; give the "
            "whole drive on the video's clock"
        )
    return resample(_held_to(trajectory, times[0], times[-1]), times)


def _held_to(trajectory: Trajectory, first_s: float, last_s: float) -> Trajectory:
    """The trajectory with its ends held until the given times."""
    times, poses = trajectory.timestamps_s, trajectory.cam_to_world
    if first_s < times[0]:
        times, poses = np.concatenate([[first_s], times]), np.concatenate([poses[:1], poses])
    if last_s > times[-1]:
        times, poses = np.concatenate([times, [last_s]]), np.concatenate([poses, poses[-1:]])
    return Trajectory(timestamps_s=times, cam_to_world=poses)


def _per_frame(trajectory: Trajectory, times: np.ndarray, path: Path, fps: float) -> Trajectory:
    if len(trajectory) != len(times):
        raise TrajectoryError(
            f"{path}: {len(trajectory)} rows ({len(trajectory) / fps:.2f} s) for {len(times)} frames; give one row for "
            "each frame of the run, or a TUM file with times"
        )
    return Trajectory(timestamps_s=times, cam_to_world=trajectory.cam_to_world)
