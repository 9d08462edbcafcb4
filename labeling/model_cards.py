"""Model cards: what each ONNX extractor takes and gives, where its weights come from, and where they lie.

A card is a TOML file in ``labeling/models/`` (or beside a user's own weights). Nothing here downloads anything.
"""

import functools
import hashlib
import json
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field, TypeAdapter, ValidationError, field_validator, model_validator

from labeling.errors import AnimaticError, ModelError
from labeling.schemas import Category, KeypointSchema, keypoint_schema

SHIPPED_CARDS = Path(__file__).with_name("models")
"""The folder of the cards that ship, and of the street models' weights."""

DETECTOR_STRIDES = (8, 16, 32)
"""Pixels between the cells of a YOLOX's levels, in the order of its output."""
IMAGENET_MEAN = (123.675, 116.28, 103.53)
IMAGENET_STD = (58.395, 57.12, 57.375)
"""Per channel (R, G, B), in units of 0 to 255."""

COCO_CLASSES = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat", "traffic light",
    "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog", "horse", "sheep", "cow", "elephant",
    "bear", "zebra", "giraffe", "backpack", "umbrella", "handbag", "tie", "suitcase", "frisbee", "skis", "snowboard",
    "sports ball", "kite", "baseball bat", "baseball glove", "skateboard", "surfboard", "tennis racket", "bottle",
    "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple", "sandwich", "orange", "broccoli",
    "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch", "potted plant", "bed", "dining table", "toilet",
    "tv", "laptop", "mouse", "remote", "keyboard", "cell phone", "microwave", "oven", "toaster", "sink", "refrigerator",
    "book", "clock", "vase", "scissors", "teddy bear", "hair drier", "toothbrush",
)  # fmt: skip
"""COCO's 80 detection classes in the order of their indices."""

WeightsState = Literal["present", "absent", "wrong hash"]
Dimensions = tuple[int | None, ...]
"""A tensor's shape as a card states it; ``None`` (the batch) may be anything."""


MAX_INPUT_SIDE = 4096
"""Pixels: several times what any extractor takes, and an input that memory has room for."""
_LEAST_STD, _GREATEST_LEVEL = 1e-3, 1e6
"""What mean and std are bounded by, in units of 0 to 255: beyond it, no input keeps a picture's differences."""

DEFAULT_SURE_SCORE = 0.5
"""At which a detected object may begin a track (Zhang et al. 2022, ByteTrack)."""


