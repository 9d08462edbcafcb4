"""What a job would take, before anything is spent: clips, disk and hours, from a minute of the footage itself.

Lengths come from the headers, of files that are cut off from the packets. Costs come from a small job on windows of the
same videos, with the same settings, in a scratch folder; a still smaller one before it pays for loading and compiling.
"""

import functools
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dataset.receipts import Receipt, read_receipts
from labeling.ego_calibration import ROAD_FRAMES
from labeling.errors import ConfigError, VideoError
from labeling.mp4_boxes import is_cut_off
from labeling.timeline import FPS, ClipSettings
from labeling.video import probe, read_packet_times
from pipelines.commands import JobOptions, chosen_cards, configured
from pipelines.config import Config
from pipelines.damage import damage_lines
from pipelines.engine import Engine
from pipelines.job import Job
from pipelines.label import ALL_STAGES, Reporter, StageReport, run_stages
from pipelines.models import check_models_folder
from pipelines.sources import Source, find_videos, likely_twins, with_leave_out
from pipelines.stage import Part
from pipelines.stages_source import packet_facts
from pipelines.trial_windows import SourceClips, plan_windows, read_clips

CALIBRATION_S = 60.0
_WARM_UP_FRAMES = 25
"""Of a clip: enough for every stage to have something to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StageCost:
    """One stage of the whole job."""

    stage: str
    core_hours: float
    disk_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class JobPlan:
    """What the job would take."""

    videos: int
    broken: tuple[str, ...]
    """Videos that cannot be opened, with the reason."""
    damaged: tuple[str, ...]
    """Videos that are less than they claim, as far as is known: files cut off, and those that were measured on."""
    twins: dict[str, str]
    """By video id, the video that has the same bytes and is counted in its place."""
    too_short: int
    """Videos that are shorter than a clip, less what is left out of them."""
    clip_frames: int
    """Of one clip."""
    source_hours: float
    clips: int
    """Candidates: all that fit on the videos' timelines, twins' left out; of the videos that were measured on, those
    without a hole."""
    kept_clips: int
    """Kept by their objects."""
    sampled_clips: int
    """Taken of the kept ones."""
    clip_hours: float
    """Of the sampled clips, overlaps counted as often as they occur."""
    stages: tuple[StageCost, ...]
    calibration_s: float
    """Seconds of footage that costs were measured on."""
    calibration_clips: int
    """Clips that were labelled for it."""
    calibration_videos: int
    """Videos that these are of."""
    workers: int
    parts: int
    largest_part: float
    """Share of the footage that falls to the busiest host."""

    @property
    def core_hours(self) -> float:
        """Over all stages and hosts."""
        return sum(stage.core_hours for stage in self.stages)

    @property
    def disk_bytes(self) -> int:
        """All that is left in the job's folder."""
        return sum(stage.disk_bytes for stage in self.stages)

    @property
    def hours_per_host(self) -> float:
        """Until the busiest host is done."""
        return self.core_hours * self.largest_part / self.workers


