"""Boxes against boxes: left, top, right, bottom."""

import numpy as np


def iou(boxes_a: np.ndarray, boxes_b: np.ndarray) -> np.ndarray:
    """(N, M) intersection over union of (N, 4) and (M, 4) boxes, left top right bottom."""
    shared = _shared(boxes_a, boxes_b)
    return shared / np.maximum(_areas(boxes_a)[:, None] + _areas(boxes_b)[None] - shared, 1e-9)


def inside(boxes_a: np.ndarray, boxes_b: np.ndarray) -> np.ndarray:
    """(N, M) share of each of the (M, 4) boxes that each of the (N, 4) covers."""
    return _shared(boxes_a, boxes_b) / np.maximum(_areas(boxes_b)[None], 1e-9)


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
