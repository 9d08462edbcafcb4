"""Constant-rate MP4 files: H.264 in closed GOPs, BT.709 limited range, the same bytes for the same frames.

``libx264rgb`` at crf 0 keeps every pixel, for drawings whose colours mean something.
"""

import contextlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import av
import av.container
import av.error
import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from labeling.conversion import tag_bt709
from labeling.errors import ConfigError, StorageError, VideoError
from labeling.mp4_boxes import indexed_frames
from labeling.sources import open_video, pick_video_stream

Codec = Literal["libx264", "libx264rgb"]
Preset = Literal["ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow"]


# With AVX-512 x264's macroblock tree reads memory that it never wrote: the same frames gave up to 7 different files in
# 150 encodes (measured, 96x64 to 1056x704). With AVX2 they never do, at the same speed and size.
_CPU_AVX_512F = 13
_REPRODUCIBLE = ":asm=avx2" if cv2.checkHardwareSupport(_CPU_AVX_512F) else ""


class EncoderSettings(BaseModel):
    """How video is encoded. The thread count is part of the result: x264 makes other pixels with 1, 2 or 3 threads."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    codec: Codec = "libx264"
    """``libx264`` is YUV 4:2:0; ``libx264rgb`` keeps full-resolution RGB."""
    crf: int = Field(default=18, ge=0, le=51)
    """Constant rate factor; 0 is lossless."""
    preset: Preset = "veryfast"
    threads: int = Field(default=1, ge=1, le=64)
    gop: int = Field(default=24, ge=1, le=600)
    """Frames from one keyframe to the next; clips start on keyframes, so strides are multiples of it."""
    b_frames: int = Field(default=3, ge=0, le=16)
    """Most B-frames in a row."""


def lossless_rgb(*, threads: int = 1) -> EncoderSettings:
    """Settings for skeletons: every pixel comes back as it went in."""
    return EncoderSettings(codec="libx264rgb", crf=0, preset="ultrafast", threads=threads, b_frames=0)


class VideoWriter:
    """Writes frames one by one to a constant-rate MP4; a context manager. After an error the file is taken away.

    Raises:
        ConfigError: odd sizes with ``libx264``.
        StorageError: no space left, an unwritable folder.
        VideoError: a frame of another size or type.
    """

    def __init__(
        self,
        path: Path,
        *,
        width: int,
        height: int,
        fps: int | Fraction = 24,
        settings: EncoderSettings | None = None,
    ) -> None:
        self._path = Path(path)
        self._size = (width, height)
        self._settings = settings or EncoderSettings()
        self._rate = Fraction(fps)
        self._index = 0
        if self._settings.codec == "libx264" and (width % 2 or height % 2):
            raise ConfigError(f"{width}x{height}: H.264 in 4:2:0 needs even sizes; round them or take libx264rgb")
        with storage_errors(self._path):
            # Without bitexact the muxer would write its version into the file.
            self._container = av.open(str(self._path), "w", format="mp4", options={"fflags": "+bitexact"})
            self._stream = self._container.add_stream(self._settings.codec, rate=self._rate, options=self._options())
            self._configure()

    def _options(self) -> dict[str, str]:
        chosen = self._settings
        quality = {"qp": "0"} if chosen.crf == 0 else {"crf": str(chosen.crf)}
        x264 = f"keyint={chosen.gop}:min-keyint={chosen.gop}:scenecut=0:open-gop=0"
        x264 += _REPRODUCIBLE
        return {**quality, "preset": chosen.preset, "bf": str(chosen.b_frames), "x264-params": x264}

    def _configure(self) -> None:
        stream, context = self._stream, self._stream.codec_context
        context.width, context.height = self._size
        context.pix_fmt = "yuv420p" if self._settings.codec == "libx264" else "rgb24"
        context.time_base = 1 / self._rate
        stream.time_base = 1 / self._rate
        context.gop_size = self._settings.gop
        context.thread_count = self._settings.threads
        if self._settings.codec == "libx264":
            tag_bt709(context)

    def write(self, rgb: np.ndarray) -> None:
        """Append a (H, W, 3) uint8 RGB picture."""
        width, height = self._size
        if rgb.shape != (height, width, 3) or rgb.dtype != np.uint8:
            raise VideoError(
                f"{self._path.name}: frame {self._index} is {rgb.shape} {rgb.dtype}; give ({height}, {width}, 3) uint8"
            )
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        if self._settings.codec == "libx264":
            frame = frame.reformat(
                format="yuv420p", src_color_range="JPEG", dst_color_range="MPEG", dst_colorspace="ITU709",
                interpolation="BICUBIC",
            )  # fmt: skip
            tag_bt709(frame)
        self.write_frame(frame)

    def write_frame(self, frame: av.VideoFrame) -> None:
        """Append a frame that already has the encoder's size, pixel format and colours."""
        frame.pts, frame.time_base = self._index, 1 / self._rate
        frame.pict_type = 0  # the source's choice of keyframes is not ours
        with storage_errors(self._path):
            self._container.mux(self._stream.encode(frame))
        self._index += 1

    def close(self) -> None:
        """Flush the encoder, write the index, and check that all of it arrived on the disk.

        Raises:
            VideoError: no frame was given.
        """
        if not self._index:
            raise VideoError(f"{self._path.name}: not one frame was given; a video has at least one")
        with storage_errors(self._path):
            self._container.mux(self._stream.encode(None))
            self._container.close()
        check_written(self._path, self._index)

    def abort(self) -> None:
        """Give up and take the unfinished file away."""
        with contextlib.suppress(Exception):
            self._container.close()
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self.abort()
            return
        try:
            self.close()
        except BaseException:
            self.abort()
            raise


