"""How far two trajectories, two sets of boxes or keypoints, or two pictures are apart.

Trajectories are compared in the ground plane (x, z), metres. ``none`` compares them as they are, both starting at the
identity; ``se3`` and ``sim3`` first fit one onto the other (Umeyama 1991), which forgives a wrong heading or scale, so
every figure names its alignment. Lengths that differ are an error: nothing is resampled behind the caller's back.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np

from labeling.camera import invert, rigid, rotation_angle_deg
from labeling.errors import DataError
from training.criteria import PCK_SHARE

Alignment = Literal["none", "se3", "sim3"]
_GROUND = [0, 2]


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """A mean and the range that holds it with 95 % confidence."""

    mean: float
    low: float
    high: float
    groups: int
    """Independent sources that it rests on; with one the range is all of it."""


def ade_m(predicted: np.ndarray, truth: np.ndarray, *, alignment: Alignment) -> float:
    """Average displacement error in the ground plane, metres.

    Args:
        predicted: (T, 4, 4) cam_to_world.
        truth: (T, 4, 4).
        alignment: how ``predicted`` is first laid onto ``truth``.

    Raises:
        DataError: the lengths differ, or numbers are not finite.
    """
    aligned = align(predicted, truth, alignment=alignment)
    return float(np.linalg.norm((aligned - truth)[:, _GROUND, 3], axis=1).mean())


def min_ade_m(samples: Sequence[np.ndarray], truth: np.ndarray) -> float:
    """minADE: the least ``ade_m`` of several samples from the truth, unaligned. minADE6 has six of them.

    Raises:
        DataError: no sample, or as ``ade_m``.
    """
    if not len(samples):
        raise DataError("minADE needs at least one sample, got none; generate some, or count the clip as failed")
    return min(ade_m(sample, truth, alignment="none") for sample in samples)


def apd_m(samples: Sequence[np.ndarray]) -> float:
    """Average pairwise distance: mean over pairs of the L2 norm of the flattened ground-plane difference, metres.

    It grows with the root of the number of points, so that number belongs beside it.

    Raises:
        DataError: fewer than two samples, or lengths that differ.
    """
    if len(samples) < 2:
        raise DataError(f"APD needs at least two samples, got {len(samples)}; generate more with --samples")
    for sample in samples:
        _check_pair(sample, samples[0])
    return float(np.mean([np.linalg.norm((a - b)[:, _GROUND, 3]) for a, b in combinations(samples, 2)]))


def ate_m(predicted: np.ndarray, truth: np.ndarray, *, alignment: Alignment) -> float:
    """Absolute trajectory error: root mean square of the displacement in space, metres (Sturm et al. 2012).

    Raises:
        DataError: as ``ade_m``.
    """
    aligned = align(predicted, truth, alignment=alignment)
    return float(np.sqrt(((aligned - truth)[:, :3, 3] ** 2).sum(axis=1).mean()))


def rpe(predicted: np.ndarray, truth: np.ndarray, *, frames: int = 1) -> tuple[float, float]:
    """Relative error over a fixed number of frames, unaligned (it needs none): root mean squares.

    Returns:
        Metres, and degrees.

    Raises:
        DataError: as ``ade_m``, or the trajectories are no longer than ``frames``.
    """
    _check_pair(predicted, truth)
    if len(truth) <= frames:
        raise DataError(f"a relative error over {frames} frames needs more than {len(truth)} poses; use fewer frames")
    steps = [invert(poses[:-frames]) @ poses[frames:] for poses in (predicted, truth)]
    error = invert(steps[1]) @ steps[0]
    distance = np.linalg.norm(error[:, :3, 3], axis=1)
    angle = rotation_angle_deg(error[:, :3, :3])
    return float(np.sqrt((distance**2).mean())), float(np.sqrt((angle**2).mean()))


def drift_share(predicted: np.ndarray, truth: np.ndarray, *, fractions: Sequence[float] = (0.25, 0.5, 1.0)) -> float:
    """Mean end error of segments that are fractions of the path, as a share of their length (after KITTI's).

    A clip is 0 to 150 m long, so lengths in metres would leave most clips out. NaN where the camera stood still.

    Raises:
        DataError: as ``ade_m``.
    """
    _check_pair(predicted, truth)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
    if way[-1] < 1.0:
        return float("nan")
    errors = []
    for length in np.asarray(fractions) * way[-1]:
        for start in range(0, len(truth) - 1, max(1, len(truth) // 12)):
            end = int(np.searchsorted(way, way[start] + length - 1e-9))
            if end < len(truth):
                steps = [invert(poses[start]) @ poses[end] for poses in (predicted, truth)]
                errors.append(np.linalg.norm((invert(steps[1]) @ steps[0])[:3, 3]) / length)
    return float(np.mean(errors))


def align(predicted: np.ndarray, truth: np.ndarray, *, alignment: Alignment) -> np.ndarray:
    """``predicted``, (T, 4, 4), laid onto ``truth`` by the motion that fits positions best (Umeyama 1991, eq. 40-43).

    Raises:
        DataError: the lengths differ, or numbers are not finite.
    """
    _check_pair(predicted, truth)
    if alignment == "none":
        return predicted
    source, target = predicted[:, :3, 3], truth[:, :3, 3]
    centred, goal = source - source.mean(axis=0), target - target.mean(axis=0)
    u, singular, vt = np.linalg.svd(goal.T @ centred / len(source))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt)) or 1.0])
    rotation = u @ sign @ vt
    spread = (centred**2).sum(axis=1).mean()
    scale = float((singular * np.diag(sign)).sum() / spread) if alignment == "sim3" and spread > 1e-12 else 1.0
    scaled = predicted.copy()
    scaled[:, :3, 3] *= scale
    return rigid(rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0)) @ scaled


def mean_interval(values: Sequence[float], groups: Sequence[str], *, draws: int = 2000, seed: int = 0) -> Interval:
    """Mean of ``values`` with a 95 % bootstrap interval over source videos (Efron 1979, percentile).

    Clips of one video are alike, so whole videos are drawn, never clips.

    Raises:
        DataError: no values, or as many groups as values are not given.
    """
    if not len(values) or len(values) != len(groups):
        raise DataError(f"an interval needs values and a source video for each, got {len(values)} and {len(groups)}")
    names, owner = np.unique(np.asarray(groups), return_inverse=True)
    sums = np.bincount(owner, weights=np.asarray(values, np.float64))
    counts = np.bincount(owner)
    drawn = np.random.default_rng(seed).integers(0, len(names), (draws, len(names)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5]) if len(names) > 1 else (np.min(values), np.max(values))
    return Interval(mean=float(np.mean(values)), low=float(low), high=float(high), groups=len(names))


def paired_interval(
    first: Mapping[str, float],
    second: Mapping[str, float],
    groups: Mapping[str, str],
    *,
    draws: int = 2000,
    seed: int = 0,
) -> Interval:
    """Mean of ``second - first`` over what both have, with its 95 % interval: pairs cancel what is common to them.

    Args:
        first: value by key (a clip, a seed).
        second: the same for the other method; NaN counts as not there.
        groups: the source video of each key.
        draws: bootstrap draws.
        seed: of the draws.

    Raises:
        DataError: no key has both values.
    """
    both = sorted(key for key in first if key in second and np.isfinite(first[key]) and np.isfinite(second[key]))
    if not both:
        raise DataError("no key has a value on both sides, so there is nothing to compare; evaluate the same clips")
    differences = [second[key] - first[key] for key in both]
    return mean_interval(differences, [groups[key] for key in both], draws=draws, seed=seed)


def pck(
    predicted: np.ndarray, truth: np.ndarray, box_xyxy: np.ndarray, *, threshold: float = PCK_SHARE
) -> tuple[int, int]:
    """Points within ``threshold`` of the box diagonal, and points that the truth shows (Yang and Ramanan 2013).

    Args:
        predicted: (K, 3) x, y, score; an absent point is a miss.
        truth: (K, 3); absent points do not count.
        box_xyxy: (4,) the truth's box.
        threshold: share of the diagonal.
    """
    shown = truth[:, 2] > 0
    distance = np.linalg.norm(predicted[:, :2] - truth[:, :2], axis=1)
    near = (predicted[:, 2] > 0) & (distance <= threshold * np.hypot(*(box_xyxy[2:] - box_xyxy[:2])))
    return int((near & shown).sum()), int(shown.sum())


def picture_similarity(generated: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """PSNR (dB) and SSIM of two videos, (T, H, W, 3) uint8, means over frames (scikit-image).

    Raises:
        DataError: the shapes differ, or a side is less than three pixels, which SSIM's smallest window has.
    """
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    if generated.shape != truth.shape:
        raise DataError(f"pictures of {generated.shape} and {truth.shape} cannot be compared; resize one first")
    side = min(7, *truth.shape[1:3])
    if side < 3:
        raise DataError(f"pictures of {truth.shape[2]}x{truth.shape[1]} are too small to be compared")
    psnr = [
        peak_signal_noise_ratio(b, a, data_range=255) if (a != b).any() else 99.0
        for a, b in zip(generated, truth, strict=True)
    ]
    ssim = [
        structural_similarity(a, b, channel_axis=2, data_range=255, win_size=side - (side + 1) % 2)
        for a, b in zip(generated, truth, strict=True)
    ]
    return float(np.mean(psnr)), float(np.mean(ssim))


def _check_pair(predicted: np.ndarray, truth: np.ndarray) -> None:
    if predicted.shape != truth.shape or predicted.shape[1:] != (4, 4) or not len(truth):
        raise DataError(
            f"trajectories of {predicted.shape} and {truth.shape} cannot be compared; bring both to the same timestamps"
        )
    if not (np.isfinite(predicted).all() and np.isfinite(truth).all()):
        raise DataError("a trajectory holds numbers that are not finite; count the estimate as failed instead")
