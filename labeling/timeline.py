"""The 24 fps grid, the clips and runs on it, and the runs' video files.

Plans are pure; ``cut_run`` and ``copy_clip`` do the work. Spans are half-open in frames of the video's grid.
"""

import math
import re
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from labeling.camera import PictureMap
from labeling.conversion import FrameConverter, OutputPicture
from labeling.encoding import EncoderSettings, VideoWriter, copy_packets
from labeling.errors import ConfigError, VideoError
from labeling.read_ahead import read_ahead
from labeling.run_encoder import RunEncoder, converted_frames
from labeling.video import HOLE_S, SAME_TIME_S, probe, source_frames

FPS = 24

# Times come from integer ticks of 1e-6 s or more, so a tie is exact but for rounding.
_TIE_S = 1e-7
_MOST_SHOWN, _MOST_GRID = 1000, 24 * 3600 * FPS
"""No source has so few frames, or so long a hole, unless one of its times is wrong: frames of the grid for each of
its frames, and a day beside."""
# Decoding and converting run beside encoding, as in ffmpeg itself.
_FRAMES_AHEAD = 4
_VIDEO_ID = re.compile(r"[A-Za-z0-9_-]+")
LONGEST_VIDEO_ID = 75
"""Names in a shard end at 100 bytes: the id, ``_``, seven digits of a start frame, and ``.cam_to_world.npy``."""


@dataclass(frozen=True, slots=True, kw_only=True, order=True)
class Span:
    """Frames ``[start, end)``."""

    start: int
    end: int

    def __len__(self) -> int:
        return self.end - self.start

    def contains(self, other: "Span") -> bool:
        """Whether all of ``other`` lies inside."""
        return self.start <= other.start and other.end <= self.end


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Timeline:
    """A source video on a grid of constant rate."""

    fps: int
    """Grid frame i is at i / fps after the source's first presentation time."""
    source_time_s: np.ndarray
    """(N,) float64, presentation time of the source frame that each grid frame shows."""
    duplicate: np.ndarray
    """(N,) bool, shows the same source frame as the grid frame before."""
    hole: np.ndarray
    """(N,) bool, lies inside a gap of the source."""

    def __len__(self) -> int:
        return len(self.source_time_s)


