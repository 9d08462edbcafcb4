"""Reading video: what a file is, when its frames are shown, and its pictures by time.

Times are presentation times in seconds, exactly as the container gives them (not from zero). Frames are found by those
times, never by index: sources run at variable rates.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path

import av
import av.container
import av.error
import numpy as np

from labeling.camera import PictureMap
from labeling.conversion import FrameConverter, OutputPicture, colour_matrix, deinterlaced, is_full_range
from labeling.encoding import EncoderSettings, VideoWriter, copy_packets, lossless_rgb
from labeling.errors import VideoError
from labeling.packet_times import HOLE_S, PacketTimes, read_packet_times
from labeling.sources import SAME_TIME_S, open_video, pick_video_stream, read_packets, read_packets_from, seconds

__all__ = [
    "SAME_TIME_S",
    "DecodedFrame",
    "EncoderSettings",
    "PacketTimes",
    "SourceFrame",
    "VideoInfo",
    "VideoWriter",
    "copy_packets",
    "decode_at",
    "decode_frames",
    "frame_count",
    "lossless_rgb",
    "probe",
    "read_frames",
    "read_packet_times",
    "source_frames",
]

_B_FRAME = 3
_PROBED_FRAMES = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoInfo:
    """What a video file is, as a person sees it: upright, with square pixels."""

    path: Path
    width: int
    """Upright, square pixels."""
    height: int
    coded_width: int
    """As stored, before pixel shape and rotation."""
    coded_height: int
    rotation_deg: int
    """Clockwise turn that makes the stored picture upright: 0, 90, 180 or 270."""
    codec: str
    pixel_format: str
    frame_rate: float
    """Nominal, frames per second; 0 when the file does not say."""
    duration_s: float
    """As the container claims; 0 when it does not say."""
    color_matrix: str
    """swscale's name; what untagged video is taken for."""
    color_tagged: bool
    full_range: bool
    interlaced: bool
    focal_35mm: float | None = None
    """Focal length for a picture with the diagonal of 35 mm film, mm, where the file's metadata say it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SourceFrame:
    """A decoded frame as the decoder gave it, neither turned nor scaled nor converted."""

    time_s: float
    picture: av.VideoFrame
    is_keyframe: bool
    is_clean: bool
    """False from a decoding error to the next keyframe: the picture may be made of what was left."""
    is_bidirectional: bool
    """A B-frame: it may rest on a frame that is shown after it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DecodedFrame:
    """A decoded frame, converted when its pixels are asked for."""

    time_s: float
    is_clean: bool
    """As in ``SourceFrame``."""
    picture: av.VideoFrame
    converter: FrameConverter

    @property
    def rgb(self) -> np.ndarray:
        """(H, W, 3) uint8, upright."""
        return self.converter.convert(self.picture).to_ndarray(format="rgb24")


def probe(path: Path) -> VideoInfo:
    """What ``path`` is, from its header and first frames.

    Raises:
        VideoError: no such file, a folder, zero bytes, no video, audio only, an index that is missing, or no frame that
            can be decoded; the message says which.
    """
    path = Path(path)
    with open_video(path) as container:
        stream = pick_video_stream(container, path)
        pictures = [
            frame.picture
            for frame, _ in zip(_decode(stream, read_packets(container, stream)), range(_PROBED_FRAMES), strict=False)
        ]
        if not pictures:
            raise VideoError(f"{path}: not one frame can be decoded ({stream.codec.name}); get the file again")
        return _video_info(path, container, stream, pictures)


def source_frames(
    path: Path, *, start_s: float = -math.inf, end_s: float = math.inf, deinterlace: bool = False, threads: int = 1,
    hole_s: float = HOLE_S,
) -> Iterator[SourceFrame]:  # fmt: skip
    """Frames shown in ``[start_s, end_s)``, in order, as the decoder gives them; what does not decode is left out.

    After a gap of more than ``hole_s`` frames are unclean, as after an error.

    Raises:
        VideoError: as ``probe``.
    """
    path = Path(path)
    with open_video(path) as container:
        stream = pick_video_stream(container, path)
        stream.thread_count = threads
        packets = read_packets_from(container, stream, start_s)
        frames = _decode(stream, packets, hole_s=hole_s)
        shown = _deinterlaced(frames) if deinterlace else frames
        for frame in shown:
            if frame.time_s >= end_s - SAME_TIME_S:
                return
            if frame.time_s >= start_s - SAME_TIME_S:
                yield frame


