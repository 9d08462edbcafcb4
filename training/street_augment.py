"""Pictures made harder before a network learns from them: light, blur, weather, noise, compression, place and scale."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

_NOISE_SIDE = 1024
_LIT = 0.7
"""Of dark pictures: so many have lights in them."""
_LAMPS_PER_MEGAPIXEL = 16.0
"""At most: a whole picture has up to eight, the crop of one object none."""
_LAMP_COLOUR = np.array([255.0, 244.0, 214.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class AugmentSettings:
    """How often each disturbance strikes, and how hard at most; lengths are pixels of the network's input."""

    dusk: float = 0.15
    night: float = 0.1
    blur: float = 0.15
    blur_px: int = 8
    weather: float = 0.1
    noise: float = 0.3
    noise_sigma: float = 7.0
    compression: float = 0.2


def disturb(picture: np.ndarray, rng: np.random.Generator, settings: AugmentSettings) -> np.ndarray:
    """A picture as a worse camera in worse light would have taken it.

    Args:
        picture: (h, w, 3) uint8 RGB.
        rng: source of every draw.
        settings: how often and how hard.

    Returns:
        (h, w, 3) uint8 RGB.
    """
    day = picture
    picture, dark = _relight(day, rng, settings)
    if dark and rng.random() < _LIT:
        picture = _night_lights(picture, day, rng)
    if rng.random() < settings.blur:
        picture = _smear(picture, rng, settings.blur_px)
    if rng.random() < settings.weather:
        picture = _rain(picture, rng) if rng.random() < 0.5 else _glare(picture, rng)
    if dark or rng.random() < settings.noise:
        picture = _grain(picture, rng, settings.noise_sigma)
    if rng.random() < settings.compression:
        quality = int(rng.integers(10, 60))
        encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        picture = np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR))
    return picture


def random_map(
    rng: np.random.Generator,
    *,
    source: tuple[float, float],
    target: tuple[int, int],
    scales: tuple[float, float],
    flip: bool,
    rotation_deg: float = 0.0,
    focus_xy: np.ndarray | None = None,
) -> np.ndarray:
    """(2, 3) affine map that puts a part of a picture, scaled and perhaps mirrored, into a window.

    Args:
        rng: source of every draw.
        source: width and height of the picture.
        target: width and height of the window.
        scales: least and largest scale, drawn evenly in its logarithm.
        flip: mirror left and right.
        rotation_deg: largest turn to either side.
        focus_xy: (2,) a place in the picture that should come to lie somewhere in the middle of the window.
    """
    scale = math.exp(rng.uniform(math.log(scales[0]), math.log(scales[1])))
    angle = math.radians(rng.uniform(-rotation_deg, rotation_deg))
    free = [target[axis] - source[axis] * scale for axis in (0, 1)]
    shift = [rng.uniform(min(0.0, space), max(0.0, space)) for space in free]
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    linear = scale * turn @ np.diag([-1.0 if flip else 1.0, 1.0])
    centre = np.array([source[0] - 1, source[1] - 1]) / 2
    if focus_xy is not None:
        wanted = rng.uniform(0.2, 0.8, 2) * target - (linear @ (focus_xy - centre) + scale * centre)
        shift = [float(np.clip(wanted[axis], min(0.0, free[axis]), max(0.0, free[axis]))) for axis in (0, 1)]
    offset = np.array(shift) + scale * centre - linear @ centre
    return np.column_stack([linear, offset])


def map_points(points_xy: np.ndarray, source_to_target: np.ndarray) -> np.ndarray:
    """(..., 2) points through a (2, 3) affine map."""
    return points_xy @ source_to_target[:, :2].T + source_to_target[:, 2]


def map_boxes(boxes_xyxy: np.ndarray, source_to_target: np.ndarray) -> np.ndarray:
    """(n, 4) boxes through a (2, 3) affine map: the boxes around their mapped corners."""
    corners = map_points(boxes_xyxy[:, [[0, 1], [2, 1], [2, 3], [0, 3]]], source_to_target)
    return np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)


def _relight(picture: np.ndarray, rng: np.random.Generator, settings: AugmentSettings) -> tuple[np.ndarray, bool]:
    draw = rng.random()
    if draw < settings.night:
        gain = rng.uniform(0.1, 0.3)
    elif draw < settings.night + settings.dusk:
        gain = rng.uniform(0.3, 0.75)
    else:
        gain = rng.uniform(0.75, 1.25)
    gains = gain * rng.uniform(0.93, 1.07, 3)
    levels = (np.arange(256) / 255.0) ** rng.uniform(0.8, 1.3)
    table = np.clip(255 * levels[:, None] * gains + rng.uniform(-6, 6), 0, 255).astype(np.uint8)
    return cv2.LUT(picture, table[None]), gain < 0.3


