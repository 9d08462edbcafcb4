"""Train, export and judge the small shipped extractors of the synthetic street: ``python -m training.street_models``.

Everything follows from the seeds: pool, batches, weights, ONNX bytes (on one kind of processor), thresholds, figures.
With ``--checkpoints FOLDER`` a run that was stopped goes on where it was, and ends with the same files.
"""

import argparse
import ctypes
import json
import resource
import time
from collections.abc import Sequence
from multiprocessing import get_context
from pathlib import Path

import cv2
import torch

from labeling.detection import Detector
from labeling.fields import FieldModel
from labeling.keypoints import KeypointHead
from labeling.model_cards import SHIPPED_CARDS, ModelCard, SimccCard, YoloxCard, read_card
from labeling.model_cards import write_card as write_model_card
from training.street_export import export_model
from training.street_fitting import fit
from training.street_plans import HELD_OUT_SEED, TRAIN_SEED, VALIDATION_SEED, judging_frames, plan_lessons
from training.street_pool import StreetPool, render_pool
from training.street_recipes import MODEL_NAMES, ModelName, Recipe, recipe
from training.street_scores import StreetModels, Tally, judge_frame
from training.street_thresholds import choose_thresholds

WORKERS = 2
"""Processes that render and train."""
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4
"""Of mallopt(3)."""
JUDGED_FRAMES = 6
"""Of each street that chooses thresholds or judges."""


def train_model(plan: Recipe, pool: StreetPool, folder: Path, *, checkpoints: Path | None = None) -> ModelCard:
    """Train by the recipe and write the ONNX file and its card (without figures) into ``folder``."""
    torch.manual_seed(plan.fit.seed)
    kept = checkpoints / f"{plan.card.name}.pt" if checkpoints else None
    network = fit(plan.network(), plan.batches(pool), plan.loss, plan.fit, checkpoint=kept)
    return export_model(plan.graph(network), plan.card, folder)


_shared_pool: list[StreetPool] = []
_Job = tuple[ModelName, Path, Path | None, int, float]


def train_models(
    names: Sequence[ModelName],
    pool: StreetPool,
    folder: Path,
    *,
    seed: int,
    share: float,
    checkpoints: Path | None = None,
    workers: int = WORKERS,
) -> None:
    """Train several models side by side, one thread each, in the order given; no model's bytes depend on company."""
    _shared_pool[:] = [pool]
    jobs: list[_Job] = [(name, folder, checkpoints, seed, share) for name in names]
    # Forked workers see the pool where it is: it would take longer to send than to render.
    with get_context("fork").Pool(min(workers, len(jobs)), maxtasksperchild=1) as processes:
        for name, seconds in processes.imap_unordered(_train_job, jobs):
            print(f"{name} trained and exported in {seconds:.0f} s", flush=True)


def _train_job(job: _Job) -> tuple[str, float]:
    name, folder, checkpoints, seed, share = job
    torch.set_num_threads(1)
    _keep_memory()
    start = time.perf_counter()
    train_model(recipe(name, seed=seed, share=share), _shared_pool[0], folder, checkpoints=checkpoints)
    return name, time.perf_counter() - start


def _keep_memory() -> None:
    """Let glibc keep what is freed: fetching a step's activations from the system anew is a seventh of its time."""
    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):
        for parameter, value in ((_M_MMAP_MAX, 0), (_M_TRIM_THRESHOLD, 2**31 - 1)):
            library.mallopt(parameter, value)


def evaluate(folder: Path, *, streets: int = 30, frames: int = JUDGED_FRAMES) -> dict[str, float]:
    """Figures of the models in ``folder`` on held-out streets, through the labelling code."""
    models, tally = open_models(folder), Tally()
    for rgb, truths in judging_frames(HELD_OUT_SEED, streets, frames):
        judge_frame(models, rgb, truths, tally)
    return tally.figures()


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
    """The pool, the models that ``--only`` names, and their thresholds."""
    start = time.perf_counter()
    pool = render_pool(plan_lessons(TRAIN_SEED, options.streets, frames=7, every=15), workers=options.workers)
    counts = {name: len(found) for name, found in pool.crops.items()}
    print(f"{len(pool.frames)} frames, crops {counts}, {time.perf_counter() - start:.0f} s", flush=True)
    if options.checkpoints:
        options.checkpoints.mkdir(parents=True, exist_ok=True)
    train_models(
        options.only, pool, options.out, seed=options.seed, share=options.share, checkpoints=options.checkpoints,
        workers=options.workers,
    )  # fmt: skip
    frames = list(judging_frames(VALIDATION_SEED, options.judged_streets, JUDGED_FRAMES))
    choose_thresholds(options.out, options.only, frames)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train what is asked for, then judge it; ``--evaluate`` only judges."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=MODEL_NAMES, default=MODEL_NAMES)
    parser.add_argument("--evaluate", action="store_true", help="judge what is there, train nothing")
    parser.add_argument("--out", type=Path, default=SHIPPED_CARDS)
    parser.add_argument("--checkpoints", type=Path, help="folder from which a stopped run goes on")
    parser.add_argument("--results", type=Path, help="JSON file for the figures and the time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--streets", type=int, default=384, help="streets to learn from, 7 frames each")
    parser.add_argument("--judged-streets", type=int, default=30)
    parser.add_argument("--share", type=float, default=1.0, help="share of the full number of steps")
    parser.add_argument("--workers", type=int, default=WORKERS, help="processes that render and train")
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    if not options.evaluate:
        train_all(options)
    figures = evaluate(options.out, streets=options.judged_streets)
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
