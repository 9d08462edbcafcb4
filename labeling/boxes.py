"""Boxes against boxes: left, top, right, bottom."""

import numpy as np


def iou(boxes_a: np.ndarray, boxes_b: np.ndarray) -> np.ndarray:
    """(N, M) intersection over union of (N, 4) and (M, 4) boxes, left top right bottom."""
    corner = np.maximum(boxes_a[:, None, :2], boxes_b[None, :, :2])
    sides = np.clip(np.minimum(boxes_a[:, None, 2:], boxes_b[None, :, 2:]) - corner, 0, None)
    shared = sides.prod(axis=2)
    area_a, area_b = ((boxes[:, 2:] - boxes[:, :2]).clip(0).prod(axis=1) for boxes in (boxes_a, boxes_b))
    return shared / np.maximum(area_a[:, None] + area_b[None] - shared, 1e-9)