def plan_job(
    videos: Sequence[Path], options: JobOptions, *, workers: int, parts: int = 1, calibration_s: float = CALIBRATION_S
) -> JobPlan:
    """The plan of ``animatic label`` with the same videos and options.

    Raises:
        ConfigError: settings or videos that cannot be used, or no video long enough for a clip.
    """
    config = configured(Config(), options)
    check_models_folder(options.models)
    sources = find_videos(videos)
    chosen_cards(Job(Path(), config, {}, models_dir=options.models))
    if options.leave_out is not None:
        by_id = {source.video_id: source for source in sources}
        sources = list(with_leave_out(by_id, options.leave_out).values())
    lengths, cut_off, broken = _lengths_s(sources)
    candidates = {name: count_candidates(length, config.clip) for name, length in lengths.items()}
    long_enough = [source for source in sources if candidates.get(source.video_id)]
    twins = likely_twins([source for source in sources if source.video_id in lengths])
    usable = [source for source in long_enough if source.video_id not in twins]
    if not usable:
        raise ConfigError(
            f"none of {len(sources)} videos is long enough for one clip of {config.clip.clip_frames} frames "
            f"({_clip_s(config.clip):g} s); give longer videos, or a smaller clip.clip_frames with --config"
        )
    clips_of = functools.cache(functools.partial(read_clips, clip=config.clip))
    receipts = _calibrate(usable, clips_of, config, options.models, seconds=calibration_s)
    measured = _Measured.of(receipts)
    candidates |= {
        source.video_id: len(clips_of(source).clips) for source in usable if source.video_id in receipts["index"]
    }
    judged = {name: count for name, count in candidates.items() if name not in twins}
    total = sum(judged.values())
    kept = max(1, round(total * measured.kept_clips / measured.clips))
    sampled = min(kept, config.select.sample_clips or kept)
    looked = {name: receipt.facts for name, receipt in receipts["index"].items()}
    damaged = damage_lines(cut_off | looked, receipts["cut"].values())
    return JobPlan(
        videos=len(lengths), broken=broken, damaged=tuple(damaged), twins=twins,
        too_short=len(lengths) - len(long_enough), clip_frames=config.clip.clip_frames,
        source_hours=sum(lengths.values()) / 3600,
        clips=total, kept_clips=kept, sampled_clips=sampled, clip_hours=sampled * _clip_s(config.clip) / 3600,
        stages=_scaled(
            receipts, measured, lengths, candidates=judged, counted=sum(candidates.values()), sampled=sampled
        ),
        calibration_s=measured.window_s, calibration_clips=measured.kept_clips,
        calibration_videos=measured.videos, workers=workers, parts=parts,
        largest_part=_largest_part({name: length for name, length in lengths.items() if name not in twins}, parts),
    )  # fmt: skip


def count_candidates(length_s: float, clip: ClipSettings) -> int:
    """Clips that fit on a timeline of that length."""
    frames = int(length_s * FPS) + 1
    return 0 if frames < clip.clip_frames else (frames - clip.clip_frames) // clip.stride_frames + 1


def _lengths_s(
    sources: Sequence[Source],
) -> tuple[dict[str, float], dict[str, Mapping[str, Any]], tuple[str, ...]]:
    """Usable seconds by video, what the packets of files that are cut off hold, and those that cannot be opened."""
    lengths: dict[str, float] = {}
    cut_off: dict[str, Mapping[str, Any]] = {}
    broken = []
    for source in sources:
        try:
            info = probe(source.path)
            # The last frame is shown for its own time: the timeline ends where it begins.
            length_s = info.duration_s - 1 / (info.frame_rate or FPS)
            if is_cut_off(source.path):
                # The header promises what is no longer there; only the packets know.
                cut_off[source.video_id] = packet_facts(info, read_packet_times(source.path))
                length_s = cut_off[source.video_id]["seconds"]
            lengths[source.video_id] = max(0.0, length_s - sum(source.leave_out_s))
        except VideoError as error:
            broken.append(str(error))
    if not lengths:
        raise ConfigError(f"none of {len(sources)} videos can be opened: {broken[0]}")
    return lengths, cut_off, tuple(broken)


class _Quiet(Reporter):
    """Shows nothing."""

    def stage_started(self, stage: str, *, items: int, weight: float, current: int) -> None:
        """Nothing."""

    def item_finished(self, receipt: Receipt, *, weight: float) -> None:
        """Nothing."""

    def stage_finished(self, report: StageReport) -> None:
        """Nothing."""

    def waiting(self, message: str) -> None:
        """Nothing."""


def _calibrate(
    sources: Sequence[Source],
    clips_of: Callable[[Source], SourceClips],
    config: Config,
    models_dir: Path | None,
    *,
    seconds: float,
) -> dict[str, dict[str, Receipt]]:
    """Receipts of a small job on windows of videos; one on a second before it pays for loading and compiling.

    Raises:
        ConfigError: no video holds a whole clip.
    """
    clip = config.clip
    windows = plan_windows(sources, clips_of, clip_frames=clip.clip_frames, seconds=seconds)
    if not windows:
        raise ConfigError(
            f"none of {len(sources)} videos holds a clip of {_clip_s(clip):g} s without a hole, so none would be kept; "
            "give recordings without gaps, or a smaller clip.clip_frames with --config"
        )
    short = clip.model_copy(update={"clip_frames": min(clip.clip_frames, _WARM_UP_FRAMES)})
    (warm_up,) = plan_windows(
        sources, lambda source: clips_of(source).cut_to(short.clip_frames), clip_frames=short.clip_frames, seconds=0
    )
    unsampled = config.model_copy(update={"select": config.select.model_copy(update={"sample_clips": None})})
    with tempfile.TemporaryDirectory(prefix="animatic-plan-") as scratch:
        _run(Path(scratch) / "warm-up", [warm_up], unsampled.model_copy(update={"clip": short}), models_dir)
        return _run(Path(scratch) / "job", windows, unsampled, models_dir)


