"""The synthetic street's textures, painted by rule: asphalt, pavement, grass, facades, shop fronts, sky.

They do not depend on a street's seed (buildings differ by tint and choice), so that one process paints them once.
"""

import functools
from typing import Literal

import cv2
import numpy as np

from dataset.street_polygons import Atlas, pack_rgb

TextureName = Literal[
    "asphalt",
    "pavement",
    "grass",
    "sky",
    "plaster",
    "brick",
    "concrete",
    "stucco",
    "shop",
    "shutters",
    "wall",
    "leaves",
]
TEXTURES: tuple[TextureName, ...] = (
    "asphalt", "pavement", "grass", "sky", "plaster", "brick", "concrete", "stucco", "shop", "shutters", "wall",
    "leaves",
)  # fmt: skip
FACADES: tuple[TextureName, ...] = ("plaster", "brick", "concrete", "stucco")
GROUND_FLOORS: tuple[TextureName, ...] = ("shop", "shutters")

TEXTURE_METRES: dict[TextureName, tuple[float, float]] = {
    "asphalt": (8.0, 8.0), "pavement": (4.0, 4.0), "grass": (8.0, 8.0), "sky": (0.0, 0.0),
    "plaster": (12.8, 12.8), "brick": (12.8, 12.8), "concrete": (12.8, 12.8), "stucco": (12.8, 12.8),
    "shop": (12.8, 3.6), "shutters": (12.8, 3.6), "wall": (6.4, 6.4), "leaves": (2.4, 2.4),
}  # fmt: skip
"""Width and height in metres that one repeat covers."""

_LEVELS = 11
_PLAIN = ("grass", "sky", "leaves")
SKY_TANGENTS = (-0.06, 0.74)
"""Tangent of the elevation at the bottom and the top of the sky's texture."""
HAZE = (196.0, 207.0, 217.0)
SKY_TOP = (92.0, 138.0, 196.0)


def texture_index(name: TextureName) -> int:
    """Its number in the atlas."""
    return TEXTURES.index(name)


@functools.cache
def street_atlas() -> Atlas:
    """All textures with their mip chains, each level the mean over 2x2 texels of the one before."""
    painters = {
        "asphalt": _asphalt, "pavement": _pavement, "grass": _grass, "sky": _sky, "plaster": _plaster, "brick": _brick,
        "concrete": _concrete, "stucco": _stucco, "shop": _shop, "shutters": _shutters, "wall": _wall,
        "leaves": _leaves,
    }  # fmt: skip
    count = len(TEXTURES)
    offset, levels = np.zeros((count, _LEVELS), np.int64), np.zeros(count, np.int32)
    log_width, log_height = np.zeros((count, _LEVELS), np.int32), np.zeros((count, _LEVELS), np.int32)
    chunks, at = [], 0
    for index, name in enumerate(TEXTURES):
        picture = np.clip(painters[name](np.random.default_rng(1000 + index)), 0, 255).astype(np.float32)
        while True:
            level = levels[index]
            height, width = picture.shape[:2]
            offset[index, level] = at
            log_width[index, level], log_height[index, level] = int(np.log2(width)), int(np.log2(height))
            chunks.append(pack_rgb(np.round(picture).astype(np.uint8).reshape(-1, 3)))
            at += width * height
            levels[index] += 1
            if levels[index] == _LEVELS or min(width, height) == 2:
                break
            picture = picture.reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))
    return Atlas(
        texels=np.concatenate(chunks),
        offset=offset,
        log_width=log_width,
        log_height=log_height,
        levels=levels,
        taps=np.array([1 if name in _PLAIN else 2 for name in TEXTURES], np.int32),
    )


def texture_size(name: TextureName) -> tuple[int, int]:
    """Width and height of level 0 in texels."""
    atlas, index = street_atlas(), texture_index(name)
    return 1 << int(atlas.log_width[index, 0]), 1 << int(atlas.log_height[index, 0])


