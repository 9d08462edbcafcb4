"""Decoded pictures to upright working pictures: colours, rotation, pixel shape, scaling to cover, crop, deinterlacing.

One filter graph does the lot in a single pass over the planes, so that a frame goes from decoder to encoder as YUV and
never through Python.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

import av
import av.filter
import av.video.frame
import numpy as np

from labeling.camera import PictureMap

OutputFormat = Literal["yuv420p", "rgb24"]

BT709 = 1
"""The number of BT.709 in H.273's tables of matrices, primaries and transfers."""
BT709_NAME = "bt709"
LIMITED_RANGE = 1
_FULL_RANGE = 2
# H.273 matrix numbers -> what swscale calls them. 0 (RGB) has none, 2 means untagged.
_MATRIX_NAMES = {1: "bt709", 4: "fcc", 5: "bt470", 6: "smpte170m", 7: "smpte240m", 9: "bt2020", 10: "bt2020"}
_COLORSPACE_NAMES = {"bt470": "bt470bg", "bt2020": "bt2020ncl"}
_TURNS = {0: (), 90: ("transpose=clock",), 180: ("hflip", "vflip"), 270: ("transpose=cclock",)}


def colour_matrix(tag: int, *, width: int, height: int) -> str:
    """swscale's name for a stream's YCbCr matrix; untagged video is BT.709 from 1280 columns or 577 rows on.

    That is what players assume (mpv, VLC, browsers): standard definition is BT.601, anything larger is BT.709.
    """
    is_large = max(width, height) >= 1280 or min(width, height) > 576
    return _MATRIX_NAMES.get(tag, "bt709" if is_large else "smpte170m")


def is_full_range(tag: int, pixel_format: str) -> bool:
    """Whether luma spans 0-255 rather than 16-235, by the stream's tag or by one of the old ``yuvj`` formats."""
    return tag == _FULL_RANGE or pixel_format.startswith("yuvj")


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputPicture:
    """What the upright picture becomes."""

    scaled_width: int
    scaled_height: int
    crop_x: int
    crop_y: int
    width: int
    height: int
    rotation_deg: int
    """Clockwise turn that makes the stored picture upright: 0, 90, 180 or 270."""
    pixel_format: OutputFormat

    @classmethod
    def of_map(cls, picture: PictureMap, *, rotation_deg: int, pixel_format: OutputFormat) -> "OutputPicture":
        """Scaled to cover and cropped as ``picture`` says."""
        return cls(
            scaled_width=picture.scaled_width, scaled_height=picture.scaled_height,
            crop_x=picture.crop_x, crop_y=picture.crop_y, width=picture.width, height=picture.height,
            rotation_deg=rotation_deg, pixel_format=pixel_format,
        )  # fmt: skip

    @classmethod
    def whole(cls, width: int, height: int, *, rotation_deg: int, pixel_format: OutputFormat) -> "OutputPicture":
        """The whole upright picture at ``width`` x ``height``."""
        return cls(
            scaled_width=width, scaled_height=height, crop_x=0, crop_y=0, width=width, height=height,
            rotation_deg=rotation_deg, pixel_format=pixel_format,
        )  # fmt: skip


class FrameConverter:
    """Converts frames one by one; the graph is rebuilt when the stream changes its size, format or colours."""

    def __init__(self, output: OutputPicture) -> None:
        self._output = output
        self._key: tuple[object, ...] = ()
        self._graph: av.filter.Graph | None = None

    def convert(self, frame: av.VideoFrame) -> av.VideoFrame:
        """The upright, scaled, cropped picture; YUV comes out as BT.709 limited range, tagged."""
        key = (frame.width, frame.height, frame.format.name, int(frame.colorspace), int(frame.color_range))
        if self._graph is None or key != self._key:
            self._graph, self._key = _conversion_graph(frame, self._output), key
        self._graph.vpush(frame)
        converted = self._graph.vpull()
        if self._output.pixel_format == "yuv420p":
            tag_bt709(converted)
        return converted


def tag_bt709(frame: av.VideoFrame | av.VideoCodecContext) -> None:
    """Mark a frame, or a stream that is going to be encoded, as BT.709 limited range."""
    frame.colorspace = BT709
    frame.color_primaries = BT709
    frame.color_trc = BT709
    frame.color_range = LIMITED_RANGE


