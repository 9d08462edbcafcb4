"""The compiled inside of CIF/CAF decoding: the accumulated map read lazily, greedy growth, suppression.

The dense map of 66 points at 1056x704 is 197 MB and most of it is never read. Here a reading sums the few Gaussians
that reach the place; cells are filed under the bins that their Gaussians touch. All lengths are input pixels.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

MAP_SHARE = 1 / 16
"""What one cell of full confidence adds to the map: 16 cells that agree make a certain point."""
MAP_FLOOR = 0.1
"""A connection keeps this much of its confidence where the map knows nothing of its target."""
BLEND_RATIO = 0.5
"""The second-best connection is blended in if it scores this much of the best."""
MIN_SCALE_PX = 4.0
"""Points are never told apart, nor connections refused, within less."""
_BINS_PX = np.array([32.0, 128.0, 512.0, 1e9])
_STRIP_PX = 16.0
_CUT = 0.5
_CONFIDENCE, _X, _Y, _SCALE, _SIGMA = range(5)
_FROM_X, _FROM_Y, _TO_X, _TO_Y, _TO_SCALE, _TRUST, _SCORE, _ORDER = range(8)


class Cells(NamedTuple):
    """CIF cells that count, in the order of kind, row, column."""

    kind: np.ndarray
    """(n,) int64: index of the point in the schema."""
    values: np.ndarray
    """(n, 5) float64: confidence, x, y, scale, sigma of the Gaussian."""


class MapIndex(NamedTuple):
    """Which cells reach which part of the picture: one grid of bins for each range of sigma."""

    columns: np.ndarray
    """(levels,) int64, bins across; 0 where no cell has such a sigma."""
    rows: np.ndarray
    first: np.ndarray
    """(levels,) int64, number of the first bin of a level."""
    starts: np.ndarray
    """(bins + 1,) int32 into ``entries``."""
    entries: np.ndarray
    """(m, 4) float64: x, y, 1 / (2 variance), height of a Gaussian."""


class Connections(NamedTuple):
    """CAF cells in both directions, filed by directed edge (2 e, and 2 e + 1 backwards) and strip of source x."""

    starts: np.ndarray
    """(2 E, strips + 1) int32 into ``values``."""
    values: np.ndarray
    """(n, 8) float64: source x, y, target x, y, target scale, confidence, score (confidence rescored by the map at the
    target; negative until somebody asks), number of the cell in the field (which settles ties)."""


class Graph(NamedTuple):
    """The schema's edges."""

    source: np.ndarray
    """(2 E,) int64: the point where a directed edge starts."""
    target: np.ndarray
    starts: np.ndarray
    """(K + 1,) int64 into ``leaving``."""
    leaving: np.ndarray
    """Directed edges by the point where they start."""


@njit(cache=True)
def _confident(field: np.ndarray, threshold: float) -> np.ndarray:
    """(n, 3) int32: kind, row, column of the cells of a field (K, C, h, w) of at least ``threshold``."""
    kinds, height, width = field.shape[0], field.shape[2], field.shape[3]
    least = np.float32(threshold)
    counts = np.zeros((kinds, height), np.int32)
    for k in range(kinds):
        for i in range(height):
            in_row = np.int32(0)
            for j in range(width):
                in_row += np.int32(field[k, 1, i, j] >= least)
            counts[k, i] = in_row
    places = np.empty((counts.sum(), 3), np.int32)
    n = 0
    for k in range(kinds):
        for i in range(height):
            # Most rows hold nothing, and counting runs many times as fast as looking.
            if counts[k, i]:
                for j in range(width):
                    if field[k, 1, i, j] >= least:
                        places[n, 0], places[n, 1], places[n, 2] = k, i, j
                        n += 1
    return places


@njit(cache=True)
def gather_cells(cif: np.ndarray, threshold: float, stride: float) -> Cells:
    """The cells of a CIF, (K, 5, h, w), of at least ``threshold``."""
    places = _confident(cif, threshold)
    kind = np.empty(len(places), np.int64)
    values = np.empty((len(places), 5), np.float64)
    for n in range(len(places)):
        k, i, j = places[n, 0], places[n, 1], places[n, 2]
        kind[n] = k
        values[n, _CONFIDENCE] = cif[k, 1, i, j]
        values[n, _X] = cif[k, 2, i, j] * stride
        values[n, _Y] = cif[k, 3, i, j] * stride
        values[n, _SCALE] = cif[k, 4, i, j] * stride
        values[n, _SIGMA] = max(1.0, 0.5 * values[n, _SCALE])
    return Cells(kind, values)


