"""Conditions that a picture can be in: dusk, night, rain, glare, wiper, blur, noise, compression, things in the way.

Each is a pure function of the picture, the seed and the frame number, so that a stability table can play it again.
"""

import io
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from typing import Literal, get_args

import av
import av.video.stream
import cv2
import numpy as np

from labeling.errors import ConfigError
from labeling.timeline import FPS

Condition = Literal[
    "clean", "dusk", "night", "rain", "glare", "wiper", "motion_blur", "noise", "bonnet", "overlay", "letterbox",
    "brightness_ramp", "h264", "black",
]  # fmt: skip
CONDITIONS: tuple[Condition, ...] = get_args(Condition)

DEFAULT_AMOUNT: dict[Condition, float] = {
    "clean": 0.0, "dusk": 0.4, "night": 0.15, "rain": 1.0, "glare": 1.0, "wiper": 1.0, "motion_blur": 15.0,
    "noise": 4.0, "bonnet": 0.15, "overlay": 0.15, "letterbox": 0.12, "brightness_ramp": 0.5, "h264": 40.0,
    "black": 0.0,
}  # fmt: skip
"""What ``amount`` means: a gain (dusk, night), a strength from 0 to 1 (rain, glare, wiper), pixels (motion_blur), grey
levels of sigma (noise), a share of the picture's height or area (bonnet, overlay, letterbox), a relative change
(brightness_ramp), a constant rate factor (h264)."""

_NIGHT_NOISE = 6.0
_LAMP_LEVEL = 228.0
_RAMP_FRAMES = 120


def apply_condition(
    rgb: np.ndarray, name: Condition, *, seed: int, frame: int, amount: float | None = None
) -> np.ndarray:
    """The picture as it would look in a condition.

    Args:
        rgb: (H, W, 3) uint8; not changed.
        name: which condition.
        seed: the same seed and frame give the same bytes.
        frame: number of the frame, for what moves or differs from frame to frame.
        amount: how much, see DEFAULT_AMOUNT; None takes that.

    Returns:
        (H, W, 3) uint8.

    Raises:
        ConfigError: an unknown name, or a picture that is not (H, W, 3) uint8.
    """
    if name not in _MAKERS:
        raise ConfigError(f"picture condition {name!r} is not known; choose one of {', '.join(CONDITIONS)}")
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise ConfigError(f"a picture must be (H, W, 3) uint8, got {rgb.shape} {rgb.dtype}; convert it first")
    rng = np.random.default_rng([seed, frame, CONDITIONS.index(name)])
    return _MAKERS[name](rgb, DEFAULT_AMOUNT[name] if amount is None else amount, seed, frame, rng)


def compress_frames(frames: Iterable[np.ndarray], *, crf: int) -> Iterator[np.ndarray]:
    """Frames (H, W, 3) uint8 after H.264 as one stream at ``crf``, in memory; sides must be even.

    Raises:
        ConfigError: odd sides.
    """
    buffer = io.BytesIO()
    count = 0
    with av.open(buffer, "w", format="mp4") as container:
        stream: av.video.stream.VideoStream | None = None
        for rgb in frames:
            height, width = rgb.shape[:2]
            if stream is None:
                if width % 2 or height % 2:
                    raise ConfigError(f"{width}x{height}: H.264 in 4:2:0 needs even sides; resize the picture first")
                options = {"crf": str(crf), "preset": "veryfast", "threads": "1"}
                stream = container.add_stream("libx264", rate=Fraction(FPS), options=options)
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                stream.codec_context.thread_count = 1
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24")))
            count += 1
        if stream is not None:
            container.mux(stream.encode(None))
    if not count:
        return
    buffer.seek(0)
    with av.open(buffer, "r") as container:
        for picture in container.decode(video=0):
            yield picture.to_ndarray(format="rgb24")


def _bytes(picture: np.ndarray) -> np.ndarray:
    return np.clip(picture + 0.5, 0, 255).astype(np.uint8)


