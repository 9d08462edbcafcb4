"""Capsules on a picture: the one rasteriser behind the drawn skeletons and the mask of lit cells.

A capsule is all that lies within a radius of a line segment. It is convex, so on a row of pixels it is one interval,
found without trying each pixel; a pixel belongs to it when its centre does.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Capsules:
    """N shapes in drawing order: the geometry that both the picture and the mask of lit cells are made of."""

    ends: np.ndarray
    """(N, 4) float64: x0, y0, x1, y1, pixels of the target picture."""
    radii: np.ndarray
    """(N,) float64, pixels of the target picture."""
    colours: np.ndarray
    """(N, 3) uint8, RGB, none of them black."""


def fill_capsules(picture: np.ndarray, shapes: Capsules) -> None:
    """Paint ``shapes`` in their order on ``picture`` (H, W, 3) uint8, in place; parts outside it are cut."""
    _fill_all(picture, shapes.ends, shapes.radii, shapes.colours)


def mark_cells(lit: np.ndarray, shapes: Capsules, *, width: int, height: int, cell: int) -> None:
    """Set ``lit`` (height / cell, width / cell) bool where ``fill_capsules`` would paint a pixel of the cell."""
    _mark_all(lit, shapes.ends, shapes.radii, width, height, cell)


@njit(cache=True)
def _row_span(x0, y0, x1, y1, radius, y):  # pragma: no cover - compiled
    """First and last x of a capsule on row y (an interval, for a capsule is convex); empty as (1, 0)."""
    low, high = np.inf, -np.inf
    for cx, cy in ((x0, y0), (x1, y1)):
        reach = radius * radius - (y - cy) * (y - cy)
        if reach >= 0:
            half = math.sqrt(reach)
            low, high = min(low, cx - half), max(high, cx + half)
    dx, dy = x1 - x0, y1 - y0
    length = math.sqrt(dx * dx + dy * dy)
    if length > 0:
        # The straight part: |cross| <= radius and 0 <= dot <= length, each an interval of x on this row.
        start, end = -np.inf, np.inf
        ux, uy = dx / length, dy / length
        offset = y - y0
        start, end, ok = _narrow(start, end, uy, -ux * offset - x0 * uy, -radius, radius)
        if ok:
            start, end, ok = _narrow(start, end, ux, uy * offset - x0 * ux, 0.0, length)
        if ok and start <= end:
            low, high = min(low, start), max(high, end)
    return low, high


@njit(cache=True)
def _narrow(start, end, slope, offset, least, most):  # pragma: no cover - compiled
    """[start, end] cut to where ``least <= slope * x + offset <= most``."""
    if abs(slope) < 1e-12:
        return start, end, least <= offset <= most
    one, other = (least - offset) / slope, (most - offset) / slope
    return max(start, min(one, other)), min(end, max(one, other)), True


@njit(cache=True)
def _row_range(low, high, limit):  # pragma: no cover - compiled
    """Integers in [low, high] and [0, limit), half-open."""
    return math.ceil(max(low, 0.0)), math.floor(min(high, limit - 1.0)) + 1


@njit(cache=True)
def _fill_all(picture, ends, radii, colours):  # pragma: no cover - compiled
    height, width = picture.shape[:2]
    for i in range(len(radii)):
        x0, y0, x1, y1 = ends[i]
        red, green, blue = colours[i]
        top, bottom = _row_range(min(y0, y1) - radii[i], max(y0, y1) + radii[i], height)
        for y in range(top, bottom):
            low, high = _row_span(x0, y0, x1, y1, radii[i], y)
            left, right = _row_range(low, high, width)
            for x in range(left, right):
                picture[y, x, 0], picture[y, x, 1], picture[y, x, 2] = red, green, blue


@njit(cache=True)
def _mark_all(lit, ends, radii, width, height, cell):  # pragma: no cover - compiled
    for i in range(len(radii)):
        x0, y0, x1, y1 = ends[i]
        top, bottom = _row_range(min(y0, y1) - radii[i], max(y0, y1) + radii[i], height)
        for y in range(top, bottom):
            low, high = _row_span(x0, y0, x1, y1, radii[i], y)
            left, right = _row_range(low, high, width)
            if left < right:
                for column in range(left // cell, (right - 1) // cell + 1):
                    lit[y // cell, column] = True
