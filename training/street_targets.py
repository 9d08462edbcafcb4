"""What the street models are asked to predict: grid rows, 1-D responses and composite fields made from labels.

Every encoding is the inverse of the decoding in ``labeling``: a test feeds the encoded truth to the decoders. All
coordinates are pixels of the network's input. Shape suffixes as in ``street_networks``.
"""

from dataclasses import dataclass

import numpy as np

from labeling.schemas import KeypointSchema
from training.street_networks import DETECTOR_STRIDES

LEVEL_LIMITS_PX = (0.0, 40.0, 88.0, np.inf)
"""Root of the box area from which each stride of the detector is responsible, input pixels."""
_CENTRE_RADIUS = 1.0
_FIELD_WINDOW = 4
"""Cells along each side of the square that votes for a point: 16 votes of c / 16 make a whole one."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GridTargets:
    """A detector's targets in one picture."""

    classes: np.ndarray
    """(A,) int64: class of the object a cell is responsible for, -1 background, -2 not counted in the loss."""
    boxes_xyxy: np.ndarray
    """(A, 4) float32; zero where there is no object."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FieldTargets:
    """One schema's fields in one picture."""

    cif: np.ndarray
    """(K, 4, h, w) float32: confidence (-1 not counted), x and y offset in cells, log scale in cells."""
    caf: np.ndarray
    """(E, 7, h, w) float32: confidence (-1 not counted), both ends' offsets, both log scales."""


def grid_cells(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Column and row (A, 2) and stride (A,) of every cell, both float32, in the order of the network's output."""
    cells, strides = [], []
    for stride in DETECTOR_STRIDES:
        columns, rows = np.meshgrid(np.arange(width // stride), np.arange(height // stride))
        cells.append(np.stack([columns, rows], axis=2).reshape(-1, 2))
        strides.append(np.full(columns.size, stride))
    return np.concatenate(cells).astype(np.float32), np.concatenate(strides).astype(np.float32)


def encode_boxes(
    boxes_xyxy: np.ndarray, classes: np.ndarray, counted: np.ndarray, *, width: int, height: int
) -> GridTargets:
    """Give each object the cells around its centre, on the stride that suits its size.

    Args:
        boxes_xyxy: (n, 4), inside the picture.
        classes: (n,) class indices.
        counted: (n,) bool; cells inside the box of an object that is not counted are left out of the loss.
        width: of the picture, a multiple of 32.
        height: of the picture.
    """
    cells, strides = grid_cells(width, height)
    centres = (cells + 0.5) * strides[:, None]
    found = np.full(len(cells), -1, np.int64)
    boxes = np.zeros((len(cells), 4), np.float32)
    for box in boxes_xyxy[~counted]:
        found[((centres > box[:2]) & (centres < box[2:])).all(axis=1)] = -2
    sizes = np.sqrt(np.prod(boxes_xyxy[:, 2:] - boxes_xyxy[:, :2], axis=1))
    # The smaller object takes a cell that two claim: the larger has others.
    for index in sorted(np.flatnonzero(counted), key=lambda i: -sizes[i]):
        box, level = boxes_xyxy[index], int(np.searchsorted(LEVEL_LIMITS_PX, sizes[index], side="right")) - 1
        stride = DETECTOR_STRIDES[level]
        off = np.abs(centres - (box[:2] + box[2:]) / 2) / stride
        mine = (strides == stride) & (off.max(axis=1) < _CENTRE_RADIUS)
        mine |= (strides == stride) & (off.max(axis=1) == off[strides == stride].max(axis=1).min())
        found[mine], boxes[mine] = classes[index], box
    return GridTargets(classes=found, boxes_xyxy=boxes)


def encode_responses(points_xy: np.ndarray, size: tuple[int, int], *, split: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Gaussian responses of a SimCC head, each row summing to 1.

    Args:
        points_xy: (..., K, 2) input pixels; points outside are cut to the border.
        size: width and height of the crop.
        split: bins per pixel.

    Returns:
        (..., K, split * width) and (..., K, split * height) float32.
    """
    responses = []
    for axis in (0, 1):
        bins = np.arange(split * size[axis], dtype=np.float32)
        centres = np.clip(points_xy[..., axis, None] * split, 0, bins[-1])
        # A fortieth of the side: neighbouring bins are nearly as right.
        weights = np.exp(-0.5 * ((bins - centres) / (split * size[axis] / 40)) ** 2)
        responses.append((weights / weights.sum(axis=-1, keepdims=True)).astype(np.float32))
    return responses[0], responses[1]


def encode_fields(
    objects: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
    table: KeypointSchema,
    *,
    columns: int,
    rows: int,
    stride: int,
) -> FieldTargets:
    """Composite fields of one picture.

    Args:
        objects: per object, far ones first: points (K, 2) in input pixels, (K,) bool those that are there, and (K,)
            scale of each point in pixels.
        table: the schema.
        columns: w.
        rows: h.
        stride: input pixels per cell; cell i lies at pixel i * stride.
    """
    cif = np.zeros((table.point_count, 4, rows, columns), np.float32)
    caf = np.zeros((len(table.edges), 7, rows, columns), np.float32)
    nearest = np.full((table.point_count, rows, columns), np.inf, np.float32)
    for points, present, scales in objects:
        cells, log_scales = points / stride, np.log(np.maximum(scales / stride, 1e-3))
        for k in np.flatnonzero(present):
            _vote_point(cif[k], nearest[k], cells[k], log_scales[k])
        for e, (a, b) in enumerate(table.edges):
            if present[a] and present[b]:
                _vote_edge(caf[e], cells[a], cells[b], (log_scales[a], log_scales[b]))
    return FieldTargets(cif=cif, caf=caf)


def _vote_point(field: np.ndarray, nearest: np.ndarray, cell_xy: np.ndarray, log_scale: float) -> None:
    rows, columns = nearest.shape
    left, top = (int(value) for value in np.floor(cell_xy - (_FIELD_WINDOW / 2 - 1)))
    bottom, right = min(top + _FIELD_WINDOW, rows), min(left + _FIELD_WINDOW, columns)
    window = (slice(max(top, 0), bottom), slice(max(left, 0), right))
    if bottom <= 0 or right <= 0 or not nearest[window].size:
        return
    y, x = np.mgrid[window]
    off_x, off_y = cell_xy[0] - x, cell_xy[1] - y
    distance = np.hypot(off_x, off_y)
    # Two objects' points share cells: each cell votes for the nearer.
    wins = distance < nearest[window]
    values = np.stack([np.ones_like(off_x), off_x, off_y, np.full_like(off_x, log_scale)])
    field[(slice(None), *window)] = np.where(wins, values, field[(slice(None), *window)])
    nearest[window] = np.minimum(nearest[window], distance)


def _vote_edge(field: np.ndarray, a: np.ndarray, b: np.ndarray, log_scales: tuple[float, float]) -> None:
    rows, columns = field.shape[1:]
    steps = max(2, int(np.ceil(2 * np.hypot(*(b - a)))) + 1)
    line = a + np.linspace(0, 1, steps)[:, None] * (b - a)
    corners = np.floor(line).astype(int)
    cells = np.unique(np.concatenate([corners + shift for shift in ((0, 0), (1, 0), (0, 1), (1, 1))]), axis=0)
    cells = cells[((cells >= 0) & (cells < (columns, rows))).all(axis=1)]
    x, y = cells.T
    field[0, y, x] = 1
    field[1:3, y, x] = (a - cells).T
    field[3:5, y, x] = (b - cells).T
    field[5, y, x], field[6, y, x] = log_scales
