"""Trajectories from elsewhere (GPS and IMU, a SLAM system, a learned model) in place of estimated ones.

A file covers a video: TUM rows (``timestamp_s tx ty tz qx qy qz qw``) bring their times, KITTI rows (3x4 row-major)
stand for the video's own frames or come at a rate. Camera to world, metres, OpenCV axes. Times are seconds from the
video's first frame, once the file's offset is taken away.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from labeling.camera import Intrinsics, Trajectory, read_kitti, read_tum, rebased_trajectory, resample
from labeling.ego_motion import EgoMotion, RoadView
from labeling.errors import TrajectoryError

TrajectoryFormat = Literal["tum", "kitti"]
MISSING = "missing"
"""Mode of a frame that the file says nothing about."""

_COLUMNS: dict[int, TrajectoryFormat] = {8: "tum", 12: "kitti"}
_LONGEST_GAP_S = 0.25
_STILL_M_S, _TURNING_RAD_S = 0.05, 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class FileClock:
    """What a file's times mean."""

    offset_s: float = 0.0
    """The file's time at the video's first frame."""
    fps: float | None = None
    """Rate of a KITTI file's rows, the first at the file's time 0; None: they are the video's frames, and the offset
    says nothing."""


def trajectory_format(path: Path) -> TrajectoryFormat:
    """The format of a file, by the numbers in its first row.

    Raises:
        TrajectoryError: it cannot be read, or has neither 8 nor 12 numbers a row.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise TrajectoryError(f"{path}: cannot be read as a trajectory ({error}); give a TUM or KITTI file") from error
    rows = [line.split() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    count = len(rows[0]) if rows else 0
    if count not in _COLUMNS:
        raise TrajectoryError(
            f"{path}: has {count} numbers in its first row; give 8 (TUM: timestamp_s tx ty tz qx qy qz qw) or 12 "
            "(KITTI: a 3x4 matrix)"
        )
    return _COLUMNS[count]


def read_drive(path: Path, *, video_times_s: np.ndarray | None, clock: FileClock | None = None) -> Trajectory:
    """A file's trajectory on the clock of a video, re-based to its first row.

    Args:
        path: a TUM or KITTI file.
        video_times_s: (N,) times of the video's own frames, seconds from the first; None where they are not known.
        clock: what the file's times mean.

    Raises:
        TrajectoryError: not rotations, time that runs backwards, rows that are no numbers, a KITTI file of another
            length than the video, or a file that says nothing about any of the video.
    """
    clock = clock or FileClock()
    try:
        if trajectory_format(path) == "tum":
            trajectory = read_tum(path)
            times = trajectory.timestamps_s - clock.offset_s
        else:
            trajectory = read_kitti(path, fps=clock.fps or 1.0)
            times = _row_times(len(trajectory), video_times_s, clock)
        trajectory = Trajectory(timestamps_s=times, cam_to_world=trajectory.cam_to_world)
    except (TrajectoryError, ValueError) as error:
        text = str(error)
        raise TrajectoryError(text if text.startswith(str(path)) else f"{path}: {text}") from error
    _check_overlap(path, times, video_times_s)
    return trajectory


def _row_times(count: int, video_times_s: np.ndarray | None, clock: FileClock) -> np.ndarray:
    if clock.fps is not None:
        return np.arange(count) / clock.fps - clock.offset_s
    if video_times_s is None:
        raise TrajectoryError("a KITTI file carries no times; say its rate in rows a second, or index the video first")
    if count != len(video_times_s):
        raise TrajectoryError(
            f"{count} rows for a video of {len(video_times_s)} frames; give a row for each frame, say the rows' rate, "
            "or give a TUM file with times"
        )
    return np.asarray(video_times_s, dtype=np.float64)


def _check_overlap(path: Path, times_s: np.ndarray, video_times_s: np.ndarray | None) -> None:
    if video_times_s is None or len(video_times_s) == 0:
        return
    if times_s[-1] < 0 or times_s[0] > video_times_s[-1]:
        raise TrajectoryError(
            f"{path}: covers {times_s[0]:g} to {times_s[-1]:g} s of a video of {video_times_s[-1]:g} s, so none of it; "
            "times count from the video's first frame: say the file's time then as its offset"
        )


def motion_at(trajectory: Trajectory, times_s: np.ndarray, *, intrinsics: Intrinsics, road: RoadView) -> EgoMotion:
    """A run's ego-motion from a whole drive's trajectory.

    Frames in a gap of more than a quarter second, or before or after the file, have the mode ``missing`` and confidence
    0; their poses are carried over.

    Args:
        trajectory: of ``read_drive``.
        times_s: (T,) times of the run's frames on the same clock, increasing.
        intrinsics: of the run's pictures, kept with the result.
        road: kept with the result.
    """
    times = np.asarray(times_s, dtype=np.float64)
    seen = covered(trajectory.timestamps_s, times)
    motion = resample(_held_to(trajectory, times[0], times[-1]), times)
    mode = np.where(seen, motion_modes(motion), MISSING).astype("<U8")
    return EgoMotion(
        trajectory=motion, mode=mode, confidence=seen.astype(np.float32),
        scale_source=np.where(seen, "given", "held").astype("<U8"),
        scale_sigma=np.where(seen, 0.0, 1.0).astype(np.float32), intrinsics=intrinsics, road=road,
    )  # fmt: skip


def covered(given_s: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """(T,) bool: times that lie between two rows not too far apart, or within half a usual step of either end."""
    after = np.searchsorted(given_s, times_s).clip(1, max(len(given_s) - 1, 1))
    gap = given_s[np.minimum(after, len(given_s) - 1)] - given_s[after - 1]
    slack = min(_LONGEST_GAP_S, float(np.median(np.diff(given_s)))) / 2 if len(given_s) > 1 else 0.0
    inside = (times_s >= given_s[0] - slack - 1e-6) & (times_s <= given_s[-1] + slack + 1e-6)
    on_a_row = np.abs(times_s[:, None] - given_s[np.stack([after - 1, np.minimum(after, len(given_s) - 1)], 1)]) < 1e-6
    return inside & ((gap <= _LONGEST_GAP_S + 1e-6) | on_a_row.any(axis=1))


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


def _held_to(trajectory: Trajectory, first_s: float, last_s: float) -> Trajectory:
    """The trajectory with its ends held until the given times."""
    times, poses = trajectory.timestamps_s, trajectory.cam_to_world
    if first_s < times[0]:
        times, poses = np.concatenate([[first_s], times]), np.concatenate([poses[:1], poses])
    if last_s > times[-1]:
        times, poses = np.concatenate([times, [last_s]]), np.concatenate([poses, poses[-1:]])
    return rebased_trajectory(times, poses)
