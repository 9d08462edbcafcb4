"""When a video's frames are shown, read from its packets alone."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from labeling.errors import VideoError
from labeling.mp4_boxes import is_cut_off
from labeling.sources import open_video, pick_video_stream, read_packets, seconds

HOLE_S = 0.25
"""A longer gap between source frames is a hole."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PacketTimes:
    """When a video's frames are shown, read from packets alone."""

    times_s: np.ndarray
    """(N,) float64, strictly increasing presentation times."""
    is_keyframe: np.ndarray
    """(N,) bool."""
    broken_packets: int
    """Packets that could not be read whole; their frames are not among ``times_s``."""


def read_packet_times(path: Path) -> PacketTimes:
    """Every frame's presentation time, without decoding one.

    Raises:
        VideoError: as ``probe``, or packets that carry no presentation times, or times that start again: recordings
            joined into one file, of which all but one would be lost.
    """
    path = Path(path)
    times: dict[float, bool] = {}
    broken = untimed = 0
    newest_key_s = -math.inf
    with open_video(path) as container:
        stream = pick_video_stream(container, path)
        for packet in read_packets(container, stream):
            if packet is None or packet.is_corrupt:
                broken += 1
            elif packet.size and not packet.is_discard:
                if packet.pts is None:
                    untimed += 1
                else:
                    time_s = seconds(packet.pts, packet.time_base)
                    if packet.is_keyframe and time_s < newest_key_s - HOLE_S:
                        raise VideoError(
                            f"{path}: timestamps start again at {time_s:.3f} s after {newest_key_s:.3f} s: recordings "
                            "were joined as they were; give them one by one, or remux them into one timeline"
                        )
                    newest_key_s = max(newest_key_s, time_s) if packet.is_keyframe else newest_key_s
                    times[time_s] = packet.is_keyframe
        if is_cut_off(path):
            broken = max(broken, stream.frames - len(times) - untimed)
    if untimed > len(times):
        raise VideoError(
            f"{path}: {untimed} of {untimed + len(times)} packets carry no presentation time; remux it first: "
            "ffmpeg -fflags +genpts -i IN -c copy OUT.mp4"
        )
    if not times:
        raise VideoError(f"{path}: holds no whole frame ({broken} broken packets); get the file again")
    ordered = sorted(times)
    return PacketTimes(
        times_s=np.array(ordered, dtype=np.float64),
        is_keyframe=np.array([times[time] for time in ordered], dtype=bool),
        broken_packets=broken,
    )