class ClipSettings(BaseModel):
    """How a timeline is divided."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    clip_frames: int = Field(default=121, ge=1)
    """121 frames are 5 s; LTX's VAE takes 8k+1."""
    stride_frames: int = Field(default=48, ge=1)
    """Frames from one clip's start to the next, a multiple of the GOP."""
    run_frames: int = Field(default=1440, ge=1)
    """Clips that start within the same stretch of this length share a run."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DroppedClip:
    """A clip that is not made, and why."""

    span: Span
    reason: str
    """A slug with its numbers, such as ``hole=13 frames from 12.500 s``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipPlan:
    """What becomes of every clip of a video."""

    kept: tuple[Span, ...]
    dropped: tuple[DroppedClip, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunFrames:
    """The table beside a run's video: one row per frame."""

    frame: np.ndarray
    """(N,) int32, index on the video's grid."""
    source_time_s: np.ndarray
    """(N,) float64."""
    duplicate: np.ndarray
    """(N,) bool, shows the picture of the frame before: the same source frame, or the next of a camera that froze."""
    hole: np.ndarray
    """(N,) bool, in a gap of the source, or its source frame did not decode: it shows a neighbour instead."""
    cut: np.ndarray
    """(N,) bool, the first frame of a new shot."""


def plan_timeline(packet_times_s: np.ndarray, *, fps: int = FPS) -> Timeline:
    """Lay source frames on a grid: each grid frame shows the nearest in time, of two equally near the earlier.

    Args:
        packet_times_s: (N,) float64, presentation times; need not be sorted.
        fps: frames per second of the grid.

    Raises:
        VideoError: no times, times that are not finite, or so far apart that one must be wrong.
    """
    times = np.unique(np.asarray(packet_times_s, dtype=np.float64))
    if len(times) == 0 or not np.isfinite(times).all():
        raise VideoError(f"a timeline needs finite presentation times, got {len(times)}; read the index again")
    t0 = float(times[0])
    count = math.floor((float(times[-1]) - t0) * fps + _TIE_S * fps) + 1
    if count > len(times) * _MOST_SHOWN + _MOST_GRID:
        raise VideoError(
            f"{len(times)} source frames span {float(times[-1]) - t0:.0f} s: a timestamp is wild; remux the file"
        )
    grid = t0 + np.arange(count) / fps
    after = np.searchsorted(times, grid - _TIE_S).clip(0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    chosen = np.where(np.abs(times[after] - grid) < np.abs(grid - times[before]) - _TIE_S, after, before)
    inside = (times[before] < grid - _TIE_S) & (grid + _TIE_S < times[after])
    source = times[chosen]
    return Timeline(
        fps=fps,
        source_time_s=source,
        duplicate=np.concatenate([[False], source[1:] == source[:-1]]),
        hole=inside & (times[after] - times[before] > HOLE_S + _TIE_S),
    )


def plan_clips(
    timeline: Timeline,
    *,
    clip_frames: int = 121,
    stride_frames: int = 48,
    leave_out_s: tuple[float, float] = (0.0, 0.0),
) -> ClipPlan:
    """Clips at every stride that fit, but for those that touch a hole or what is left out.

    Args:
        timeline: the video's grid.
        clip_frames: length of a clip.
        stride_frames: from one start to the next.
        leave_out_s: seconds at the video's start and at its end that no clip may touch (intros, credits).
    """
    count = len(timeline)
    if count < clip_frames:
        reason = f"too_short: frames={count} < clip_frames={clip_frames}"
        return ClipPlan(kept=(), dropped=(DroppedClip(span=Span(start=0, end=count), reason=reason),))
    first, last = leave_out_s[0] * timeline.fps, count - leave_out_s[1] * timeline.fps
    kept: list[Span] = []
    dropped: list[DroppedClip] = []
    for start in range(0, count - clip_frames + 1, stride_frames):
        span = Span(start=start, end=start + clip_frames)
        reason = _hole_reason(timeline.hole[span.start : span.end], start=start, fps=timeline.fps)
        if span.start < first:
            reason = f"left_out: start={start / timeline.fps:.3f} s < {leave_out_s[0]:g} s"
        elif span.end > last:
            reason = f"left_out: end={span.end / timeline.fps:.3f} s > {last / timeline.fps:.3f} s"
        if reason is None:
            kept.append(span)
        else:
            dropped.append(DroppedClip(span=span, reason=reason))
    return ClipPlan(kept=tuple(kept), dropped=tuple(dropped))


def plan_runs(kept: Sequence[Span], *, run_frames: int = 1440) -> list[Span]:
    """Runs: kept clips that start within the same stretch of ``run_frames``, merged where they overlap or touch."""
    runs: list[Span] = []
    for clip in sorted(kept):
        last = runs[-1] if runs else None
        same = last is not None and last.start // run_frames == clip.start // run_frames
        if last is not None and same and clip.start <= last.end:
            runs[-1] = Span(start=last.start, end=max(last.end, clip.end))
        else:
            runs.append(clip)
    return runs


def clip_fault(frames: RunFrames, clip: Span, *, fps: int = FPS) -> str | None:
    """Why a clip of a run cannot be used: it touches a hole or contains a hard cut; None when it is whole.

    Raises:
        VideoError: the clip does not lie inside the run.
    """
    start = clip.start - int(frames.frame[0])
    if start < 0 or clip.end - 1 > int(frames.frame[-1]):
        raise VideoError(f"clip [{clip.start}, {clip.end}) is outside the run; give one of its own clips")
    rows = slice(start, start + len(clip))
    reason = _hole_reason(frames.hole[rows], start=clip.start, fps=fps)
    # A cut at the clip's own first frame does no harm: nothing of the shot before is in it.
    cuts = np.flatnonzero(frames.cut[rows][1:]) + 1 + clip.start
    if reason is None and len(cuts):
        reason = f"cut={len(cuts)} first at {cuts[0] / fps:.3f} s"
    return reason


def _hole_reason(hole: np.ndarray, *, start: int, fps: int) -> str | None:
    at = np.flatnonzero(hole)
    return f"hole={len(at)} frames from {(start + at[0]) / fps:.3f} s" if len(at) else None


def check_video_id(video_id: str) -> str:
    """Return ``video_id`` if it can be part of a key.

    Raises:
        ConfigError: more than ``LONGEST_VIDEO_ID`` characters, or others than letters, digits, ``_`` and ``-``
            (WebDataset splits a name at its first dot).
    """
    if not _VIDEO_ID.fullmatch(video_id):
        raise ConfigError(
            f"video id {video_id!r} may hold only letters, digits, _ and -; rename the file or give an id"
        )
    if len(video_id) > LONGEST_VIDEO_ID:
        raise ConfigError(
            f"video id {video_id!r} has {len(video_id)} characters, and a shard's names have room for "
            f"{LONGEST_VIDEO_ID}; rename the file or give an id"
        )
    return video_id


def clip_key(video_id: str, start: int) -> str:
    """A clip's key, ``<video_id>_<start_frame>``."""
    return f"{check_video_id(video_id)}_{start}"


def run_name(span: Span) -> str:
    """A run's file name without suffix, ``run_<start>_<end>``."""
    return f"run_{span.start}_{span.end}"


def copy_clip(run_mp4: Path, run: Span, clip: Span, out_mp4: Path) -> None:
    """Write a clip of a run by copying packets: nothing is decoded, and its frames are those of the run, bit for bit.

    Raises:
        VideoError: the clip is not inside the run, or starts off the GOP grid.
        StorageError: no space left, an unwritable folder.
    """
    if not run.contains(clip):
        raise VideoError(f"clip [{clip.start}, {clip.end}) is outside run [{run.start}, {run.end}); plan again")
    copy_packets(Path(run_mp4), Path(out_mp4), start=clip.start - run.start, end=clip.end - run.start)


def cut_run(
    source: Path,
    timeline: Timeline,
    span: Span,
    out_mp4: Path,
    *,
    picture: PictureMap,
    encoder: EncoderSettings | None = None,
) -> RunFrames:
    """Transcode a run: each source frame it shows is decoded, converted and encoded once, one frame at a time.

    Source frames that do not decode, or that rest on such, become holes that show a neighbour.

    Raises:
        VideoError: the source cannot be read, or no frame of the run decodes.
        StorageError: no space left, an unwritable folder.
    """
    settings = encoder or EncoderSettings()
    info = probe(source)
    pixel_format = "yuv420p" if settings.codec == "libx264" else "rgb24"
    output = OutputPicture.of_map(picture, rotation_deg=info.rotation_deg, pixel_format=pixel_format)
    wanted = timeline.source_time_s[span.start : span.end]
    if len(wanted) != len(span) or len(wanted) == 0:
        raise VideoError(f"{source}: run [{span.start}, {span.end}) leaves the timeline's {len(timeline)} frames")
    frames = source_frames(
        source, start_s=float(wanted[0]), end_s=float(wanted[-1]) + 2 * SAME_TIME_S, deinterlace=info.interlaced
    )
    with VideoWriter(
        out_mp4, width=picture.width, height=picture.height, fps=timeline.fps, settings=settings
    ) as writer:
        run = RunEncoder(wanted, writer=writer)
        converted = converted_frames(frames, wanted, FrameConverter(output))
        with closing(read_ahead(converted, depth=_FRAMES_AHEAD)) as ahead:
            for frame in ahead:
                run.show(frame)
        run.finish(source)
    return RunFrames(
        frame=np.arange(span.start, span.end, dtype=np.int32),
        source_time_s=wanted.copy(),
        duplicate=run.repeated,
        hole=timeline.hole[span.start : span.end] | run.lost,
        cut=run.cuts(),
    )
