"""From fitted steps to a chain of camera poses: what moves on, smoothing, lengths, and the frames between."""

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from labeling.camera import rigid
from labeling.ego_modes import MOVING, STILL
from labeling.ego_scale import Depths, length_ratio, step_in_heights
from labeling.ego_settings import EgoSettings
from labeling.ego_smoothing import smoothed
from labeling.ego_speed import LengthEvidence
from labeling.ego_steps import FORWARD, Step

_SURE_SIGMAS = 2.0
"""A change of speed of that many of its sigmas is believed by half."""


def moves(steps: list[Step | None], states: np.ndarray, cuts: np.ndarray) -> np.ndarray:
    """(m,) bool: steps with a length; held steps move on if the last one seen did."""
    moving = np.zeros(len(steps), bool)
    last = False
    for index, step in enumerate(steps):
        if cuts[index]:
            last = False
        elif step is not None:
            last = states[index] == MOVING
        moving[index] = last and index > 0 and not cuts[index]
    return moving


def turns_and_directions(
    steps: list[Step | None], states: np.ndarray, signs: np.ndarray, cuts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(m, 3, 3) first to second camera, and (m, 3) unit translations; what is not seen is held."""
    count = len(steps)
    rotations, directions = np.tile(np.eye(3), (count, 1, 1)), np.tile(FORWARD, (count, 1))
    for index in range(1, count):
        step = steps[index]
        if cuts[index]:
            continue
        if step is None:
            rotations[index], directions[index] = rotations[index - 1], directions[index - 1]
            continue
        rotations[index] = (np.eye(3), step.pair.turn, step.pair.rotation)[states[index]]
        moved = states[index] == MOVING
        directions[index] = signs[index] * step.pair.axis if moved else directions[index - 1]
    return rotations, directions


def smoothed_steps(
    steps: list[Step | None],
    states: np.ndarray,
    cuts: np.ndarray,
    rotations: np.ndarray,
    directions: np.ndarray,
    settings: EgoSettings,
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and directions smoothed within each stretch of one mode."""
    seen = np.array([step is not None for step in steps])
    kind = np.where(seen & (states != STILL), states, -1)
    groups = np.cumsum(np.diff(kind, prepend=kind[:1]).astype(bool) | cuts)
    turn_sigma = np.array([step.pair.rotation_sigma if step else 0.0 for step in steps])
    axis_sigma = np.array([step.pair.axis_sigma if step else 0.0 for step in steps])
    vectors = Rotation.from_matrix(rotations).as_rotvec()
    turned = smoothed(vectors, np.repeat(turn_sigma[:, None], 3, axis=1), groups, lag=settings.smoothing_lag)
    drawn = smoothed(directions, np.repeat(axis_sigma[:, None], 3, axis=1), groups, lag=settings.smoothing_lag)
    changed = kind >= 0
    rotations = np.where(changed[:, None, None], Rotation.from_rotvec(turned).as_matrix(), rotations)
    drawn /= np.maximum(np.linalg.norm(drawn, axis=1, keepdims=True), 1e-9)
    return rotations, np.where(changed[:, None], drawn, directions)


def length_evidence(
    steps: list[Step | None],
    depths: list[Depths | None],
    roads: list[Depths | None],
    directions: np.ndarray,
    times: np.ndarray,
    moving: np.ndarray,
    pitch_rad: float,
) -> LengthEvidence:
    """What the road, the scene's depth and the steps' neighbours say of each step's length, one entry a frame."""
    count = len(steps)
    elapsed = np.diff(times, prepend=times[0])
    heights, road_sigma = np.zeros(count), np.full(count, np.inf)
    ratio, ratio_sigma, depth = np.ones(count), np.full(count, np.inf), np.zeros(count)
    for index, (step, here, road) in enumerate(zip(steps, depths, roads, strict=True)):
        if step is None or here is None or road is None or not moving[index]:
            continue
        heights[index], road_sigma[index] = step_in_heights(road, pitch_rad)
        before = depths[index - 1]
        if before is not None and moving[index - 1]:
            lengths, ratio_sigma[index] = length_ratio(before, here, directions[index - 1])
            ratio[index] = lengths * elapsed[index - 1] / max(elapsed[index], 1e-4)
        if len(here.ids):
            depth[index] = max(float(np.median(here.inverse_depth)), 1e-4) / max(elapsed[index], 1e-4)
    reaches = np.array([step.reach if step else 0 for step in steps], int)
    heights /= _measured_s(elapsed, ratio, ratio_sigma, reaches)
    return LengthEvidence(
        elapsed_s=elapsed, heights_per_s=heights, road_sigma=road_sigma, ratio=ratio, ratio_sigma=ratio_sigma,
        depth_per_s=depth,
    )  # fmt: skip


def _measured_s(elapsed_s: np.ndarray, ratio: np.ndarray, ratio_sigma: np.ndarray, reaches: np.ndarray) -> np.ndarray:
    """(m,) what the length that a step measures is divided by to give the step's own speed.

    A window's length is the sum of its steps', and those differ: each counts as long as the middle step would take
    for it. Where pictures have been dropped and the rest shown at an even rate, the window's duration would call each
    middle step as fast as its neighbours, and ratios and road would contradict each other.
    """
    # A change that may be noise is taken for none: at a crawl the longest windows would add up the most of it.
    change = np.log(np.maximum(ratio, 1e-6))
    doubt = np.minimum(_SURE_SIGMAS * ratio_sigma / np.maximum(np.abs(change), 1e-9), 1e6)
    logs = np.cumsum(change / (1.0 + doubt**4))
    spans = [slice(index - reach, index + reach + 1) for index, reach in enumerate(reaches)]
    measured = [np.exp(logs[span] - logs[index]) @ elapsed_s[span] for index, span in enumerate(spans)]
    return np.maximum(np.array(measured), 1e-4)


def chained(rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    """(m, 4, 4) camera to first camera, of steps ``x2 = R x1 + t``."""
    poses = np.tile(np.eye(4), (len(rotations), 1, 1))
    for index in range(1, len(rotations)):
        back = rotations[index].T
        poses[index] = poses[index - 1] @ rigid(back, -back @ translations[index])
    return poses


def interpolated(times: np.ndarray, poses: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Poses at other times: positions linear, rotations slerped, held beyond the ends."""
    if len(times) == 1:
        return np.repeat(poses, len(wanted), axis=0)
    inside = np.clip(wanted, times[0], times[-1])
    rotations = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(inside).as_matrix()
    positions = np.stack([np.interp(inside, times, axis) for axis in poses[:, :3, 3].T], axis=-1)
    return rigid(rotations, positions)


def output_times(times_s: np.ndarray) -> np.ndarray:
    """The given times, or an even grid over their span where some repeat (a trajectory's times must increase)."""
    if len(times_s) < 2 or (np.diff(times_s) > 0).all():
        return times_s.astype(np.float64).copy()
    span = max(times_s[-1] - times_s[0], 1e-3 * (len(times_s) - 1))
    return times_s[0] + np.arange(len(times_s)) * span / (len(times_s) - 1)
