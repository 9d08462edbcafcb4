"""Train, export and judge the small shipped extractors of the synthetic street: ``python -m training.street_models``.

Everything follows from the seeds: pool, batches, weights, ONNX bytes (on one kind of processor).
"""

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
import torch
from torch import nn

from dataset.street import Scenario, Street, StreetConfig
from labeling.detection import Detector
from labeling.fields import FieldModel
from labeling.keypoints import KeypointHead
from labeling.model_cards import SHIPPED_CARDS, CifcafCard, FieldHeadCard, ModelCard, SimccCard, YoloxCard, read_card
from labeling.model_cards import write_card as write_model_card
from training.street_augment import AugmentSettings
from training.street_batches import CLASSES, Batch, CropBatches, DetectorBatches, FieldBatches
from training.street_export import export_model
from training.street_fitting import FitSettings, fit
from training.street_losses import detector_loss, field_loss, simcc_loss
from training.street_networks import (
    FIELD_STRIDE,
    DetectorGraph,
    FieldGraph,
    FieldNetwork,
    SimccGraph,
    SimccNetwork,
    StreetDetector,
)
from training.street_pool import PICTURE_SIZE, RenderPlan, StreetPool, render_pool, truths_of
from training.street_scores import StreetModels, Tally, judge_frame
from training.street_targets import grid_cells

ModelName = Literal["street_detector", "street_car24", "street_coco17", "street_lane24"]
MODEL_NAMES: tuple[ModelName, ...] = get_args(ModelName)
WORKERS = 2
"""Processes that render and train."""
TRAIN_SEED, HELD_OUT_SEED = 20_000, 95_000
"""First street seed of either set; no street is in both. Thresholds were chosen on seeds from 90,000, in neither."""
PLANNED: tuple[Scenario, ...] = (
    "drive", "traffic", "crossing", "stop_and_go", "parked", "traffic", "turn", "cross_traffic", "drive", "crossing",
    "traffic", "lead_leaves", "parked", "fast", "sharp_turn", "reverse", "empty", "wall", "road_only", "still",
)  # fmt: skip
"""Scenarios in turn; busy ones come more often."""
_WINDOW = (352, 256)
_HEAD_SIZES = {"car24": (128, 96), "coco17": (64, 128)}
_FIELD_SIZE = (529, 353)
_VOTES = {"gain": 3.0, "shift": 1.5, "widen": 1.4}
"""Chosen, as the thresholds, for the decoder's own constants: counts of lanes exact in 78 % of frames against 20 %."""
_LICENCE = "Apache-2.0"
_SOURCE = "ships with Animatic; `make street-models` trains and exports it again from seeds"


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """How one model comes to be."""

    card: ModelCard
    network: Callable[[], nn.Module]
    graph: Callable[[Any], nn.Module]
    batches: Callable[[StreetPool], Callable[[Any], Batch]]
    loss: Callable[[nn.Module, Batch], torch.Tensor]
    fit: FitSettings


def plan_streets(first_seed: int, streets: int, *, frames: int = 12, every: int = 9) -> list[RenderPlan]:
    """``streets`` streets of consecutive seeds, scenarios in turn, every ``every``-th frame of each.

    Three in four are seen by the standard camera, the others from another height, pitch and focal length.
    """
    plans = []
    for index in range(streets):
        seed = first_seed + index
        config = StreetConfig(seed=seed, scenario=PLANNED[index % len(PLANNED)], frames=frames * every)
        if index % 4 == 3:
            rng = np.random.default_rng((seed, 11))
            config = replace(
                config, camera_height_m=rng.uniform(1.2, 1.9), camera_pitch_deg=rng.uniform(-1, 5),
                focal_px=rng.uniform(850, 1250),
            )  # fmt: skip
        plans.append(RenderPlan(config=config, frames=tuple(range(index % every, frames * every, every))))
    return plans


def recipe(name: ModelName, *, seed: int = 1, share: float = 1.0) -> Recipe:
    """The recipe of one shipped model.

    Args:
        name: which.
        seed: of the first weights and of every draw.
        share: of the full number of steps.
    """
    if name == "street_detector":
        return _detector_recipe(seed, share)
    if name == "street_lane24":
        return _field_recipe(name, ("lane24",), seed, share)
    return _head_recipe(name, name.removeprefix("street_"), seed, share)


