"""How each shipped street model comes to be: card, network, batches, loss and length of its training."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import torch
from torch import nn

from labeling.detection import grid_cells
from labeling.model_cards import CifcafCard, FieldHeadCard, ModelCard, SimccCard, YoloxCard
from training.criteria import JUDGED_HEIGHT_PX
from training.street_augment import AugmentSettings
from training.street_batches import (
    CLASSES,
    Batch,
    CropBatches,
    DetectorBatches,
    FieldBatches,
    Windows,
    to_input,
)
from training.street_fitting import FitSettings
from training.street_losses import detector_loss, field_loss, second_look_loss, simcc_loss
from training.street_networks import (
    FIELD_STRIDE,
    FieldGraph,
    FieldNetwork,
    Sharpening,
    SimccGraph,
    SimccNetwork,
)
from training.street_pool import PICTURE_SCALE, PICTURE_SIZE, StreetPool
from training.street_second_look import OBJECTS, TwoLookDetector, TwoLookGraph

ModelName = Literal["street_detector", "street_car24", "street_coco17", "street_fields"]
MODEL_NAMES: tuple[ModelName, ...] = get_args(ModelName)
"""In the order in which their training begins: the longest first, and the others beside it, one after the other."""
_WIDTH, _HEIGHT = PICTURE_SIZE
_WINDOWS = (Windows(width=416, height=288, count=6), Windows(width=_WIDTH, height=_HEIGHT, count=2))
"""Of the detector's first lesson: windows are full of objects, whole pictures show both ends of near cars. Small
batches, many steps: of the same pictures twice as many find more people."""
_SECOND_WINDOWS = (
    Windows(width=_WIDTH, height=_HEIGHT // 2, count=6, share=3.0), Windows(width=_WIDTH, height=_HEIGHT, count=3),
)  # fmt: skip
"""Of its second: pictures as labelling shows them, most without the sky and the road at the camera's feet, where there
is little to learn."""
_RATE = 1e-2
"""Peak of Muon's, which learns more of as many steps than AdamW (``docs/street_models.md``)."""
_ELEMENTWISE: dict[ModelName, tuple[str, ...]] = {
    "street_detector": ("first.head.",), "street_fields": ("cif.", "caf."), "street_car24": (), "street_coco17": (),
}  # fmt: skip
_SECOND_RATE = 8e-3
"""As above, of the detector's second lesson."""
_SECOND_AUGMENT = AugmentSettings(night=0.15, weather=0.2)
"""What is taken for an object in bad weather or at night is for the second look to tell."""
_MIDDLE_LEVELS, _CONTRAST = (128.0, 128.0, 128.0), (64.0, 64.0, 64.0)
"""Of the detector's input, as its card says them: labelling looks levels up in a table anyway, and a graph that
centred them would read the picture once more."""
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
_DETECTOR_SOURCE = (
    "ships with Animatic; its first look was trained by `make street-models DEVICE=cuda`, which trains and exports the "
    "same network from seeds; docs/street_models.md tells how it went on"
)
_SOURCE = "ships with Animatic; `make street-models DEVICE=cuda` trains and exports it again from seeds"


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """What one kind of machine can do in the time that it is given."""

    streets: int
    """To learn from."""
    steps: dict[ModelName, int]
    second_steps: int
    """Of the detector's second lesson."""
    second_threads: int
    """Processor threads of that lesson, which comes when all else is through."""
    enlarge: int
    """Batches are so many times as large as those of a core."""
    loaders: dict[ModelName, int]
    """Processes that make a model's batches; 0: a thread."""
    jobs: int
    """Models trained side by side."""


Device = Literal["cpu", "cuda"]
BUDGETS: dict[Device, Budget] = {
    "cpu": Budget(
        streets=584, second_steps=2450, second_threads=2, enlarge=1, jobs=2, loaders=dict.fromkeys(MODEL_NAMES, 0),
        steps={"street_detector": 4700, "street_fields": 1650, "street_coco17": 6200, "street_car24": 2300},
    ),
    "cuda": Budget(
        streets=1760, second_steps=2400, second_threads=1, enlarge=4, jobs=4,
        loaders={"street_detector": 6, "street_fields": 4, "street_coco17": 2, "street_car24": 1},
        steps={"street_detector": 14000, "street_fields": 6000, "street_coco17": 9000, "street_car24": 4000},
    ),
}  # fmt: skip
"""Two cores in about an hour; one GPU with sixteen cores took ten minutes when the detector's first lesson taught one
look. The shipped models come from a GPU, by AdamW and not by Muon, and the detector went on from there
(``docs/street_models.md``)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lesson:
    """One training of a network; a later one goes on from the weights that an earlier one left."""

    batches: Callable[[StreetPool], Callable[[Any], Batch]]
    loss: Callable[[nn.Module, Batch], torch.Tensor]
    fit: FitSettings
    threads: int = 1
    """Of the processor. Lessons of more threads come when those of fewer are through, of all models."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recipe:
    """How one model comes to be."""

    card: ModelCard
    network: Callable[[], nn.Module]
    graph: Callable[[Any], nn.Module]
    lessons: tuple[Lesson, ...]


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
        loaders=budget.loaders[name], optimiser="muon", elementwise=_ELEMENTWISE[name], learning_rate=_RATE,
    )  # fmt: skip
    if name == "street_detector":
        again = replace(
            settings, name=f"{name}_second_lesson", steps=max(1, round(budget.second_steps * share)),
            learning_rate=_SECOND_RATE, fixed_norms=True,
        )  # fmt: skip
        return _detector_recipe(settings, again, budget)
    if name == "street_fields":
        return _field_recipe(settings, budget.enlarge)
    return _head_recipe(name.removeprefix("street_"), settings, budget.enlarge)


