"""General moving-shape videos: what the study's little video model is taught before it ever sees a street.

Half of them are scenes (ellipses, boxes, polygons that drift, grow and turn over a background that pans and zooms), the
rest drawings on black (thin coloured lines, dots, flat boxes). Video ``i`` is a pure function of (seed, i).
"""

from collections.abc import Callable

import cv2
import numpy as np

_SHARE_OF_SCENES = 0.55
_Shape = Callable[[np.ndarray, float, np.ndarray], None]


def shape_video(seed: int, index: int, *, frames: int, width: int, height: int) -> np.ndarray:
    """Video ``index``: (frames, height, width, 3) uint8 RGB."""
    rng = np.random.default_rng([seed, index])
    scene = rng.random() < _SHARE_OF_SCENES
    backgrounds = _background(rng, frames, width, height) if scene else None
    video = np.zeros((frames, height, width, 3), np.uint8) if backgrounds is None else backgrounds
    zoom = rng.normal(0.0, 0.03) if rng.random() < 0.7 else 0.0
    pan = rng.normal(0.0, 1.0, 2) * (rng.random() < 0.7)
    middle = np.array([width / 2, height * rng.uniform(0.3, 0.7)])
    for _ in range(rng.integers(3, 12)):
        shape = _scene_shape(rng, height) if scene else _drawn_shape(rng, height)
        place = rng.uniform((-0.1 * width, 0), (1.1 * width, height))
        drift = pan + rng.normal(0.0, 0.8, 2) * (rng.random() < 0.6)
        for t, frame in enumerate(video):
            scale = float(np.exp(zoom * t))
            shape(frame, scale, middle + (place - middle) * scale + drift * t)
    return video


def _background(rng: np.random.Generator, frames: int, width: int, height: int) -> np.ndarray:
    """A texture larger than the picture, seen through a window that pans and zooms."""
    sides = (2 * width, 2 * height)
    top, bottom = rng.uniform(20, 235, (2, 1, 1, 3))
    shade = np.linspace(0, 1, sides[1])[:, None, None] ** rng.uniform(0.4, 2.5)
    texture = np.broadcast_to(top + (bottom - top) * shade, (sides[1], sides[0], 3)).astype(np.float32)
    for cells, most in ((5, 25), (12, 20), (30, 8)):
        rough = rng.normal(0, rng.uniform(0, most), (cells, 2 * cells, 3 if rng.random() < 0.5 else 1)).astype(
            np.float32
        )
        layer = cv2.resize(rough, sides, interpolation=cv2.INTER_LINEAR)
        texture = texture + (layer if layer.ndim == 3 else layer[..., None])
    if rng.random() < 0.5:
        texture = texture + _stripes(rng, sides)
    texture = np.clip(texture, 0, 255).astype(np.uint8)
    zoom, angle, drift = rng.normal(0, 0.015), rng.normal(0, 0.003), rng.normal(0, 1.0, 2)
    seen = []
    for t in range(frames):
        scale, turn = float(np.exp(zoom * t)), angle * t
        linear = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        shift = np.array([width / 2, height / 2]) + drift * t - linear @ np.array([sides[0] / 2, sides[1] / 2])
        matrix = np.column_stack([linear, shift])
        seen.append(cv2.warpAffine(texture, matrix, (width, height), borderMode=cv2.BORDER_REFLECT))
    return np.stack(seen)


def _stripes(rng: np.random.Generator, sides: tuple[int, int]) -> np.ndarray:
    """Stripes or checks of a random direction over half of the texture."""
    x, y = np.meshgrid(np.arange(sides[0]), np.arange(sides[1]))
    angle, period = rng.uniform(0, np.pi), rng.uniform(6, 40)
    wave = np.sin(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period) > 0
    if rng.random() < 0.5:
        wave ^= np.sin(2 * np.pi * (y * np.cos(angle) - x * np.sin(angle)) / period) > 0
    part = y > rng.uniform(0, sides[1])
    return (wave & part)[..., None] * rng.normal(0, 40, 3)


def _scene_shape(rng: np.random.Generator, height: int) -> _Shape:
    """A filled shape with one piece of detail."""
    size = height * float(np.exp(rng.uniform(np.log(0.04), np.log(0.45))))
    outline = _outline(rng) * size
    detail = _outline(rng) * size * rng.uniform(0.2, 0.6) + rng.uniform(-0.3, 0.3, 2) * size
    colours = rng.integers(0, 256, (2, 3)).tolist()

    def draw(frame: np.ndarray, scale: float, place: np.ndarray) -> None:
        _fill(frame, place + outline * scale, colours[0])
        _fill(frame, place + detail * scale, colours[1])

    return draw


def _drawn_shape(rng: np.random.Generator, height: int) -> _Shape:
    """A line figure with dots, or a flat shape, in pure colours."""
    size = height * float(np.exp(rng.uniform(np.log(0.06), np.log(0.6))))
    if rng.random() < 0.35:
        outline, colour = _outline(rng) * size, _vivid(rng)
        return lambda frame, scale, place: _fill(frame, place + outline * scale, colour)
    points = rng.uniform(-1, 1, (int(rng.integers(2, 9)), 2)) * size * rng.uniform(0.2, 1, 2)
    colours = [_vivid(rng) for _ in points] if rng.random() < 0.7 else [[255, 255, 255]] * len(points)
    pairs = rng.integers(0, len(points), (len(points) + 2, 2)).tolist()

    def draw(frame: np.ndarray, scale: float, place: np.ndarray) -> None:
        spots = np.rint(place + points * scale).astype(int).tolist()
        for number, (a, b) in enumerate(pairs):
            cv2.line(frame, spots[a], spots[b], colours[number % len(colours)], 1)
        for spot, colour in zip(spots, colours, strict=True):
            cv2.circle(frame, spot, 1, colour, -1)

    return draw


def _outline(rng: np.random.Generator) -> np.ndarray:
    """(P, 2) corners around the origin: an ellipse, a box or a polygon."""
    kind, stretch = rng.integers(0, 3), rng.uniform(0.4, 1.0, 2)
    count = (16, 4, int(rng.integers(3, 8)))[kind]
    angles = np.arange(count) * 2 * np.pi / count + (np.pi / 4 if kind == 1 else 0.0)
    radius = rng.uniform(0.5, 1.0, count) if kind == 2 else np.ones(count)
    turn = rng.uniform(0, np.pi) if rng.random() < 0.4 else 0.0
    corners = np.column_stack([np.cos(angles), np.sin(angles)]) * radius[:, None] * stretch
    return corners @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])


def _vivid(rng: np.random.Generator) -> list[int]:
    hue = np.array([[[rng.integers(0, 180), 255, 255]]], np.uint8)
    return cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0].tolist()


def _fill(frame: np.ndarray, corners: np.ndarray, colour: list[int]) -> None:
    # Four fractional bits, so that slow shapes move by less than a pixel.
    bounded = np.clip(corners, -4 * max(frame.shape), 5 * max(frame.shape))
    cv2.fillPoly(frame, [np.rint(bounded * 16).astype(np.int32)], colour, lineType=cv2.LINE_AA, shift=4)
