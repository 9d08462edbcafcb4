"""The ladder of models for a pair of frames, and the penalised robust cost that says which rung is enough.

*Still* has no parameter, *turning* three, *moving* five. Each is fitted from the last motion; GRIC (Torr, "Bayesian
model estimation and selection for epipolar geometry", IJCV 2002) weighs residuals against parameters, with the noise
read off the richest model's residuals. Two things that GRIC alone gets wrong on a street are settled here: traffic
before a standing camera fits an epipolar geometry whose resting background lies at infinity (nothing lies below the
road, so it does not), and one plane has two epipolar geometries (the one nearer to the last motion is taken).
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from labeling.ego_models import (
    fit_moving,
    fit_turning,
    parallaxes,
    sampson_residuals,
    turning_residuals,
)

GRIC_OUTLIER = 2.0
"""Torr's lambda 3: a residual costs at most this times the residual's dimension."""
_RUNGS = ((2, 0), (2, 3), (3, 5))
"""Dimension of the manifold and parameters of still, turning, moving."""
_INLIER = 3.0
_SIDEWAYS_RAD = 0.5
_STEPS = 9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Corners:
    """The corners that two frames share."""

    ids: np.ndarray
    """(n,) int64."""
    first: np.ndarray
    """(n, 2) float64, normalised."""
    second: np.ndarray
    """(n, 2) float64."""
    weight: np.ndarray
    """(n,) float64, mean about one: less where corners crowd."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairMotion:
    """What two frames say about the camera's motion, for every rung of the ladder."""

    costs: np.ndarray
    """(3,) GRIC of still, turning, moving; per corner."""
    turn: np.ndarray
    """(3, 3) rotation if it only turned."""
    rotation: np.ndarray
    """(3, 3) rotation if it moved."""
    axis: np.ndarray
    """(3,) unit translation of ``x2 = R x1 + t`` if it moved; backwards is told apart by ``evidence``."""
    evidence: float
    """Log likelihood ratio of ``axis`` against ``-axis`` (cheirality)."""
    axis_sigma: float
    """Radians: how well the direction is known along its worse tangent."""
    rotation_sigma: float
    """Radians about the worst axis."""
    noise: float
    """Standard deviation of a corner, normalised units."""
    inlier: np.ndarray
    """(n,) bool: corners that the moving model explains."""
    inlier_shares: np.ndarray
    """(3,) of still, turning, moving."""
    parallax: float
    """Median motion along the epipolar lines over the inliers, normalised units."""
    second_share: float
    """Share of all corners that agree on another motion."""


def explain_pair(
    corners: Corners,
    *,
    rotation: np.ndarray,
    axis: np.ndarray,
    axis_sigma: float,
    noise_floor: float,
    least_inlier_share: float,
) -> PairMotion:
    """Fit every rung to the corners of a pair.

    Args:
        corners: at least five of them, better twenty.
        rotation: (3, 3) to start from: the last motion's.
        axis: (3,) direction of translation to start from.
        axis_sigma: radians by which the direction may differ from ``axis``; 0 leaves it free.
        noise_floor: least standard deviation of a corner, normalised units.
        least_inlier_share: below it, five-point RANSAC and the homography's decomposition propose other starts.
    """
    first, second = corners.first, corners.second
    turn = _turn(corners, rotation, noise_floor)
    prior = (axis, axis_sigma)
    fit = _moving(corners, [(rotation, axis), (turn, axis)], noise_floor, prior)
    if max(_share(corners, fit, noise_floor), _turning_share(corners, turn, noise_floor)) < least_inlier_share:
        starts = [*five_point(first, second, noise_floor), *plane_motions(first, second, noise_floor)]
        fit = _moving(corners, starts, noise_floor, prior, rival=fit)
    rotation, axis, information = _without_traffic(corners, fit, noise_floor, prior)
    distance = np.abs(sampson_residuals(first, second, rotation, axis))
    noise = float(np.clip(1.4826 * np.median(distance), noise_floor, 4.0 * noise_floor))
    moving = (distance / noise) ** 2
    # Noise sits on both ends: as for Sampson's distance, half the transfer error belongs to each.
    still = ((second - first) ** 2).sum(axis=1) / (2.0 * noise**2)
    turning = (turning_residuals(first, second, turn) ** 2).sum(axis=1) / (2.0 * noise**2)
    along, gain = parallaxes(first, second, rotation, axis).T
    evidence = sign_evidence(along[moving < _INLIER**2], noise)
    moving_cost = np.where(
        _below_road(first, second, rotation, along * np.sign(evidence or 1.0) / gain, noise / gain), 1e9, moving
    )
    squares = (still, turning, moving_cost)
    inlier = moving_cost < _INLIER**2
    rotation_sigma, direction_sigma = _sigmas(information, noise / noise_floor)
    rungs = zip(squares, _RUNGS, strict=True)
    costs = np.array([gric(square, dimension=d, parameters=p) for square, (d, p) in rungs])
    # A car that moves sideways: as if most corners were outliers.
    costs[2] += 0.75 * GRIC_OUTLIER * sideways(axis)
    return PairMotion(
        costs=costs, turn=turn, rotation=rotation, axis=axis, evidence=evidence,
        rotation_sigma=rotation_sigma, axis_sigma=direction_sigma, noise=noise, inlier=inlier,
        inlier_shares=np.array([(square < _INLIER**2).mean() for square in squares]),
        parallax=float(np.median(np.abs(along[inlier]))) if inlier.any() else 0.0,
        second_share=_second_share(corners, inlier, noise),
    )  # fmt: skip


