"""Videos made on the spot, whose truth is known: which frame is which, which colour is where, what is broken.

The colours are converted here in floating point, by the standards' formulas, and not by the library under test.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import av.container
import numpy as np

CODE_BITS = 12
_KR_KB = {"bt709": (0.2126, 0.0722), "bt601": (0.299, 0.114)}
_TAGS = {"bt709": 1, "bt601": 6}

PATCHES_RGB = ((200, 40, 40), (40, 180, 60), (50, 60, 190), (210, 200, 50))
"""Colours of the top-left, top-right, bottom-left and bottom-right quarters of ``patches``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceSpec:
    """What kind of file to make."""

    width: int = 128
    height: int = 96
    matrix: str = "bt709"
    tagged: bool = True
    full_range: bool = False
    pixel_format: str = "yuv420p"
    rotation_deg: int = 0
    """Clockwise turn that a player must make."""
    aspect: Fraction = Fraction(1)
    """Width of a pixel over its height."""
    interlaced: bool = False
    gop: int = 30
    b_frames: int = 2
    quality: int = 8
    container: str = "mp4"
    faststart: bool = False
    ticks_per_s: int = 90000
    first_s: Fraction = Fraction(0)


def regular_times(fps: Fraction | int, count: int) -> list[Fraction]:
    """``count`` presentation times at a constant rate, from zero."""
    return [Fraction(i) / Fraction(fps) for i in range(count)]


def variable_times(count: int, *, seed: int = 0, shortest_s: float = 0.01, longest_s: float = 0.08) -> list[Fraction]:
    """``count`` presentation times at random distances, from zero, on ticks of 1/90000 s."""
    steps = np.random.default_rng(seed).uniform(shortest_s, longest_s, count)
    ticks = np.concatenate([[0], np.cumsum(np.round(steps * 90000))[:-1]]).astype(int)
    return [Fraction(int(tick), 90000) for tick in ticks]


def write_source(
    path: Path,
    times_s: Sequence[Fraction],
    spec: SourceSpec | None = None,
    *,
    picture: Callable[[int, int, int], np.ndarray] | None = None,
) -> Path:
    """Encode ``picture(index, width, height)`` (RGB uint8; ``coded`` by default) shown at ``times_s``."""
    spec, draw = spec or SourceSpec(), picture or coded
    options = {"movflags": "faststart"} if spec.faststart else {}
    with av.open(str(path), "w", format=spec.container, options=options) as container:
        stream = _add_stream(container, spec)
        for index, time_s in enumerate(times_s):
            rgb = draw(index, spec.width, spec.height)
            if spec.interlaced:
                rgb[1::2] = draw(index + 1, spec.width, spec.height)[1::2]
            frame = to_frame(rgb, spec)
            frame.pts = round((time_s + spec.first_s) * spec.ticks_per_s)
            frame.time_base = Fraction(1, spec.ticks_per_s)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    if spec.rotation_deg:
        _write_display_matrix(path, spec)
    return path


def _add_stream(container: av.container.OutputContainer, spec: SourceSpec) -> av.VideoStream:
    x264 = f"keyint={spec.gop}:min-keyint=1:scenecut=0:bframes={spec.b_frames}:b-adapt=0"
    options = {"preset": "ultrafast", "crf": str(spec.quality), "x264-params": x264 + ":tff=1" * spec.interlaced}
    if spec.interlaced:
        options["flags"] = "+ildct+ilme"
    stream = container.add_stream("libx264", rate=30, options=options)
    stream.width, stream.height, stream.pix_fmt = spec.width, spec.height, spec.pixel_format
    context = stream.codec_context
    context.thread_count = 1
    context.time_base = Fraction(1, spec.ticks_per_s)
    stream.time_base = Fraction(1, spec.ticks_per_s)
    if spec.aspect != 1:
        context.sample_aspect_ratio = spec.aspect
    if spec.tagged:
        context.colorspace = context.color_primaries = context.color_trc = _TAGS[spec.matrix]
        context.color_range = 2 if spec.full_range else 1
    return stream


