"""How far an estimated trajectory is from the truth, in the terms of the ego-motion chart and stability table."""

import numpy as np

from labeling.camera import invert, rotation_angle_deg

LEAST_TURN_DEG = 0.01
"""Rotation errors below this are taken as this when they are divided by: renders are cleaner than any camera."""


def rotation_errors_deg(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(T - 1,) degrees between the steps' rotations of two (T, 4, 4) trajectories."""
    ours, true = _steps(found), _steps(truth)
    return rotation_angle_deg(ours[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1))


def direction_errors_deg(
    found: np.ndarray, truth: np.ndarray, *, least_m: float = 0.01, ground_plane: bool = False
) -> np.ndarray:
    """(n,) degrees between the steps' directions where the true step is at least ``least_m`` long.

    ``ground_plane`` leaves the camera's y axis out: GPS truth knows little of height.
    """
    ours, true = _steps(found)[:, :3, 3].copy(), _steps(truth)[:, :3, 3].copy()
    if ground_plane:
        ours[:, 1] = true[:, 1] = 0.0
    lengths = np.linalg.norm(ours, axis=1), np.linalg.norm(true, axis=1)
    far = lengths[1] >= least_m
    cosine = (ours * true).sum(axis=1) / np.maximum(lengths[0] * lengths[1], 1e-12)
    # A step of no length has no direction: as wrong as sideways.
    return np.degrees(np.arccos(np.clip(cosine[far], -1.0, 1.0)))


def window_errors_m(found: np.ndarray, truth: np.ndarray, *, frames: int, fit_scale: bool) -> np.ndarray:
    """Mean displacement error of each window of ``frames``, aligned at its first pose; one fitted scale, or none."""
    errors = []
    for start in range(0, len(truth) - frames + 1, max(1, frames // 10)):
        ours = (invert(found[start]) @ found[start : start + frames])[:, :3, 3]
        true = (invert(truth[start]) @ truth[start : start + frames])[:, :3, 3]
        scale = float((ours * true).sum() / max((ours * ours).sum(), 1e-12)) if fit_scale else 1.0
        errors.append(np.linalg.norm(scale * ours - true, axis=1).mean())
    return np.array(errors)


def yaw_deg(poses: np.ndarray) -> np.ndarray:
    """(T,) degrees turned to the right since the first frame."""
    relative = invert(poses[0]) @ poses
    return np.degrees(np.unwrap(np.arctan2(relative[:, 0, 2], relative[:, 2, 2])))


def path_m(poses: np.ndarray) -> float:
    """Length of the way."""
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


def farthest_m(poses: np.ndarray) -> float:
    """Farthest from the start, metres."""
    return float(np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max())


def longest_step_m(poses: np.ndarray) -> float:
    """Longest step between two frames, metres."""
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max())


def most_yaw_deg(poses: np.ndarray) -> float:
    """Farthest turned from the first frame, degrees."""
    return float(np.abs(yaw_deg(poses)).max())


def end_yaw_error_deg(found: np.ndarray, truth: np.ndarray) -> float:
    """Degrees between the yaws at the end."""
    return float(abs(yaw_deg(found)[-1] - yaw_deg(truth)[-1]))


def worst_turn_deg(found: np.ndarray, truth: np.ndarray) -> float:
    """Rotation error of the worst step, degrees."""
    return float(rotation_errors_deg(found, truth).max())


def typical_turn_deg(found: np.ndarray, truth: np.ndarray) -> float:
    """Median rotation error of a step, degrees; never below ``LEAST_TURN_DEG``, so that it can be divided by."""
    return max(float(np.median(rotation_errors_deg(found, truth))), LEAST_TURN_DEG)


def _steps(poses: np.ndarray) -> np.ndarray:
    return invert(poses[:-1]) @ poses[1:]
