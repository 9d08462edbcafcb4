"""CIF/CAF decoding as plainly as it can be said: every map value a sum over all cells, every connection tried.

The yardstick for ``labeling.fields``; a hundred times slower. Lengths are input pixels.
"""

import math

import numpy as np

from labeling.model_cards import FieldHeadCard
from labeling.schemas import keypoint_schema


class PlainDecoder:
    """The reference; same arguments and results as ``FieldDecoder``."""

    def __init__(self, head: FieldHeadCard, *, stride: int) -> None:
        self.head, self.stride = head, stride
        self.table = keypoint_schema(head.schema_name)

    def decode(self, cif: np.ndarray, caf: np.ndarray) -> list[tuple[np.ndarray, float]]:
        self.cells = [self._cells(field) for field in cif]
        self.links = {}
        for e, (a, b) in enumerate(self.table.edges):
            self.links[a, b, e] = self._links(caf[e], backwards=False, target=b)
            self.links[b, a, e] = self._links(caf[e], backwards=True, target=a)
        seeds = [
            (0.9 * self.map_value(k, x, y) + 0.1 * confidence, k, x, y, scale)
            for k, cells in enumerate(self.cells)
            for confidence, x, y, scale in cells
        ]
        objects: list[np.ndarray] = []
        for score, k, x, y, scale in sorted(seeds, key=lambda seed: -seed[0]):
            if score < self.head.seed_threshold or len(objects) == self.head.max_objects:
                break
            if not self._covered(objects, k, x, y):
                objects.append(self._grow(k, x, y, scale, score))
        return self._finish(objects)

    def map_value(self, k: int, x: float, y: float) -> float:
        confidence, cell_x, cell_y, scale = self.cells[k].T
        sigma = np.maximum(1.0, 0.5 * scale)
        squared = (cell_x - x) ** 2 + (cell_y - y) ** 2
        heights = confidence / 16 * np.exp(-0.5 * squared / sigma**2)
        return min(1.0, float(heights[squared <= sigma**2].sum()))

    def _cells(self, field: np.ndarray) -> np.ndarray:
        strong = field[1] >= np.float32(self.head.map_threshold)
        values = field[1:, strong].T.astype(np.float64)
        return values * [1, self.stride, self.stride, self.stride]

    def _links(self, field: np.ndarray, *, backwards: bool, target: int) -> np.ndarray:
        """(n, 6): score, source x, y, target x, y, target scale."""
        strong = field[1] >= np.float32(self.head.connection_threshold)
        confidence, x1, y1, x2, y2, s1, s2 = field[1:, strong].astype(np.float64)
        rows = (x2, y2, x1, y1, s1) if backwards else (x1, y1, x2, y2, s2)
        source_x, source_y, target_x, target_y, scale = (row * self.stride for row in rows)
        known = [self.map_value(target, x, y) for x, y in zip(target_x, target_y, strict=True)]
        score = confidence * (0.1 + 0.9 * np.array(known))
        return np.stack([score, source_x, source_y, target_x, target_y, scale], axis=1)

    def _connect(self, links: np.ndarray, x: float, y: float, scale: float) -> tuple[float, float, float, float] | None:
        squared = (links[:, 1] - x) ** 2 + (links[:, 2] - y) ** 2
        near = squared <= (2 * scale) ** 2
        links, weights = links[near], np.exp(-0.5 * squared[near] / (0.5 * scale) ** 2)
        scores = weights * links[:, 0]
        if not len(scores) or scores.max() <= 0:
            return None
        best, *rest = np.argsort(-scores, kind="stable")[:2]
        first = links[best, 3:]
        if rest and scores[rest[0]] >= 0.5 * scores[best]:
            other = links[rest[0], 3:]
            if math.dist(first[:2], other[:2]) <= max(first[2], 4.0):
                pair = scores[[best, rest[0]]]
                x, y, scale = pair @ np.stack([first, other]) / pair.sum()
                return x, y, scale, float(pair.mean())
        return first[0], first[1], first[2], 0.5 * float(scores[best])

    def _grow(self, k: int, x: float, y: float, scale: float, score: float) -> np.ndarray:
        points = np.zeros((self.table.point_count, 4))
        points[k] = x, y, scale, score
        while True:
            proposals = [
                (*found, target)
                for (source, target, e) in self.links
                if points[source, 3] > 0 and points[target, 3] == 0
                if (found := self._propose(points[source], source, target, e)) is not None
            ]
            if not proposals:
                return points
            *found, target = max(proposals, key=lambda proposal: proposal[3])
            points[target] = found

    def _propose(
        self, origin: np.ndarray, source: int, target: int, e: int
    ) -> tuple[float, float, float, float] | None:
        x, y, scale, score = origin
        found = self._connect(self.links[source, target, e], x, y, max(scale, 4.0))
        if found is None:
            return None
        new_score = math.sqrt(found[3] * score)
        if new_score < self.head.growth_threshold or new_score < self.head.relative_threshold * score:
            return None
        back = self._connect(self.links[target, source, e], found[0], found[1], max(found[2], 4.0))
        if back is None or math.dist(back[:2], (x, y)) > max(scale, 4.0):
            return None
        return found[0], found[1], found[2], new_score

    def _covered(self, objects: list[np.ndarray], k: int, x: float, y: float) -> bool:
        others = [points[k] for points in objects if points[k, 3] > 0]
        return any(
            abs(other[0] - x) < max(other[2], 4.0) and abs(other[1] - y) < max(other[2], 4.0) for other in others
        )

    def _score(self, points: np.ndarray) -> float:
        ordered = sorted(points[:, 3], reverse=True)
        return (3 * sum(ordered[:3]) + sum(ordered[3:])) / (9 + len(ordered) - 3)

    def _finish(self, objects: list[np.ndarray]) -> list[tuple[np.ndarray, float]]:
        objects = sorted(objects, key=lambda points: -self._score(points))
        for n, points in enumerate(objects):
            for k in range(len(points)):
                if points[k, 3] > 0 and self._covered(objects[:n], k, points[k, 0], points[k, 1]):
                    points[k, 3] = 0
        for points in objects:
            points[points[:, 3] < self.head.point_threshold] = 0
        kept = [points for points in objects if self._score(points) >= self.head.instance_threshold]
        kept = [points for points in kept if self._largest_piece(points[:, 3] > 0) >= self.head.min_points]
        kept.sort(key=lambda points: -self._score(points))
        return [(points[:, [0, 1, 3]], self._score(points)) for points in kept]

    def _largest_piece(self, present: np.ndarray) -> int:
        left, largest = set(np.flatnonzero(present).tolist()), 0
        while left:
            reached, front = set(), {left.pop()}
            while front:
                k = front.pop()
                reached.add(k)
                touching = {b if a == k else a for a, b in self.table.edges if k in (a, b)}
                front |= touching & left
                left -= touching
            largest = max(largest, len(reached))
        return largest
