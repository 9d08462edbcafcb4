"""Opening video files and reading their packets, whatever state they are in."""

import math
from collections.abc import Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import av
import av.container
import av.error
from av.stream import Discard, Disposition

from labeling.errors import VideoError
from labeling.mp4_boxes import top_level_boxes

SAME_TIME_S = 1e-6
"""Two times closer than this are the same frame's."""

_MOST_DEMUX_ERRORS = 100
# Ever further back, to find a keyframe that is really shown before the wanted frame.
_SEEK_BACK_S = (0.0, 0.5, 2.0, 8.0, 32.0)


def open_video(path: Path) -> av.container.InputContainer:
    """Open a file for reading.

    Raises:
        VideoError: no such file, a folder, zero bytes, not a video, no index; the message says which.
    """
    if not path.exists():
        raise VideoError(f"{path}: no such file; check the path")
    if path.is_dir():
        raise VideoError(f"{path}: is a folder; give a video file")
    if path.stat().st_size == 0:
        raise VideoError(f"{path}: is empty (0 bytes); get the file again")
    try:
        return av.open(str(path))
    except (av.error.FFmpegError, OSError) as error:
        raise VideoError(_why_unreadable(path, error)) from error


def _why_unreadable(path: Path, error: Exception) -> str:
    if isinstance(error, PermissionError):
        return f"{path}: may not be read ({error.strerror}); change its permissions"
    boxes = [box.name for box in top_level_boxes(path)]
    if "ftyp" in boxes and "moov" not in boxes:
        return (
            f"{path}: is an MP4 without its index (no moov box: found {', '.join(boxes)}); the recording or the copy "
            "was cut off, get the file again"
        )
    return f"{path}: is not a video that can be read ({error.__class__.__name__}); check what the file is"


def pick_video_stream(container: av.container.InputContainer, path: Path) -> av.VideoStream:
    """The first video stream that is not a cover picture; the others are not read any more.

    Raises:
        VideoError: there is none, or its codec is not known here.
    """
    streams = [stream for stream in container.streams.video if not stream.disposition & Disposition.attached_pic]
    if not streams:
        kinds = sorted({stream.type for stream in container.streams})
        raise VideoError(f"{path}: has no video stream, only {', '.join(kinds) or 'nothing'}; give a video file")
    if streams[0].codec_context is None:
        raise VideoError(f"{path}: its codec is not known here; convert it to H.264 first")
    chosen = streams[0]
    for stream in container.streams:
        if stream.index != chosen.index:
            stream.discard = Discard.all
    return chosen


def seconds(pts: int, time_base: Fraction) -> float:
    """A count of ticks in seconds, rounded once."""
    return pts * time_base.numerator / time_base.denominator


def read_packets(container: av.container.InputContainer, stream: av.VideoStream) -> Iterator[av.Packet | None]:
    """Packets, with None wherever the file could not be read; ends with the empty packet that flushes a decoder."""
    errors = 0
    while True:
        try:
            for packet in container.demux(stream):
                errors = 0
                yield packet
            return
        except av.error.FFmpegError:
            errors += 1
            if errors > _MOST_DEMUX_ERRORS:
                return
            yield None


def read_packets_from(
    container: av.container.InputContainer, stream: av.VideoStream, start_s: float
) -> Iterator[av.Packet | None]:
    """Packets from a keyframe that is shown at or before ``start_s``; from the first if there is none."""
    tick = float(stream.time_base or 0)
    for back_s in _SEEK_BACK_S if math.isfinite(start_s) and tick else ():
        try:
            container.seek(round((start_s - back_s) / tick), stream=stream)
        except av.error.FFmpegError:
            continue
        following = read_packets(container, stream)
        for packet in following:
            if packet is not None and packet.is_keyframe and packet.pts is not None:
                if seconds(packet.pts, packet.time_base) <= start_s + SAME_TIME_S:
                    return chain([packet], following)
                break
    try:
        container.seek(-(2**62), stream=stream)
    except av.error.FFmpegError:
        container.seek(0)
    return read_packets(container, stream)