def _clean(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    return rgb.copy()


def _black(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    return np.zeros_like(rgb)


def _dusk(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    tint = np.array([1.04, 0.98, 0.96], np.float32)
    return _bytes(rgb * (amount * tint) + rng.normal(0, 1.5, rgb.shape).astype(np.float32))


def _night(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    """A low gain, more in the cone of the own headlights; lamps in the picture shine; noise."""
    height, width = rgb.shape[:2]
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    across, down = (x - width / 2) / width, y / height - 0.5
    cone = np.exp(-((across / (0.10 + 0.5 * np.maximum(down, 0.0))) ** 2)) * np.clip(down * 9, 0, 1) * 0.3
    dark = rgb * (amount + cone)[..., None] * np.array([0.94, 0.97, 1.06], np.float32)
    red, blue = rgb[..., 0].astype(np.float32), rgb[..., 2].astype(np.float32)
    # Lamps are bright and warm; clouds and white paint are bright and cold.
    lamps = np.clip(red - _LAMP_LEVEL, 0, 10) * np.clip(red - blue - 8, 0, 4) * (210.0 / 40)
    halo = cv2.GaussianBlur(lamps, (0, 0), max(1.0, width / 130))
    glow = (np.minimum(lamps, 170) + 1.1 * halo)[..., None] * np.array([1.0, 0.92, 0.74], np.float32)
    return _bytes(dark + glow * 0.6 + rng.normal(0, _NIGHT_NOISE, rgb.shape).astype(np.float32))


def _rain(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    height, width = rgb.shape[:2]
    streaks = np.zeros((height, width), np.float32)
    count = int(520 * amount * width * height / (1056 * 704))
    slant = 0.12 + 0.04 * np.sin(seed)
    tops = rng.uniform((0, -40), (width, height), (count, 2))
    for (x, y), length, light in zip(tops, rng.uniform(14, 46, count), rng.uniform(40, 150, count), strict=True):
        start, end = (int(16 * x), int(16 * y)), (int(16 * (x + slant * length)), int(16 * (y + length)))
        cv2.line(streaks, start, end, float(light), 1, cv2.LINE_AA, shift=4)
    streaks = cv2.GaussianBlur(streaks, (0, 0), 0.8)[..., None]
    grey = rgb.astype(np.float32) * (1 - 0.22 * amount) + 36.0 * amount
    return _bytes(grey + streaks * 0.75)


def _glare(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    """A low sun behind the windscreen: a veil that falls off around it, and a ghost opposite."""
    height, width = rgb.shape[:2]
    place = np.random.default_rng([seed, 91])
    sun = np.array([place.uniform(0.25, 0.75) * width, place.uniform(0.12, 0.38) * height])
    sun += 0.004 * width * np.sin(frame * np.array([0.21, 0.13]))
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    away = np.hypot(x - sun[0], y - sun[1]) / width
    ghost = np.hypot(x - (width - sun[0]), y - (height - sun[1])) / width
    veil = 270 * np.exp(-((away / 0.07) ** 2)) + 130 * np.exp(-away / 0.16) + 26 * (np.abs(ghost - 0.05) < 0.012)
    return _bytes(rgb * (1 - 0.12 * amount) + (amount * veil)[..., None] * np.array([1.0, 0.96, 0.86], np.float32))


def _wiper(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    """One sweep there and back each second, blurred, from below the picture."""
    height, width = rgb.shape[:2]
    phase = (frame % FPS) / FPS
    if phase > 0.75:
        return rgb.copy()
    angle = np.radians(-62 + 124 * (0.5 - 0.5 * np.cos(2 * np.pi * phase / 0.75)))
    foot = np.array([0.5 * width, 1.12 * height])
    along = np.array([np.sin(angle), -np.cos(angle)])
    side = np.array([along[1], -along[0]])
    reach, half = 1.05 * height, 0.014 * width
    corners = np.array([foot - side * half, foot + side * half, foot + along * reach + side * half * 0.6,
                        foot + along * reach - side * half * 0.6])  # fmt: skip
    mask = np.zeros((height, width), np.float32)
    cv2.fillConvexPoly(mask, np.round(corners * 16).astype(np.int32), 1.0, cv2.LINE_AA, shift=4)
    mask = cv2.GaussianBlur(mask, (0, 0), width / 200)[..., None] * amount
    return _bytes(rgb * (1 - mask) + 16 * mask)


def _motion_blur(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    """A box of ``amount`` pixels along a row, as while the camera turns; parts of a pixel count."""
    length = max(1.0, amount)
    reach = int(np.ceil((length - 1) / 2))
    kernel = np.clip(length / 2 + 0.5 - np.abs(np.arange(-reach, reach + 1)), 0, 1).astype(np.float32)
    return cv2.filter2D(rgb, -1, (kernel / kernel.sum())[None], borderType=cv2.BORDER_REPLICATE)


def _noise(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    return _bytes(rgb + amount * rng.standard_normal(rgb.shape, dtype=np.float32))


def _bonnet(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    """The own car's bonnet along the lower edge, ``amount`` of the area, still in the picture."""
    height, width = rgb.shape[:2]
    x = (np.arange(width) - width / 2) / (width / 2)
    rise = np.cos(np.clip(x, -1, 1) * 1.15)
    top = height * (1 - amount * rise / rise.mean())
    y = np.arange(height, dtype=np.float32)[:, None]
    cover = np.clip(y - top[None], 0, 1)[..., None]
    shade = 34 + 60 * np.clip(1 - (y - top[None]) / (0.12 * height), 0, 1) ** 2
    colour = shade[..., None] * np.array([0.92, 0.98, 1.08])
    return _bytes(rgb * (1 - cover) + colour * cover)


def _overlay(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    """A recorder's bar along the lower edge, ``amount`` of the height, with a running clock."""
    height, width = rgb.shape[:2]
    out = rgb.copy()
    top = round(height * (1 - amount))
    out[top:] = (12, 14, 16)
    text = f"CAM {seed % 100:02d}  {frame // (60 * FPS):02d}:{frame // FPS % 60:02d}.{frame % FPS:02d}  000 km/h"
    scale = max(0.3, (height - top) / 60)
    cv2.putText(out, text, (int(0.02 * width), top + int(0.65 * (height - top))), cv2.FONT_HERSHEY_SIMPLEX, scale,
                (230, 230, 200), max(1, int(scale * 1.5)), cv2.LINE_AA)  # fmt: skip
    return out


def _letterbox(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    out = rgb.copy()
    bar = round(rgb.shape[0] * amount)
    out[:bar] = 0
    out[rgb.shape[0] - bar :] = 0
    return out


def _brightness_ramp(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    """Gain from 1 to ``1 + amount`` and back, over five seconds each way."""
    share = 1 - abs(frame / _RAMP_FRAMES % 2 - 1)
    return _bytes(rgb * np.float32(1 + amount * share))


def _h264(rgb: np.ndarray, amount: float, seed: int, frame: int, rng: np.random.Generator) -> np.ndarray:
    """One picture coded alone; ``compress_frames`` codes a whole stream."""
    height, width = rgb.shape[:2]
    even = cv2.copyMakeBorder(rgb, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    return next(compress_frames([even], crf=round(amount)))[:height, :width].copy()


_MAKERS: dict[Condition, Callable[[np.ndarray, float, int, int, np.random.Generator], np.ndarray]] = {
    "clean": _clean, "dusk": _dusk, "night": _night, "rain": _rain, "glare": _glare, "wiper": _wiper,
    "motion_blur": _motion_blur, "noise": _noise, "bonnet": _bonnet, "overlay": _overlay, "letterbox": _letterbox,
    "brightness_ramp": _brightness_ramp, "h264": _h264, "black": _black,
}  # fmt: skip
