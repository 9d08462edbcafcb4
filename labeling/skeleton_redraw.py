"""A car that was read from a picture, drawn anew and compared: points move to where, or go unless, they explain it."""

import math
from collections.abc import Sequence

import numpy as np

from labeling.schemas import keypoint_schema
from labeling.skeleton_raster import Capsules, fill_capsules
from labeling.skeleton_video import dot_edges

_STEPS = np.arange(-3.0, 3.01, 0.75)
_ROUNDS = 2


def redrawn_points(
    parts: np.ndarray, places: dict[int, np.ndarray], unsure: Sequence[int], *, schema: str, radii: tuple[float, float]
) -> dict[int, np.ndarray]:
    """The points of one car, settled by drawing it.

    Args:
        parts: (H, W) int32, the edge whose hue a pixel of the picture has, or -1.
        places: where the points were read, (2,) each, pixels of the picture.
        unsure: those whose dots are painted over: they are moved, by up to 3 pixels.
        schema: car66 or car24.
        radii: of lines and dots.

    Returns:
        The points without which the drawing would be less like the picture.
    """
    car = _Car(schema, places, radii)
    for point in [*unsure] * _ROUNDS:
        car.move(parts, point)
    # A point explains at least half a dot of its own, or nothing tells it from a wrong one.
    least = math.pi * radii[1] ** 2 / 2
    for _ in range(_ROUNDS):
        idle = [point for point in car.present() if car.gain(parts, point) < least]
        if not idle:
            break
        car.shown[idle] = False
    return {point: car.places[point] for point in car.present()}


class _Car:
    """One car's points and the shapes that join them, coloured by the edge's number from 1."""

    def __init__(self, schema: str, places: dict[int, np.ndarray], radii: tuple[float, float]) -> None:
        table = keypoint_schema(schema)
        points = np.arange(table.point_count)
        edges = np.array(table.edges)
        self.places = np.zeros((table.point_count, 2))
        self.shown = np.zeros(table.point_count, bool)
        for point, place in places.items():
            self.places[point], self.shown[point] = place, True
        self._start, self._stop = np.concatenate([edges[:, 0], points]), np.concatenate([edges[:, 1], points])
        self._radii = np.repeat(radii, [len(edges), len(points)])
        numbers = np.concatenate([np.arange(len(edges)), dot_edges(schema)]) + 1
        self._colours = np.stack([numbers, 0 * numbers, 0 * numbers], axis=1).astype(np.uint8)
        self._reach = math.ceil(radii[1] + 2 * _STEPS[-1])

    def present(self) -> list[int]:
        """Points that are there, in order."""
        return np.flatnonzero(self.shown).tolist()

    def move(self, parts: np.ndarray, point: int) -> None:
        """Move a point to where the drawing around it agrees best with the picture."""
        first = self.places[point].copy()
        around = np.stack(np.meshgrid(_STEPS, _STEPS), axis=-1).reshape(-1, 2)
        left, top = np.maximum(np.rint(first).astype(int) - self._reach, 0).tolist()
        crop = parts[top : top + 2 * self._reach + 1, left : left + 2 * self._reach + 1]
        agreeing = np.empty(len(around))
        for i, step in enumerate(around):
            self.places[point] = first + step
            agreeing[i] = self._agreeing(crop, left, top)
        # Of equally good places the nearest to the first guess counts most.
        agreeing -= 0.1 * np.hypot(*around.T)
        self.places[point] = first + around[agreeing >= agreeing.max() - 0.5].mean(axis=0)

    def gain(self, parts: np.ndarray, point: int) -> int:
        """How many pixels agree with the picture only because the point and its lines are drawn."""
        places = self.places[self.shown]
        low = np.maximum(np.rint(places.min(axis=0)).astype(int) - self._reach, 0)
        high = np.maximum(np.rint(places.max(axis=0)).astype(int) + self._reach + 1, low)
        crop = parts[low[1] : high[1], low[0] : high[0]]
        whole = self._agreeing(crop, int(low[0]), int(low[1]))
        self.shown[point] = False
        without = self._agreeing(crop, int(low[0]), int(low[1]))
        self.shown[point] = True
        return whole - without

    def _agreeing(self, crop: np.ndarray, left: int, top: int) -> int:
        drawn = np.zeros((*crop.shape, 3), np.uint8)
        there = self.shown[self._start] & self.shown[self._stop]
        ends = np.concatenate([self.places[self._start[there]], self.places[self._stop[there]]], axis=1)
        shapes = Capsules(ends=ends - [left, top, left, top], radii=self._radii[there], colours=self._colours[there])
        fill_capsules(drawn, shapes)
        return int((drawn[..., 0] == crop + 1).sum())