def _steps(count: int, share: float) -> int:
    return max(1, round(count * share))


def _detector_recipe(seed: int, share: float) -> Recipe:
    cells, strides = (torch.from_numpy(array) for array in grid_cells(*_WINDOW))

    def loss(network: nn.Module, batch: Batch) -> torch.Tensor:
        classes, boxes = batch.targets
        return detector_loss(network(batch.pictures).float(), classes, boxes, cells, strides)

    card = YoloxCard(
        name="street_detector", file="street_detector.onnx", licence=_LICENCE, source=_SOURCE, classes=CLASSES,
        categories={name: name for name in CLASSES}, input_width=PICTURE_SIZE[0], input_height=PICTURE_SIZE[1],
        score_threshold=0.35, nms_threshold=0.45,
    )  # fmt: skip
    return Recipe(
        card=card, network=lambda: StreetDetector(len(CLASSES)), graph=DetectorGraph,
        batches=lambda pool: DetectorBatches(pool=pool, size=_WINDOW, count=16, augment=AugmentSettings()),
        loss=loss,
        fit=FitSettings(name=card.name, seed=seed, steps=_steps(2400, share)),
    )  # fmt: skip


def _head_recipe(name: str, schema: str, seed: int, share: float) -> Recipe:
    size, category = _HEAD_SIZES[schema], "car" if schema == "car24" else "person"
    card = SimccCard.model_validate(
        {"name": name, "file": f"{name}.onnx", "licence": _LICENCE, "source": _SOURCE, "schema": schema,
         "input_width": size[0], "input_height": size[1]}
    )  # fmt: skip

    def loss(network: nn.Module, batch: Batch) -> torch.Tensor:
        outputs = tuple(output.float() for output in network(batch.pictures))
        along_x, along_y, weights, visible, tolerance = batch.targets
        return simcc_loss(outputs, (along_x, along_y), weights, visible, tolerance)  # type: ignore[arg-type]

    augment = AugmentSettings(blur_px=5, weather=0.1)
    return Recipe(
        card=card, network=lambda: SimccNetwork(schema, size), graph=SimccGraph, loss=loss,
        batches=lambda pool: CropBatches(
            crops=pool.crops[category], schema=schema, size=size, count=64, augment=augment
        ),
        fit=FitSettings(name=name, seed=seed, steps=_steps(900 if category == "car" else 1400, share)),
    )  # fmt: skip


