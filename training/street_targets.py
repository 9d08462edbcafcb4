"""What the street models are asked to predict: grid rows, 1-D responses and composite fields made from labels.

Every encoding is the inverse of the decoding in ``labeling``: a test feeds the encoded truth to the decoders. All
coordinates are pixels of the network's input. Shape suffixes as in ``street_networks``.
"""

from dataclasses import dataclass

import numpy as np

from labeling.model_cards import DETECTOR_STRIDES
from labeling.schemas import KeypointSchema

LEVEL_LIMITS_PX = (0.0, 40.0, 88.0, np.inf)
"""Root of the box area from which each stride of the detector is responsible, input pixels."""
CENTRE_RADIUS = 0.501
"""Strides from an object's middle to the cells that are responsible for it: one cell, or both on whose border it lies.
With 1 or 1.5, up to nine, neighbours quarrel over whose object it is, and fewer people are found."""
_NEAR_SIGMA = 0.6
"""Strides: how near an object's middle a cell, not responsible for it, may take it for its own unpunished. Where a
middle lies on the border of two cells, which of them it is in is a toss."""
_NEAR_LEVEL = 0.2
"""Octaves of an object's size: as above, of the strides."""
_FIELD_WINDOW = 4
"""Cells along each side of the square that votes for a point: 16 votes of c / 16 make a whole one."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GridTargets:
    """A detector's targets in one picture."""

    classes: np.ndarray
    """(A,) int64: class of the object a cell is responsible for, -1 background, -2 - class on an object that does not
    count: nothing is said there of whether it is one, but of what it is."""
    boxes_xyxy: np.ndarray
    """(A, 4) float32; zero where there is no object."""
    weights: np.ndarray
    """(A,) float32 0 to 1: of each cell in the loss of whether there is an object. Near a middle less, as Law and Deng
    2018 (CornerNet) weigh theirs; 0 on what does not count."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FieldVotes:
    """The cells of one kind of field that have something to say; all others are empty."""

    places: np.ndarray
    """(P, 3) int64: field, row, column; each at most once."""
    values: np.ndarray
    """(P, 3 or 6) float32: offsets x, y in cells of the point or of both ends, then log scales in cells."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FieldTargets:
    """One schema's fields in one picture."""

    cif: FieldVotes
    caf: FieldVotes


