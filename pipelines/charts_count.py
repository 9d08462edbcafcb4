"""``animatic chart count``: how few looks rank clips as looking at every frame does."""

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from dataset.selection import count_objects, object_threshold, plan_looks
from dataset.street import StreetConfig, write_street_video
from labeling.camera import cover_map
from labeling.detection import Detector
from labeling.errors import ModelError
from labeling.model_cards import YoloxCard, find_weights, load_cards
from labeling.timeline import Span, Timeline, plan_clips, plan_timeline
from labeling.video import PacketTimes, decode_at, decode_frames, read_packet_times
from pipelines.charts import Chart, ChartPoint, Cost, Error, machine_name
from pipelines.config import COUNTED_CLASSES

_DETECTOR = "street_detector"
_SCENARIOS = ("traffic", "empty", "drive", "parked", "crossing", "stop_and_go", "sharp_turn", "fast")
_WIDTH, _HEIGHT = 528, 352
_KEEP_SHARE = 0.5
_MIN_SCORE = 0.3
_DRAWS = 400


@dataclass(frozen=True, slots=True, kw_only=True)
class _Size:
    """How much is looked at."""

    videos: int
    """The first of the scenarios."""
    frames: int
    """Of each."""
    clip_frames: int
    stride_frames: int


_WHOLE = _Size(videos=len(_SCENARIOS), frames=313, clip_frames=121, stride_frames=48)
_QUICK = _Size(videos=5, frames=45, clip_frames=25, stride_frames=20)
"""Drawing a frame and looking at it cost most, so clips are of a second; enough of them to be ranked wrongly."""

LookPlan = Callable[[Timeline, Sequence[Span], PacketTimes], np.ndarray]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Video:
    path: Path
    packets: PacketTimes
    timeline: Timeline
    clips: tuple[Span, ...]


def chart(name: str, *, quick: bool = False) -> Chart:
    """Overlap of the kept halves with the half that counts on every frame keep, against milliseconds per source frame.

    Every method decodes what it looks at and runs the shipped street detector; the videos go from empty to dense.
    Methods take turns over the videos. The error's spread is over drawings of the videos with replacement.

    Raises:
        ModelError: the street detector's weights are not there.
    """
    detector = _open_detector()
    with tempfile.TemporaryDirectory() as folder:
        videos = _make_videos(Path(folder), _QUICK if quick else _WHOLE)
        frames = sum(len(video.packets.times_s) for video in videos)
        counts: dict[str, list[list[float]]] = {method: [] for method in _METHODS}
        seconds: dict[str, list[float]] = {method: [] for method in _METHODS}
        for video in videos:
            for method, plan in _METHODS.items():
                start = time.process_time()
                counts[method].append(_count(video, plan, detector))
                seconds[method].append((time.process_time() - start) * 1000 / len(video.packets.times_s))
    truth = counts[_REFERENCE]
    points = tuple(
        ChartPoint(
            method=method,
            ms_per_frame=Cost(
                median=float(np.median(seconds[method])),
                p95=float(np.percentile(seconds[method], 95)),
                runs=len(videos),
                over="videos",
            ),
            error=_error(counts[method], truth),
            reference=method in (_REFERENCE, _TRIVIAL),
        )
        for method in _METHODS
    )
    data = f"{len(videos)} street videos, {sum(map(len, truth))} clips, {frames} frames of {_WIDTH}x{_HEIGHT}"
    return Chart(stage=name, data=data, points=points, machine=machine_name())


def _open_detector() -> Detector:
    card = load_cards()[_DETECTOR]
    path = find_weights(card)
    if path is None or not isinstance(card, YoloxCard):
        raise ModelError(f"{_DETECTOR}: its weights {card.file} are not there; make them with `make street-models`")
    return Detector(card, path)