def _detector_recipe(settings: FitSettings, again: FitSettings, budget: Budget) -> Recipe:
    first_windows, second_windows = (
        tuple(replace(one, count=one.count * budget.enlarge) for one in windows)
        for windows in (_WINDOWS, _SECOND_WINDOWS)
    )

    def loss(network: nn.Module, batch: Batch) -> torch.Tensor:
        first, second = network(to_input(batch.pictures, card))
        height, width = batch.pictures.shape[1:3]
        cells, strides = (torch.from_numpy(array).to(first.rows.device) for array in grid_cells(width, height))
        classes, boxes, weights, *objects = batch.targets
        claimed = detector_loss(first.rows, classes, boxes, weights, cells, strides)
        judged = second_look_loss(second, *objects, size=(width, height), low_px=JUDGED_HEIGHT_PX * PICTURE_SCALE)
        return claimed + 0.5 * judged

    card = YoloxCard(
        name=settings.name, file=f"{settings.name}.onnx", licence=_LICENCE, source=_DETECTOR_SOURCE, classes=CLASSES,
        categories={name: name for name in CLASSES}, input_width=PICTURE_SIZE[0], input_height=PICTURE_SIZE[1],
        mean=_MIDDLE_LEVELS, std=_CONTRAST,
        # The second look leaves one box of each object.
        score_threshold=0.4, nms_threshold=1.0, max_detections=OBJECTS, decided_classes=CLASSES,
    )  # fmt: skip
    first = Lesson(
        batches=lambda pool: DetectorBatches(pool=pool, windows=first_windows, augment=AugmentSettings()),
        fit=settings, loss=loss,
    )  # fmt: skip
    second = Lesson(
        batches=lambda pool: DetectorBatches(
            pool=pool, windows=second_windows, augment=_SECOND_AUGMENT, plain_share=0.3, person_share=0.4,
        ),
        fit=again, loss=loss, threads=budget.second_threads,
    )  # fmt: skip
    return Recipe(card=card, network=lambda: TwoLookDetector(len(CLASSES)), graph=TwoLookGraph, lessons=(first, second))


def _head_recipe(schema: str, settings: FitSettings, enlarge: int) -> Recipe:
    size = _HEAD_SIZES[schema]
    card = SimccCard.model_validate(
        {"name": settings.name, "file": f"{settings.name}.onnx", "licence": _LICENCE, "source": _SOURCE,
         "schema": schema, "input_width": size[0], "input_height": size[1]}
    )  # fmt: skip

    def loss(network: nn.Module, batch: Batch) -> torch.Tensor:
        along_x, along_y, seen = (output.float() for output in network(to_input(batch.pictures, card)))
        wanted_x, wanted_y, weights, visible, tolerance = batch.targets
        return simcc_loss(
            (along_x, along_y, seen), (wanted_x, wanted_y), weights, visible, tolerance,
            hidden_weight=_HIDDEN_WEIGHTS[schema],
        )  # fmt: skip

    augment = AugmentSettings(blur_px=5, weather=0.1)
    return Recipe(
        card=card, network=lambda: SimccNetwork(schema, size, widths=_HEAD_WIDTHS[schema]),
        graph=lambda network: SimccGraph(network, shift=_SEEN_SHIFT),
        lessons=(Lesson(loss=loss, fit=settings, batches=lambda pool: CropBatches(
            crops=pool.crops[card.category], schema=schema, size=size, count=32 * enlarge, augment=augment
        )),),
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
        fields = [field for pair in network(to_input(batch.pictures, card)) for field in pair]
        truths = zip(fields, batch.targets[::2], batch.targets[1::2], strict=True)
        return torch.stack([field_loss(*truth) for truth in truths]).sum()

    return Recipe(
        card=card, network=lambda: FieldNetwork(_FIELD_SCHEMAS),
        graph=lambda network: FieldGraph(network, columns=columns, rows=rows, sharpen=_SHARPEN),
        lessons=(Lesson(loss=loss, fit=settings, batches=lambda pool: FieldBatches(
            pool=pool, schemas=_FIELD_SCHEMAS, size=_FIELD_SIZE, count=4 * enlarge, augment=AugmentSettings()
        )),),
    )  # fmt: skip
