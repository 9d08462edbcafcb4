"""``animatic evaluate``: generated videos against the job's clips, by one ruler for every generator.

A clip at a time: its samples, the same painted over true skeletons where there are some, the truth's own video (the
noise floor), and two baselines go through the same estimators and scores. What a clip gave is kept, so that a killed
evaluation goes on where it was.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from dataset.loader import Sample, ShardDataset
from dataset.receipts import atomic_write, digest, sha256_file, storage_errors
from labeling.camera import read_tum, resample
from labeling.errors import ConfigError
from labeling.extraction import Effort
from labeling.extractors import ExtractorChoice, Extractors, choose_extractors
from pipelines.config import EFFORTS
from pipelines.evaluate_notes import clip_notes, result_notes, ruler_notes
from pipelines.job import open_job
from training.evaluation import ClipTruth, SampleEstimate, score_clip, too_short, with_fault
from training.evaluation_baselines import constant_velocity, held_first_frame
from training.evaluation_estimates import ClipEstimator, EstimateSettings, clip_truth
from training.evaluation_files import CONDITIONS, SampleFiles, SampleFolder, find_samples, video_size
from training.evaluation_report import (
    FLOOR,
    HELD,
    SAMPLES,
    TRUE_SKELETONS,
    VELOCITY,
    ClipResult,
    Report,
    build_report,
    finite_or_none,
    outcome,
    result_from_json,
)

REPORT = "evaluation.json"
_KEPT, _VERSION = "clips.jsonl", 1

Files = Mapping[str, tuple[SampleFiles, ...]]
"""One clip's samples by set."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateOptions:
    """Options of ``animatic evaluate``; what is None is as the job has it."""

    out: Path | None = None
    """Folder of the results; ``evaluation`` in the samples' folder where None."""
    true_skeletons: Path | None = None
    """Samples painted over the true skeletons, for stage attribution."""
    trajectories: Path | None = None
    """Folder of imported trajectories, ``<key>[_n].tum``."""
    skeletons: Path | None = None
    """Folder of skeleton videos; ``skeleton`` in the samples' folder where None."""
    samples_per_clip: int = 6
    seconds: float | None = None
    """Compare no more than this of each clip."""
    object_variant: int | None = None
    """Which of the clips' object videos the samples were conditioned on."""
    every: int = 8
    extractors: tuple[str, ...] | None = None
    models_dir: Path | None = None
    effort: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Ruler:
    """What every video is looked at with; the same for all, and stored with the figures."""

    choice: ExtractorChoice
    models_dir: Path | None
    settings: EstimateSettings
    seconds: float | None
    object_variant: int

    def as_json(self) -> dict[str, Any]:
        """Plain values, the extractors with their hashes."""
        return {
            "version": _VERSION, "extractors": {card.name: card.sha256 for card in self.choice.cards},
            "every": self.settings.every, "effort": self.settings.effort, "seconds": self.seconds,
            "ego": self.settings.ego.model_dump(mode="json"), "object_variant": self.object_variant,
        }  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """What was found."""

    report: Report
    results: tuple[ClipResult, ...]
    notes: tuple[str, ...]
    """Sentences that a reader has to know: what was left out and why."""
    file: Path
    """``evaluation.json``."""