def _run(
    root: Path, sources: Sequence[Source], config: Config, models_dir: Path | None
) -> dict[str, dict[str, Receipt]]:
    root.mkdir()
    # The split has no cost, and a split file names videos that the windows leave out.
    config = config.model_copy(update={"select": config.select.model_copy(update={"split": None})})
    job = Job(root, config, {source.video_id: source for source in sources}, models_dir=models_dir)
    job.save()
    with Engine(root, workers=0) as engine:
        run_stages(job, ALL_STAGES, engine, _Quiet())
    return {stage: read_receipts(root, stage) for stage in ALL_STAGES}


@dataclass(frozen=True, slots=True, kw_only=True)
class _Measured:
    """What the calibration job saw."""

    window_s: float
    video_s: float
    videos: int
    """That the windows' kept clips are of."""
    clips: int
    kept_clips: int
    frames_per_clip: float
    """Of runs, over kept clips: overlaps are cut once."""
    camera_frames: int
    """That the videos' cameras were read from."""

    @classmethod
    def of(cls, receipts: dict[str, dict[str, Receipt]]) -> "_Measured":
        failed = [receipt for stage in receipts.values() for receipt in stage.values() if receipt.state == "failed"]
        if failed:
            raise ConfigError(f"a trial on the footage failed in {failed[0].stage}: {failed[0].message}")
        (chosen,) = receipts["select"].values()
        kept = max(1, int(chosen.facts["kept"]))
        # Clips outside the windows have rows in the selection too; where every clip is kept none is counted.
        clips = sum(int(receipt.facts["clips"]) for receipt in receipts["count"].values()) or kept
        frames: Counter[str] = Counter()
        for receipt in receipts["cut"].values():
            frames[receipt.item.split("/")[0]] += int(receipt.facts["frames"])
        return cls(
            window_s=frames.total() / FPS, videos=len(frames),
            video_s=sum(float(receipt.facts["seconds"]) for receipt in receipts["index"].values()),
            clips=clips, kept_clips=kept, frames_per_clip=frames.total() / kept,
            camera_frames=sum(min(count, ROAD_FRAMES) for count in frames.values()),
        )  # fmt: skip


def _scaled(
    receipts: dict[str, dict[str, Receipt]],
    measured: _Measured,
    lengths_s: dict[str, float],
    *,
    candidates: dict[str, int],
    counted: int,
    sampled: int,
) -> tuple[StageCost, ...]:
    """Costs of the whole job: reading grows with the footage, counting with its clips (``counted``, twins' as well),
    the rest with what is taken; of a video's camera only so much is looked at."""
    clips = sum(candidates.values())
    taken = {name: count * sampled / clips * measured.frames_per_clip for name, count in candidates.items()}
    looked = sum(min(frames, ROAD_FRAMES) for frames in taken.values())
    by_length = sum(lengths_s.values()) / max(measured.video_s, 1e-9)
    factors = {"source": by_length, "index": by_length, "count": counted / measured.clips, "select": 1.0}
    factors["camera"] = looked / max(measured.camera_frames, 1)
    costs = []
    for stage, made in receipts.items():
        factor = factors.get(stage, sampled / measured.kept_clips)
        seconds = sum(receipt.seconds for receipt in made.values())
        size = sum(output.size for receipt in made.values() for output in receipt.outputs)
        costs.append(StageCost(stage=stage, core_hours=seconds * factor / 3600, disk_bytes=round(size * factor)))
    return tuple(costs)


def _largest_part(lengths_s: dict[str, float], parts: int) -> float:
    shares = [
        sum(length for name, length in lengths_s.items() if Part(index=index, count=parts).owns(name))
        for index in range(1, parts + 1)
    ]
    return max(shares) / max(sum(lengths_s.values()), 1e-9)


def _clip_s(clip: ClipSettings) -> float:
    return clip.clip_frames / FPS