def _noise(rng: np.random.Generator, size: tuple[int, int], octaves: tuple[tuple[int, float], ...]) -> np.ndarray:
    """(H, W) float32 noise that tiles: normal values on grids of ``cells`` across, smoothly enlarged, weighted."""
    width, height = size
    total = np.zeros((height, width), np.float32)
    for cells, weight in octaves:
        rows = max(1, cells * height // width)
        grid = rng.standard_normal((rows, cells)).astype(np.float32)
        if (rows, cells) != (height, width):
            grid = np.pad(grid, 2, mode="wrap")
            big = cv2.resize(
                grid, ((cells + 4) * width // cells, (rows + 4) * height // rows), interpolation=cv2.INTER_CUBIC
            )
            x0, y0 = 2 * width // cells, 2 * height // rows
            grid = big[y0 : y0 + height, x0 : x0 + width]
        total += weight * grid
    return total


def _flat(size: tuple[int, int], colour: tuple[float, float, float]) -> np.ndarray:
    return np.broadcast_to(np.asarray(colour, np.float32), (size[1], size[0], 3)).copy()


def _asphalt(rng: np.random.Generator) -> np.ndarray:
    size = (512, 512)
    grain = _noise(rng, size, ((512, 6.0), (128, 5.0), (32, 4.0), (8, 4.0)))
    picture = _flat(size, (108, 109, 113)) + grain[..., None]
    for _ in range(7):  # Tar seams and cracks.
        points = np.cumsum(rng.normal(0, 22, (9, 2)), axis=0) + rng.uniform(0, 512, 2)
        shade = float(rng.uniform(58, 72))
        line = np.round(points).astype(np.int32)
        for shift_x in (-512, 0, 512):
            for shift_y in (-512, 0, 512):
                cv2.polylines(picture, [line + (shift_x, shift_y)], False, (shade, shade, shade + 3), 2, cv2.LINE_AA)
    for _ in range(10):  # Patches and stains.
        x, y = rng.integers(40, 430, 2)
        w, h = rng.integers(15, 70, 2)
        picture[y : y + h, x : x + w] += rng.uniform(-14, 12)
    return picture


def _pavement(rng: np.random.Generator) -> np.ndarray:
    size = (512, 512)
    picture = _flat(size, (158, 154, 147)) + _noise(rng, size, ((512, 5.0), (64, 5.0), (16, 4.0)))[..., None]
    step = 64
    for y in range(0, 512, step):
        for x in range(0, 512, step):
            picture[y : y + step, x : x + step] += rng.normal(0, 8)
    picture[::step] -= 38
    picture[1::step] -= 24
    picture[:, ::step] -= 38
    picture[:, 1::step] -= 24
    return picture


def _grass(rng: np.random.Generator) -> np.ndarray:
    size = (512, 512)
    blades = _noise(rng, size, ((512, 9.0), (256, 9.0), (64, 8.0), (16, 6.0), (4, 4.0)))
    return _flat(size, (98, 116, 72)) + blades[..., None] * np.array([1.0, 0.9, 0.6], np.float32)


def _sky(rng: np.random.Generator) -> np.ndarray:
    width, height = 2048, 512
    low, high = SKY_TANGENTS
    tangent = np.linspace(high, low, height, dtype=np.float32)[:, None, None]
    share = np.clip(tangent / 0.6, 0, 1) ** 0.7
    picture = np.asarray(HAZE, np.float32) + (np.asarray(SKY_TOP, np.float32) - np.asarray(HAZE, np.float32)) * share
    picture = np.broadcast_to(picture, (height, width, 3)).copy()
    clouds = _noise(rng, (width, height), ((16, 1.0), (32, 0.7), (64, 0.45), (128, 0.25), (256, 0.12)))
    cover = np.clip(clouds * 0.55 + 0.05, 0, 1)[..., None] * np.clip(tangent * 6, 0, 1) * np.clip(2 - 2.4 * share, 0, 1)
    picture += (np.array([246, 247, 250], np.float32) - picture) * cover * 0.85
    horizon_row = (high - 0.0) / (high - low) * height
    for shade, lift, seed_cells in (((168, 184, 198), 30, 32), ((134, 152, 158), 14, 64), ((104, 122, 116), 5, 128)):
        ridge = _noise(rng, (width, 64), ((seed_cells, 0.6), (seed_cells * 4, 0.3), (seed_cells * 16, 0.12)))[32]
        top = horizon_row - lift - ridge * lift * 0.6
        mask = np.arange(height, dtype=np.float32)[:, None] - top[None]
        picture += (np.asarray(shade, np.float32) - picture) * np.clip(mask, 0, 1)[..., None]
    return picture


def _panes(picture: np.ndarray, rng: np.random.Generator, box: tuple[int, int, int, int], frame: float) -> None:
    """One window: frame, two panes of reflecting glass, a sill."""
    x0, y0, x1, y1 = box
    picture[y0 - 5 : y1 + 5, x0 - 5 : x1 + 5] = frame
    height = y1 - y0
    sheen = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    glass = np.array([74, 88, 104], np.float32) + rng.normal(0, 9) + sheen * -26
    picture[y0:y1, x0:x1] = glass
    if rng.random() < 0.5:  # Curtains.
        width = int((x1 - x0) * rng.uniform(0.15, 0.42))
        cloth = np.array([186, 178, 164], np.float32) + rng.normal(0, 12)
        picture[y0:y1, x0 : x0 + width] = cloth
        picture[y0:y1, x1 - width : x1] = cloth
    if rng.random() < 0.35:  # A blind.
        picture[y0 : y0 + int(height * rng.uniform(0.2, 0.6)), x0:x1] = np.array([196, 190, 176]) + rng.normal(0, 9)
    middle = (x0 + x1) // 2
    picture[y0:y1, middle - 3 : middle + 3] = frame
    cross = y0 + height // 3
    picture[cross - 2 : cross + 3, x0:x1] = frame
    picture[y1 + 5 : y1 + 14, x0 - 12 : x1 + 12] = frame * 0.86
    picture[y1 + 14 : y1 + 19, x0 - 12 : x1 + 12] *= 0.72


def _windows(
    picture: np.ndarray, rng: np.random.Generator, *, columns: int, floors: int, size: tuple[float, float], frame: float
) -> np.ndarray:
    height, width = picture.shape[:2]
    step_x, step_y = width // columns, height // floors
    half_x, half_y = int(step_x * size[0] / 2), int(step_y * size[1] / 2)
    for row in range(floors):
        for column in range(columns):
            x, y = column * step_x + step_x // 2, row * step_y + step_y // 2
            _panes(picture, rng, (x - half_x, y - half_y, x + half_x, y + half_y), frame)
    return picture


def _plaster(rng: np.random.Generator) -> np.ndarray:
    size = (1024, 1024)
    picture = _flat(size, (214, 206, 190)) + _noise(rng, size, ((512, 3.0), (64, 4.0), (8, 4.0)))[..., None]
    for y in range(0, 1024, 256):
        picture[y + 236 : y + 250] -= 26
        picture[y + 250 : y + 254] -= 52
    return _windows(picture, rng, columns=6, floors=4, size=(0.52, 0.56), frame=236.0)


def _bricks(rng: np.random.Generator, size: tuple[int, int], row: int, long: int) -> np.ndarray:
    width, height = size
    picture = _flat(size, (176, 166, 154))
    for index, y in enumerate(range(0, height, row)):
        start = (index % 2) * long // 2
        for x in range(start - long, width, long):
            colour = np.array([158, 92, 72], np.float32) * rng.uniform(0.78, 1.15)
            picture[y : y + row - 2, max(0, x) : max(0, x + long - 2)] = colour
    return picture + _noise(rng, size, ((512, 4.0), (64, 3.0)))[..., None]


def _brick(rng: np.random.Generator) -> np.ndarray:
    picture = _bricks(rng, (1024, 1024), 16, 40)
    return _windows(picture, rng, columns=5, floors=4, size=(0.46, 0.58), frame=226.0)


def _concrete(rng: np.random.Generator) -> np.ndarray:
    size = (1024, 1024)
    picture = _flat(size, (178, 178, 176)) + _noise(rng, size, ((256, 4.0), (32, 6.0), (8, 5.0)))[..., None]
    for at in range(0, 1024, 256):
        picture[at : at + 4] -= 60
        picture[:, at : at + 4] -= 60
    return _windows(picture, rng, columns=4, floors=4, size=(0.76, 0.46), frame=84.0)


def _stucco(rng: np.random.Generator) -> np.ndarray:
    size = (1024, 1024)
    picture = _flat(size, (222, 186, 150)) + _noise(rng, size, ((512, 5.0), (128, 4.0), (16, 4.0)))[..., None]
    picture = _windows(picture, rng, columns=5, floors=4, size=(0.4, 0.62), frame=244.0)
    for row in range(4):
        for column in range(5):  # Green shutters beside each window.
            x, y = column * 204 + 102, row * 256 + 128
            shade = np.array([70, 104, 88], np.float32) * rng.uniform(0.85, 1.15)
            for side in (-1, 1):
                left = x + side * 66 - 20
                picture[y - 80 : y + 80, left : left + 40] = shade
                picture[y - 76 : y + 76 : 8, left + 4 : left + 36] *= 0.78
    return picture


def _shop(rng: np.random.Generator) -> np.ndarray:
    width, height = 1024, 256
    size = (width, height)
    picture = _flat(size, (120, 112, 104)) + _noise(rng, size, ((512, 4.0), (64, 4.0)))[..., None]
    for x in range(0, width, 256):
        sign = rng.uniform(40, 220, 3).astype(np.float32)
        picture[12:62, x + 10 : x + 246] = sign
        ink = 245.0 if sign.mean() < 130 else 30.0
        left = x + 30
        while left < x + 210:  # Letters, or what passes for them.
            wide = int(rng.integers(8, 20))
            picture[24 : 24 + int(rng.integers(18, 28)), left : left + wide] = ink
            left += wide + int(rng.integers(5, 12))
        picture[70:228, x + 12 : x + 168] = np.array([52, 62, 74], np.float32)
        for _ in range(9):  # Goods in the window.
            gx, gy = x + 16 + int(rng.integers(0, 120)), 120 + int(rng.integers(0, 70))
            picture[gy : gy + int(rng.integers(14, 36)), gx : gx + int(rng.integers(10, 32))] = rng.uniform(60, 230, 3)
        picture[74:78, x + 16 : x + 164] = 150.0
        picture[66:250, x + 182 : x + 240] = rng.uniform(50, 120, 3)
        picture[84:170, x + 192 : x + 230] = np.array([86, 100, 114], np.float32)
        picture[160:166, x + 186 : x + 192] = 220.0
    picture[250:] -= 40
    return picture


def _shutters(rng: np.random.Generator) -> np.ndarray:
    picture = _bricks(rng, (1024, 256), 16, 40) * 0.3 + _flat((1024, 256), (150, 142, 132)) * 0.7
    for x in range(0, 1024, 256):
        if rng.random() < 0.5:
            colour = rng.uniform(90, 190, 3).astype(np.float32)
            picture[50:250, x + 30 : x + 226] = colour
            picture[50:250:9, x + 30 : x + 226] *= 0.72
        else:
            _panes(picture, rng, (x + 40, 60, x + 130, 180), 230.0)
            picture[56:252, x + 165 : x + 225] = rng.uniform(60, 130, 3)
            picture[60:120, x + 175 : x + 215] = np.array([92, 104, 118], np.float32)
    return picture


def _wall(rng: np.random.Generator) -> np.ndarray:
    size = (512, 512)
    return _flat(size, (184, 174, 162)) + _noise(rng, size, ((256, 5.0), (64, 7.0), (16, 8.0), (4, 5.0)))[..., None]


def _leaves(rng: np.random.Generator) -> np.ndarray:
    size = (256, 256)
    picture = _flat(size, (150, 168, 120)) + _noise(rng, size, ((128, 12.0), (32, 22.0), (8, 14.0)))[..., None]
    for _ in range(900):
        x, y = (int(value) for value in rng.integers(0, 256, 2))
        shade = float(rng.normal(1.0, 0.22))
        colour = (168 * shade, 190 * shade, 126 * shade)
        for shift_x in (-256, 0, 256):
            axes = (int(rng.integers(3, 7)), int(rng.integers(2, 4)))
            cv2.ellipse(picture, (x + shift_x, y), axes, float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA)
    return picture
