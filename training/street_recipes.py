"""How each shipped street model comes to be: card, network, batches, loss and length of its training."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from torch import nn

from labeling.model_cards import CifcafCard, FieldHeadCard, ModelCard, SimccCard, SoftSuppression, YoloxCard
from training.street_augment import AugmentSettings
from training.street_batches import CLASSES, Batch, CropBatches, DetectorBatches, FieldBatches, to_input
from training.street_fitting import FitSettings
from training.street_losses import detector_loss, field_loss, simcc_loss
from training.street_networks import (
    FIELD_STRIDE,
    DetectorGraph,
    FieldGraph,
    FieldNetwork,
    Sharpening,
    SimccGraph,
    SimccNetwork,
    StreetDetector,
)
from training.street_pool import PICTURE_SIZE, StreetPool
from training.street_targets import grid_cells

ModelName = Literal["street_detector", "street_car24", "street_coco17", "street_fields"]
MODEL_NAMES: tuple[ModelName, ...] = get_args(ModelName)
"""In the order in which their training begins: the longest first, and the others beside it, one after the other."""
_WINDOWS = ((416, 288, 6), (*PICTURE_SIZE, 2))
"""Of the detector: windows are full of objects, whole pictures show both ends of near cars. Small batches, many steps:
of the same pictures twice as many find more people."""
_SOFT_NMS = SoftSuppression(sigma=0.4, part_cost=0.4)
"""Chosen, as the thresholds. Cars that stand close overlap by up to 0.55: a hard limit of 0.45 lost one in 4 % of the
validation streets' frames, one of 0.6 left as many doubles. Halves of near cars look like cars: the cost of parts takes
phantoms from 0.017 to 0.007 a frame at a score of 0.3."""
_HEAD_SIZES = {"car24": (128, 96), "coco17": (64, 128)}
_HEAD_WIDTHS = {"car24": (32, 56, 88), "coco17": (32, 56, 88, 72)}
_HIDDEN_WEIGHTS = {"car24": 1.0, "coco17": 2.0}
"""A walker's far arm and leg come and go: in doubt they are called hidden."""
_SEEN_SHIFT = -0.3
"""Chosen, as the thresholds: what is behind something is called hidden more often (behind a board 98.1 instead of
97.7 % of cars' hidden points, 95 instead of 94 % of people's), for 0.2 and 1 % of the visible ones."""
_FIELD_SIZE = (529, 353)
_FIELD_SCHEMAS = ("car24", "lane24")
_SHARPEN = (Sharpening(gain=2.5, shift=4.0, widen=5.0), Sharpening(gain=3.0, shift=1.5, widen=1.4))
"""Chosen, as the thresholds, for the decoder's own constants. Small networks are honest and modest, and their votes for
a point lie further apart than a point is large: as they came, 4 % of the held-out cars grew together, so 75 %."""
_FIELD_DECODING: dict[str, dict[str, float]] = {
    "car24": {},
    "lane24": {"point_threshold": 0.3, "instance_threshold": 0.28, "min_points": 4},
}
_LICENCE = "Apache-2.0"
_SOURCE = "ships with Animatic; `make street-models DEVICE=cuda` trains and exports it again from seeds"


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """What one kind of machine can do in the time that it is given."""

    streets: int
    """To learn from."""
    steps: dict[ModelName, int]
    enlarge: int
    """Batches are so many times as large as those of a core."""
    loaders: dict[ModelName, int]
    """Processes that make a model's batches; 0: a thread."""
    jobs: int
    """Models trained side by side."""


