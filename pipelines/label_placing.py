"""Where the names of a chart's points go: beside them, clear of each other, their leaders uncrossed."""

from collections.abc import Sequence

import numpy as np

_LINE_PX = 20.0
_BESIDE_PX = 12.0
"""From a point to a name at its height."""
_POINT_PX = 5.0
"""Half the width of a point."""
_ROUNDS = 3
"""Of placing each name among all the others: the first ones were placed before the last were there."""


def place_labels(
    points_xy: np.ndarray, widths: Sequence[float], bounds: tuple[float, float, float, float]
) -> list[tuple[float, float]]:
    """Where each name starts, relative to its point: on either side, above or below, clear of what stands already.

    Args:
        points_xy: (n, 2) pixels, y upwards.
        widths: of the names, pixels.
        bounds: left, bottom, right, top of the axes, pixels.
    """
    points = np.asarray(points_xy, dtype=np.float64)
    marks = _diagonals(np.hstack([points - _POINT_PX, points + _POINT_PX])).reshape(-1, 2, 2)
    # From the top down; along a row from the right, where names have room, so that those left of it go to the left.
    order = np.lexsort((-points[:, 0], np.rint(-points[:, 1] / _LINE_PX)))
    boxes: dict[int, np.ndarray] = {}
    placed = [(0.0, 0.0)] * len(points)
    for index in [int(index) for _ in range(_ROUNDS) for index in order]:
        boxes.pop(index, None)
        candidates = _candidates(widths[index])
        starts = points[index] + np.array(candidates) - (0, _LINE_PX / 2)
        choice = np.hstack([starts, starts + (widths[index], _LINE_PX)])
        others = np.array(list(boxes.values())).reshape(-1, 4)
        ends = points[list(boxes)]
        # What is drawn already, as lines: points and names as crosses, leaders as they are.
        drawn = np.concatenate([marks, *_lines(ends, others)])
        covered = ((points >= choice[:, None, :2] - 5) & (points <= choice[:, None, 2:] + 5)).all(axis=-1).sum(axis=1)
        overlaps = ((choice[:, None, :2] < others[:, 2:]) & (others[:, :2] < choice[:, None, 2:])).all(axis=-1)
        outside = (choice[:, :2] < bounds[:2]).any(axis=1) | (choice[:, 2:] > bounds[2:]).any(axis=1)
        crossings = crossing(_lines(points[index], choice)[:, :, None], drawn).sum(axis=(1, 2))
        far = np.array([abs(up) + (25 if right < 0 else 0) for right, up in candidates])
        cost = 3000 * outside + 1000 * overlaps.sum(axis=1) + 300 * covered + 100 * crossings + far
        placed[index] = candidates[int(cost.argmin())]
        boxes[index] = choice[int(cost.argmin())]
    return placed


def _candidates(width: float) -> list[tuple[float, float]]:
    """Where a name may start, relative to its point."""
    sides = (_BESIDE_PX, -_BESIDE_PX - width)
    return [(right, float(up)) for up in range(-150, 151, 15) for right in sides if up or right > 0]


def _lines(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(n, 3, 2, 2) what is drawn of names, as lines: leaders from points (n, 2), then boxes (n, 4) as crosses."""
    middles = (boxes[:, :2] + boxes[:, 2:]) / 2
    ways = middles - points
    starts = middles - ways * (1 - np.minimum(1, 2 * _POINT_PX / np.hypot(*ways.T)))[:, None]
    return np.concatenate([np.stack([starts, middles], axis=1)[:, None], _diagonals(boxes)], axis=1)


def _diagonals(boxes: np.ndarray) -> np.ndarray:
    """(n, 2, 2, 2) the two diagonals of boxes (n, 4): who crosses a box through its middle crosses one of them."""
    return boxes[:, [0, 1, 2, 3, 0, 3, 2, 1]].reshape(-1, 2, 2, 2)


def crossing(lines: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(...) whether two line segments cross; those that only touch do not.

    Args:
        lines: (..., 2, 2) ends.
        others: the same, broadcast against them.
    """

    def sides(line: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """On which side of a line both ends of another are: their signs differ where it is crossed."""
        along, to = line[..., 1, :] - line[..., 0, :], ends - line[..., :1, :]
        return np.sign(along[..., None, 0] * to[..., 1] - along[..., None, 1] * to[..., 0]).prod(axis=-1)

    return (sides(lines, others) < 0) & (sides(others, lines) < 0)
