"""``animatic study``: does the method work? Small arms on the street, at equal compute, judged by exact truth.

Every step leaves a record in the folder and is skipped when it is there: a study that was stopped goes on where it was.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from dataset.pictures import write_picture
from dataset.receipts import atomic_write, make_folder, storage_errors, try_folder
from labeling.errors import ConfigError, DataError
from pipelines.charts import machine_name
from pipelines.study_data import StudyClip, study_clips
from training.clip_views import resized
from training.latent_store import LatentStore
from training.metrics import Interval
from training.study_arms import cache_rate, decoded, rate_backbone, run_config, sample_arm, through_vae, train_run
from training.study_base import open_backbone, save_denoiser, save_vae
from training.study_judge import PAIR_FRAMES, Judge, JudgeClip, Reading, is_counted, load_judge, train_judge
from training.study_plan import ARMS, JUDGED_EVERY, QUESTIONS, Arm, StudyPlan, plan_study
from training.study_scores import FIGURES, TrueTrack, clip_scores, true_tracks
from training.study_verdicts import SAME_SHARE, Gate, crossed_interval, find, judge_gate, table_of

HEADLINE = "keypoint_error"
"""The figure whose verdict answers a question; the others stand beside it."""
JUDGED_FIGURES = ("keypoint_error", "track_survival", "min_ade")
SHOWN_FRAMES = 5
Scores = dict[str, dict[str, float]]
"""Figures by clip."""


@dataclass(eq=False)
class Study:
    """A plan, a folder, and what has been made there."""

    plan: StudyPlan
    out: Path
    say: Callable[[str], None]

    @property
    def base(self) -> Path:
        """The general video model, a diffusers folder."""
        return self.out / "base"

    @cached_property
    def clips(self) -> dict[str, list[StudyClip]]:
        """By split."""
        return study_clips(self.plan.scale)

    @property
    def keys(self) -> list[str]:
        """Of the streets that are judged."""
        return [clip.key for clip in self.clips["val"]]

    @cached_property
    def stores(self) -> dict[int, LatentStore]:
        """Latents by frame step."""
        return {step: LatentStore(self.out / f"latents-every{step}") for step in (1, 2)}

    @cached_property
    def judge(self) -> Judge:
        """The trained judge."""
        scale = self.plan.scale
        return load_judge(self.out / "judge.safetensors", width=scale.width, height=scale.height)

    @cached_property
    def tracks(self) -> dict[str, list[TrueTrack]]:
        """The cars that are asked for, by clip."""
        return {clip.key: _tracks(clip) for clip in self.clips["val"]}

    @cached_property
    def paths(self) -> dict[str, np.ndarray]:
        """The true poses, by clip."""
        return {clip.key: clip.cam_to_world[::PAIR_FRAMES] for clip in self.clips["val"]}

    def recorded(self, name: str, make: Callable[[], Any]) -> Any:
        """What ``make`` returns, from the record where there is one.

        Raises:
            DataError: a record that is damaged.
        """
        path = self.out / "records" / f"{name}.json"
        if path.is_file():
            return _read_record(path)["value"]
        started = time.process_time()
        value = make()
        spent = time.process_time() - started
        record = {"value": value, "processor_s": round(spent, 1)}
        atomic_write(path, (json.dumps(record, indent=1, sort_keys=True) + "\n").encode())
        self.say(f"{name}: {spent:.0f} processor seconds")
        return value

    def scores(self, videos: Sequence[np.ndarray], *, frame_step: int) -> Scores:
        """Figures by clip of several samples (V, T, H, W, 3) each; clips that ask for nothing have ego figures only."""
        readings = [[self.read(video, frame_step=frame_step) for video in sample] for sample in videos]
        return {
            key: clip_scores([sample[place] for sample in readings], self.tracks[key], self.paths[key])
            for place, key in enumerate(self.keys)
        }

    def read(self, video: np.ndarray, *, frame_step: int) -> Reading:
        """What the judge sees in a video, at the frames that all arms have."""
        return self.judge.read(video[:: JUDGED_EVERY // frame_step], pair_step=PAIR_FRAMES // JUDGED_EVERY)


def _read_record(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_bytes())
        return {"value": record["value"], "processor_s": float(record["processor_s"])}
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: is no record of the study ({error}); remove it and run the study again") from error


def run_study(
    out: Path, *, minutes: float | None = None, quick: bool = False, report: bool = False,
    say: Callable[[str], None] = print,
) -> dict[str, Any]:  # fmt: skip
    """The whole study; the tree of ``study.json``, which is written with ``study.png`` and ``study-sheet.png``.

    Args:
        out: folder of everything; a study in it goes on.
        minutes: processor minutes in all, nominal; None for the default.
        quick: a smoke run.
        report: make nothing more; conclude from the seeds whose arms are all there.
        say: progress, a line at a time.

    Raises:
        ConfigError: the folder holds a study of another plan, or a budget too small; a report with nothing to report.
        DataError: a record that is damaged.
        StorageError: the folder cannot be written to.
    """
    from pipelines.study_picture import draw_study
    from pipelines.study_report import draw_sheet

    plan = plan_study(quick=quick) if minutes is None else plan_study(minutes, quick=quick)
    study = Study(plan=plan, out=out, say=say)
    _refuse_other_plan(study)
    if report:
        # What has nothing to report claims no folder.
        _complete_seeds(study)
    try_folder(out)
    with storage_errors(out):
        atomic_write(_plan_file(study), _plan_text(study).encode())
        if not report:
            prepare(study)
            for seed in range(plan.scale.seeds):
                for arm in ARMS:
                    study.recorded(_arm_record(arm, seed), lambda arm=arm, seed=seed: run_arm(study, arm, seed))
        result = conclude(study, seeds=_complete_seeds(study))
        atomic_write(out / "study.json", (json.dumps(result, indent=1, sort_keys=True) + "\n").encode())
        draw_study(result, out / "study.png")
        draw_sheet(out / "shown", out / "study-sheet.png")
    return result


def show_study(out: Path, *, minutes: float | None, quick: bool, report: bool) -> int:
    """``animatic study``: run, print, 0."""
    from diffusers.utils import logging as diffusers_logging
    from transformers.utils import logging as transformers_logging

    from pipelines.console import make_console
    from pipelines.study_report import print_result

    # A bar for each of a hundred small files would bury what is said.
    diffusers_logging.disable_progress_bar()
    transformers_logging.disable_progress_bar()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    console = make_console()
    result = run_study(out, minutes=minutes, quick=quick, report=report, say=console.print)
    print_result(result, console)
    console.print(f"{out / 'study.json'}, {out / 'study.png'}, {out / 'study-sheet.png'}")
    return 0


def _plan_file(study: Study) -> Path:
    return study.out / "plan.json"


def _plan_text(study: Study) -> str:
    return json.dumps(asdict(study.plan), indent=1, sort_keys=True) + "\n"


def _refuse_other_plan(study: Study) -> None:
    """Refuse a folder of another plan: its parts would be mixed."""
    path = _plan_file(study)
    if path.is_file() and path.read_bytes() != _plan_text(study).encode():
        raise ConfigError(f"{study.out} holds a study of another plan; give another --out, or the budget it began with")


def prepare(study: Study) -> None:
    """The general video model, the street's latents, the judge, and what it makes of the truth."""
    plan, base = study.plan, study.base
    base.mkdir(parents=True, exist_ok=True)
    picture = plan.scale.picture(1)
    study.recorded("vae", lambda: save_vae(base, plan.base, picture=picture))
    study.recorded("denoiser", lambda: save_denoiser(base, plan.base, picture=picture))
    study.recorded("latents", lambda: _cache(study))
    study.recorded("judge", lambda: _teach_judge(study))
    study.recorded("truth", lambda: judge_truth(study))
    study.recorded("another-street", lambda: judge_others(study))
    study.recorded("shipped", lambda: judge_shipped(study))