def gric(square: np.ndarray, *, dimension: int, parameters: int) -> float:
    """Torr's GRIC per corner, of squared residuals in units of the noise.

    Args:
        square: (n,) squared residual over noise squared.
        dimension: of the manifold the corner pairs lie on (2 for a point map, 3 for epipolar geometry).
        parameters: of the model.
    """
    count = max(len(square), 1)
    robust = np.minimum(square, GRIC_OUTLIER * (4 - dimension)).sum()
    return float(robust + dimension * math.log(4) * count + parameters * math.log(4 * count)) / count


def sign_evidence(parallax: np.ndarray, noise: float) -> float:
    """Log likelihood ratio that the direction points the right way rather than backwards, each corner's say bounded.

    A corner behind the camera must be noise about zero inverse depth. ``cv2.recoverPose`` instead counts corners nearer
    than fifty baselines, and so knows nothing at walking speed.
    """
    square = np.minimum((parallax / noise) ** 2, 2.0 * GRIC_OUTLIER**2) / 2.0
    return float(square[parallax > 0].sum() - square[parallax < 0].sum())


def _turn(corners: Corners, rotation: np.ndarray, noise: float) -> np.ndarray:
    """The rotation that most corners agree on, from the last one or, should that explain much less, from afar."""
    first, second, weight = corners.first, corners.second, corners.weight
    distance = np.linalg.norm(turning_residuals(first, second, rotation), axis=1)
    widest = max(15.0 * noise, 2.0 * float(np.median(distance)))
    found, most = rotation, -0.05
    for start in (15.0 * noise, widest):
        turn = fit_turning(first, second, weight, rotation, _narrowing(start, noise))
        share = _turning_share(corners, turn, noise)
        if share > most + 0.05:
            found, most = turn, share
    return found


def _turning_share(corners: Corners, rotation: np.ndarray, noise: float) -> float:
    distance = np.linalg.norm(turning_residuals(corners.first, corners.second, rotation), axis=1)
    return float((corners.weight * (distance < 2.0 * _INLIER * noise)).mean())


def _moving(
    corners: Corners,
    starts: list[tuple[np.ndarray, np.ndarray]],
    noise: float,
    prior: tuple,
    rival: tuple | None = None,
) -> tuple:
    """The fit that explains most corners; a later start must explain clearly more than an earlier one.

    The first start is the last motion, so that traffic takes over only where it outnumbers the scene.
    """
    first, second, weight = corners.first, corners.second, corners.weight
    scales = _narrowing(15.0 * noise, noise)
    best = rival
    most = -9.0 if best is None else _merit(corners, best, noise, prior)
    for rotation, direction in starts:
        fit = fit_moving(first, second, weight, rotation, direction, scales, noise, *prior)
        merit = _merit(corners, fit, noise, prior)
        if best is None or merit > most + 0.05:
            best, most = fit, merit
    assert best is not None
    return best


def _without_traffic(corners: Corners, fit: tuple, noise: float, prior: tuple) -> tuple:
    """The fit again without corners that, had they stood still, would lie behind the camera or below the road."""
    rotation, direction = fit[0], fit[1]
    first, second = corners.first, corners.second
    near = np.abs(sampson_residuals(first, second, rotation, direction)) < _INLIER * noise
    along, gain = parallaxes(first, second, rotation, direction).T
    along = along * (1.0 if sign_evidence(along[near], noise) >= 0 else -1.0)
    wrong = (along < -_INLIER * noise) | _below_road(first, second, rotation, along / gain, noise / gain)
    if not (wrong & near).any() or wrong.mean() > 0.5:
        return fit
    weight = np.where(wrong, 0.0, corners.weight)
    return fit_moving(first, second, weight, rotation, direction, np.full(4, 3.0 * noise), noise, *prior)