def _night_lights(dark: np.ndarray, day: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The dark picture with a part of it lit as by headlights, and with lamps that shine in it."""
    height, width = dark.shape[:2]
    across, down = rng.uniform(0.3, 0.7) * width, rng.uniform(0.55, 1.1) * height
    x = np.exp(-(((np.arange(width) - across) / (rng.uniform(0.1, 0.5) * width)) ** 2)).astype(np.float32)
    y = np.exp(-(((np.arange(height) - down) / (rng.uniform(0.15, 0.5) * height)) ** 2)).astype(np.float32)
    cone = np.float32(rng.uniform(0.0, 0.5)) * np.outer(y, x)[..., None]
    lamps = np.zeros((height // 2, width // 2), np.float32)
    most = round(_LAMPS_PER_MEGAPIXEL * width * height / 1e6)
    for _ in range(int(rng.integers(0, most + 1))):
        place = (int(rng.integers(width // 2)), int(rng.integers(height // 2)))
        cv2.circle(lamps, place, int(rng.integers(1, 5)), float(rng.uniform(150, 500)), -1, cv2.LINE_AA)
    glow = lamps + cv2.GaussianBlur(lamps, (0, 0), rng.uniform(1.5, 6.0))
    shine = cv2.resize(glow, (width, height), interpolation=cv2.INTER_LINEAR)[..., None] * (_LAMP_COLOUR / 255)
    return np.clip(dark * (1 - cone) + day * cone + shine.astype(np.float32), 0, 255).astype(np.uint8)


def _smear(picture: np.ndarray, rng: np.random.Generator, longest_px: int) -> np.ndarray:
    length = int(rng.integers(2, longest_px + 1))
    if rng.random() < 0.3:
        return cv2.GaussianBlur(picture, (0, 0), 0.25 * length)
    kernel = np.zeros((length, length), np.float32)
    angle = rng.uniform(0, math.pi)
    middle, reach = (length - 1) / 2, np.array([math.cos(angle), math.sin(angle)]) * length
    ends = [tuple(int(value) for value in np.round(16 * (middle + sign * reach / 2))) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0, 1, cv2.LINE_AA, 4)
    return cv2.filter2D(picture, -1, kernel / max(float(kernel.sum()), 1e-6))


def _rain(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    height, width = picture.shape[:2]
    streaks = np.zeros((height, width), np.uint8)
    count, slant = int(width * height * rng.uniform(0.5e-3, 2e-3)), rng.uniform(-0.3, 0.3)
    starts = rng.uniform((0, -20), (width, height), (count, 2))
    lengths = rng.uniform(4, 0.08 * height + 5, count)
    lines = np.stack([starts, starts + lengths[:, None] * (slant, 1.0)], axis=1)
    cv2.polylines(streaks, list(np.round(lines).astype(np.int32)), False, int(rng.integers(40, 130)), 1, cv2.LINE_AA)
    if rng.random() < 0.5:
        streaks = cv2.GaussianBlur(streaks, (0, 0), rng.uniform(0.5, 1.0))
    veil = rng.uniform(0, 0.4)
    hazy = cv2.addWeighted(picture, 1 - veil, picture, 0.0, veil * rng.uniform(60, 200))
    return cv2.add(hazy, cv2.merge([streaks] * 3))


def _glare(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    height, width = picture.shape[:2]
    y, x = np.ogrid[0:height, 0:width]
    across, down, radius = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0.1, 0.6) * width
    glow = rng.uniform(0.2, 0.7) * np.exp(-((x - across) ** 2 + (y - down) ** 2) / (2 * radius**2)).astype(np.float32)
    return (picture + glow[..., None] * (_LAMP_COLOUR - picture)).astype(np.uint8)


def put_board(
    picture: np.ndarray, box_xyxy: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A board, evenly coloured or coarsely patterned, over 15 to 60 % of a box, from one of its sides.

    Args:
        picture: (h, w, 3) uint8 RGB.
        box_xyxy: (4,) pixels.
        rng: source of every draw.

    Returns:
        The picture with the board, the board's place (4,), and the rest of the box (4,).
    """
    box = np.asarray(box_xyxy, np.float64)
    sides = box[2:] - box[:2]
    # From the left or the right mostly: what stands before a car or a walker stands on the ground.
    edge = int(rng.choice(4, p=(0.4, 0.1, 0.4, 0.1)))
    axis, low = edge % 2, edge < 2
    reach = rng.uniform(0.15, 0.6) * sides[axis]
    cover, rest = np.concatenate([box[:2] - 0.2 * sides, box[2:] + 0.2 * sides]), box.copy()
    cover[axis + 2 if low else axis] = rest[edge] = box[axis] + reach if low else box[axis + 2] - reach
    height, width = picture.shape[:2]
    left, top, right, bottom = np.clip(np.rint(cover).astype(int), 0, (width, height, width, height)).tolist()
    if right > left and bottom > top:
        cells = rng.normal(0, rng.uniform(0, 30), (int(rng.integers(1, 12)), int(rng.integers(1, 8)), 1))
        shade = cv2.resize(cells.astype(np.float32), (right - left, bottom - top), interpolation=cv2.INTER_LINEAR)
        colour = rng.uniform(20, 235) + rng.normal(0, 25, 3)
        picture = picture.copy()
        picture[top:bottom, left:right] = np.clip(colour + shade[..., None], 0, 255).astype(np.uint8)
    return picture, cover, rest.astype(np.float32)


_grain_bank: list[np.ndarray] = []


def _grain(picture: np.ndarray, rng: np.random.Generator, largest_sigma: float) -> np.ndarray:
    if not _grain_bank:
        bank = np.random.default_rng(0).standard_normal((_NOISE_SIDE, _NOISE_SIDE, 3))
        _grain_bank.append(np.clip(16 * bank, -127, 127).astype(np.int16))
    height, width = picture.shape[:2]
    top, left = rng.integers(0, (_NOISE_SIDE - height, _NOISE_SIDE - width))
    noise = _grain_bank[0][top : top + height, left : left + width]
    sigma = rng.uniform(1, largest_sigma)
    return cv2.addWeighted(picture, 1.0, noise, sigma / 16, 0.0, dtype=cv2.CV_8U)