def _cache(study: Study) -> int:
    for step in (1, 2):
        folder = study.out / f"latents-every{step}"
        cache_rate(folder, study.base, study.plan.scale, frame_step=step, clips=study.clips)
    return len(study.clips["train"]) + len(study.clips["val"])


def small_video(study: Study, clip: StudyClip) -> np.ndarray:
    """(T, H, W, 3): a clip as the arms would have to make it."""
    return resized(clip.frames("rgb.mp4"), study.plan.scale.width, study.plan.scale.height)


def _vae(study: Study, step: int) -> Any:
    return open_backbone(rate_backbone(study.base, study.plan.scale, frame_step=step))


def judge_clips(study: Study, split: str) -> list[JudgeClip]:
    """Clips to teach the judge by: as they are, and as the VAE gives them back, at both rates."""
    clips, made = study.clips[split], []
    for step in (1, 2):
        given = through_vae(_vae(study, step), study.stores[step], [clip.key for clip in clips])
        for clip, video in zip(clips, given, strict=True):
            cars = clip.cars()[::step]
            boxes = tuple(np.array([car.box_xyxy for car in frame], np.float32).reshape(-1, 4) for frame in cars)
            counted = [np.array([is_counted(car.box_xyxy, car.visible_share) for car in f], bool) for f in cars]
            videos = (small_video(study, clip), video) if step == 1 else (video,)
            made.append(
                JudgeClip(
                    videos=videos, boxes=boxes, counted=tuple(counted), frame_step=step,
                    cam_to_world=clip.cam_to_world[::step],
                )
            )  # fmt: skip
    return made