def luma(frame: av.VideoFrame) -> np.ndarray:
    """(H, W) uint8 view of a planar frame's first plane; nothing is copied."""
    plane = frame.planes[0]
    return np.frombuffer(memoryview(plane), np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width]


def deinterlaced(frames: Iterable[av.VideoFrame]) -> Iterator[av.VideoFrame]:
    """Frames whose fields were woven, as whole pictures at the same times; frames marked progressive pass through.

    Bob-weave (ffmpeg's ``bwdif``), one picture per frame. It looks a frame ahead.
    """
    graph: av.filter.Graph | None = None
    key: tuple[object, ...] = ()
    time_base = Fraction(1)
    for frame in frames:
        frame_key = (frame.width, frame.height, frame.format.name)
        if graph is None or key != frame_key:
            if graph is not None:
                yield from _drained(graph, time_base)
            graph, key, time_base = _graph(frame, ["bwdif=mode=send_frame:deint=interlaced"]), frame_key, _tick(frame)
        graph.vpush(frame)
        yield from _pulled(graph, time_base)
    if graph is not None:
        yield from _drained(graph, time_base)


def _conversion_graph(frame: av.VideoFrame, output: OutputPicture) -> av.filter.Graph:
    turned = output.rotation_deg in (90, 270)
    width, height = output.scaled_width, output.scaled_height
    stored_width, stored_height = (height, width) if turned else (width, height)
    matrix = colour_matrix(int(frame.colorspace), width=frame.width, height=frame.height)
    in_range = "full" if is_full_range(int(frame.color_range), frame.format.name) else "limited"
    # accurate_rnd and full_chroma_int would cost 8 ms a frame instead of 0.5 and gain 2 levels at edges of colours.
    scale = f"scale={stored_width}:{stored_height}:flags=bicubic:in_color_matrix={matrix}:in_range={in_range}"
    to_yuv = output.pixel_format == "yuv420p"
    is_rgb = frame.format.is_rgb
    if to_yuv:
        scale += f":out_range=limited:out_color_matrix={BT709_NAME if is_rgb else matrix}"
    else:
        scale += ":out_range=full"
    steps = [scale, f"format={output.pixel_format}", *_TURNS[output.rotation_deg]]
    if to_yuv and not is_rgb and matrix != BT709_NAME:
        # swscale goes from matrix to matrix by way of truncated RGB, which darkens by 3 levels.
        same = "primaries=bt709:iprimaries=bt709:trc=bt709:itrc=bt709:range=tv:irange=tv"
        steps.append(f"colorspace=space=bt709:ispace={_COLORSPACE_NAMES.get(matrix, matrix)}:{same}:fast=1")
    if (width, height) != (output.width, output.height):
        steps.append(f"crop={output.width}:{output.height}:{output.crop_x}:{output.crop_y}")
    return _graph(frame, steps)


def _graph(frame: av.VideoFrame, steps: list[str]) -> av.filter.Graph:
    tick = _tick(frame)
    source = (
        f"video_size={frame.width}x{frame.height}:pix_fmt={frame.format.name}:time_base={tick.numerator}/"
        f"{tick.denominator}:pixel_aspect=1/1:colorspace={int(frame.colorspace)}:range={int(frame.color_range)}"
    )
    graph = av.filter.Graph()
    graph.threads = 1
    nodes = [graph.add("buffer", source)]
    for step in steps:
        name, _, arguments = step.partition("=")
        nodes.append(graph.add(name, arguments))
    nodes.append(graph.add("buffersink"))
    graph.link_nodes(*nodes)
    graph.configure()
    return graph


def _tick(frame: av.VideoFrame) -> Fraction:
    return frame.time_base if frame.time_base else Fraction(1, 1000)


def _drained(graph: av.filter.Graph, time_base: Fraction) -> Iterator[av.VideoFrame]:
    graph.vpush(None)
    yield from _pulled(graph, time_base)


def _pulled(graph: av.filter.Graph, time_base: Fraction) -> Iterator[av.VideoFrame]:
    while True:
        try:
            frame = graph.vpull()
        except (BlockingIOError, EOFError):
            return
        if frame.pts is not None and frame.time_base is not None:
            # bwdif halves the tick to make room for a picture per field.
            frame.pts, frame.time_base = round(frame.pts * frame.time_base / time_base), time_base
        yield frame
