"""Jitter without lag: keypoints of a track, smoothed over time by local quadratic fits.

A run is labelled whole, so the filter looks both ways and cannot lag; a quadratic keeps velocity and acceleration
(Savitzky and Golay 1964; Cleveland 1979 for the weights). The window is as wide as the motion allows: where a wide and
a narrow fit agree within the noise the wide one is taken, which is how a parked car gets steadier than a walking leg
(the intersection of confidence intervals of Goldenshluger and Nemirovski 1997, for two windows).
"""

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np

from labeling.carrying import UNSEEN_FRAMES
from labeling.labels import POINT_ABSENT, POINT_DETECTED, POINT_INTERPOLATED, Keypoints
from labeling.medians import masked_median


@dataclass(frozen=True, slots=True, kw_only=True)
class SmoothingSettings:
    """Windows are half-widths in moments; as they stand, in frames of the 24 fps grid."""

    narrow: int = 5
    """Wide enough to halve white noise, narrow enough for a walking leg (1 Hz passes at 99 %)."""
    wide: int = 12
    """For what moves evenly: half a second each way."""
    agreement: float = 1.0
    """The wide fit is used where it is nearer to the narrow one than this many noise sigmas."""
    fill_frames: int = 6
    """Longest hole in a track that is filled."""

    def at_pace(self, frames: int) -> "SmoothingSettings":
        """The same times for a source of fewer frames, each of whose pictures is shown for ``frames`` of the grid."""
        narrow, wide = (-(-window // frames) for window in (self.narrow, self.wide))
        return replace(self, narrow=narrow, wide=wide, fill_frames=self.fill_frames // frames)


def smooth_tracks(
    labels: Iterable[Keypoints],
    *,
    settings: SmoothingSettings | None = None,
    breaks: frozenset[int] = frozenset(),
) -> list[Keypoints]:
    """The labels of a run with steadier points and boxes, and short holes filled.

    A hole of up to ``fill_frames`` frames, of a point or of a whole object, is bridged with points marked as
    interpolated and scored by the lesser of their neighbours. Nothing crosses a break.

    Args:
        labels: tracked labels.
        settings: windows.
        breaks: grid numbers of frames before which nothing may be carried over.

    Returns:
        Labels ordered by frame, then track.
    """
    settings = settings or SmoothingSettings()
    groups: dict[tuple[int, str, int], list[Keypoints]] = {}
    ordered = sorted(breaks)
    for label in labels:
        part = bisect_right(ordered, label.frame)
        groups.setdefault((label.track_id, label.schema, part), []).append(label)
    smoothed = [label for group in groups.values() for label in _smooth_track(group, settings)]
    return sorted(smoothed, key=lambda label: (label.frame, label.track_id))


def drop_unseen(
    labels: Sequence[Keypoints], clocks: Sequence[int], *, max_frames: int = UNSEEN_FRAMES
) -> list[Keypoints]:
    """Without points, and objects, that were not detected within ``max_frames`` of when they are shown.

    Args:
        labels: tracked, by moment. Objects without any detected point, boxes alone, are left as they are.
        clocks: time of each moment, frames of the grid; where a camera froze, without that.
        max_frames: of the grid, before or after.
    """
    groups: dict[int, list[int]] = {}
    for index, label in enumerate(labels):
        groups.setdefault(label.track_id, []).append(index)
    kept: list[Keypoints | None] = list(labels)
    for indices in groups.values():
        track = [labels[i] for i in indices]
        frames = np.array([clocks[label.frame] for label in track])[:, None]
        detected = np.array([label.point_source for label in track]) == POINT_DETECTED
        shown = np.array([label.present for label in track])
        if not detected.any():
            continue
        before = np.maximum.accumulate(np.where(detected, frames, -np.inf))
        after = np.minimum.accumulate(np.where(detected, frames, np.inf)[::-1])[::-1]
        unseen = np.minimum(frames - before, after - frames) > max_frames
        for row in np.flatnonzero((unseen & shown).any(axis=1)):
            points, source = track[row].points.copy(), track[row].point_source.copy()
            points[unseen[row]], source[unseen[row]] = 0, POINT_ABSENT
            gone = unseen[row].all()
            kept[indices[row]] = None if gone else replace(track[row], points=points, point_source=source)
    return [label for label in kept if label is not None]


def _smooth_track(group: list[Keypoints], settings: SmoothingSettings) -> list[Keypoints]:
    group = sorted(group, key=lambda label: label.frame)
    first = group[0].frame
    rows = np.array([label.frame - first for label in group])
    length = int(rows[-1]) + 1
    points = np.zeros((length, len(group[0].points), 3))
    source = np.zeros(points.shape[:2], np.int8)
    corners = np.zeros((length, 2, 3))
    points[rows] = [label.points for label in group]
    source[rows] = [label.point_source for label in group]
    corners[rows, :, :2] = [label.box_xyxy.reshape(2, 2) for label in group]
    corners[rows, :, 2] = 1
    points, filled = fill_holes(points, settings.fill_frames)
    corners, _ = fill_holes(corners, settings.fill_frames)
    scores = np.interp(np.arange(length), rows, [label.score for label in group])
    source[filled] = POINT_INTERPOLATED
    points[..., :2] = smooth_series(points, settings)
    boxes = smooth_series(corners, settings).reshape(length, 4).astype(np.float32)
    shown = np.flatnonzero(corners[:, 0, 2] > 0)
    return group[0].elsewhere(
        (first + shown).tolist(), boxes_xyxy=boxes[shown], points=points.astype(np.float32)[shown],
        point_source=source[shown], scores=scores[shown],
    )  # fmt: skip


def fill_holes(points: np.ndarray, fill_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Points with their short holes bridged by straight lines.

    Args:
        points: (T, K, 3) x, y, score; absent points have score 0.
        fill_frames: longest hole that is bridged.

    Returns:
        (T, K, 3) points, and (T, K) bool: those that were made up.
    """
    points = points.copy()
    made_up = np.zeros(points.shape[:2], bool)
    there = points[..., 2] > 0
    ever_before, ever_after = np.maximum.accumulate(there), np.maximum.accumulate(there[::-1])[::-1]
    for k in np.flatnonzero((ever_before & ever_after & ~there).any(axis=0)):
        seen = np.flatnonzero(there[:, k])
        steps = np.diff(seen)
        for n in np.flatnonzero((steps > 1) & (steps <= fill_frames + 1)):
            before, after = seen[n], seen[n + 1]
            hole = np.arange(before + 1, after)
            share = ((hole - before) / (after - before))[:, None]
            points[hole, k, :2] = (1 - share) * points[before, k, :2] + share * points[after, k, :2]
            points[hole, k, 2] = min(points[before, k, 2], points[after, k, 2])
            made_up[hole, k] = True
    return points, made_up


def smooth_series(points: np.ndarray, settings: SmoothingSettings) -> np.ndarray:
    """Positions of one object's points, smoothed over as many frames as its motion allows.

    Args:
        points: (T, K, 3) x, y, score.
        settings: windows.

    Returns:
        (T, K, 2) positions; absent points are left as they are.
    """
    present = points[..., 2] > 0
    positions, weights = points[..., :2], np.where(present, np.maximum(points[..., 2], 0.05), 0)
    positions = np.ascontiguousarray(positions, np.float64)
    narrow = _local_fit(positions, weights, settings.narrow)
    wide = _local_fit(positions, weights, settings.wide)
    residual = np.linalg.norm(positions - narrow, axis=-1)
    gap = np.linalg.norm(wide - narrow, axis=-1)
    # One window for the whole object, since its points move together; the noise is each object's own.
    sigma = masked_median(residual.reshape(1, -1), present.reshape(1, -1))[0]
    object_gap = masked_median(gap, present)
    share = np.clip(2 - object_gap / max(settings.agreement * sigma, 1e-6), 0, 1)[:, None, None]
    # A point that bends while its object does not (a foot of someone who stands) keeps the narrow fit.
    bends = np.clip(2 - gap / max(3 * settings.agreement * sigma, 1e-6), 0, 1)[..., None]
    blend = np.minimum(share, bends)
    return np.where(present[..., None], blend * wide + (1 - blend) * narrow, positions)


@numba.njit(cache=True)
def _local_fit(positions, weights, half_width):
    """(T, K, 2) values at each frame of quadratics fitted by tricube-weighted least squares around it.

    Args:
        positions: (T, K, 2) float64.
        weights: (T, K) float64, 0 for what is absent.
        half_width: frames on either side.
    """
    length, count, _ = positions.shape
    # Side by side in memory, so that the innermost loop does all points at once: weights, and weighted x and y.
    weighted = np.empty((length, 3, count))
    weighted[:, 0], weighted[:, 1], weighted[:, 2] = weights, weights * positions[..., 0], weights * positions[..., 1]
    channels = weighted.reshape(length, 3 * count)
    away = np.arange(-half_width, half_width + 1) / (half_width + 1)
    tricube = (1 - np.abs(away) ** 3) ** 3
    moments = np.empty((5, 3 * count))
    fitted = np.zeros_like(positions)
    for t in range(length):
        moments[:] = 0
        for s in range(max(0, t - half_width), min(length - 1, t + half_width) + 1):
            tap = tricube[s - t + half_width]
            for power in range(5):
                for c in range(3 * count):
                    moments[power, c] += tap * channels[s, c]
                tap *= away[s - t + half_width]
        for k in range(count):
            m0, m1, m2, m3, m4 = moments[0, k], moments[1, k], moments[2, k], moments[3, k], moments[4, k]
            # A little ridge on slope and bend: with too few frames for them (the ends of a track) the fit falls back to
            # a mean. The first unknown of the normal equations by Cramer's rule.
            a, d, f = m0 + 1e-9, m2 + 1e-3, m4 + 2e-3
            c0, c1, c2 = d * f - m3 * m3, m2 * m3 - m1 * f, m1 * m3 - m2 * d
            determinant = a * c0 + m1 * c1 + m2 * c2
            for axis in range(2):
                c = (axis + 1) * count + k
                fitted[t, k, axis] = (c0 * moments[0, c] + c1 * moments[1, c] + c2 * moments[2, c]) / determinant
    return fitted
