"""``animatic evaluate``: generated videos against the job's clips, by one ruler for every generator.

A clip at a time: its samples, the same painted over true skeletons where there are some, the truth's own video (the
noise floor), and two baselines go through the same estimators and scores. What a clip gave is kept, so that a killed
evaluation goes on where it was.
"""

import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from dataset.loader import Sample, ShardDataset
from dataset.receipts import atomic_write, digest, make_folder, sha256_file, storage_errors, try_folder
from labeling.camera import read_tum, resample
from labeling.errors import DataError
from labeling.extractors import Extractors, choose_extractors
from pipelines.engine import minding_workers
from pipelines.evaluate_notes import clip_notes, record_notes, result_notes, ruler_notes
from pipelines.evaluate_ruler import EvaluateOptions, Ruler, check_options, read_ruler
from training.evaluation import ClipTruth, SampleEstimate, score_clip, too_short, with_fault
from training.evaluation_baselines import constant_velocity, held_first_frame
from training.evaluation_estimates import ClipEstimator, clip_truth
from training.evaluation_files import (
    CONDITIONS,
    SampleFiles,
    SampleFolder,
    find_samples,
    shown_frames,
    video_size,
)
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
_KEPT = "clips.jsonl"

Files = Mapping[str, tuple[SampleFiles, ...]]
"""One clip's samples by set."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Task:
    """One clip to be looked at."""

    sample: Sample
    files: Files
    asked: Path
    """Where the trajectory that was asked for would lie."""
    shown: int | None
    """Frames of the clip that the samples' conditions were made of, where a record tells."""
    ruler: Ruler


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
    check_options(options)
    datasets = [ShardDataset(job, split) for split in ("val", "train")]
    clips = {sample.key: sample for dataset in datasets for sample in dataset}
    splits = {key: dataset.split for dataset in datasets for key in dataset.keys}
    try:
        folders = _folders(samples, clips, options)
    except DataError as error:
        count = ", ".join(f"{len(dataset)} {dataset.split}" for dataset in datasets)
        raise DataError(f"{error} (of {count} clips; `animatic inspect {job} --keys` lists them)") from error
    ruler = read_ruler(job, options)
    keys = [key for key in clips if key in folders[SAMPLES].by_key]
    out = options.out or samples / "evaluation"
    try_folder(out)
    kept = _KeptClips(out / _KEPT)
    tasks = {}
    for key in keys:
        files = {name: folder.by_key.get(key, ()) for name, folder in folders.items()}
        task = _Task(
            sample=clips[key], files=files, asked=samples / CONDITIONS / f"{key}.tum",
            shown=shown_frames(samples / f"{key}.json"), ruler=ruler,
        )  # fmt: skip
        tasks[_stamp(task)] = task
    left = {stamp: task for stamp, task in tasks.items() if stamp not in kept}
    for stamp, result in _worked(left, workers=options.workers):
        kept.add(stamp, result)
        left.pop(stamp)
        if on_clip is not None:
            on_clip(len(tasks) - len(left), len(tasks))
    results = [kept[stamp] for stamp in tasks]
    report = build_report(results)
    notes = (
        *clip_notes(splits, folders, options.samples_per_clip), *ruler_notes(ruler.choice, options.trajectories),
        *record_notes(keys, [task.sample.key for task in tasks.values() if task.shown is None], ruler.choice),
        *result_notes(report, results, longest_s=_longest_s([clips[key] for key in keys])),
    )  # fmt: skip
    record = {
        "job": job.resolve().name, "samples": samples.resolve().name, "ruler": ruler.as_json(), "notes": notes,
        **report.as_json(), "by_clip": [asdict(result) for result in results],
    }  # fmt: skip
    atomic_write(out / REPORT, (json.dumps(finite_or_none(record), sort_keys=True, indent=1) + "\n").encode())
    return Evaluation(report=report, results=tuple(results), notes=notes, file=out / REPORT)


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


def _worked(tasks: Mapping[str, _Task], *, workers: int) -> Iterator[tuple[str, ClipResult]]:
    """Results as they come, by stamp; in this process where there is one worker or one clip.

    Raises:
        ConfigError: a worker died, or none can start.
    """
    if min(workers, len(tasks)) < 2:
        yield from ((stamp, _evaluate_clip(task)) for stamp, task in list(tasks.items()))
        return
    with minding_workers(), ProcessPoolExecutor(min(workers, len(tasks)), mp_context=get_context("spawn")) as pool:
        running = {pool.submit(_evaluate_clip, task): stamp for stamp, task in tasks.items()}
        for done in as_completed(running):
            yield running[done], done.result()


@functools.lru_cache(maxsize=1)
def _opened(cards: tuple[str, ...], models_dir: Path | None) -> Extractors | None:
    """The networks, opened once in each process."""
    return Extractors(choose_extractors(cards, models_dir=models_dir), models_dir=models_dir) if cards else None


def _evaluate_clip(task: _Task) -> ClipResult:
    sample, ruler = task.sample, task.ruler
    condition = _asked_poses(task.asked, sample) if task.asked.is_file() else None
    truth = clip_truth(sample, object_variant=ruler.object_variant, ego_condition=condition, shown=task.shown)
    extractors = _opened(tuple(card.name for card in ruler.choice.cards), ruler.models_dir)
    looker = ClipEstimator(sample, truth, extractors=extractors, settings=ruler.settings)
    sets: dict[str, list[SampleEstimate]] = {
        name: [looker.estimate(one) for one in these] for name, these in task.files.items()
    }
    for name, found in sets.items():
        short = too_short(found)
        sets[name] = [with_fault(one, "video", short[one.name]) if one.name in short else one for one in found]
    sets |= _beside(truth, looker, sets[SAMPLES], task.files[SAMPLES])
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


def _stamp(task: _Task) -> str:
    """What a clip's result depends on."""
    paths = {
        name: [[part.name, sha256_file(part)] for one in these for part in _parts(one)]
        for name, these in task.files.items()
    }
    members = {suffix: member.sha256 for suffix, member in task.sample.members.items()}
    wants = [one.wants_trajectory for these in task.files.values() for one in these]
    asked = sha256_file(task.asked) if task.asked.is_file() else ""
    return digest([task.ruler.as_json(), paths, wants, members, asked, task.shown])


def _parts(files: SampleFiles) -> list[Path]:
    return [path for path in (files.rgb, files.skeleton, files.trajectory) if path is not None]


class _KeptClips:
    """Results by stamp, a line each in a file that only grows; a line that is torn or damaged is ignored."""

    def __init__(self, path: Path) -> None:
        self._path, self._found = path, dict[str, ClipResult]()
        self._torn = ""
        if path.is_file():
            data = path.read_bytes()
            # A line that was being written when the process was killed must not swallow the next.
            self._torn = "\n" if data and not data.endswith(b"\n") else ""
            for line in data.splitlines():
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
            make_folder(self._path.parent)
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(f"{self._torn}{line}\n")
        self._torn = ""
        self._found[stamp] = result
