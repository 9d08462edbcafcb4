"""A run's speeds: the road's metres where it is seen, carried along by the ratios of steps where it is not."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

ROAD, HELD, DEFAULT = "road", "held", "default"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LengthEvidence:
    """What the steps say about their lengths. Relative sigmas are infinite where nothing is said."""

    elapsed_s: np.ndarray
    """(m,) duration of each step."""
    heights_per_s: np.ndarray
    """(m,) speed from the road, camera heights a second."""
    road_sigma: np.ndarray
    """(m,)."""
    ratio: np.ndarray
    """(m,) speed over the speed of the step before."""
    ratio_sigma: np.ndarray
    """(m,)."""
    depth_per_s: np.ndarray
    """(m,) speed in median scene depths a second; 0 where none is known."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Speeds:
    """Metric speeds of a run's steps."""

    metres_per_s: np.ndarray
    """(m,)."""
    sigma: np.ndarray
    """(m,) relative."""
    source: np.ndarray
    """(m,) str: road | held | default."""


def run_speeds(
    evidence: LengthEvidence, moving: np.ndarray, *, height_m: float, scale_walk: float, default_depth_heights: float
) -> Speeds:
    """Smooth log speeds over every stretch of moving steps; 0 elsewhere.

    A stretch is solved at once: ``u`` = log speed, observed by the road, tied from step to step by the ratios of
    lengths or, where there are none, by what a car can accelerate; all robust. The depth of the scene anchors what no
    road does.
    """
    count = len(moving)
    seen = np.isfinite(evidence.road_sigma) & moving
    depth_heights, depth_sigma = _usual_depth(evidence, seen, default_depth_heights)
    speeds, sigma = np.zeros(count), np.full(count, 0.05)
    anywhere = HELD if seen.any() else DEFAULT
    source = np.where(seen, ROAD, anywhere).astype("<U8")
    for start, end in _stretches(moving):
        part = slice(start, end)
        logs, spread = _solve_stretch(
            _sliced(evidence, part), seen[part], np.log(depth_heights), depth_sigma, scale_walk
        )
        speeds[part], sigma[part] = np.exp(logs) * height_m, spread
    return Speeds(metres_per_s=speeds, sigma=sigma, source=source)


def _usual_depth(evidence: LengthEvidence, seen: np.ndarray, default: float) -> tuple[float, float]:
    """Median scene depth in camera heights, and its relative sigma: from steps that see the road, else the default."""
    both = seen & (evidence.depth_per_s > 0)
    if both.sum() < 5:
        return default, 0.8
    return float(np.median(evidence.heights_per_s[both] / evidence.depth_per_s[both])), 0.4


def _sliced(evidence: LengthEvidence, part: slice) -> LengthEvidence:
    return LengthEvidence(**{name: getattr(evidence, name)[part] for name in LengthEvidence.__slots__})


def _stretches(moving: np.ndarray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], moving, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _solve_stretch(
    evidence: LengthEvidence, seen: np.ndarray, log_depth: float, depth_sigma: float, scale_walk: float
) -> tuple[np.ndarray, np.ndarray]:
    """(m,) log speeds in heights a second and their sigma."""
    count = len(seen)
    elapsed = np.maximum(evidence.elapsed_s, 1e-4)
    road = np.log(np.where(seen, np.maximum(evidence.heights_per_s, 1e-6), 1.0))
    # Neighbouring votes share the road's bumps: a floor keeps many of them from looking like certainty.
    road_weight = np.where(seen, 1.0 / (np.where(seen, evidence.road_sigma, 1.0) ** 2 + 0.06**2), 0.0)
    deep = evidence.depth_per_s > 0
    depth = np.log(np.where(deep, evidence.depth_per_s, 1.0)) + log_depth
    # The depth's error is shared by the whole stretch, not fresh in each step.
    depth_weight = np.where(deep, 1.0 / (depth_sigma**2 * count), 0.0)
    tied = np.isfinite(evidence.ratio_sigma)
    change = np.where(tied, np.log(np.maximum(evidence.ratio, 1e-6)), 0.0)
    walk = scale_walk * np.sqrt(elapsed)
    tie_weight = np.where(tied, 1.0 / (np.where(tied, evidence.ratio_sigma, 1.0) ** 2 + walk**2), 0.0)
    logs = _start(road, seen, depth, deep)
    gain, robust_road, robust_tie = walk, road_weight, tie_weight
    for _ in range(6):
        # A car gains some 3 m/s, two heights, a second: the slower it is, the more that is of its speed.
        gain = 2.0 * elapsed / np.maximum(np.exp(logs), 0.3) + 0.01
        robust_road = road_weight / (1 + (road - logs) ** 2 * road_weight / 9.0) ** 2
        step = np.diff(logs, prepend=logs[0])
        robust_tie = tie_weight / (1 + (change - step) ** 2 * tie_weight / 9.0) ** 2
        logs = _tridiagonal(
            robust_road + depth_weight,
            robust_road * road + depth_weight * depth,
            robust_tie[1:],
            change[1:],
            np.where(tied[1:], 0.0, 1.0 / gain[1:] ** 2),
        )
    drift = np.where(robust_tie > 0, walk, gain)
    return logs, np.sqrt(_variance(robust_road, drift, depth_sigma**2))


def _start(road: np.ndarray, seen: np.ndarray, depth: np.ndarray, deep: np.ndarray) -> np.ndarray:
    at = np.arange(len(road))
    if seen.any():
        smooth = np.array([np.median(road[seen][max(0, k - 4) : k + 5]) for k in range(int(seen.sum()))])
        return np.interp(at, at[seen], smooth)
    if deep.any():
        return np.full(len(road), np.median(depth[deep]))
    return np.full(len(road), np.log(5.0))


def _tridiagonal(
    weight: np.ndarray, weighted: np.ndarray, tie: np.ndarray, change: np.ndarray, stiff: np.ndarray
) -> np.ndarray:
    """Least squares of observations, ties ``u[i+1] - u[i] = change[i]`` and stiffness ``u[i+1] = u[i]``."""
    count = len(weight)
    if count == 1:
        return weighted / (weight + 1e-9)
    bands = np.zeros((2, count))
    bands[1] = weight + 1e-9
    right = weighted.copy()
    both = tie + stiff
    bands[1, :-1] += both
    bands[1, 1:] += both
    bands[0, 1:] = -both
    right[1:] += tie * change
    right[:-1] -= tie * change
    return solveh_banded(bands, right)


def _variance(weight: np.ndarray, drift: np.ndarray, prior: float) -> np.ndarray:
    """(m,) variance of a random walk observed with these weights, from both sides."""
    count = len(weight)
    sides = []
    for order in (range(count), range(count - 1, -1, -1)):
        variance, out = prior, np.zeros(count)
        for index in order:
            variance = 1.0 / (1.0 / (variance + drift[index] ** 2) + weight[index])
            out[index] = variance
        sides.append(out)
    return np.minimum(prior, 1.0 / np.maximum(1 / sides[0] + 1 / sides[1] - weight - 1 / prior, 1 / prior))
