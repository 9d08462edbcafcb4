"""The compiled inside of reading skeletons back: dots, lines and agreeing places in a picture of edge numbers.

``parts`` is (H, W) int32 everywhere: the edge whose hue a pixel has, or -1. Every function's time is bounded by the
sizes of what it is given, whatever the picture shows.
"""

import math

import numpy as np
from numba import njit

from labeling.skeleton_raster import direction, row_span, whole

_SEARCH = np.arange(-2.0, 2.01, 0.5)
_LEAST_DOT = 0.5
_SAMPLES = 13
_OVERSHOOT = 0.25


@njit(cache=True, error_model="numpy")
def merged_places(places: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Places that lie within ``radius`` pixels taken together, the most agreed upon first.

    Args:
        places: (n, 2) float64.
        radius: pixels.

    Returns:
        (m, 2) means and (m,) how many places each stands for.
    """
    count = len(places)
    near = np.zeros((count, count), np.bool_)
    agreeing = np.zeros(count, np.int64)
    for i in range(count):
        for j in range(count):
            near[i, j] = math.hypot(places[i, 0] - places[j, 0], places[i, 1] - places[j, 1]) <= radius
            agreeing[i] += near[i, j]
    means, votes, found = np.zeros((count, 2)), np.zeros(count), 0
    left = np.ones(count, np.bool_)
    for _ in range(count):
        best, most = -1, 0
        for i in range(count):
            if left[i] and agreeing[i] > most:
                best, most = i, agreeing[i]
        if best < 0:
            break
        for j in range(count):
            if left[j] and near[best, j]:
                means[found] += places[j]
                votes[found] += 1
                left[j] = False
                for i in range(count):
                    agreeing[i] -= near[i, j]
        means[found] /= votes[found]
        found += 1
    return means[:found], votes[:found]


@njit(cache=True, error_model="numpy")
def on_dots(parts: np.ndarray, edge: int, places: np.ndarray, dot_radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Places moved to where a dot of its hue fits best within two pixels, where one does.

    Args:
        parts: see the module.
        edge: whose hue the dot has.
        places: (n, 2) float64.
        dot_radius: pixels.

    Returns:
        (n, 2) places and (n,) the share of the dot that is seen there, 0 to 1.
    """
    moved, seen = places.copy(), np.zeros(len(places))
    reach = math.ceil(dot_radius + _SEARCH[-1])
    area = max(math.pi * dot_radius**2, 1.0)
    scores = np.zeros((len(_SEARCH), len(_SEARCH)))
    for n in range(len(places)):
        best = -1.0
        for i in range(len(_SEARCH)):
            for j in range(len(_SEARCH)):
                x, y = places[n, 0] + _SEARCH[j], places[n, 1] + _SEARCH[i]
                scores[i, j] = _dot_gain(parts, edge, x, y, places[n], reach, dot_radius) / area
                best = max(best, scores[i, j])
        if best >= _LEAST_DOT:
            total, x, y = 0, 0.0, 0.0
            for i in range(len(_SEARCH)):
                for j in range(len(_SEARCH)):
                    if scores[i, j] >= best - 1e-9:
                        total, x, y = total + 1, x + _SEARCH[j], y + _SEARCH[i]
            moved[n, 0], moved[n, 1] = places[n, 0] + x / total, places[n, 1] + y / total
        seen[n] = min(max(best, 0.0), 1.0)
    return moved, seen


@njit(cache=True, error_model="numpy")
def _dot_gain(parts, edge, x, y, place, reach, radius):  # pragma: no cover - compiled
    """Pixels of a dot that have its hue, less those that have another, inside the picture."""
    height, width = parts.shape
    column, row = round(place[0]), round(place[1])
    gain = 0.0
    for r in range(max(row - reach, 0), min(row + reach, height - 1) + 1):
        for c in range(max(column - reach, 0), min(column + reach, width - 1) + 1):
            if math.hypot(c - x, r - y) <= radius:
                gain += 1.0 if parts[r, c] == edge else -1.0
    return gain


@njit(cache=True, error_model="numpy")
def line_evidence(
    hue: np.ndarray, lit: np.ndarray, first: np.ndarray, second: np.ndarray, dot_radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """What the picture says of one edge between every pair of proposals of its ends.

    Args:
        hue: (H, W) bool or uint8, where the edge's hue is, widened by a pixel.
        lit: (H, W), where anything is, widened by a pixel.
        first: (n, 2) proposals of its first point.
        second: (m, 2) proposals of its second.
        dot_radius: pixels; lines are looked at clear of the dots at both ends, which have hues of their own.

    Returns:
        (n, m) share of the line that has the hue, less where it runs on beyond an end (there another line broke it),
        and (n, m) share of it that is lit.
    """
    hues, lights = np.zeros((len(first), len(second))), np.zeros((len(first), len(second)))
    for i in range(len(first)):
        for j in range(len(second)):
            x, y = first[i, 0], first[i, 1]
            dx, dy = second[j, 0] - x, second[j, 1] - y
            length = max(math.hypot(dx, dy), 1e-9)
            margin, past = min((dot_radius + 0.5) / length, 0.45), (dot_radius + 2.5) / length
            inner, light = 0.0, 0.0
            for k in range(2 * _SAMPLES):
                light += _at(lit, x, y, dx, dy, k / (2 * _SAMPLES - 1))
            for k in range(_SAMPLES):
                inner += _at(hue, x, y, dx, dy, margin + (1 - 2 * margin) * k / (_SAMPLES - 1))
            beyond = _at(hue, x, y, dx, dy, -past) + _at(hue, x, y, dx, dy, 1 + past)
            hues[i, j] = (_OVERSHOOT if beyond > 0 else 1.0) * inner / _SAMPLES
            lights[i, j] = light / (2 * _SAMPLES)
    return hues, lights


@njit(cache=True, error_model="numpy")
def _at(mask, x, y, dx, dy, share):  # pragma: no cover - compiled
    """1 where the mask is set at a share of the way, 0 elsewhere and outside the picture."""
    column, row = round(x + dx * share), round(y + dy * share)
    if 0 <= row < mask.shape[0] and 0 <= column < mask.shape[1] and mask[row, column]:
        return 1.0
    return 0.0


@njit(cache=True, error_model="numpy")
def matching_pixels(
    parts: np.ndarray, corner: np.ndarray, ends: np.ndarray, radii: np.ndarray, numbers: np.ndarray, steps: np.ndarray,
    moved: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """How many pixels of a crop a drawing gets right, for each of S places of one of its points.

    Args:
        parts: (h, w) crop, see the module.
        corner: (2,) x, y of its first pixel in the picture.
        ends: (N, 4) of the shapes, in drawing order, pixels of the picture.
        radii: (N,) pixels.
        numbers: (N,) int, the edge whose hue each shape has.
        steps: (S, 2) by how much the point is moved.
        moved: (N, 2) bool, which ends of which shapes are that point.

    Returns:
        (S,) int64.
    """
    counts = np.zeros(len(steps), np.int64)
    height, width = parts.shape
    drawn = np.empty((height, width), np.int32)
    for s in range(len(steps)):
        drawn[:] = -1
        for i in range(len(radii)):
            x0, y0, x1, y1 = ends[i] - np.array([corner[0], corner[1], corner[0], corner[1]])
            if moved[i, 0]:
                x0, y0 = x0 + steps[s, 0], y0 + steps[s, 1]
            if moved[i, 1]:
                x1, y1 = x1 + steps[s, 0], y1 + steps[s, 1]
            ux, uy, length = direction(x0, y0, x1, y1)
            top, bottom = whole(min(y0, y1) - radii[i], max(y0, y1) + radii[i], height)
            for y in range(top, bottom):
                low, high = row_span(x0, y0, x1, y1, radii[i], ux, uy, length, float(y))
                left, right = whole(low, high, width)
                for x in range(left, right):
                    drawn[y, x] = numbers[i]
        for y in range(height):
            for x in range(width):
                counts[s] += drawn[y, x] == parts[y, x]
    return counts


@njit(cache=True, error_model="numpy")
def explained_pixels(parts: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """Pixels whose edge a drawing has there or in a neighbouring pixel: a line half a pixel off is the same line.

    Args:
        parts: see the module.
        drawn: (H, W) int32, edge numbers of the drawing, or -1.

    Returns:
        (H, W) bool.
    """
    height, width = parts.shape
    explained = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            if drawn[y, x] < 0:
                continue
            for r in range(max(y - 1, 0), min(y + 2, height)):
                for c in range(max(x - 1, 0), min(x + 2, width)):
                    if parts[r, c] == drawn[y, x]:
                        explained[r, c] = True
    return explained