def encode_boxes(
    boxes_xyxy: np.ndarray,
    classes: np.ndarray,
    counted: np.ndarray,
    *,
    width: int,
    height: int,
    radius: float = CENTRE_RADIUS,
    soften: bool = True,
) -> GridTargets:
    """Give each object the cell in its middle, on the stride that suits its size.

    Args:
        boxes_xyxy: (n, 4), inside the picture.
        classes: (n,) class indices.
        counted: (n,) bool; cells inside the box of an object that is not counted need not find it.
        width: of the picture, a multiple of 32.
        height: of the picture.
        radius: strides from the middle to the cells that are the object's.
        soften: let cells weigh less that are nearly responsible.
    """
    shapes = [(height // stride, width // stride) for stride in DETECTOR_STRIDES]
    found = [np.full(shape, -1, np.int64) for shape in shapes]
    boxes = [np.zeros((*shape, 4), np.float32) for shape in shapes]
    weights = [np.ones(shape, np.float32) for shape in shapes]
    for index in np.flatnonzero(~counted):
        for classes_at, weights_at, stride in zip(found, weights, DETECTOR_STRIDES, strict=True):
            covered = _cells_within(boxes_xyxy[index], stride)
            classes_at[covered], weights_at[covered] = -2 - classes[index], 0
    sizes = np.sqrt(np.prod(boxes_xyxy[:, 2:] - boxes_xyxy[:, :2], axis=1))
    if soften:
        for weights_at, stride, octaves in zip(weights, DETECTOR_STRIDES, _octaves_off(sizes), strict=True):
            for index in np.flatnonzero(counted & (octaves < 3 * _NEAR_LEVEL)):
                _soften(weights_at, boxes_xyxy[index], stride, octaves[index])
    # The smaller object takes a cell that two claim: the larger has others.
    for index in sorted(np.flatnonzero(counted), key=lambda i: -sizes[i]):
        box, level = boxes_xyxy[index], int(np.searchsorted(LEVEL_LIMITS_PX, sizes[index], side="right")) - 1
        stride = DETECTOR_STRIDES[level]
        centre, reach = np.tile((box[:2] + box[2:]) / 2, 2), radius * stride
        mine = _cells_within(centre + np.array([-reach, -reach, reach, reach]), stride)
        found[level][mine], boxes[level][mine], weights[level][mine] = classes[index], box, 1
    return GridTargets(
        classes=np.concatenate([level.ravel() for level in found]),
        boxes_xyxy=np.concatenate([level.reshape(-1, 4) for level in boxes]),
        weights=np.concatenate([level.ravel() for level in weights]),
    )


def _octaves_off(sizes: np.ndarray) -> np.ndarray:
    """(strides, n) how far boxes, by the roots of their areas (n,), are from those that each stride is responsible
    for."""
    lowest, highest = np.array(LEVEL_LIMITS_PX[:-1])[:, None], np.array(LEVEL_LIMITS_PX[1:])[:, None]
    return np.log2(np.maximum(1, np.maximum(lowest / sizes, sizes / highest)))


def _soften(weights: np.ndarray, box_xyxy: np.ndarray, stride: int, octaves: float) -> None:
    """Lower the weights (h, w) of a stride's cells around the middle of a box."""
    column, row = ((box_xyxy[:2] + box_xyxy[2:]) / 2 / stride - 0.5).tolist()
    left, top = max(0, round(column) - 2), max(0, round(row) - 2)
    patch = weights[top : round(row) + 3, left : round(column) + 3]
    y, x = np.arange(top, top + patch.shape[0])[:, None], np.arange(left, left + patch.shape[1])
    distance = ((x - column) ** 2 + (y - row) ** 2) / _NEAR_SIGMA**2 + (octaves / _NEAR_LEVEL) ** 2
    np.minimum(patch, (1 - np.exp(-distance / 2)) ** 2, out=patch)


def _cells_within(box_xyxy: np.ndarray, stride: int) -> tuple[slice, slice]:
    """Rows and columns of the cells whose middles lie inside a box, edges not counted."""
    first = np.maximum(np.floor(box_xyxy[:2] / stride - 0.5).astype(int) + 1, 0)
    end = np.maximum(np.ceil(box_xyxy[2:] / stride - 0.5).astype(int), 0)
    return slice(int(first[1]), int(end[1])), slice(int(first[0]), int(end[0]))


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
    shape = (rows, columns)
    edges = np.array(table.edges)
    cif, caf = [np.zeros((0, 7))], [np.zeros((0, 10))]
    for rank, (points, present, scales) in enumerate(objects):
        cells, log_scales = points / stride, np.log(np.maximum(scales / stride, 1e-3))
        cif.append(_point_votes(cells, present, log_scales))
        caf.append(_edge_votes(cells, edges[present[edges].all(axis=1)], edges, log_scales, rank))
    return FieldTargets(cif=_settle(np.concatenate(cif), shape), caf=_settle(np.concatenate(caf), shape))


def _point_votes(cells_xy: np.ndarray, present: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """(V, 7) votes of the cells around each point: cost, field, x, y, then offset x and y and log scale."""
    window = np.stack(np.meshgrid(np.arange(_FIELD_WINDOW), np.arange(_FIELD_WINDOW)), axis=2).reshape(-1, 2)
    chosen = np.flatnonzero(present)
    corners = np.floor(cells_xy[chosen] - (_FIELD_WINDOW / 2 - 1))
    places = corners[:, None] + window
    offsets = cells_xy[chosen, None] - places
    # Two objects' points share cells: each cell votes for the nearer.
    cost = np.hypot(*np.moveaxis(offsets, 2, 0))[..., None]
    names = np.broadcast_to(chosen[:, None, None], cost.shape)
    scale = np.broadcast_to(log_scales[chosen][:, None, None], cost.shape)
    return np.concatenate([cost, names, places, offsets, scale], axis=2).reshape(-1, 7)


def _edge_votes(
    cells_xy: np.ndarray, chosen: np.ndarray, edges: np.ndarray, log_scales: np.ndarray, rank: int
) -> np.ndarray:
    """(V, 10) votes of the cells along each edge: cost, field, x, y, then both ends' offsets and log scales."""
    if not len(chosen):
        return np.zeros((0, 10))
    start, end = cells_xy[chosen[:, 0]], cells_xy[chosen[:, 1]]
    steps = int(np.ceil(2 * np.hypot(*(end - start).T).max())) + 2
    line = start[:, None] + np.linspace(0, 1, steps)[:, None] * (end - start)[:, None]
    corners = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
    places = (np.floor(line)[:, :, None] + corners).reshape(len(chosen), -1, 2)
    index = {pair: field for field, pair in enumerate(map(tuple, edges.tolist()))}
    names = np.array([index[pair] for pair in map(tuple, chosen.tolist())], float)
    one = np.ones((*places.shape[:2], 1))
    ends = [start[:, None] - places, end[:, None] - places]
    scales = [one * log_scales[chosen[:, side]][:, None, None] for side in (0, 1)]
    return np.concatenate([-rank * one, names[:, None, None] * one, places, *ends, *scales], axis=2).reshape(-1, 10)


def _settle(votes: np.ndarray, shape: tuple[int, int]) -> FieldVotes:
    """The cheapest vote of every cell inside the fields."""
    rows, columns = shape
    field, x, y = votes[:, 1:4].astype(np.int64).T
    inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    votes, places = votes[inside], np.stack([field, y, x], axis=1)[inside]
    order = np.argsort(votes[:, 0], kind="stable")
    flat = np.ravel_multi_index(tuple(places[order].T), (int(field.max(initial=0)) + 1, rows, columns))
    first = order[np.unique(flat, return_index=True)[1]]
    return FieldVotes(places=places[first], values=votes[first, 4:].astype(np.float32))