def _teach_judge(study: Study) -> None:
    plan = study.plan
    judge = train_judge(
        judge_clips(study, "train"), detector_steps=plan.detector_steps, pair_steps=plan.pair_steps, seed=plan.base.seed
    )
    judge.save(study.out / "judge.safetensors")


def _tracks(clip: StudyClip) -> list[TrueTrack]:
    frames = [
        {car.track_id: (car.box_xyxy, is_counted(car.box_xyxy, car.visible_share)) for car in frame}
        for frame in clip.cars()[::JUDGED_EVERY]
    ]
    return true_tracks(frames)


def judge_truth(study: Study) -> dict[str, Scores]:
    """What the judge reads in the truth as drawn, through the VAE at both rates, and in the first frame held."""
    drawn = np.stack([small_video(study, clip) for clip in study.clips["val"]])
    given = {step: through_vae(_vae(study, step), study.stores[step], study.keys) for step in (1, 2)}
    held = np.repeat(given[1][:, :1], given[1].shape[1], axis=1)
    place = min(1, len(study.keys) - 1)
    for name, videos in (("truth", drawn), ("through the VAE", given[1]), ("first frame held", held)):
        _show(study, name, videos[place], frame_step=1)
    return {
        "drawn": study.scores([drawn], frame_step=1), "vae": study.scores([given[1]], frame_step=1),
        "vae half rate": study.scores([given[2]], frame_step=2), "held": study.scores([held], frame_step=1),
    }  # fmt: skip


def judge_shipped(study: Study) -> dict[str, float]:
    """What the project's own extractors make of the truth at this size: why the study needs a judge of its own."""
    from pipelines.study_shipped import shipped_figures

    return shipped_figures(study.clips["val"], small=lambda clip: small_video(study, clip))


def run_arm(study: Study, arm: Arm, seed: int) -> dict[str, Any]:
    """Train an arm's adapters (those that another arm has trained are taken over), draw its samples, judge them."""
    plan, adapters, losses = study.plan, {}, {}
    store = study.stores[arm.frame_step]
    for run in arm.runs:
        config = run_config(plan, run, steps=plan.steps(arm, run), seed=seed, base=study.base)
        folder = study.out / "adapters" / f"{run.name}-seed{seed}"
        adapters[run.stage], history = train_run(config, store=store, out=folder)
        losses[run.name] = [float(np.mean(history[:10])), float(np.mean(history[-10:]))] if history else []
    vae = _vae(study, arm.frame_step)
    videos = []
    drawn = sample_arm(arm, adapters, plan=plan, base=study.base, store=store, keys=study.keys, seed=seed)
    place = min(1, len(study.keys) - 1)
    for rgb, control in drawn:
        videos.append(decoded(vae, rgb))
        if seed == 0 and len(videos) == 1:
            _show(study, arm.name, videos[0][place], frame_step=arm.frame_step)
            if control is not None:
                shown = decoded(vae, control[place : place + 1])[0]
                _show(study, f"{arm.name}, its {arm.control} video", shown, frame_step=arm.frame_step)
    return {"clips": study.scores(videos, frame_step=arm.frame_step), "losses": losses}


