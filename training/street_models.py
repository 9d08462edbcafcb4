"""Train, export and judge the small shipped extractors of the synthetic street: ``python -m training.street_models``.

On processors everything follows from the seeds: pool, batches, weights, ONNX bytes (on one kind of processor),
thresholds, figures. On a GPU (``--device cuda``) pool and batches do; its sums, and so the weights, differ in their
last digits from run to run. Where the shipped weights come from, ``docs/street_models.md`` tells. With ``--checkpoints
FOLDER`` a run that was stopped goes on where it was; of models whose training has ended, it exports and judges what is
there, without a GPU.
"""

import argparse
import ctypes
import json
import os
import resource
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path
from typing import get_args

import cv2
import torch

from labeling.detection import Detector
from labeling.fields import FieldModel
from labeling.keypoints import KeypointHead
from labeling.model_cards import SHIPPED_CARDS, SimccCard, YoloxCard, read_card
from labeling.model_cards import write_card as write_model_card
from training.street_export import export_model
from training.street_fitting import fit, is_finished, load_finished
from training.street_plans import (
    HELD_OUT_SEED,
    TRAIN_SEED,
    VALIDATION_SEED,
    judging_frames,
    plan_lessons,
)
from training.street_pool import StreetPool, render_pool
from training.street_recipes import BUDGETS, MODEL_NAMES, Device, Lesson, ModelName, Recipe, recipe
from training.street_scores import StreetModels, Tally, grouped_standard_error, judge_frame
from training.street_thresholds import choose_thresholds

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4
"""Of mallopt(3)."""
JUDGED_STREETS, CHOOSING_STREETS, JUDGED_FRAMES = 90, 270, 6
"""So many streets judge, so many choose the thresholds, with so many frames each. Frames of one street show the same
objects: on 30 streets the share of exact counts would have a standard error of three points and more, on 90 it is under
two, on 270 about one, which is what thresholds differ by."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """One model to train, in a process of its own."""

    name: ModelName
    device: Device
    seed: int
    share: float
    checkpoints: Path

    @property
    def plan(self) -> Recipe:
        return recipe(self.name, device=self.device, seed=self.seed, share=self.share)

    def checkpoint(self, lesson: Lesson) -> Path:
        return self.checkpoints / f"{lesson.fit.name}.pt"

    def has_learnt(self, lesson: Lesson) -> bool:
        return is_finished(self.checkpoint(lesson), lesson.fit.steps)

    @property
    def unfinished(self) -> tuple[Lesson, ...]:
        lessons = self.plan.lessons
        return () if self.has_learnt(lessons[-1]) else tuple(one for one in lessons if not self.has_learnt(one))


_shared_pool: list[StreetPool] = []
"""The one that is learnt from: forked workers see it where it is, which takes no time; to send it takes longer than to
render it."""


def _train_models(jobs: Sequence[_Job], pool: StreetPool, *, at_once: int) -> None:
    """Train models side by side in the order given, first those lessons that take one thread; no model's weights depend
    on company."""
    _shared_pool[:] = [pool]
    for threads in sorted({lesson.threads for job in jobs for lesson in job.unfinished}):
        mine = [job for job in jobs if any(lesson.threads == threads for lesson in job.unfinished)]
        side_by_side = max(1, min(at_once // threads, len(mine)))
        with ProcessPoolExecutor(side_by_side, mp_context=get_context("fork")) as processes:
            for name, seconds in processes.map(_train, mine, repeat(threads)):
                print(f"{name} trained in {seconds:.0f} s, {threads} thread(s)", flush=True)
    # Gigabytes, which judging needs for pictures of its own.
    _shared_pool.clear()


def _train(job: _Job, threads: int) -> tuple[str, float]:
    """Those lessons of a model that take so many threads; fewer come first."""
    torch.set_num_threads(threads)
    torch.backends.cudnn.benchmark = True
    _keep_memory()
    start = time.perf_counter()
    plan = job.plan
    torch.manual_seed(job.seed)
    network = plan.network()
    for lesson in plan.lessons:
        if job.has_learnt(lesson):
            network = load_finished(network, job.checkpoint(lesson))
        elif lesson.threads == threads:
            batches = lesson.batches(*_shared_pool)
            network = fit(network, batches, lesson.loss, lesson.fit, checkpoint=job.checkpoint(lesson))
    return job.name, time.perf_counter() - start


def _keep_memory() -> None:
    """Let glibc keep what is freed: fetching a step's activations from the system anew is a seventh of its time."""
    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):
        for parameter, value in ((_M_MMAP_MAX, 0), (_M_TRIM_THRESHOLD, 2**31 - 1)):
            library.mallopt(parameter, value)


def evaluate(
    folder: Path, *, streets: int = JUDGED_STREETS, frames: int = JUDGED_FRAMES, workers: int = 1
) -> dict[str, float]:
    """Figures of the models in ``folder`` on held-out streets, through the labelling code."""
    models, tally = open_models(folder), Tally()
    for rgb, truths in judging_frames(HELD_OUT_SEED, streets, frames, workers=workers):
        judge_frame(models, rgb, truths, tally)
    figures = tally.figures()
    if models.detector is not None and streets > 1:
        figures["count_exact_standard_error"] = round(grouped_standard_error(tally.hits["count_exact"], frames), 4)
    return figures