def decode_frames(
    path: Path, *, start_s: float = -math.inf, end_s: float = math.inf, picture: PictureMap | None = None,
    hole_s: float = HOLE_S,
) -> Iterator[DecodedFrame]:  # fmt: skip
    """Upright frames shown in ``[start_s, end_s)``, in order, at their own size or mapped by ``picture``.

    ``hole_s`` as for ``source_frames``.

    Raises:
        VideoError: as ``probe``.
    """
    info = probe(path)
    converter = _rgb_converter(info, picture)
    for frame in source_frames(path, start_s=start_s, end_s=end_s, deinterlace=info.interlaced, hole_s=hole_s):
        yield DecodedFrame(
            time_s=frame.time_s, is_clean=frame.is_clean, picture=frame.picture, converter=converter
        )  # fmt: skip


def decode_at(path: Path, times_s: Sequence[float], *, picture: PictureMap | None = None) -> Iterator[DecodedFrame]:
    """The frames shown at ``times_s`` (presentation times, in order), by seeks; a keyframe costs one decode.

    A time at which no frame decodes is left out, so compare ``time_s``. Interlaced pictures stay woven.

    Raises:
        VideoError: as ``probe``.
    """
    converter = _rgb_converter(probe(path), picture)
    with open_video(Path(path)) as container:
        stream = pick_video_stream(container, Path(path))
        for time_s in times_s:
            frame = _frame_at(container, stream, float(time_s))
            if frame is not None:
                yield DecodedFrame(
                    time_s=frame.time_s, is_clean=frame.is_clean, picture=frame.picture, converter=converter
                )  # fmt: skip


def read_frames(path: Path, *, start: int = 0, end: int | None = None) -> Iterator[np.ndarray]:
    """(H, W, 3) uint8 RGB frames ``[start, end)`` of one of *our* constant-rate files, by index.

    Raises:
        VideoError: as ``probe``, or the file ends before ``end``.
    """
    path = Path(path)
    count = frame_count(path)
    end = count if end is None else end
    if not 0 <= start <= end <= count:
        raise VideoError(f"{path}: has {count} frames, asked for [{start}, {end}); check the span")
    with open_video(path) as container:
        stream = pick_video_stream(container, path)
        rate = stream.average_rate or Fraction(24)
        first = float(Fraction(start) / rate)
        shown = 0
        converter = FrameConverter(
            OutputPicture.whole(stream.width, stream.height, rotation_deg=0, pixel_format="rgb24")
        )  # fmt: skip
        for frame in _decode(stream, read_packets_from(container, stream, first)):
            index = round(frame.time_s * rate)
            if index >= end:
                break
            if index >= start:
                shown += 1
                yield converter.convert(frame.picture).to_ndarray(format="rgb24")
    if shown != end - start:
        raise VideoError(f"{path}: {shown} of the frames [{start}, {end}) decode; the file is broken, make it again")


def frame_count(path: Path) -> int:
    """How many frames a file's index lists.

    Raises:
        VideoError: as ``probe``, or a container that lists none, such as Matroska.
    """
    with open_video(Path(path)) as container:
        count = pick_video_stream(container, Path(path)).frames
    if not count:
        raise VideoError(f"{path}: its container lists no frames; remux it: ffmpeg -i IN -c copy OUT.mp4")
    return count


def _rgb_converter(info: VideoInfo, picture: PictureMap | None) -> FrameConverter:
    if picture is None:
        output = OutputPicture.whole(info.width, info.height, rotation_deg=info.rotation_deg, pixel_format="rgb24")
    else:
        output = OutputPicture.of_map(picture, rotation_deg=info.rotation_deg, pixel_format="rgb24")
    return FrameConverter(output)


def _video_info(
    path: Path, container: av.container.InputContainer, stream: av.VideoStream, pictures: list[av.VideoFrame]
) -> VideoInfo:
    frame = pictures[0]
    aspect = stream.sample_aspect_ratio or Fraction(1)
    # Pixels are made square by enlarging the side they are long on, so that none is lost.
    width = round(frame.width * aspect) if aspect > 1 else frame.width
    height = round(frame.height / aspect) if 0 < aspect < 1 else frame.height
    rotation_deg = _upright_turn_deg(frame)
    if rotation_deg in (90, 270):
        width, height = height, width
    tag = int(frame.colorspace)
    duration_s = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
    return VideoInfo(
        path=path, width=width, height=height, coded_width=frame.width, coded_height=frame.height,
        rotation_deg=rotation_deg, codec=stream.codec_context.name, pixel_format=frame.format.name,
        frame_rate=float(stream.average_rate or stream.guessed_rate or 0),
        duration_s=duration_s or (container.duration or 0) / av.time_base,
        color_matrix=colour_matrix(tag, width=frame.width, height=frame.height), color_tagged=tag != 2,
        full_range=is_full_range(int(frame.color_range), frame.format.name),
        interlaced=any(picture.interlaced_frame for picture in pictures),
        focal_35mm=_focal_35mm({**container.metadata, **stream.metadata}),
    )  # fmt: skip