def _merit(corners: Corners, fit: tuple, noise: float, prior: tuple) -> float:
    """Share of the corners that a fit explains, less up to a third where its direction is not one that cars take."""
    axis, sigma = prior
    jump = _angle(axis, fit[1]) / (3.0 * sigma + 0.2)
    return _share(corners, fit, noise) - 0.33 * max(min(1.0, jump**2), sideways(fit[1]))


def sideways(axis: np.ndarray) -> float:
    """0 to 1: how unlike a car with a camera on its windscreen a direction of travel is, forward or backward alike."""
    return min(1.0, (_angle(np.array([0.0, 0.0, 1.0]), axis) / _SIDEWAYS_RAD) ** 2)


def _angle(one: np.ndarray, other: np.ndarray) -> float:
    """Radians between two lines."""
    return math.acos(min(1.0, abs(float(one @ other))))


def _narrowing(widest: float, noise: float) -> np.ndarray:
    """Robust scales from the widest down to three sigma."""
    ratio = (3.0 * noise / widest) ** (1.0 / (_STEPS - 3))
    return np.maximum(3.0 * noise, widest * ratio ** np.arange(_STEPS))


def _share(corners: Corners, fit: tuple, noise: float) -> float:
    """Weighted share of the corners that obey the epipolar constraint and do not lie below the road."""
    first, second = corners.first, corners.second
    rotation, direction = fit[0], fit[1]
    near = np.abs(sampson_residuals(first, second, rotation, direction)) < _INLIER * noise
    along, gain = parallaxes(first, second, rotation, direction).T
    sign = 1.0 if sign_evidence(along[near], noise) >= 0 else -1.0
    near &= ~_below_road(first, second, rotation, sign * along / gain, noise / gain)
    return float((corners.weight * near).mean())


def five_point(first: np.ndarray, second: np.ndarray, noise: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """The rotation and direction (sign open) of five-point RANSAC: one proposal or none."""
    if len(first) < 8:
        return []
    essential, _ = cv2.findEssentialMat(
        first, second, np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=2.0 * noise, maxIters=300
    )
    if essential is None or essential.shape != (3, 3) or not np.isfinite(essential).all():
        return []
    one, two, direction = cv2.decomposeEssentialMat(essential)
    return [(one if np.trace(one) > np.trace(two) else two, direction[:, 0])]


def plane_motions(first: np.ndarray, second: np.ndarray, noise: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotations and directions of the homography that explains most corners: up to four proposals."""
    if len(first) < 8:
        return []
    homography, mask = cv2.findHomography(first, second, cv2.RANSAC, 3.0 * noise, maxIters=300)
    if homography is None or mask is None or mask.mean() < 0.3 or not np.isfinite(homography).all():
        return []
    _, rotations, translations, _ = cv2.decomposeHomographyMat(homography, np.eye(3))
    pairs = [(rotation, shift[:, 0]) for rotation, shift in zip(rotations, translations, strict=True)]
    return [(rotation, t / np.linalg.norm(t)) for rotation, t in pairs if np.linalg.norm(t) > 1e-6]


def _below_road(
    first: np.ndarray, second: np.ndarray, rotation: np.ndarray, inverse_depth: np.ndarray, sigma: np.ndarray
) -> np.ndarray:
    """(n,) bool: corners low in the picture that would lie far below the road that the other low corners move on."""
    row = (second - turning_residuals(first, second, rotation))[:, 1]
    low = row > 0.08
    votes = inverse_depth[low] / row[low]
    clear = inverse_depth[low] > 3.0 * sigma[low]
    if clear.sum() < 5:
        return np.zeros(len(row), bool)
    heights = float(np.median(votes[clear]))
    return low & (inverse_depth < 0.4 * heights * row - 2.0 * sigma)


def _sigmas(information: np.ndarray, noise_ratio: float) -> tuple[float, float]:
    """Standard deviations, radians, of rotation and direction about their worst axes."""
    covariance = np.linalg.inv(information + 1e-3 * np.eye(5))
    worst = [max(float(np.linalg.eigvalsh(part)[-1]), 0.0) for part in (covariance[:3, :3], covariance[3:, 3:])]
    return noise_ratio * math.sqrt(worst[0]), noise_ratio * math.sqrt(worst[1])


def _second_share(corners: Corners, inlier: np.ndarray, noise: float) -> float:
    """Share of all corners, among those left unexplained, that move as one rigid thing or rest together."""
    rest = ~inlier
    if rest.sum() < max(15, 0.1 * len(rest)):
        return 0.0
    first, second = corners.first[rest], corners.second[rest]
    flow = second - first
    # A body far enough away moves as a shift; the mode of the flows is robust where their median is not.
    distance = np.abs(flow[:, None] - flow[None]).max(axis=-1)
    return float((distance < 6.0 * noise).sum(axis=1).max() / len(rest))
