"""Metric scale from the road: how many camera heights the camera moved, from corners on the ground ahead.

With the turn taken out, a corner's parallax gives its inverse depth in units of the translation. On a plane at height
h under a camera pitched by p that inverse depth is linear in the image row: ``|t| / depth = s (cos p * v + sin p)``
with ``s = |t| / h``, so scale and pitch come from one robust line, and pitch is pooled over the run before it is used
(a fixed pitch is worth metres in 5 s).
"""

from dataclasses import dataclass

import numpy as np

from labeling.ego_ladder import Corners, PairMotion
from labeling.ego_models import parallaxes, turning_residuals

_LEAST_CORNERS = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Depths:
    """Inverse depths of the corners that a moving camera explains."""

    ids: np.ndarray
    """(n,) int64."""
    turned: np.ndarray
    """(n, 2) float64: normalised coordinates in the first frame, turned into the second's axes."""
    inverse_depth: np.ndarray
    """(n,) in the turned first frame, in units of 1 / |t|."""
    sigma: np.ndarray
    """(n,) its noise."""


def corner_depths(corners: Corners, motion: PairMotion, *, sign: float) -> Depths:
    """Inverse depths of the inliers; ``sign`` says which way along ``motion.axis`` the camera went."""
    at = np.flatnonzero(motion.inlier)
    first, second = corners.first[at], corners.second[at]
    along, gain = parallaxes(first, second, motion.rotation, sign * motion.axis).T
    return Depths(
        ids=corners.ids[at], turned=second - turning_residuals(first, second, motion.rotation),
        inverse_depth=along / gain, sigma=motion.noise / gain,
    )  # fmt: skip


def road_part(depths: Depths) -> Depths:
    """The corners that may lie on the road: the lower middle of the picture, in front of the camera."""
    column, row = depths.turned.T
    low = (row > 0.06) & (np.abs(column) < 0.15 + 1.3 * row) & (depths.inverse_depth > -2.0 * depths.sigma)
    return Depths(
        ids=depths.ids[low], turned=depths.turned[low], inverse_depth=depths.inverse_depth[low], sigma=depths.sigma[low]
    )


def step_in_heights(road: Depths, pitch_rad: float) -> tuple[float, float]:
    """How far the camera moved, in camera heights, and its relative sigma; (0, inf) where no road is seen.

    Each corner votes with its own ``s``; the road is the mode of the votes, for what stands on the road is nearer than
    the road behind it and spreads its votes.
    """
    height = road.turned[:, 1] * np.cos(pitch_rad) + np.sin(pitch_rad)
    votes = road.inverse_depth / np.maximum(height, 1e-6)
    sigma = road.sigma / np.maximum(height, 1e-6)
    usable = (height > 0.04) & (votes > 2 * sigma)
    if usable.sum() < _LEAST_CORNERS:
        return 0.0, np.inf
    logs, widths = np.log(votes[usable]), np.hypot(sigma[usable] / votes[usable], 0.03)
    centre = _mode(logs, widths)
    for _ in range(5):
        near = np.abs(logs - centre) < 3 * widths
        weights = near / widths**2 / (1 + ((logs - centre) / (2 * widths)) ** 2) ** 2
        centre = float((weights * logs).sum() / max(weights.sum(), 1e-12))
    near = np.abs(logs - centre) < 3 * widths
    if near.sum() < _LEAST_CORNERS or near.mean() < 0.25:
        return 0.0, np.inf
    spread = 1.4826 * float(np.median(np.abs(logs[near] - centre))) + 0.01
    return float(np.exp(centre)), 2.0 * spread / float(np.sqrt(near.sum()))


def pooled_pitch(roads: list[Depths], *, limit_rad: float = 0.2) -> tuple[float, float]:
    """Pitch against the road, radians (positive looks down), and its sigma; (0, inf) where no road is seen.

    Each pair's road is a line of inverse depth over row; the rows where it reaches zero are pooled by their median.
    """
    found = []
    for road in roads:
        if len(road.ids) < 12:
            continue
        slope, offset = _robust_line(road)
        if slope > 0 and abs(offset / slope) < np.tan(limit_rad):
            found.append(np.arctan(offset / slope))
    if len(found) < 5:
        return 0.0, np.inf
    spread = 1.4826 * float(np.median(np.abs(found - np.median(found))))
    return float(np.median(found)), 1.25 * spread / np.sqrt(len(found)) + 1e-3


def _robust_line(road: Depths) -> tuple[float, float]:
    """Slope and offset of inverse depth over row by Geman-McClure IRLS from the line through the horizon."""
    row = road.turned[:, 1]
    slope, offset = float(np.median(road.inverse_depth / row)), 0.0
    design = np.stack([row, np.ones_like(row)], axis=1)
    for scale in (8.0, 5.0, 3.0, 3.0, 3.0, 3.0):
        sigma = np.hypot(road.sigma, 0.03 * np.abs(slope * row))
        residual = (road.inverse_depth - slope * row - offset) / sigma
        weight = 1.0 / sigma**2 / (1 + (residual / scale) ** 2) ** 2
        normal = design.T @ (design * weight[:, None]) + np.diag([1e-9, 1e-9])
        slope, offset = np.linalg.solve(normal, design.T @ (weight * road.inverse_depth))
    return float(slope), float(offset)


def _mode(values: np.ndarray, widths: np.ndarray) -> float:
    """The most voted-for value, votes widened by their noise."""
    width = np.maximum(widths, 0.05)
    votes = (np.exp(-0.5 * ((values[:, None] - values[None]) / width[None]) ** 2) / width[None]).sum(axis=1)
    return float(values[votes.argmax()])


def length_ratio(before: Depths, after: Depths, direction: np.ndarray) -> tuple[float, float]:
    """Length of a step over the length of the one before it, from corners that both see, and its relative sigma.

    Args:
        before: depths of the earlier step.
        after: of the later one; its first frame is the earlier one's second.
        direction: (3,) unit translation of the earlier step.
    """
    at = np.searchsorted(after.ids, before.ids)
    at = np.minimum(at, max(len(after.ids) - 1, 0))
    same = after.ids[at] == before.ids if len(after.ids) else np.zeros(len(before.ids), bool)
    one, two = np.flatnonzero(same), at[same]
    nearer = before.inverse_depth[one] / (1 + direction[2] * before.inverse_depth[one])
    clear = (nearer > 3 * before.sigma[one]) & (after.inverse_depth[two] > 3 * after.sigma[two])
    one, two, nearer = one[clear], two[clear], nearer[clear]
    if len(one) < 10:
        return 1.0, np.inf
    logs = np.log(after.inverse_depth[two] / nearer)
    widths = np.hypot(before.sigma[one] / nearer, after.sigma[two] / after.inverse_depth[two]) + 0.01
    centre, weights = float(np.median(logs)), np.zeros(0)
    for _ in range(4):
        weights = 1 / widths**2 / (1 + ((logs - centre) / (3 * widths)) ** 2) ** 2
        centre = float((weights * logs).sum() / weights.sum())
    return float(np.exp(centre)), float(2.0 / np.sqrt(weights.sum())) + 2e-3
