"""Metric scale from the road: how many camera heights the camera moved, from corners on the ground ahead.

With the turn taken out, a corner's parallax gives its inverse depth in units of the translation. On a plane at height
h under a camera pitched by p that inverse depth is linear in the image row: ``|t| / depth = s (cos p * v + sin p)``
with ``s = |t| / h``, so scale and pitch come from one robust line, and pitch is pooled over the run before it is used
(a fixed pitch is worth metres in 5 s).
"""

from dataclasses import dataclass

import numpy as np

from labeling.ego_models import parallaxes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RoadSamples:
    """One pair's corners that may lie on the road."""

    row: np.ndarray
    """(n,) normalised image row v, turn taken out."""
    inverse_depth: np.ndarray
    """(n,) in units of 1 / |t|."""
    sigma: np.ndarray
    """(n,) its noise."""


NO_ROAD = RoadSamples(row=np.zeros(0), inverse_depth=np.zeros(0), sigma=np.zeros(0))


def road_samples(
    first: np.ndarray, second: np.ndarray, rotation: np.ndarray, direction: np.ndarray, *, noise: float
) -> RoadSamples:
    """Inverse depths of the corners in the lower middle of the picture (normalised coordinates, noise in the same
    unit)."""
    low = (second[:, 1] > 0.06) & (np.abs(second[:, 0]) < 0.15 + 1.3 * second[:, 1])
    first, second = first[low], second[low]
    if not len(first):
        return NO_ROAD
    along, gain = parallaxes(first, second, rotation, direction).T
    inverse_depth, sigma = along / gain, noise / gain
    good = inverse_depth > -2 * sigma
    return RoadSamples(row=second[good, 1], inverse_depth=inverse_depth[good], sigma=sigma[good])


def step_in_heights(samples: RoadSamples, pitch_rad: float) -> tuple[float, float]:
    """How far the camera moved, in camera heights, and its relative sigma (infinite where no road is seen).

    Each corner votes with its own ``s``; the road is the mode of the votes, for what stands on the road is nearer than
    the road behind it and spreads its votes.
    """
    height = samples.row * np.cos(pitch_rad) + np.sin(pitch_rad)
    good = height > 0.04
    if good.sum() < 6:
        return 0.0, np.inf
    votes = samples.inverse_depth[good] / height[good]
    sigma = samples.sigma[good] / height[good]
    usable = (votes > 2 * sigma) & (votes > 0)
    if usable.sum() < 6:
        return 0.0, np.inf
    logs, widths = np.log(votes[usable]), np.hypot(sigma[usable] / votes[usable], 0.03)
    centre = _mode(logs, widths)
    near = np.abs(logs - centre) < 3 * widths
    for _ in range(5):
        weights = near / widths**2 / (1 + ((logs - centre) / (2 * widths)) ** 2) ** 2
        centre = float((weights * logs).sum() / max(weights.sum(), 1e-12))
        near = np.abs(logs - centre) < 3 * widths
    if near.sum() < 5 or near.mean() < 0.25:
        return 0.0, np.inf
    spread = float(np.median(np.abs(logs[near] - centre))) * 1.5 + 0.01
    return float(np.exp(centre)), spread * 2.0 / np.sqrt(near.sum())


def pooled_pitch(pairs: list[RoadSamples], *, limit_rad: float = 0.2) -> tuple[float, float]:
    """Pitch of the camera against the road, radians (positive looks down), and its sigma; (0, inf) where no road is
    seen.

    Each pair's road is a line through inverse depth over row; the pairs' zero crossings are pooled by their median.
    """
    found = []
    for pair in pairs:
        if len(pair.row) < 12:
            continue
        slope, offset = _robust_line(pair)
        if slope > 0 and abs(offset / slope) < np.tan(limit_rad):
            found.append(np.arctan(offset / slope))
    if len(found) < 5:
        return 0.0, np.inf
    spread = 1.4826 * float(np.median(np.abs(found - np.median(found))))
    return float(np.median(found)), 1.25 * spread / np.sqrt(len(found)) + 1e-4


def _robust_line(pair: RoadSamples) -> tuple[float, float]:
    """Slope and offset of inverse depth over row by Geman-McClure IRLS from the line through the horizon."""
    slope, offset = float(np.median(pair.inverse_depth / pair.row)), 0.0
    design = np.stack([pair.row, np.ones_like(pair.row)], axis=1)
    for scale in (8.0, 5.0, 3.0, 3.0, 3.0, 3.0):
        sigma = np.hypot(pair.sigma, 0.03 * np.abs(slope * pair.row))
        residual = (pair.inverse_depth - slope * pair.row - offset) / sigma
        weight = 1.0 / sigma**2 / (1 + (residual / scale) ** 2) ** 2
        normal = design.T @ (design * weight[:, None]) + np.diag([1e-9, 1e-9])
        slope, offset = np.linalg.solve(normal, design.T @ (weight * pair.inverse_depth))
    return float(slope), float(offset)


def _mode(values: np.ndarray, widths: np.ndarray) -> float:
    """The most voted-for value, votes widened by their noise."""
    width = np.maximum(widths, 0.05)
    votes = (np.exp(-0.5 * ((values[:, None] - values[None]) / width[None]) ** 2) / width[None]).sum(axis=1)
    return float(values[votes.argmax()])