def _make_videos(folder: Path, size: _Size) -> list[_Video]:
    videos = []
    for seed, scenario in enumerate(_SCENARIOS[: size.videos]):
        path = folder / f"{scenario}.mp4"
        write_street_video(
            StreetConfig(seed=900 + seed, scenario=scenario, frames=size.frames, width=_WIDTH, height=_HEIGHT), path
        )
        packets = read_packet_times(path)
        timeline = plan_timeline(packets.times_s)
        clips = plan_clips(timeline, clip_frames=size.clip_frames, stride_frames=size.stride_frames).kept
        videos.append(_Video(path=path, packets=packets, timeline=timeline, clips=clips))
    return videos


def _looks(timeline: Timeline, clips: Sequence[Span], packets: PacketTimes, *, per_clip: int) -> np.ndarray:
    return plan_looks(timeline, clips, packets.times_s[packets.is_keyframe], looks_per_clip=per_clip)


def _spread(timeline: Timeline, clips: Sequence[Span], packets: PacketTimes, *, per_clip: int) -> np.ndarray:
    return plan_looks(timeline, clips, np.empty(0), looks_per_clip=per_clip)


def _regular(timeline: Timeline, clips: Sequence[Span], packets: PacketTimes, *, per_second: float) -> np.ndarray:
    return packets.times_s[:: round(24 / per_second)]


def _none(timeline: Timeline, clips: Sequence[Span], packets: PacketTimes) -> np.ndarray:
    return np.empty(0)


_REFERENCE, _TRIVIAL = "every frame", "no look"
_METHODS: dict[str, LookPlan] = {
    _TRIVIAL: _none,
    "1 look per clip": partial(_spread, per_clip=1),
    "2 looks per clip": partial(_spread, per_clip=2),
    "keyframes (default)": partial(_looks, per_clip=2),
    "2 per second": partial(_regular, per_second=2),
    "8 per second": partial(_regular, per_second=8),
    _REFERENCE: partial(_regular, per_second=24),
}


def _count(video: _Video, plan: LookPlan, detector: Detector) -> list[float]:
    """Objects per clip of one video by one method."""
    looks = plan(video.timeline, video.clips, video.packets)
    picture = cover_map(_WIDTH, _HEIGHT, width=_WIDTH, height=_HEIGHT)
    # Many looks are cheaper in one pass than by seeking.
    one_pass = len(looks) * 4 > len(video.packets.times_s)
    source = decode_frames(video.path) if one_pass else decode_at(video.path, list(looks), picture=picture)
    wanted = set(np.round(looks, 6).tolist())
    times, classes, scores = [], [], []
    for frame in source:
        if one_pass and round(frame.time_s, 6) not in wanted:
            continue
        found = detector.detect([frame.rgb])[0].distinct()
        times.append(frame.time_s)
        classes.append(found.classes.tolist())
        scores.append(found.scores.tolist())
    objects = count_objects(
        video.timeline, video.clips, look_times_s=np.array(times), classes=classes, scores=scores,
        counted=COUNTED_CLASSES, min_score=_MIN_SCORE,
    )  # fmt: skip
    return [value or 0.0 for value in objects]


def _error(counts: list[list[float]], truth: list[list[float]]) -> Error:
    rng = np.random.default_rng(0)
    draws = [rng.integers(0, len(truth), len(truth)) for _ in range(_DRAWS)]
    missed = [_missed([counts[i] for i in draw], [truth[i] for i in draw]) for draw in draws]
    return Error(
        metric="kept clips that every frame would not keep", unit="%", median=_missed(counts, truth),
        p95=float(np.percentile(missed, 95)),
    )  # fmt: skip


def _missed(counts: list[list[float]], truth: list[list[float]]) -> float:
    kept, right = _kept(counts), _kept(truth)
    # Ties at the threshold are all kept: what one method keeps too many counts as much as what it keeps wrongly.
    return 100.0 * (1 - float((kept & right).sum()) / max(1, int(kept.sum()), int(right.sum())))


def _kept(counts: list[list[float]]) -> np.ndarray:
    values = np.array([value for video in counts for value in video])
    threshold = object_threshold(values.tolist(), _KEEP_SHARE)
    return values >= (threshold if threshold is not None else -np.inf)