def _field_recipe(name: str, schemas: tuple[str, ...], seed: int, share: float) -> Recipe:
    lane = {"point_threshold": 0.3, "instance_threshold": 0.28, "min_points": 4}
    heads = [
        {"schema": schema, "cif": f"{schema}_cif", "caf": f"{schema}_caf", **(lane if schema == "lane24" else {})}
        for schema in schemas
    ]
    card = CifcafCard(
        name=name, file=f"{name}.onnx", licence=_LICENCE, source=_SOURCE, stride=FIELD_STRIDE,
        heads=tuple(FieldHeadCard.model_validate(head) for head in heads),
        input_width=_FIELD_SIZE[0], input_height=_FIELD_SIZE[1],
    )  # fmt: skip
    columns, rows = ((side - 1) // FIELD_STRIDE + 1 for side in _FIELD_SIZE)

    def loss(network: nn.Module, batch: Batch) -> torch.Tensor:
        fields = [field for pair in network(batch.pictures) for field in pair]
        truths = zip(fields, batch.targets[::2], batch.targets[1::2], strict=True)
        return torch.stack([field_loss(*truth) for truth in truths]).sum()

    return Recipe(
        card=card, network=lambda: FieldNetwork(schemas), loss=loss,
        graph=lambda network: FieldGraph(network, columns=columns, rows=rows, **_VOTES),
        batches=lambda pool: FieldBatches(
            pool=pool, schemas=schemas, size=_FIELD_SIZE, count=8, augment=AugmentSettings()
        ),
        fit=FitSettings(name=name, seed=seed, steps=_steps(1400, share)),
    )  # fmt: skip


def train_model(plan: Recipe, pool: StreetPool, folder: Path) -> ModelCard:
    """Train by the recipe and write the ONNX file and its card (without figures) into ``folder``."""
    torch.manual_seed(plan.fit.seed)
    network = fit(plan.network(), plan.batches(pool), plan.loss, plan.fit)
    return export_model(plan.graph(network), plan.card, folder)


_shared_pool: list[StreetPool] = []


def train_models(names: Sequence[ModelName], pool: StreetPool, folder: Path, *, seed: int, share: float) -> None:
    """Train several models side by side, one thread each, the longest first; their bytes do not depend on company."""
    _shared_pool[:] = [pool]
    jobs: list[tuple[ModelName, Path, int, float]] = [(name, folder, seed, share) for name in names]
    # Forked workers see the pool where it is: it would take longer to send than to render.
    with get_context("fork").Pool(min(WORKERS, len(jobs)), maxtasksperchild=1) as workers:
        for name, seconds in workers.imap_unordered(_train_job, jobs):
            print(f"{name} trained and exported in {seconds:.0f} s", flush=True)


def _train_job(job: tuple[ModelName, Path, int, float]) -> tuple[str, float]:
    name, folder, seed, share = job
    torch.set_num_threads(1)
    start = time.perf_counter()
    train_model(recipe(name, seed=seed, share=share), _shared_pool[0], folder)
    return name, time.perf_counter() - start


def evaluate(folder: Path, *, streets: int = 30, frames: int = 6) -> dict[str, float]:
    """Figures of the models in ``folder`` on held-out streets, through the labelling code."""
    models, tally = open_models(folder), Tally()
    for plan in plan_streets(HELD_OUT_SEED, streets, frames=frames, every=17):
        street = Street(plan.config)
        for index in plan.frames:
            frame = street.render(index)
            judge_frame(models, frame.rgb, truths_of(frame), tally)
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


def write_figures(folder: Path, figures: dict[str, float], *, streets: int, frames: int) -> None:
    """Put each model's figures into its card."""
    prefixes = {
        "street_detector": ("car_recall", "car_phantoms", "person_recall", "person_phantoms", "count"),
        "street_car24": ("car_pck", "car_shown", "car_hidden", "car_right"),
        "street_coco17": ("person_pck", "person_shown", "person_hidden", "person_right"),
        "street_lane24": ("lane_",),
    }
    notes = (
        f"Figures: {streets * frames} frames of {streets} streets never trained on (seeds from {HELD_OUT_SEED}); "
        "objects at least 32 px high and 30 % visible; points in found boxes, a missed object's points are wrong."
    )
    for name, starts in prefixes.items():
        path = folder / f"{name}.toml"
        if path.is_file():
            mine = {key: value for key, value in figures.items() if key.startswith(starts)}
            write_model_card(read_card(path).model_copy(update={"accuracy": mine, "notes": notes}), path)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train what is asked for, then judge it; ``--evaluate`` only judges."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=MODEL_NAMES, default=MODEL_NAMES)
    parser.add_argument("--evaluate", action="store_true", help="judge what is there, train nothing")
    parser.add_argument("--out", type=Path, default=SHIPPED_CARDS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--streets", type=int, default=160, help="streets to learn from, 12 frames each")
    parser.add_argument("--judged-streets", type=int, default=30)
    parser.add_argument("--share", type=float, default=1.0, help="share of the full number of steps")
    options = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    if not options.evaluate:
        pool = render_pool(plan_streets(TRAIN_SEED, options.streets), workers=WORKERS)
        counts = {name: len(found) for name, found in pool.crops.items()}
        print(f"{len(pool.frames)} frames, crops {counts}, {time.perf_counter() - start:.0f} s", flush=True)
        train_models(options.only, pool, options.out, seed=options.seed, share=options.share)
    frames = 6
    figures = evaluate(options.out, streets=options.judged_streets, frames=frames)
    write_figures(options.out, figures, streets=options.judged_streets, frames=frames)
    for key, value in figures.items():
        print(f"{key:32s} {value:.4f}")
    print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