class ModelCard(BaseModel, frozen=True, extra="forbid", populate_by_name=True, allow_inf_nan=False):
    """What every extractor's card states. The subclasses add what their kind needs."""

    name: str = Field(pattern=r"^[A-Za-z0-9_.-]+$")
    kind: Literal["yolox", "simcc", "cifcaf"]
    file: str = Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.+-]*\.onnx$")
    """File name of the weights, without a folder."""
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$")
    """Of the ONNX file; absent where users export their own file, whose bytes nobody can know beforehand."""
    input_width: int = Field(gt=0, le=MAX_INPUT_SIDE)
    input_height: int = Field(gt=0, le=MAX_INPUT_SIDE)
    channel_order: Literal["rgb", "bgr"]
    mean: tuple[float, float, float]
    """Subtracted per channel, in the channel order, units of 0 to 255."""
    std: tuple[float, float, float]
    """Divided by after that."""
    licence: str
    source: str
    """Where to get the file, or how to export it."""
    notes: str = ""
    accuracy: dict[str, float] = Field(default_factory=dict)
    """Measured figures by name; the notes say on what."""

    @field_validator("std")
    @classmethod
    def _std_divides(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if not _LEAST_STD <= min(value) <= max(value) <= _GREATEST_LEVEL:
            raise ValueError(f"std must be {_LEAST_STD:g} to {_GREATEST_LEVEL:g}, got {value}")
        return value

    @field_validator("mean")
    @classmethod
    def _mean_is_a_level(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if max(map(abs, value)) > _GREATEST_LEVEL:
            raise ValueError(f"mean must be at most {_GREATEST_LEVEL:g} from 0, got {value}")
        return value

    def output_shapes(self) -> dict[str, Dimensions]:
        """The outputs that the decoder reads, by the name that the card uses, with their shapes."""
        raise NotImplementedError


class SoftSuppression(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """How much of its score a box keeps that overlaps a better one of its class: the lesser of two shares."""

    sigma: float = Field(gt=0)
    """``exp(-IoU^2 / sigma)`` (Bodla et al. 2017, equation 3)."""
    part_cost: float = Field(default=0.0, ge=0, lt=1)
    """``1 - part_cost * share``, where the better box covers that share of it."""


class YoloxCard(ModelCard, frozen=True):
    """A YOLOX detector with raw grid outputs ``[N, sum(hw/s^2), 5 + C]``, s = 8, 16, 32."""

    kind: Literal["yolox"] = "yolox"
    channel_order: Literal["rgb", "bgr"] = "bgr"
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    classes: tuple[str, ...] | Literal["coco80"]
    """C names in the order of the output, or ``coco80``."""
    categories: dict[str, Category]
    """Class name to the category of the label; classes that are not here are counted but not labelled."""
    score_threshold: float = Field(default=0.3, gt=0, lt=1)
    score_thresholds: dict[str, Annotated[float, Field(gt=0, lt=1)]] = Field(default_factory=dict)
    """Class name to a threshold of its own, in place of ``score_threshold``."""
    sure_scores: dict[str, Annotated[float, Field(gt=0, lt=1)]] = Field(default_factory=dict)
    """Class name to the score from which an object is surely there; 0.5 where nothing is said."""
    decided_classes: tuple[str, ...] = ()
    """Classes of which what is plainly seen scores near 1, so that what comes into view, or leaves it, is shown while
    it scores nearly so. Most detectors are never sure of what is far."""
    nms_threshold: float = Field(default=0.45, gt=0, le=1)
    """Overlap with a better box of its class above which a box goes."""
    soft_nms: SoftSuppression | None = None
    """In its place: for detectors that are sure of objects that stand close together."""
    max_detections: int = Field(default=200, gt=0)
    """The best of a frame; how many more there were is said in ``Detections.left_out``."""

    @model_validator(mode="after")
    def _consistent(self) -> "YoloxCard":
        named = {*self.categories, *self.score_thresholds, *self.sure_scores, *self.decided_classes}
        unknown = named - set(self.class_names)
        if unknown:
            raise ValueError(
                "categories, score_thresholds, sure_scores or decided_classes name classes that the model does not "
                f"have: {sorted(unknown)}"
            )
        if self.input_width % 32 or self.input_height % 32:
            raise ValueError(f"a yolox input must be a multiple of 32, got {self.input_width}x{self.input_height}")
        return self

    @property
    def class_names(self) -> tuple[str, ...]:
        """C names in the order of the output."""
        return COCO_CLASSES if self.classes == "coco80" else tuple(self.classes)

    @property
    def class_thresholds(self) -> tuple[float, ...]:
        """C least scores in the order of the output."""
        return tuple(self.score_thresholds.get(name, self.score_threshold) for name in self.class_names)

    @property
    def category_sure_scores(self) -> dict[str, float]:
        """The score from which an object of each category is surely there: that of its most trusted class."""
        scores: dict[str, float] = {}
        for name, category in self.categories.items():
            scores[category] = min(scores.get(category, 1.0), self.sure_scores.get(name, DEFAULT_SURE_SCORE))
        return scores

    @property
    def decided_categories(self) -> frozenset[str]:
        """Categories all of whose classes have decided scores."""
        doubtful = {category for name, category in self.categories.items() if name not in self.decided_classes}
        return frozenset(self.categories.values()) - doubtful

    def output_shapes(self) -> dict[str, Dimensions]:
        """One output: a row of box, objectness and class scores per grid cell."""
        cells = sum((self.input_width // stride) * (self.input_height // stride) for stride in DETECTOR_STRIDES)
        return {"output": (None, cells, 5 + len(self.class_names))}


class SimccCard(ModelCard, frozen=True):
    """A top-down keypoint head whose outputs are one 1-D response per point and axis (SimCC)."""

    kind: Literal["simcc"] = "simcc"
    schema_name: str = Field(alias="schema")
    channel_order: Literal["rgb", "bgr"] = "rgb"
    mean: tuple[float, float, float] = IMAGENET_MEAN
    std: tuple[float, float, float] = IMAGENET_STD
    crop_padding: float = Field(default=1.25, ge=1, le=100)
    """The crop's size relative to the box, before it is widened to the model's aspect."""
    simcc_split: float = Field(default=2.0, gt=0, le=100)
    """Response bins per input pixel."""

    @property
    def schema_table(self) -> KeypointSchema:
        """The K points that the head gives."""
        return keypoint_schema(self.schema_name)

    @property
    def category(self) -> Category:
        """What the head's points belong to."""
        return self.schema_table.category

    @field_validator("schema_name")
    @classmethod
    def _schema_is_known(cls, value: str) -> str:
        return _known_schema(value)

    def output_shapes(self) -> dict[str, Dimensions]:
        """The responses along x and along y."""
        points = self.schema_table.point_count
        return {
            "simcc_x": (None, points, round(self.input_width * self.simcc_split)),
            "simcc_y": (None, points, round(self.input_height * self.simcc_split)),
        }


class FieldHeadCard(BaseModel, frozen=True, extra="forbid", populate_by_name=True, allow_inf_nan=False):
    """One pair of CIF and CAF outputs, and how it is decoded (OpenPifPaf's constants by default)."""

    schema_name: str = Field(alias="schema")
    cif: str = "cif"
    caf: str = "caf"
    """Names of the outputs; where the graph calls them otherwise, they are told by their shapes."""
    seed_threshold: float = 0.2
    """Objects start at cells whose 0.9 map + 0.1 confidence reaches it."""
    connection_threshold: float = 0.3
    """Least confidence of a CAF cell."""
    map_threshold: float = 0.3
    """CIF cells of less confidence neither add to the accumulated map nor start an object."""
    growth_threshold: float = 0.15
    """Least score of a point that an object grows by."""
    relative_threshold: float = 0.5
    """Least score of such a point as a share of the score of the point that it grows from."""
    point_threshold: float = 0.15
    """Points that score less in the end are absent."""
    instance_threshold: float = 0.15
    """Least score of an object."""
    min_points: int = 1
    """Least number of its points that edges connect."""
    max_objects: int = Field(default=200, gt=0)
    """Growing stops there, so that a frame of noise ends in bounded time."""

    @field_validator("schema_name")
    @classmethod
    def _schema_is_known(cls, value: str) -> str:
        return _known_schema(value)


class CifcafCard(ModelCard, frozen=True):
    """A bottom-up model with composite intensity and association fields (OpenPifPaf)."""

    kind: Literal["cifcaf"] = "cifcaf"
    heads: tuple[FieldHeadCard, ...] = Field(min_length=1)
    channel_order: Literal["rgb", "bgr"] = "rgb"
    mean: tuple[float, float, float] = IMAGENET_MEAN
    std: tuple[float, float, float] = IMAGENET_STD
    stride: int = Field(default=8, gt=0)
    """Input pixels per field cell."""

    @model_validator(mode="after")
    def _consistent(self) -> "CifcafCard":
        if (self.input_width - 1) % self.stride or (self.input_height - 1) % self.stride:
            raise ValueError(
                f"a cifcaf input must be a multiple of its stride {self.stride}, plus 1, "
                f"got {self.input_width}x{self.input_height}"
            )
        names = [name for head in self.heads for name in (head.cif, head.caf)]
        if len(set(names)) != len(names):
            raise ValueError(f"two heads read the same output: {names}")
        categories = [keypoint_schema(head.schema_name).category for head in self.heads]
        if len(set(categories)) != len(categories):
            raise ValueError(f"two heads give the same category: {categories}; leave one of them out")
        return self

    def output_shapes(self) -> dict[str, Dimensions]:
        """``[N, K, 5, h, w]`` and ``[N, E, 8, h, w]`` for each head."""
        height = (self.input_height - 1) // self.stride + 1
        width = (self.input_width - 1) // self.stride + 1
        shapes: dict[str, Dimensions] = {}
        for head in self.heads:
            table = keypoint_schema(head.schema_name)
            shapes[head.cif] = (None, table.point_count, 5, height, width)
            shapes[head.caf] = (None, len(table.edges), 8, height, width)
        return shapes


AnyCard = Annotated[YoloxCard | SimccCard | CifcafCard, Field(discriminator="kind")]
_ADAPTER: TypeAdapter[YoloxCard | SimccCard | CifcafCard] = TypeAdapter(AnyCard)


def read_card(path: Path) -> YoloxCard | SimccCard | CifcafCard:
    """The card in the TOML file ``path``.

    Raises:
        ModelError: it cannot be read, is no TOML, or says something that no card may say.
    """
    try:
        return _ADAPTER.validate_python(tomllib.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors())
        raise ModelError(f"model card {path}: {faults}; compare it with {SHIPPED_CARDS}/*.toml") from error
    except (OSError, ValueError, RecursionError) as error:  # tomllib raises each, for the length and depth of values
        raise ModelError(f"model card {path} cannot be read as TOML: {error}; mend or remove it") from error


def write_card(card: ModelCard, path: Path) -> None:
    """Write ``card`` as TOML; ``read_card`` gives it back equal."""
    values = card.model_dump(by_alias=True, exclude_none=True)
    heads = values.pop("heads", ())
    tables = [key for key, value in values.items() if isinstance(value, dict)]
    lines = [f"{key} = {_toml(value)}" for key, value in values.items() if key not in tables]
    for key in tables:
        lines += ["", f"[{key}]", *(f"{json.dumps(name)} = {_toml(value)}" for name, value in values[key].items())]
    for head in heads:
        lines += ["", "[[heads]]", *(f"{name} = {_toml(value)}" for name, value in head.items())]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def load_cards(models_dir: Path | None = None) -> dict[str, YoloxCard | SimccCard | CifcafCard]:
    """The cards that ship, and those beside a user's own weights (``weights_folders``), by name, sorted.

    Raises:
        ModelError: a card breaks the rules, or two have one name.
    """
    folders = {folder.resolve(): folder for folder in reversed(weights_folders(models_dir))}.values()
    found: dict[str, tuple[YoloxCard | SimccCard | CifcafCard, Path]] = {}
    for path in (path for folder in folders for path in sorted(folder.glob("*.toml"))):
        card = read_card(path)
        if card.name in found:
            raise ModelError(f"two model cards are called {card.name!r}: {found[card.name][1]} and {path}; rename one")
        found[card.name] = (card, path)
    return {name: found[name][0] for name in sorted(found)}


def weights_folders(models_dir: Path | None = None) -> tuple[Path, ...]:
    """Where weights are looked for, in order: ``models_dir`` (else ``$ANIMATIC_MODELS``, else the user's cache folder),
    then the weights that ship."""
    if models_dir is None and os.environ.get("ANIMATIC_MODELS"):
        models_dir = Path(os.environ["ANIMATIC_MODELS"])
    if models_dir is None:
        cache = os.environ.get("XDG_CACHE_HOME")
        models_dir = (Path(cache) if cache else Path.home() / ".cache") / "animatic" / "models"
    return (models_dir, SHIPPED_CARDS)


def find_weights(card: ModelCard, models_dir: Path | None = None) -> Path | None:
    """The file called ``card.file`` in the first of ``weights_folders`` that has it.

    Its hash is checked when it opens.
    """
    for folder in weights_folders(models_dir):
        if (folder / card.file).is_file():
            return folder / card.file
    return None


def weights_state(card: ModelCard, models_dir: Path | None = None) -> WeightsState:
    """Whether the card's weights are there, and the ones it means."""
    path = find_weights(card, models_dir)
    if path is None:
        return "absent"
    return "present" if card.sha256 in (None, file_sha256(path)) else "wrong hash"


def weights_without_card(models_dir: Path, cards: Mapping[str, ModelCard]) -> list[Path]:
    """ONNX files in ``models_dir`` that no card names, sorted: they are never used, so a person is told of them."""
    named = {card.file for card in cards.values()}
    return [path for path in sorted(models_dir.glob("*.onnx")) if path.name not in named]


def file_sha256(path: Path) -> str:
    """Hex SHA-256 of a file, remembered while its size and modification time stay."""
    status = path.stat()
    return _file_sha256(path.resolve(), status.st_size, status.st_mtime_ns)


@functools.lru_cache(maxsize=64)
def _file_sha256(path: Path, size: int, modified_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _known_schema(name: str) -> str:
    try:
        keypoint_schema(name)
    except AnimaticError as error:
        raise ValueError(str(error)) from error
    return name


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return json.dumps(value, ensure_ascii=False)