@njit(cache=True)
def _bin(value: float, size: float, count: int) -> int:
    return min(max(int(value // size), 0), count - 1)


@njit(cache=True)
def _level(sigma: float) -> int:
    level = 0
    while sigma > _BINS_PX[level] and level < len(_BINS_PX) - 1:
        level += 1
    return level


@njit(cache=True)
def _bin_range(value: float, sigma: float, size: float, count: int) -> tuple[int, int]:
    return _bin(value - sigma, size, count), _bin(value + sigma, size, count) + 1


@njit(cache=True)
def index_map(cells: Cells, kinds: int, width: float, height: float) -> MapIndex:
    """File every cell under the bins that the square of one sigma around it touches: nine at most, whatever sigma."""
    columns, rows = np.zeros(len(_BINS_PX), np.int64), np.zeros(len(_BINS_PX), np.int64)
    first = np.zeros(len(_BINS_PX), np.int64)
    for n in range(len(cells.kind)):
        level = _level(cells.values[n, _SIGMA])
        columns[level], rows[level] = int(width / _BINS_PX[level]) + 1, int(height / _BINS_PX[level]) + 1
    for level in range(1, len(_BINS_PX)):
        first[level] = first[level - 1] + kinds * columns[level - 1] * rows[level - 1]
    bins = first[-1] + kinds * columns[-1] * rows[-1]
    starts = np.zeros(bins + 1, np.int32)
    entries = np.empty((0, 4), np.float64)
    for filling in range(2):
        for n in range(len(cells.kind)):
            x, y, sigma = cells.values[n, _X], cells.values[n, _Y], cells.values[n, _SIGMA]
            level = _level(sigma)
            size, across, down = _BINS_PX[level], columns[level], rows[level]
            top, bottom = _bin_range(y, sigma, size, down)
            left, right = _bin_range(x, sigma, size, across)
            for row in range(top, bottom):
                base = first[level] + (cells.kind[n] * down + row) * across
                for place in range(base + left, base + right):
                    if filling:
                        m = starts[place]
                        entries[m, 0], entries[m, 1], entries[m, 2] = x, y, 0.5 / (sigma * sigma)
                        entries[m, 3] = cells.values[n, _CONFIDENCE] * MAP_SHARE
                    starts[place] += 1
        if filling:
            starts[1:] = starts[:-1].copy()
            starts[0] = 0
        else:
            entries = np.empty((_to_offsets(starts), 4), np.float64)
    return MapIndex(columns, rows, first, starts, entries)


@njit(cache=True)
def _to_offsets(counts: np.ndarray) -> int:
    """Counts to exclusive sums, in place; the whole sum."""
    total = 0
    for b in range(len(counts)):
        total, counts[b] = total + counts[b], total
    return total


@njit(cache=True)
def read_map(index: MapIndex, kind: int, x: float, y: float) -> float:
    """The accumulated map of one kind of point at one place, 0 to 1: Gaussians cut at one sigma, clipped at 1."""
    total = 0.0
    for level in range(len(_BINS_PX)):
        across, down = index.columns[level], index.rows[level]
        if across == 0:
            continue
        row, column = _bin(y, _BINS_PX[level], down), _bin(x, _BINS_PX[level], across)
        place = index.first[level] + (kind * down + row) * across + column
        for m in range(index.starts[place], index.starts[place + 1]):
            squared = (x - index.entries[m, 0]) ** 2 + (y - index.entries[m, 1]) ** 2
            exponent = squared * index.entries[m, 2]
            if exponent <= _CUT:
                total += index.entries[m, 3] * math.exp(-exponent)
                if total >= 1:
                    return 1.0
    return total


@njit(cache=True)
def score_seeds(index: MapIndex, cells: Cells) -> np.ndarray:
    """(n,) float64: how well each cell starts an object, 0.9 map + 0.1 confidence."""
    scores = np.empty(len(cells.kind), np.float64)
    for n in range(len(scores)):
        known = read_map(index, cells.kind[n], cells.values[n, _X], cells.values[n, _Y])
        scores[n] = 0.9 * known + 0.1 * cells.values[n, _CONFIDENCE]
    return scores


@njit(cache=True)
def gather_connections(caf: np.ndarray, threshold: float, stride: float, width: float) -> Connections:
    """The cells of a CAF, (E, 8, h, w), of at least ``threshold``, in both directions."""
    places = _confident(caf, threshold)
    edges, across, count = caf.shape[0], caf.shape[3], len(places)
    strips = int(width / _STRIP_PX) + 1
    starts = np.zeros((2 * edges, strips + 1), np.int32)
    for n in range(count):
        e, i, j = places[n, 0], places[n, 1], places[n, 2]
        for back in range(2):
            starts[2 * e + back, _bin(caf[e, 2 + 2 * back, i, j] * stride, _STRIP_PX, strips)] += 1
    _to_offsets(starts.reshape(-1))
    values = np.empty((2 * count, 8), np.float64)
    cursor = starts.copy()
    for n in range(count):
        e, i, j = places[n, 0], places[n, 1], places[n, 2]
        for back in range(2):
            near, far = 2 + 2 * back, 4 - 2 * back
            x = caf[e, near, i, j] * stride
            strip = _bin(x, _STRIP_PX, strips)
            row = values[cursor[2 * e + back, strip]]
            cursor[2 * e + back, strip] += 1
            row[_FROM_X], row[_FROM_Y] = x, caf[e, near + 1, i, j] * stride
            row[_TO_X], row[_TO_Y] = caf[e, far, i, j] * stride, caf[e, far + 1, i, j] * stride
            row[_TO_SCALE] = caf[e, 7 - back, i, j] * stride
            row[_TRUST], row[_SCORE], row[_ORDER] = caf[e, 1, i, j], -1.0, i * across + j
    return Connections(starts, values)


@njit(cache=True)
def connect(
    links: Connections, index: MapIndex, graph: Graph, d: int, x: float, y: float, scale: float
) -> tuple[float, float, float, float]:
    """Where directed edge ``d`` leads from (x, y), the two best connections blended: x, y, scale, score (0 = nowhere).

    A connection counts by its score times a Gaussian of its source's distance, sigma = scale / 2, cut at 4 sigma. One
    that no second one confirms counts half.
    """
    reach, variance = 2 * scale, 0.25 * scale * scale
    best, second, best_at, second_at = 0.0, 0.0, -1, -1
    strips = links.starts.shape[1] - 1
    begin, end = _bin(x - reach, _STRIP_PX, strips), _bin(x + reach, _STRIP_PX, strips)
    for n in range(links.starts[d, begin], links.starts[d, end + 1]):
        row = links.values[n]
        squared = (x - row[_FROM_X]) ** 2 + (y - row[_FROM_Y]) ** 2
        if squared > reach * reach:
            continue
        weight = math.exp(-0.5 * squared / variance)
        # A score never exceeds its confidence: the map is read only for those that can still matter.
        if weight * row[_TRUST] < second:
            continue
        if row[_SCORE] < 0:
            known = read_map(index, graph.target[d], row[_TO_X], row[_TO_Y])
            row[_SCORE] = row[_TRUST] * (MAP_FLOOR + (1 - MAP_FLOOR) * known)
        score = weight * row[_SCORE]
        if score > best or (score == best and best_at >= 0 and row[_ORDER] < links.values[best_at, _ORDER]):
            best, second, best_at, second_at = score, best, n, best_at
        elif score > second or (score == second and second_at >= 0 and row[_ORDER] < links.values[second_at, _ORDER]):
            second, second_at = score, n
    if best_at < 0:
        return 0.0, 0.0, 0.0, 0.0
    first, other = links.values[best_at], links.values[second_at]
    apart = math.hypot(first[_TO_X] - other[_TO_X], first[_TO_Y] - other[_TO_Y])
    if second_at < 0 or second < BLEND_RATIO * best or apart > max(first[_TO_SCALE], MIN_SCALE_PX):
        return first[_TO_X], first[_TO_Y], first[_TO_SCALE], 0.5 * best
    share = second / (best + second)
    to_x = first[_TO_X] + share * (other[_TO_X] - first[_TO_X])
    to_y = first[_TO_Y] + share * (other[_TO_Y] - first[_TO_Y])
    return to_x, to_y, first[_TO_SCALE] + share * (other[_TO_SCALE] - first[_TO_SCALE]), 0.5 * (best + second)


@njit(cache=True)
def grow(
    points: np.ndarray, seed: int, links: Connections, index: MapIndex, graph: Graph, threshold: float, relative: float
) -> None:
    """Complete one object in place from its seed, always by the point that scores best next.

    Args:
        points: (K, 4) float64: x, y, scale, score; all zero but the seed.
        seed: the point that is there.
        links: connections.
        index: of the map.
        graph: the schema's edges.
        threshold: least score of a point.
        relative: least score as a share of the score of the point before it.
    """
    # The queue holds at most the best proposal for each point: a worse one could never come first.
    queue = np.zeros_like(points)
    latest = seed
    while latest >= 0:
        from_x, from_y, from_score = points[latest, 0], points[latest, 1], points[latest, 3]
        from_scale = max(points[latest, 2], MIN_SCALE_PX)
        for m in range(graph.starts[latest], graph.starts[latest + 1]):
            d = graph.leaving[m]
            target = graph.target[d]
            if points[target, 3] > 0:
                continue
            x, y, scale, value = connect(links, index, graph, d, from_x, from_y, from_scale)
            score = math.sqrt(value * from_score)
            if score < threshold or score < relative * from_score or score <= queue[target, 3]:
                continue
            # Reverse match: the way back must end where it began.
            back_x, back_y, _, back = connect(links, index, graph, d ^ 1, x, y, max(scale, MIN_SCALE_PX))
            if back > 0 and math.hypot(back_x - from_x, back_y - from_y) <= from_scale:
                queue[target, 0], queue[target, 1], queue[target, 2], queue[target, 3] = x, y, scale, score
        latest = np.argmax(queue[:, 3])
        if queue[latest, 3] == 0:
            return
        points[latest] = queue[latest]
        queue[latest, 3] = 0


@njit(cache=True)
def _occupied(objects: np.ndarray, count: int, kind: int, x: float, y: float) -> bool:
    for n in range(count):
        if objects[n, kind, 3] > 0:
            radius = max(objects[n, kind, 2], MIN_SCALE_PX)
            if abs(objects[n, kind, 0] - x) < radius and abs(objects[n, kind, 1] - y) < radius:
                return True
    return False


@njit(cache=True)
def grow_all(
    seeds: np.ndarray, seed_scores: np.ndarray, cells: Cells, links: Connections, index: MapIndex, graph: Graph,
    threshold: float, relative: float, max_objects: int,
) -> tuple[np.ndarray, int]:  # fmt: skip
    """One object from every seed that no earlier object covers.

    Args:
        seeds: indices of cells, best first.
        seed_scores: (n,) of all cells.
        cells: of the CIF.
        links: connections.
        index: of the map.
        graph: the schema's edges.
        threshold: as in ``grow``.
        relative: as in ``grow``.
        max_objects: it stops there.

    Returns:
        (M, K, 4) float64: x, y, scale, score; and how many seeds were left that no object covers.
    """
    objects = np.zeros((max_objects, len(graph.starts) - 1, 4), np.float64)
    count, left_out = 0, 0
    for rank in range(len(seeds)):
        cell = seeds[rank]
        kind = int(cells.kind[cell])
        x, y = cells.values[cell, _X], cells.values[cell, _Y]
        if _occupied(objects, count, kind, x, y):
            continue
        if count == max_objects:
            left_out += 1
            continue
        points = objects[count]
        points[kind, 0], points[kind, 1], points[kind, 2] = x, y, cells.values[cell, _SCALE]
        points[kind, 3] = seed_scores[cell]
        grow(points, kind, links, index, graph, threshold, relative)
        count += 1
    return objects[:count].copy(), left_out


@njit(cache=True)
def suppress_points(objects: np.ndarray) -> None:
    """Keypoint suppression in place: of two points of one kind at one place only the better object keeps its own.

    Args:
        objects: (M, K, 4), best object first.
    """
    for n in range(objects.shape[0]):
        for kind in range(objects.shape[1]):
            if objects[n, kind, 3] > 0 and _occupied(objects, n, kind, objects[n, kind, 0], objects[n, kind, 1]):
                objects[n, kind, 3] = 0.0


@njit(cache=True)
def largest_component(present: np.ndarray, edges: np.ndarray) -> int:
    """How many of the ``present`` (K,) points ``edges`` (E, 2) join in one piece."""
    piece = np.arange(len(present))
    changed = True
    while changed:
        changed = False
        for e in range(len(edges)):
            a, b = edges[e, 0], edges[e, 1]
            if present[a] and present[b] and piece[a] != piece[b]:
                piece[a] = piece[b] = min(piece[a], piece[b])
                changed = True
    return np.bincount(piece[present], minlength=1).max()