def evaluate(
    job: Path, samples: Path, options: EvaluateOptions | None = None, *,
    on_clip: Callable[[int, int], None] | None = None,
) -> Evaluation:  # fmt: skip
    """Evaluate a folder of samples against a job, and write ``evaluation.json``.

    Args:
        job: a job's folder, or one of shards.
        samples: folder of ``<key>[_n].mp4``.
        options: see there.
        on_clip: called with the number of clips done and of all.

    Raises:
        DataError: no clip, no sample of any, or names that cannot be told apart.
        ConfigError: an option that cannot be used.
        ModelError: an extractor that was asked for has no weights.
    """
    options = options or EvaluateOptions()
    _check(options)
    datasets = [ShardDataset(job, split) for split in ("val", "train")]
    clips = {sample.key: sample for dataset in datasets for sample in dataset}
    splits = {key: dataset.split for dataset in datasets for key in dataset.keys}
    folders = _folders(samples, clips, options)
    ruler = read_ruler(job, options)
    keys = [key for key in clips if key in folders[SAMPLES].by_key]
    out = options.out or samples / "evaluation"
    kept, results = _KeptClips(out / _KEPT), []
    extractors = Extractors(ruler.choice, models_dir=ruler.models_dir) if ruler.choice.cards else None
    for number, key in enumerate(keys):
        files = {name: folder.by_key.get(key, ()) for name, folder in folders.items()}
        asked = samples / CONDITIONS / f"{key}.tum"
        stamp = _stamp(clips[key], files, asked, ruler)
        if stamp not in kept:
            kept.add(stamp, _evaluate_clip(clips[key], files, asked, ruler, extractors))
        results.append(kept[stamp])
        if on_clip is not None:
            on_clip(number + 1, len(keys))
    report = build_report(results)
    notes = (
        *clip_notes(splits, folders, options.samples_per_clip), *ruler_notes(ruler.choice, options.trajectories),
        *result_notes(report, results, longest_s=_longest_s([clips[key] for key in keys])),
    )  # fmt: skip
    record = {
        "job": job.resolve().name, "samples": samples.resolve().name, "ruler": ruler.as_json(), "notes": notes,
        **report.as_json(), "by_clip": [asdict(result) for result in results],
    }  # fmt: skip
    atomic_write(out / REPORT, (json.dumps(finite_or_none(record), sort_keys=True, indent=1) + "\n").encode())
    return Evaluation(report=report, results=tuple(results), notes=notes, file=out / REPORT)


def read_ruler(job: Path, options: EvaluateOptions) -> Ruler:
    """The extractors, effort and object video of the job, where the options name no others.

    Raises:
        ConfigError: ``job.yaml`` or an option cannot be used.
        ModelError: an extractor that was asked for has no weights.
    """
    known = open_job(job) if (job / "job.yaml").is_file() else None
    names, models_dir = options.extractors, options.models_dir
    effort, variant = options.effort, options.object_variant
    if known is not None:
        names, models_dir = names or known.config.keypoints.extractors, models_dir or known.models_dir
        effort = effort or known.config.keypoints.effort
        variant = known.config.views.object_variant if variant is None else variant
    settings = EstimateSettings(every=options.every, effort=cast(Effort, effort or "balanced"))
    return Ruler(
        choice=choose_extractors(names, models_dir=models_dir), models_dir=models_dir, settings=settings,
        seconds=options.seconds, object_variant=variant or 0,
    )  # fmt: skip


def _check(options: EvaluateOptions) -> None:
    if options.effort is not None and options.effort not in EFFORTS:
        raise ConfigError(f"effort {options.effort!r} is not known; choose one of {', '.join(EFFORTS)}")
    if options.seconds is not None and not options.seconds > 0:
        raise ConfigError(f"--seconds {options.seconds:g} leaves nothing to compare; give a positive duration")
    if options.samples_per_clip < 1 or options.every < 1:
        raise ConfigError("--samples-per-clip and --every count from 1; give at least 1")


def _folders(samples: Path, clips: Mapping[str, Sample], options: EvaluateOptions) -> dict[str, SampleFolder]:
    most = options.samples_per_clip
    folders = {
        SAMPLES: find_samples(
            samples, clips, most=most, trajectories=options.trajectories, skeletons=options.skeletons
        )
    }  # fmt: skip
    if options.true_skeletons is not None:
        folders[TRUE_SKELETONS] = find_samples(options.true_skeletons, clips, most=most)
    return folders