def _show(study: Study, name: str, video: np.ndarray, *, frame_step: int) -> None:
    """Keep a strip of frames, at the same times for every arm."""
    make_folder(study.out / "shown")
    times = np.linspace(0, (study.plan.scale.frames - 1) // JUDGED_EVERY, SHOWN_FRAMES).round().astype(int)
    strip = np.concatenate(list(video[:: JUDGED_EVERY // frame_step][times]), axis=1)
    write_picture(study.out / "shown" / f"{name}.png", strip)


def _arm_record(arm: Arm, seed: int) -> str:
    return f"arm-{arm.name.replace(' ', '-')}-seed{seed}"


def _complete_seeds(study: Study) -> list[int]:
    """Seeds whose arms have all been judged.

    Raises:
        ConfigError: none has.
    """
    records = study.out / "records"
    seeds = [
        seed
        for seed in range(study.plan.scale.seeds)
        if all((records / f"{_arm_record(arm, seed)}.json").is_file() for arm in ARMS)
    ]
    if not seeds:
        raise ConfigError(f"{study.out} has no seed whose arms are all judged; run the study without --report first")
    return seeds


def conclude(study: Study, *, seeds: Sequence[int]) -> dict[str, Any]:
    """Verdicts and all figures, as the tree of ``study.json``."""
    plan, keys = study.plan, study.keys
    truth: dict[str, Scores] = {
        **study.recorded("truth", lambda: judge_truth(study)),
        "another street": study.recorded("another-street", lambda: judge_others(study)),
    }
    arms = {arm.name: [_clips(study, arm, seed) for seed in seeds] for arm in ARMS}
    gates, findings = _findings(study, truth, arms)
    questions = []
    for question in QUESTIONS:
        apart = table_of(arms[question.first], "apd", keys) - table_of(arms[question.second], "apd", keys)
        questions.append(
            {**asdict(question), "verdict": findings[question.name][HEADLINE]["verdict"],
             "figures": findings[question.name],
             "apd_difference_m": asdict(crossed_interval(apart))}
        )  # fmt: skip
    rows = {name: _means(seeds, keys) for name, seeds in arms.items()}
    rows |= {f"[{name}]": _means([scores], keys) for name, scores in truth.items()}
    return {
        "questions": questions, "arms": rows, "judge": {name: asdict(gate) for name, gate in gates.items()},
        "shipped_extractors": study.recorded("shipped", lambda: judge_shipped(study)), "plan": asdict(plan),
        "steps": {arm.name: {run.name: plan.steps(arm, run) for run in arm.runs} for arm in ARMS},
        "processor_s": _spent(study), "machine": machine_name(), "threads": torch.get_num_threads(),
        "seeds": list(seeds),
    }  # fmt: skip


def _findings(
    study: Study, truth: Mapping[str, Scores], arms: Mapping[str, list[Scores]]
) -> tuple[dict[str, Gate], dict[str, dict[str, Any]]]:
    """The judge's gates by figure, and what each figure says of each question."""
    gates: dict[str, Gate] = {}
    findings: dict[str, dict[str, Any]] = {question.name: {} for question in QUESTIONS}
    for figure in JUDGED_FIGURES:
        unit, more = FIGURES[figure]
        table = {name: table_of([scores], figure, study.keys)[0] for name, scores in truth.items()}
        trivial = {"the first frame held": table["held"], "another street": table["another street"]}
        # The truth is one sample: it stands beside what other streets are on average, not beside the best of six.
        single = table_of([truth["another street"]], "ade" if figure == "min_ade" else figure, study.keys)[0]
        gates[figure] = judge_gate(
            figure, table["vae"], trivial | {"another street": single}, more_is_better=more, unit=unit
        )
        same = SAME_SHARE * float(np.nanmean(np.abs(table["vae"] - table["held"])))
        for question in QUESTIONS:
            sides = [table_of(arms[name], figure, study.keys) for name in (question.first, question.second)]
            found = find(*sides, gate=gates[figure], trivial=trivial, same=same, more_is_better=more)
            findings[question.name][figure] = {**asdict(found), "unit": unit}
    return gates, findings


def judge_others(study: Study) -> Scores:
    """What the judge reads where every clip is answered by the truth of other streets: as good as any, but not this."""
    given = through_vae(_vae(study, 1), study.stores[1], study.keys)
    count = min(study.plan.scale.samples, len(study.keys) - 1)
    return study.scores([np.roll(given, -turn, axis=0) for turn in range(1, count + 1)], frame_step=1)


def _clips(study: Study, arm: Arm, seed: int) -> Scores:
    return study.recorded(_arm_record(arm, seed), lambda: run_arm(study, arm, seed))["clips"]


def _means(seeds: Sequence[Scores], keys: Sequence[str]) -> dict[str, Any]:
    """Mean and interval of every figure that an arm has."""
    figures = sorted({name for scores in seeds for row in scores.values() for name in row})
    intervals: dict[str, Interval] = {name: crossed_interval(table_of(seeds, name, keys)) for name in figures}
    return {name: asdict(interval) for name, interval in intervals.items()}


def _spent(study: Study) -> dict[str, float]:
    """Processor seconds by record, and in all."""
    spent: dict[str, float] = {}
    for path in sorted((study.out / "records").glob("*.json")):
        spent[path.stem] = float(_read_record(path)["processor_s"])
    return spent | {"in all": round(sum(spent.values()), 1)}
