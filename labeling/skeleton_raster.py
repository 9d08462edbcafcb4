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


@njit(cache=True, error_model="numpy")
def row_span(x0, y0, x1, y1, radius, ux, uy, length, y):  # pragma: no cover - compiled
    """First and last x of a capsule on row y (an interval, for a capsule is convex); empty where first > last."""
    low, high = np.inf, -np.inf
    reach = radius * radius - (y - y0) * (y - y0)
    if reach >= 0.0:
        half = math.sqrt(reach)
        low, high = x0 - half, x0 + half
    if length == 0.0:
        return low, high
    reach = radius * radius - (y - y1) * (y - y1)
    if reach >= 0.0:
        half = math.sqrt(reach)
        low, high = min(low, x1 - half), max(high, x1 + half)
    # The straight part: |across| <= radius and 0 <= along <= length, each an interval of x on this row.
    across = -ux * (y - y0) - x0 * uy
    along = uy * (y - y0) - x0 * ux
    start, end = _narrow(-np.inf, np.inf, uy, across, -radius, radius)
    start, end = _narrow(start, end, ux, along, 0.0, length)
    if start <= end:
        low, high = min(low, start), max(high, end)
    return low, high


@njit(cache=True, error_model="numpy")
def _narrow(start, end, slope, offset, least, most):  # pragma: no cover - compiled
    """[start, end] cut to where ``least <= slope * x + offset <= most``; (inf, -inf) when that is nowhere."""
    if abs(slope) < 1e-12:
        if least <= offset <= most:
            return start, end
        return np.inf, -np.inf
    inverse = 1.0 / slope
    one, other = (least - offset) * inverse, (most - offset) * inverse
    return max(start, min(one, other)), min(end, max(one, other))


@njit(cache=True, error_model="numpy")
def direction(x0, y0, x1, y1):  # pragma: no cover - compiled
    """Unit vector and length of a line, all 0 for a dot."""
    dx, dy = x1 - x0, y1 - y0
    length = math.sqrt(dx * dx + dy * dy)
    if length == 0.0:
        return 0.0, 0.0, 0.0
    return dx / length, dy / length, length


@njit(cache=True, error_model="numpy")
def whole(low, high, limit):  # pragma: no cover - compiled
    """Integers in [low, high] and [0, limit), half-open."""
    return math.ceil(min(max(low, 0.0), float(limit))), math.floor(max(min(high, limit - 1.0), -1.0)) + 1


@njit(cache=True, error_model="numpy")
def _fill_all(picture, ends, radii, colours):  # pragma: no cover - compiled
    height, width = picture.shape[:2]
    for i in range(len(radii)):
        x0, y0, x1, y1 = ends[i, 0], ends[i, 1], ends[i, 2], ends[i, 3]
        radius, red, green, blue = radii[i], colours[i, 0], colours[i, 1], colours[i, 2]
        ux, uy, length = direction(x0, y0, x1, y1)
        top, bottom = whole(min(y0, y1) - radius, max(y0, y1) + radius, height)
        for y in range(top, bottom):
            low, high = row_span(x0, y0, x1, y1, radius, ux, uy, length, float(y))
            left, right = whole(low, high, width)
            for x in range(left, right):
                picture[y, x, 0], picture[y, x, 1], picture[y, x, 2] = red, green, blue


@njit(cache=True, error_model="numpy")
def _mark_all(lit, ends, radii, width, height, cell):  # pragma: no cover - compiled
    for i in range(len(radii)):
        x0, y0, x1, y1 = ends[i, 0], ends[i, 1], ends[i, 2], ends[i, 3]
        radius = radii[i]
        ux, uy, length = direction(x0, y0, x1, y1)
        top, bottom = whole(min(y0, y1) - radius, max(y0, y1) + radius, height)
        for y in range(top, bottom):
            low, high = row_span(x0, y0, x1, y1, radius, ux, uy, length, float(y))
            left, right = whole(low, high, width)
            if left < right:
                for column in range(left // cell, (right - 1) // cell + 1):
                    lit[y // cell, column] = True
