"""A textured card that moves over a textured wall and knows where its points are: a scene for what carries points."""

from collections.abc import Collection, Mapping

import cv2
import numpy as np

from labeling.labels import POINT_DETECTED, Keypoints

WIDTH, HEIGHT = 320, 224


def texture(seed: int, width: int, height: int) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2.0)


class MovingCard:
    """A textured card that slides and grows over a textured wall; it knows where its 24 points are in every frame."""

    carries = True
    sure_scores: Mapping[str, float] = {"car": 0.5}
    decided: Collection[str] = ()

    def __init__(
        self, *, speed: float = 2.0, growth: float = 0.0, cut: int | None = None, shown: range = range(999)
    ) -> None:
        self.speed, self.growth, self.cut, self.shown = speed, growth, cut, shown
        self.card, self.wall = texture(1, 96, 72), texture(2, WIDTH, HEIGHT)
        grid = np.stack(np.meshgrid(np.linspace(8, 88, 6), np.linspace(8, 64, 4)), axis=-1).reshape(-1, 2)
        self.grid = grid.astype(np.float64)
        self.seen: list[int] = []

    def place(self, frame: int) -> tuple[float, np.ndarray]:
        return np.exp(self.growth * frame), np.array([40 + self.speed * frame, 70.0])

    def truth(self, frame: int) -> np.ndarray:
        scale, shift = self.place(frame)
        return self.grid * scale + shift

    def render(self, frame: int) -> np.ndarray:
        picture = self.wall.copy() if self.cut is None or frame < self.cut else texture(9, WIDTH, HEIGHT)
        if frame in self.shown and (self.cut is None or frame < self.cut):
            scale, shift = self.place(frame)
            matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
            mask = cv2.warpAffine(np.ones(self.card.shape[:2], np.uint8), matrix, (WIDTH, HEIGHT))
            card = cv2.warpAffine(self.card, matrix, (WIDTH, HEIGHT))
            picture[mask > 0] = card[mask > 0]
        return picture

    def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
        self.seen.append(number)
        if number not in self.shown or (self.cut is not None and number >= self.cut):
            return []
        return [self.label(number)]

    def label(self, number: int) -> Keypoints:
        points = np.concatenate([self.truth(number), np.ones((24, 1))], axis=1).astype(np.float32)
        box = np.concatenate([points[:, :2].min(axis=0), points[:, :2].max(axis=0)])
        return Keypoints(
            frame=number, category="car", schema="car24", score=0.9, box_xyxy=box, points=points,
            point_source=np.full(24, POINT_DETECTED, np.int8),
        )  # fmt: skip
