"""Boxes against boxes: left, top, right, bottom."""

import numpy as np
from scipy.optimize import linear_sum_assignment


def iou(boxes_a: np.ndarray, boxes_b: np.ndarray) -> np.ndarray:
    """(N, M) intersection over union of (N, 4) and (M, 4) boxes, left top right bottom."""
    shared = _shared(boxes_a, boxes_b)
    return shared / np.maximum(_areas(boxes_a)[:, None] + _areas(boxes_b)[None] - shared, 1e-9)


def inside(boxes_a: np.ndarray, boxes_b: np.ndarray) -> np.ndarray:
    """(N, M) share of each of the (M, 4) boxes that each of the (N, 4) covers."""
    return _shared(boxes_a, boxes_b) / np.maximum(_areas(boxes_b)[None], 1e-9)


def best_pairs(boxes_a: np.ndarray, boxes_b: np.ndarray, *, least_iou: float) -> list[tuple[int, int, float]]:
    """One-to-one pairs of largest summed overlap (Kuhn 1955), those that overlap too little never made.

    Args:
        boxes_a: (N, 4), left top right bottom.
        boxes_b: (M, 4).
        least_iou: of two boxes that may be one object.

    Returns:
        Row of ``boxes_a``, row of ``boxes_b`` and their overlap, rows of ``boxes_a`` rising.
    """
    overlaps = iou(boxes_a, boxes_b)
    # A pair too far apart is worth nothing, so that it never keeps a true pair from being made.
    worth = np.where(overlaps >= least_iou, overlaps, 0.0)
    pairs = zip(*linear_sum_assignment(worth, maximize=True), strict=True)
    return [(int(row), int(column), float(worth[row, column])) for row, column in pairs if worth[row, column] > 0]


def _shared(boxes_a: np.ndarray, boxes_b: np.ndarray) -> np.ndarray:
    # Side by side and not as (N, M, 2): reducing an axis of two takes longer than all the rest.
    width, height = (
        np.minimum(boxes_a[:, None, axis + 2], boxes_b[None, :, axis + 2])
        - np.maximum(boxes_a[:, None, axis], boxes_b[None, :, axis])
        for axis in (0, 1)
    )
    return np.maximum(width, 0) * np.maximum(height, 0)


def _areas(boxes: np.ndarray) -> np.ndarray:
    return (boxes[:, 2:] - boxes[:, :2]).clip(0).prod(axis=1)