def to_frame(rgb: np.ndarray, spec: SourceSpec) -> av.VideoFrame:
    """(H, W, 3) uint8 RGB as 4:2:0 YCbCr in the spec's matrix, range and depth; chroma is the mean of four pixels."""
    red, green, blue = np.moveaxis(rgb.astype(np.float64) / 255, -1, 0)
    kr, kb = _KR_KB[spec.matrix]
    luma = kr * red + (1 - kr - kb) * green + kb * blue
    deep = spec.pixel_format.endswith("10le")
    unit = 4 if deep else 1
    if spec.full_range:
        scale_y, offset_y, scale_c = 256 * unit - 1, 0, 256 * unit - 1
    else:
        scale_y, offset_y, scale_c = 219 * unit, 16 * unit, 224 * unit
    planes = [luma * scale_y + offset_y]
    for colour, weight in ((blue, kb), (red, kr)):
        planes.append(_halved((colour - luma) / (2 * (1 - weight))) * scale_c + 128 * unit)
    flat = np.concatenate([np.round(plane).ravel() for plane in planes])
    packed = flat.reshape(rgb.shape[0] * 3 // 2, rgb.shape[1])
    if deep:
        frame = av.VideoFrame.from_ndarray(packed.astype(np.uint16), format=spec.pixel_format)
    else:
        frame = av.VideoFrame.from_ndarray(packed.astype(np.uint8), format=spec.pixel_format)
    if spec.tagged:
        frame.colorspace = frame.color_primaries = frame.color_trc = _TAGS[spec.matrix]
        frame.color_range = 2 if spec.full_range else 1
    return frame


def _halved(plane: np.ndarray) -> np.ndarray:
    return plane.reshape(plane.shape[0] // 2, 2, plane.shape[1] // 2, 2).mean(axis=(1, 3))


def _write_display_matrix(path: Path, spec: SourceSpec) -> None:
    """Put a turn into the track header by ISO 14496-12: x' = a x + c y + tx, y' = b x + d y + ty."""
    one = 1 << 16
    a, b, c, d, tx, ty = {
        90: (0, one, -one, 0, spec.height * one, 0),
        180: (-one, 0, 0, -one, spec.width * one, spec.height * one),
        270: (0, -one, one, 0, 0, spec.width * one),
    }[spec.rotation_deg]
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + (4 + 5 * 4 + 8 + 8)
    rows = (a, b, 0, c, d, 0, tx, ty, 1 << 30)
    data[at : at + 36] = b"".join(int(value).to_bytes(4, "big", signed=True) for value in rows)
    path.write_bytes(data)


def coded(index: int, width: int, height: int) -> np.ndarray:
    """A picture that carries its index in black and white blocks, 4 x 3 of them, over its middle half."""
    rgb = np.full((height, width, 3), 90, np.uint8)
    rgb[:, :: max(2, width // 16)] = 140
    for bit in range(CODE_BITS):
        y0, y1, x0, x1 = _block(bit, width, height)
        rgb[y0:y1, x0:x1] = 235 if index >> bit & 1 else 20
    return rgb


def read_code(rgb: np.ndarray) -> int:
    """The index that ``coded`` put into a picture."""
    height, width = rgb.shape[:2]
    index = 0
    for bit in range(CODE_BITS):
        y0, y1, x0, x1 = _block(bit, width, height)
        inner = rgb[(3 * y0 + y1) // 4 : (y0 + 3 * y1) // 4, (3 * x0 + x1) // 4 : (x0 + 3 * x1) // 4]
        index |= int(inner.mean() > 128) << bit
    return index


def _block(bit: int, width: int, height: int) -> tuple[int, int, int, int]:
    row, column = divmod(bit, 4)
    y0, x0 = height / 4 + row * height / 6, width / 4 + column * width / 8
    return round(y0), round(y0 + height / 6), round(x0), round(x0 + width / 8)


def patches(index: int, width: int, height: int) -> np.ndarray:
    """Four quarters in ``PATCHES_RGB``, split on even pixels; the same in every frame."""
    rgb = np.empty((height, width, 3), np.uint8)
    y, x = height // 4 * 2, width // 4 * 2
    rgb[:y, :x], rgb[:y, x:], rgb[y:, :x], rgb[y:, x:] = PATCHES_RGB
    return rgb


def read_patches(rgb: np.ndarray) -> np.ndarray:
    """(4, 3) float64 mean colours in the middles of the quarters, in the order of ``PATCHES_RGB``."""
    height, width = rgb.shape[:2]
    half_y, half_x = max(1, height // 16), max(1, width // 16)
    return np.array([
        rgb[y - half_y : y + half_y, x - half_x : x + half_x].mean(axis=(0, 1))
        for y in (height // 4, height * 3 // 4)
        for x in (width // 4, width * 3 // 4)
    ])  # fmt: skip


def write_audio_only(path: Path, *, seconds: float = 0.5) -> Path:
    """An MP4 with one AAC stream of silence."""
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("aac", rate=16000, layout="mono")
        for at in range(0, int(seconds * 16000), 1024):
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            frame.sample_rate, frame.pts = 16000, at
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def cut_off(source: Path, out: Path, *, share: float = 0.5) -> Path:
    """The first part of a file. It lacks its index if that was at the end, and frames if it was ``faststart``."""
    data = source.read_bytes()
    out.write_bytes(data[: int(len(data) * share)])
    return out


def with_garbage(source: Path, out: Path, *, first: int, last: int, seed: int = 0) -> Path:
    """The file with the packets of frames ``first`` to ``last`` (in decoding order) overwritten with noise."""
    data = bytearray(source.read_bytes())
    with av.open(str(source)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    rng = np.random.default_rng(seed)
    for packet in packets[first : last + 1]:
        assert packet.pos is not None
        noise = rng.integers(0, 256, packet.size, dtype=np.uint8).tobytes()
        data[packet.pos : packet.pos + packet.size] = noise
    out.write_bytes(data)
    return out


def retimed(source: Path, out: Path, time_of: Callable[[int], int]) -> Path:
    """The file's packets, by ``time_of`` their place, at other times (both decoding and presentation, milliseconds)."""
    with av.open(str(source)) as container, av.open(str(out), "w") as target:
        template = container.streams.video[0]
        stream = target.add_stream_from_template(template)
        for place, packet in enumerate(packet for packet in container.demux(template) if packet.size):
            packet.time_base = Fraction(1, 1000)
            packet.pts = packet.dts = time_of(place)
            packet.stream = stream
            target.mux(packet)
    return out