Device = Literal["cpu", "cuda"]
BUDGETS: dict[Device, Budget] = {
    "cpu": Budget(
        streets=384, enlarge=1, loaders=dict.fromkeys(MODEL_NAMES, 0), jobs=2,
        steps={"street_detector": 15000, "street_fields": 6000, "street_coco17": 12000, "street_car24": 3000},
    ),
    "cuda": Budget(
        streets=960, enlarge=4, jobs=4,
        loaders={"street_detector": 6, "street_fields": 4, "street_coco17": 2, "street_car24": 1},
        steps={"street_detector": 14000, "street_fields": 6000, "street_coco17": 9000, "street_car24": 4000},
    ),
}  # fmt: skip
"""Two cores in under an hour; one GPU with sixteen cores in under ten minutes, from which the shipped models come."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """How one model comes to be."""

    card: ModelCard
    network: Callable[[], nn.Module]
    graph: Callable[[Any], nn.Module]
    batches: Callable[[StreetPool], Callable[[Any], Batch]]
    loss: Callable[[nn.Module, Batch], torch.Tensor]
    fit: FitSettings


def recipe(name: ModelName, *, device: Device = "cpu", seed: int = 1, share: float = 1.0) -> Recipe:
    """The recipe of one shipped model.

    Args:
        name: which.
        device: where, which says how much.
        seed: of the first weights and of every draw.
        share: of the full number of steps.
    """
    budget = BUDGETS[device]
    settings = FitSettings(
        name=name, seed=seed, steps=max(1, round(budget.steps[name] * share)), device=device,
        loaders=budget.loaders[name],
    )  # fmt: skip
    if name == "street_detector":
        return _detector_recipe(settings, budget.enlarge)
    if name == "street_fields":
        return _field_recipe(settings, budget.enlarge)
    return _head_recipe(name.removeprefix("street_"), settings, budget.enlarge)


def _detector_recipe(settings: FitSettings, enlarge: int) -> Recipe:
    grids = {(width, height): [torch.from_numpy(array) for array in grid_cells(width, height)]
             for width, height, _ in _WINDOWS}  # fmt: skip
    sizes = tuple((width, height, count * enlarge) for width, height, count in _WINDOWS)

    def loss(network: nn.Module, batch: Batch) -> torch.Tensor:
        classes, boxes, weights = batch.targets
        height, width = batch.pictures.shape[1:3]
        cells, strides = (array.to(classes.device, non_blocking=True) for array in grids[width, height])
        rows = network(to_input(batch.pictures, "bgr255")).float()
        return detector_loss(rows, classes, boxes, weights, cells, strides)

    card = YoloxCard(
        name=settings.name, file=f"{settings.name}.onnx", licence=_LICENCE, source=_SOURCE, classes=CLASSES,
        categories={name: name for name in CLASSES}, input_width=PICTURE_SIZE[0], input_height=PICTURE_SIZE[1],
        score_threshold=0.4, soft_nms=_SOFT_NMS,
    )  # fmt: skip
    return Recipe(
        card=card, network=lambda: StreetDetector(len(CLASSES)), graph=DetectorGraph, loss=loss, fit=settings,
        batches=lambda pool: DetectorBatches(pool=pool, sizes=sizes, augment=AugmentSettings()),
    )  # fmt: skip


def _head_recipe(schema: str, settings: FitSettings, enlarge: int) -> Recipe:
    size = _HEAD_SIZES[schema]
    card = SimccCard.model_validate(
        {"name": settings.name, "file": f"{settings.name}.onnx", "licence": _LICENCE, "source": _SOURCE,
         "schema": schema, "input_width": size[0], "input_height": size[1]}
    )  # fmt: skip

    def loss(network: nn.Module, batch: Batch) -> torch.Tensor:
        along_x, along_y, seen = (output.float() for output in network(to_input(batch.pictures, "imagenet")))
        wanted_x, wanted_y, weights, visible, tolerance = batch.targets
        return simcc_loss(
            (along_x, along_y, seen), (wanted_x, wanted_y), weights, visible, tolerance,
            hidden_weight=_HIDDEN_WEIGHTS[schema],
        )  # fmt: skip

    augment = AugmentSettings(blur_px=5, weather=0.1)
    return Recipe(
        card=card, network=lambda: SimccNetwork(schema, size, widths=_HEAD_WIDTHS[schema]),
        graph=lambda network: SimccGraph(network, shift=_SEEN_SHIFT), loss=loss, fit=settings,
        batches=lambda pool: CropBatches(
            crops=pool.crops[card.category], schema=schema, size=size, count=32 * enlarge, augment=augment
        ),
    )  # fmt: skip


def _field_recipe(settings: FitSettings, enlarge: int) -> Recipe:
    heads = [
        {"schema": schema, "cif": f"{schema}_cif", "caf": f"{schema}_caf", **_FIELD_DECODING[schema]}
        for schema in _FIELD_SCHEMAS
    ]
    card = CifcafCard(
        name=settings.name, file=f"{settings.name}.onnx", licence=_LICENCE, source=_SOURCE, stride=FIELD_STRIDE,
        heads=tuple(FieldHeadCard.model_validate(head) for head in heads), input_width=_FIELD_SIZE[0],
        input_height=_FIELD_SIZE[1],
    )  # fmt: skip
    columns, rows = ((side - 1) // FIELD_STRIDE + 1 for side in _FIELD_SIZE)

    def loss(network: nn.Module, batch: Batch) -> torch.Tensor:
        fields = [field for pair in network(to_input(batch.pictures, "imagenet")) for field in pair]
        truths = zip(fields, batch.targets[::2], batch.targets[1::2], strict=True)
        return torch.stack([field_loss(*truth) for truth in truths]).sum()

    return Recipe(
        card=card, network=lambda: FieldNetwork(_FIELD_SCHEMAS), loss=loss, fit=settings,
        graph=lambda network: FieldGraph(network, columns=columns, rows=rows, sharpen=_SHARPEN),
        batches=lambda pool: FieldBatches(
            pool=pool, schemas=_FIELD_SCHEMAS, size=_FIELD_SIZE, count=4 * enlarge, augment=AugmentSettings()
        ),
    )  # fmt: skip
