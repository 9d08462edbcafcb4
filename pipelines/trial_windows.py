"""Which part of the footage a plan is measured on: windows around clips that the packets show to be whole, so that
there is always something to measure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from dataset.receipts import hashed_share
from labeling.timeline import FPS, ClipSettings, Span, plan_clips, plan_timeline
from labeling.video import read_packet_times
from pipelines.sources import Source

_WINDOWS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceClips:
    """Where the clips of a video lie on its grid."""

    frames: int
    """Of the grid."""
    clips: tuple[Span, ...]
    """In order; those that touch a hole or what is left out are not among them."""

    def around(self, clips: Sequence[Span]) -> tuple[float, float]:
        """Seconds to leave out at the start and at the end so that only ``clips`` are left, half a frame to spare."""
        return max(0.0, (clips[0].start - 0.5) / FPS), max(0.0, (self.frames - clips[-1].end - 0.5) / FPS)

    def cut_to(self, frames: int) -> "SourceClips":
        """The first ``frames`` of each clip alone."""
        return replace(self, clips=tuple(replace(clip, end=min(clip.end, clip.start + frames)) for clip in self.clips))


def read_clips(source: Source, clip: ClipSettings) -> SourceClips:
    """The clips of a video, from its packets.

    Raises:
        VideoError: it is no video that can be used.
    """
    timeline = plan_timeline(read_packet_times(source.path).times_s)
    plan = plan_clips(
        timeline, clip_frames=clip.clip_frames, stride_frames=clip.stride_frames, leave_out_s=source.leave_out_s
    )
    return SourceClips(frames=len(timeline), clips=plan.kept)


def plan_windows(
    sources: Sequence[Source], clips_of: Callable[[Source], SourceClips], *, clip_frames: int, seconds: float
) -> list[Source]:
    """Some of the videos with all but some clips in their middle left out, ``seconds`` together.

    Videos are drawn by the hash of their id; each gives an equal share, at least one clip, short ones all they have.
    Those that hold no clip are passed over, since nothing could be measured on them.
    """
    drawn = sorted(sources, key=lambda source: hashed_share("plan", source.video_id))
    windows: list[Source] = []
    left = seconds * FPS
    for source in drawn:
        if windows and left < clip_frames:
            break
        found = clips_of(source)
        if found.clips:
            share = left / max(1, min(_WINDOWS, len(drawn)) - len(windows))
            clips = middle_clips(found.clips, share)
            windows.append(replace(source, leave_out_s=found.around(clips)))
            left -= clips[-1].end - clips[0].start
    return windows


def middle_clips(clips: Sequence[Span], frames: float) -> Sequence[Span]:
    """Neighbours around the middle clip that span at most ``frames``, and at least that clip."""
    first = last = len(clips) // 2
    while True:
        wider = [(max(0, first - 1), last), (first, min(len(clips) - 1, last + 1))]
        fits = [(a, b) for a, b in wider if (a, b) != (first, last) and clips[b].end - clips[a].start <= frames]
        if not fits:
            return clips[first : last + 1]
        # The side that has had less comes first, so that the window stays in the middle.
        first, last = min(fits, key=lambda pair: abs(pair[0] + pair[1] - len(clips) + 1))