def copy_packets(source: Path, out: Path, *, start: int, end: int) -> None:
    """Copy frames ``[start, end)`` of one of our constant-rate files by packets: nothing is decoded.

    Raises:
        VideoError: as ``open_video``; the file holds no such frames, or they are not whole: ``start`` is no keyframe,
            or B-frames at the end need a frame beyond it.
        StorageError: no space left, an unwritable folder.
    """
    with open_video(source) as container:
        stream = pick_video_stream(container, source)
        packets = _packets_between(container, stream, start, end)
        _check_whole(packets, source, start=start, end=end)
        shift = min(packet.pts for packet in packets if packet.pts is not None)
        try:
            with storage_errors(out):
                _mux_copy(packets, stream, out, shift)
            check_written(out, end - start)
        except BaseException:
            with contextlib.suppress(OSError):
                out.unlink(missing_ok=True)
            raise


def _mux_copy(packets: list[av.Packet], template: av.VideoStream, out: Path, shift: int) -> None:
    with av.open(str(out), "w", format="mp4", options={"fflags": "+bitexact"}) as target:
        stream = target.add_stream_from_template(template)
        stream.time_base = template.time_base
        for packet in packets:
            if packet.pts is not None and packet.dts is not None:
                packet.pts, packet.dts = packet.pts - shift, packet.dts - shift
            packet.stream = stream
            target.mux(packet)


def _packets_between(
    container: av.container.InputContainer, stream: av.VideoStream, start: int, end: int
) -> list[av.Packet]:
    """Packets of frames ``[start, end)`` in decoding order, up to the last of them."""
    if stream.time_base is None or stream.average_rate is None:
        return []
    tick = 1 / (stream.average_rate * stream.time_base)
    container.seek(round(start * tick), stream=stream)
    packets: list[av.Packet] = []
    inside = 0
    for packet in container.demux(stream):
        if packet.pts is None:
            continue
        frame = round(packet.pts / tick)
        if start <= frame < end or packets:
            packets.append(packet)
        inside += start <= frame < end
        if inside == end - start:
            return packets
    return packets


def _check_whole(packets: list[av.Packet], source: Path, *, start: int, end: int) -> None:
    if len(packets) < end - start:
        raise VideoError(f"{source}: has {len(packets)} of the {end - start} frames [{start}, {end}); check the span")
    if not packets[0].is_keyframe:
        raise VideoError(f"{source}: frame {start} is not a keyframe; make the stride a multiple of the GOP")
    if len(packets) > end - start:
        raise VideoError(
            f"{source}: frames [{start}, {end}) cannot be copied alone, B-frames reach out of them; "
            "make clip_frames a multiple of the GOP, plus one, or set b_frames to 0"
        )


def check_written(path: Path, frames: int) -> None:
    """Raise ``StorageError`` unless the index lists that many frames: a muxer may swallow a failed last write."""
    found = indexed_frames(path)
    if found != frames:
        raise StorageError(f"{path}: holds {found} of {frames} frames; free some space and start again")


@contextlib.contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn the operating system's refusals to write into a ``StorageError`` that names the file."""
    try:
        yield
    except av.error.InvalidDataError:
        raise
    except OSError as error:
        raise StorageError(
            f"{path}: cannot be written ({error.strerror or error}); free space or choose another folder"
        ) from error
