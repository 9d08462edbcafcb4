"""Fields for tests and benchmarks: random ones, and planted ones with objects whose points are known."""

from dataclasses import dataclass

import numpy as np

from labeling.schemas import keypoint_schema


@dataclass(frozen=True, slots=True, kw_only=True)
class PlantedFields:
    """Fields that a perfect network would give for known objects."""

    cif: np.ndarray
    """(K, 5, h, w) float32."""
    caf: np.ndarray
    """(E, 8, h, w) float32."""
    objects: np.ndarray
    """(M, K, 3) float64: x, y in input pixels, 1 if visible."""


def random_fields(
    seed: int, *, schema: str, height: int, width: int, share: float = 0.3
) -> tuple[np.ndarray, np.ndarray]:
    """Fields of noise in which a ``share`` of the cells is confident."""
    rng = np.random.default_rng(seed)
    table = keypoint_schema(schema)
    cif = rng.normal(size=(table.point_count, 5, height, width))
    caf = rng.normal(size=(len(table.edges), 8, height, width))
    rows, columns = np.mgrid[:height, :width]
    for field in (cif, caf):
        field[:, 1] = np.where(rng.random(field[:, 1].shape) < share, rng.uniform(0.3, 1, field[:, 1].shape), 0.1)
    cif[:, 4] = rng.uniform(0.2, 6, cif[:, 4].shape)
    caf[:, 6:] = rng.uniform(0.2, 6, caf[:, 6:].shape)
    for field, first in ((cif, 2), (caf, 2), (caf, 4)):
        field[:, first] = 0.7 * field[:, first] + columns
        field[:, first + 1] = 0.7 * field[:, first + 1] + rows
    return cif.astype(np.float32), caf.astype(np.float32)


def car_objects(rng: np.random.Generator, count: int, *, schema: str, width: int, height: int) -> np.ndarray:
    """(M, K, 3) cars as affine images of one made-up car, some points hidden, some cars overlapping."""
    table = keypoint_schema(schema)
    template = rng.uniform(-0.5, 0.5, (table.point_count, 2))
    objects = np.zeros((count, table.point_count, 3))
    for n in range(count):
        size = rng.uniform(60, 260) * np.array([1.0, 0.6])
        centre = np.array([rng.uniform(0.1, 0.9) * width, rng.uniform(0.35, 0.85) * height])
        objects[n, :, :2] = centre + template * size
        objects[n, :, 2] = rng.random(table.point_count) < 0.8
    inside = (
        (objects[:, :, 0] >= 0) & (objects[:, :, 0] < width) & (objects[:, :, 1] >= 0) & (objects[:, :, 1] < height)
    )
    objects[:, :, 2] *= inside
    return objects


def lane_objects(count: int, *, width: int, height: int) -> np.ndarray:
    """(M, 24, 3) lane lines that run from the bottom towards one vanishing point."""
    share = np.linspace(0, 0.9, 24)[:, None]
    vanishing = np.array([width / 2, height * 0.45])
    feet = np.stack([np.linspace(0.05, 0.95, count) * width, np.full(count, height - 4.0)], axis=1)
    lines = feet[:, None] + share * (vanishing - feet[:, None])
    return np.concatenate([lines, np.ones((count, 24, 1))], axis=2)


def plant(
    objects: np.ndarray, scales: np.ndarray, *, schema: str, height: int, width: int, stride: int = 8, seed: int = 0
) -> PlantedFields:
    """Fields of ``height`` x ``width`` cells: 3x3 CIF cells around each visible point, 3x3 CAF cells at the middle of
    each edge whose ends are both visible, with noise; later objects cover earlier ones.

    Args:
        objects: (M, K, 3).
        scales: (M,) in cells.
    """
    rng = np.random.default_rng(seed)
    table = keypoint_schema(schema)
    cif = np.zeros((table.point_count, 5, height, width), np.float32)
    caf = np.zeros((len(table.edges), 8, height, width), np.float32)
    cif[:, 1], caf[:, 1] = rng.uniform(0, 0.05, cif[:, 1].shape), rng.uniform(0, 0.05, caf[:, 1].shape)
    for points, scale in zip(objects, scales, strict=True):
        cells = points[:, :2] / stride
        for k in np.flatnonzero(points[:, 2]):
            for i, j in _around(cells[k], height, width):
                cif[k, 1:, i, j] = rng.uniform(0.75, 0.95), *(cells[k] + rng.normal(0, 0.03, 2)), scale
        for e, (a, b) in enumerate(table.edges):
            if points[a, 2] and points[b, 2]:
                for i, j in _around((cells[a] + cells[b]) / 2, height, width):
                    ends = np.concatenate([cells[a], cells[b]]) + rng.normal(0, 0.05, 4)
                    caf[e, 1:, i, j] = rng.uniform(0.75, 0.95), *ends, scale, scale
    return PlantedFields(cif=cif, caf=caf, objects=objects)


def _around(cell: np.ndarray, height: int, width: int) -> list[tuple[int, int]]:
    column, row = round(float(cell[0])), round(float(cell[1]))
    return [
        (i, j)
        for i in range(max(row - 1, 0), min(row + 2, height))
        for j in range(max(column - 1, 0), min(column + 2, width))
    ]