def _evaluate_clip(
    sample: Sample, files: Files, asked: Path, ruler: Ruler, extractors: Extractors | None
) -> ClipResult:
    condition = _asked_poses(asked, sample) if asked.is_file() else None
    truth = clip_truth(sample, object_variant=ruler.object_variant, ego_condition=condition)
    looker = ClipEstimator(sample, truth, extractors=extractors, settings=ruler.settings)
    sets: dict[str, list[SampleEstimate]] = {
        name: [looker.estimate(one) for one in these] for name, these in files.items()
    }
    for name, found in sets.items():
        short = too_short(found)
        sets[name] = [with_fault(one, "video", short[one.name]) if one.name in short else one for one in found]
    sets |= _beside(truth, looker, sets[SAMPLES], files[SAMPLES])
    scores = score_clip(truth, sets, seconds=ruler.seconds, floor=FLOOR)
    outcomes = {name: outcome(scores[name], found) for name, found in sets.items()}
    return ClipResult(key=truth.key, video_id=truth.video_id, split=truth.split, sets=outcomes)


def _beside(
    truth: ClipTruth, looker: ClipEstimator, samples: Sequence[SampleEstimate], files: Sequence[SampleFiles]
) -> dict[str, list[SampleEstimate]]:
    """The noise floor and the baselines, as the clip's first readable sample is: none where there is none."""
    like = next((one for one in samples if one.readable), None)
    if like is None:
        return {FLOOR: [], VELOCITY: [], HELD: []}
    skeletons = [size for size in (video_size(one.skeleton) for one in files) if size is not None]
    floor = looker.floor(like, skeleton_size=skeletons[0] if skeletons else None)
    return {FLOOR: [floor], VELOCITY: [constant_velocity(truth)], HELD: [looker.held(held_first_frame(floor))]}


def _asked_poses(path: Path, sample: Sample) -> np.ndarray:
    """(T, 4, 4) at the clip's own times; held after the end of what was asked for."""
    given, count = read_tum(path), len(sample.cam_to_world)
    times = given.timestamps_s[0] + np.arange(count) / float(sample.meta["fps"])
    inside = times <= given.timestamps_s[-1] + 1e-6
    poses = resample(given, np.minimum(times[inside], given.timestamps_s[-1])).cam_to_world
    return np.concatenate([poses, np.repeat(poses[-1:], count - len(poses), axis=0)])


def _longest_s(samples: Sequence[Sample]) -> float:
    return max((len(sample.cam_to_world) - 1) / float(sample.meta["fps"]) for sample in samples)


def _stamp(sample: Sample, files: Files, asked: Path, ruler: Ruler) -> str:
    """What a clip's result depends on."""
    paths = {
        name: [[str(part.name), sha256_file(part)] for one in these for part in _parts(one)]
        for name, these in files.items()
    }
    members = {suffix: member.sha256 for suffix, member in sample.members.items()}
    wants = [one.wants_trajectory for these in files.values() for one in these]
    return digest([ruler.as_json(), paths, wants, members, sha256_file(asked) if asked.is_file() else ""])


def _parts(files: SampleFiles) -> list[Path]:
    return [path for path in (files.rgb, files.skeleton, files.trajectory) if path is not None]


class _KeptClips:
    """Results by stamp, a line each in a file that only grows; a torn last line is ignored."""

    def __init__(self, path: Path) -> None:
        self._path, self._found = path, dict[str, ClipResult]()
        self._torn = ""
        if path.is_file():
            text = path.read_text(encoding="utf-8")
            # A line that was being written when the process was killed must not swallow the next.
            self._torn = "\n" if text and not text.endswith("\n") else ""
            for line in text.splitlines():
                try:
                    values = json.loads(line)
                    self._found[values["stamp"]] = result_from_json(values["result"])
                except (ValueError, KeyError, TypeError):
                    continue

    def __contains__(self, stamp: str) -> bool:
        return stamp in self._found

    def __getitem__(self, stamp: str) -> ClipResult:
        return self._found[stamp]

    def add(self, stamp: str, result: ClipResult) -> None:
        line = json.dumps({"stamp": stamp, "result": finite_or_none(asdict(result))}, sort_keys=True)
        with storage_errors(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(f"{self._torn}{line}\n")
        self._torn = ""
        self._found[stamp] = result