def _focal_35mm(metadata: Mapping[str, str]) -> float | None:
    """What phones and action cameras write: QuickTime's and Exif's names for the 35 mm equivalent."""
    for name, text in sorted(metadata.items()):
        plain = name.lower().replace("_", "").replace("-", "")
        if not plain.endswith(("focallength.35mmequivalent", "focallengthin35mmformat", "focallengthin35mmfilm")):
            continue
        try:
            value = float(text.removesuffix("mm").strip())
        except ValueError:
            continue
        if 5 <= value <= 500:
            return value
    return None


def _upright_turn_deg(frame: av.VideoFrame) -> int:
    """PyAV gives the display matrix's angle counter-clockwise; we turn clockwise, in quarters."""
    return round(-frame.rotation / 90) * 90 % 360


def _decode(
    stream: av.VideoStream, packets: Iterable[av.Packet | None], *, hole_s: float = HOLE_S
) -> Iterator[SourceFrame]:
    """Frames in the order they are shown. After an error, frames are unclean up to the next keyframe shown after it."""
    broken_at_s = -math.inf
    last_s = math.inf
    clean = True
    for packet in packets:
        pictures: list[av.VideoFrame] = []
        try:
            if packet is not None:
                pictures = stream.decode(packet)
        except av.error.FFmpegError:
            clean = False
        if packet is None or packet.is_corrupt:
            clean = False
        if not clean and packet is not None and packet.pts is not None and not pictures:
            broken_at_s = max(broken_at_s, seconds(packet.pts, packet.time_base))
        for picture in pictures:
            if picture.pts is None or picture.time_base is None:
                continue
            time_s = seconds(picture.pts, picture.time_base)
            # Lost packets need leave no other trace than the time that they should have filled.
            if picture.is_corrupt or (time_s - last_s > hole_s and not picture.key_frame):
                clean = False
            elif picture.key_frame and time_s > broken_at_s:
                clean = True
            yield SourceFrame(
                time_s=time_s, picture=picture, is_keyframe=picture.key_frame, is_clean=clean,
                is_bidirectional=int(picture.pict_type) == _B_FRAME,
            )  # fmt: skip
            last_s = time_s


def _deinterlaced(frames: Iterator[SourceFrame]) -> Iterator[SourceFrame]:
    waiting: dict[int | None, SourceFrame] = {}

    def pictures() -> Iterator[av.VideoFrame]:
        for frame in frames:
            waiting[frame.picture.pts] = frame
            yield frame.picture

    for picture in deinterlaced(pictures()):
        frame = waiting.pop(picture.pts, None)
        if frame is not None:
            yield SourceFrame(
                time_s=frame.time_s, picture=picture, is_keyframe=frame.is_keyframe, is_clean=frame.is_clean,
                is_bidirectional=frame.is_bidirectional,
            )  # fmt: skip


def _frame_at(container: av.container.InputContainer, stream: av.VideoStream, time_s: float) -> SourceFrame | None:
    packets = read_packets_from(container, stream, time_s)
    first = next(iter(packets), None)
    if first is None:
        return None
    whole = not first.is_corrupt and first.is_keyframe and first.pts is not None
    if whole and abs(seconds(first.pts or 0, first.time_base) - time_s) < SAME_TIME_S:
        return _lone_keyframe(stream, first, time_s)
    for frame in _decode(stream, chain([first], packets)):
        if frame.time_s >= time_s - SAME_TIME_S:
            return frame if frame.time_s <= time_s + SAME_TIME_S else None
    return None


def _lone_keyframe(stream: av.VideoStream, packet: av.Packet, time_s: float) -> SourceFrame | None:
    """A keyframe needs no other: flushing the decoder right behind it gives it out at once."""
    try:
        pictures = [*stream.decode(packet), *stream.decode(None)]
    except av.error.FFmpegError:
        return None
    if not pictures:
        return None
    return SourceFrame(
        time_s=time_s, picture=pictures[0], is_keyframe=True, is_clean=not pictures[0].is_corrupt,
        is_bidirectional=False,
    )  # fmt: skip