def open_models(folder: Path) -> StreetModels:
    """Whichever street models ``folder`` has."""
    cards = {name: read_card(folder / f"{name}.toml") for name in MODEL_NAMES if (folder / f"{name}.toml").is_file()}
    detector, fields, heads = None, None, {}
    for card in cards.values():
        if isinstance(card, YoloxCard):
            detector = Detector(card, folder / card.file)
        elif isinstance(card, SimccCard):
            heads[card.category] = KeypointHead(card, folder / card.file)
        else:
            fields = FieldModel(card, folder / card.file)
    return StreetModels(detector=detector, heads=heads, fields=fields)


def write_figures(folder: Path, figures: dict[str, float], *, frames: int) -> None:
    """Put each model's figures into its card."""
    prefixes = {
        "street_detector": ("car_recall", "car_phantoms", "person_recall", "person_phantoms", "count"),
        "street_car24": ("car_pck", "car_shown", "car_hidden", "car_right"),
        "street_coco17": ("person_pck", "person_shown", "person_hidden", "person_right"),
        "street_fields": ("lane_", "fields_"),
    }
    notes = (
        f"Figures: {frames} frames of streets never trained on (seeds from {HELD_OUT_SEED}); "
        "objects at least 32 px high and 30 % visible; points in found boxes, a missed object's points are wrong; a "
        "count is exact where all of them are found and nothing else but lower or more hidden objects."
    )
    for name, starts in prefixes.items():
        path = folder / f"{name}.toml"
        if path.is_file():
            mine = {key: value for key, value in figures.items() if key.startswith(starts)}
            write_model_card(read_card(path).model_copy(update={"accuracy": mine, "notes": notes}), path)


def train_all(options: argparse.Namespace) -> None:
    """Train those models that ``--only`` names and no checkpoint holds."""
    jobs = [
        _Job(name=name, device=options.device, seed=options.seed, share=options.share, checkpoints=options.checkpoints)
        for name in options.only
    ]
    missing = [job for job in jobs if job.unfinished]
    if missing:
        # Counted without opening the GPU, which forked processes could not use then.
        if options.device == "cuda" and not torch.cuda.device_count():
            raise SystemExit("--device cuda: torch sees no GPU; leave it out, or name finished --checkpoints")
        budget = BUDGETS[options.device]
        _train_models(missing, _rendered(options.streets or budget.streets, options.workers), at_once=budget.jobs)
    if options.train_only:
        return
    for job in jobs:
        plan = job.plan
        export_model(
            plan.graph(load_finished(plan.network(), job.checkpoint(plan.lessons[-1]))), plan.card, options.out
        )
    streets = CHOOSING_STREETS * options.judged_streets // JUDGED_STREETS
    frames = judging_frames(VALIDATION_SEED, streets, JUDGED_FRAMES, workers=options.workers)
    choose_thresholds(options.out, options.only, frames)


def _rendered(streets: int, workers: int) -> StreetPool:
    start = time.perf_counter()
    pool = render_pool(plan_lessons(TRAIN_SEED, streets, frames=7, every=15), workers=workers)
    counts = {name: len(found) for name, found in pool.crops.items()}
    print(f"{len(pool.frames)} frames, crops {counts}, {time.perf_counter() - start:.0f} s", flush=True)
    return pool


def main(arguments: Sequence[str] | None = None) -> None:
    """Train what is asked for, then judge it; ``--evaluate`` only judges."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=MODEL_NAMES, default=MODEL_NAMES)
    parser.add_argument("--device", choices=get_args(Device), default="cpu", help="which also says how much is learnt")
    parser.add_argument("--evaluate", action="store_true", help="judge what is there, train nothing")
    parser.add_argument("--train-only", action="store_true", help="end with the weights in --checkpoints")
    parser.add_argument("--out", type=Path, default=SHIPPED_CARDS)
    parser.add_argument("--checkpoints", type=Path, help="folder of weights, from which a stopped run goes on")
    parser.add_argument("--results", type=Path, help="JSON file for the figures and the time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--streets", type=int, help="to learn from, 7 frames each; by default as the device allows")
    parser.add_argument("--judged-streets", type=int, default=JUDGED_STREETS)
    parser.add_argument("--share", type=float, default=1.0, help="share of the full number of steps")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes that render")
    options = parser.parse_args(arguments)
    if options.train_only and not options.checkpoints:
        parser.error("--train-only leaves nothing behind without --checkpoints FOLDER")
    cv2.setNumThreads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    if not options.evaluate:
        with tempfile.TemporaryDirectory() as scratch:
            options.checkpoints = options.checkpoints or Path(scratch)
            options.checkpoints.mkdir(parents=True, exist_ok=True)
            train_all(options)
    if options.train_only:
        print(f"{time.perf_counter() - start:.0f} s")
        return
    figures = evaluate(options.out, streets=options.judged_streets, workers=options.workers)
    write_figures(options.out, figures, frames=options.judged_streets * JUDGED_FRAMES)
    for key, value in figures.items():
        print(f"{key:32s} {value:.4f}")
    spent = {"wall_s": round(time.perf_counter() - start), "cpu_s": round(_cpu_seconds()), "workers": options.workers}
    print(spent)
    if options.results:
        options.results.write_text(json.dumps({"time": spent, "figures": figures}, indent=2) + "\n", encoding="utf-8")


def _cpu_seconds() -> float:
    """Of this process and of those it has waited for."""
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in usage)


if __name__ == "__main__":
    main()
