"""A car that was read from a picture, drawn anew and compared: points move to where, or go unless, they explain it."""

import math
from collections.abc import Sequence

import numpy as np

from labeling.schemas import keypoint_schema
from labeling.skeleton_evidence import matching_pixels
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


def redrawn_parts(
    shape: tuple[int, int], places: dict[int, np.ndarray], *, schema: str, radii: tuple[float, float]
) -> np.ndarray:
    """(H, W) int32 edge numbers of one car's drawing, -1 where it draws nothing.

    Args:
        shape: H, W.
        places: its points, (2,) each, pixels of the picture.
        schema: car66 or car24.
        radii: of lines and dots.
    """
    return _Car(schema, places, radii).drawn(shape)


class _Car:
    """One car's points and the shapes that join them."""

    def __init__(self, schema: str, places: dict[int, np.ndarray], radii: tuple[float, float]) -> None:
        table = keypoint_schema(schema)
        points = np.arange(table.point_count)
        edges = np.array(table.edges)
        self.places = np.zeros((table.point_count, 2))
        self.shown = np.zeros(table.point_count, bool)
        for point, place in places.items():
            self.places[point], self.shown[point] = place, True
        self._ends = np.concatenate([edges, np.stack([points, points], axis=1)])
        self._radii = np.repeat(radii, [len(edges), len(points)])
        self._numbers = np.concatenate([np.arange(len(edges)), dot_edges(schema)])
        self._reach = math.ceil(radii[1] + 2 * _STEPS[-1])

    def present(self) -> list[int]:
        """Points that are there, in order."""
        return np.flatnonzero(self.shown).tolist()

    def drawn(self, shape: tuple[int, int]) -> np.ndarray:
        """(H, W) int32 edge numbers of the whole drawing, or -1."""
        there = self.shown[self._ends].all(axis=1)
        # Edges and points fit a byte, and 0 is left for the ground.
        numbers = (self._numbers[there] + 1).astype(np.uint8)
        picture = np.zeros((*shape, 3), np.uint8)
        ends = self.places[self._ends[there]].reshape(-1, 4)
        fill_capsules(
            picture, Capsules(ends=ends, radii=self._radii[there], colours=np.repeat(numbers, 3).reshape(-1, 3))
        )
        return picture[..., 0].astype(np.int32) - 1

    def move(self, parts: np.ndarray, point: int) -> None:
        """Move a point to where the drawing around it agrees best with the picture."""
        first = self.places[point].copy()
        around = np.stack(np.meshgrid(_STEPS, _STEPS), axis=-1).reshape(-1, 2)
        corner = np.maximum(np.rint(first).astype(int) - self._reach, 0)
        agreeing = self._matching(parts, corner, corner + 2 * self._reach + 1, around, point).astype(np.float64)
        # Of equally good places the nearest to the first guess counts most.
        agreeing -= 0.1 * np.hypot(*around.T)
        self.places[point] = first + around[agreeing >= agreeing.max() - 0.5].mean(axis=0)

    def gain(self, parts: np.ndarray, point: int) -> int:
        """How many pixels agree with the picture only because the point and its lines are drawn."""
        # Nothing changes beyond the point's own lines.
        joined = self._ends[(self._ends == point).any(axis=1)].ravel()
        places = self.places[joined[self.shown[joined]]]
        low = np.maximum(np.rint(places.min(axis=0)).astype(int) - self._reach, 0)
        high = np.maximum(np.rint(places.max(axis=0)).astype(int) + self._reach + 1, low)
        still = np.zeros((1, 2))
        (whole,) = self._matching(parts, low, high, still, point)
        self.shown[point] = False
        (without,) = self._matching(parts, low, high, still, point)
        self.shown[point] = True
        return int(whole - without)

    def _matching(
        self, parts: np.ndarray, low: np.ndarray, high: np.ndarray, steps: np.ndarray, point: int
    ) -> np.ndarray:
        """(S,) pixels of ``[low, high)`` that the drawing gets right with the point moved by each step."""
        crop = parts[low[1] : high[1], low[0] : high[0]]
        places = self.places[self._ends]
        near = self.shown[self._ends].all(axis=1)
        near &= (places.min(axis=1) < high + self._reach).all(axis=1)
        near &= (places.max(axis=1) > low - self._reach).all(axis=1)
        return matching_pixels(
            crop, low.astype(np.float64), places[near].reshape(-1, 4), self._radii[near], self._numbers[near], steps,
            self._ends[near] == point,
        )  # fmt: skip
