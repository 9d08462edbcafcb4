"""Which networks label a job: chosen from the model cards by what weights are there, and opened together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from labeling.detection import Detector
from labeling.errors import ConfigError, ModelError
from labeling.fields import FieldModel
from labeling.keypoints import KeypointHead, PersonHead
from labeling.model_cards import CifcafCard, ModelCard, SimccCard, YoloxCard, find_weights, load_cards
from labeling.onnx_model import DEFAULT_PROVIDERS
from labeling.schemas import CATEGORIES, Category, keypoint_schema

STREET_PREFIX = "street_"
"""Cards of the shipped models, which know the synthetic street only: used when asked for, never by default."""

_PREFERENCE = (
    "yolox_l", "yolox_nano", "dw-ll_ucoco_384", "rtmpose_m", "rtmpose_s", "rtmpose_t", "apollo-66", "apollo-24",
    "lane-24",
)  # fmt: skip
"""Best first; a user's own cards come before all of them."""

AnyCard = YoloxCard | SimccCard | CifcafCard


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtractorChoice:
    """The cards that label a job, by role; a role without one is left out of the labels."""

    detector: YoloxCard | None = None
    heads: tuple[SimccCard, ...] = ()
    """At most one for cars, and one or two for people (whole bodies, and 17 joints for small ones)."""
    fields: tuple[CifcafCard, ...] = ()
    absent: tuple[str, ...] = ()
    """Cards that would have been used had their weights been there."""

    @property
    def cards(self) -> tuple[AnyCard, ...]:
        """All that are used, in a fixed order."""
        return (*((self.detector,) if self.detector else ()), *self.heads, *self.fields)

    @property
    def missing_categories(self) -> tuple[Category, ...]:
        """Categories that get no keypoints."""
        found = {head.category for head in self.heads if self.detector}
        found |= {head_category(name) for card in self.fields for name in _schemas(card)}
        return tuple(category for category in CATEGORIES if category not in found)

    @property
    def draws_nothing(self) -> bool:
        """Whether no category gets keypoints: skeletons are black."""
        return set(self.missing_categories) == set(CATEGORIES)


def choose_extractors(names: Sequence[str] | None, *, models_dir: Path | None = None) -> ExtractorChoice:
    """The cards for a job.

    Args:
        names: card names; ``street`` stands for all the shipped street models; None for every card whose weights are
            there, the street models aside.
        models_dir: where weights lie, as ``find_weights`` takes it.

    Raises:
        ConfigError: a name that no card has, or of a card that would have no part beside the others.
        ModelError: a card that was asked for by name has no weights.
    """
    cards = load_cards(models_dir)
    wanted = _wanted(names, cards)
    present = [card for card in wanted if find_weights(card, models_dir)]
    absent = tuple(card.name for card in wanted if card not in present)
    if names is not None and absent:
        card = cards[absent[0]]
        raise ModelError(f"{card.name}: its weights {card.file} are not there; {card.source}")
    detectors = [card for card in present if isinstance(card, YoloxCard)]
    fields = [card for card in present if isinstance(card, CifcafCard)]
    heads = [card for card in present if isinstance(card, SimccCard)]
    choice = ExtractorChoice(
        detector=detectors[0] if detectors else None,
        heads=(*_first(heads, "car"), *_person_heads(heads)) if detectors else (),
        fields=_one_per_category(fields, taken={card.category for card in heads if detectors}),
        absent=absent,
    )
    asked = [name for name in names or () if name != "street" and cards[name] not in choice.cards]
    if asked:
        used = ", ".join(card.name for card in choice.cards) or "nothing else"
        raise ConfigError(
            f"{asked[0]} has no part beside {used}: a job takes one detector, with it a head for cars and one or two "
            "for people (wholebody133, coco17), and bottom-up networks for what no head gives; leave it out"
        )
    return choice


def head_category(schema_name: str) -> Category:
    """What the points of a schema belong to."""
    return keypoint_schema(schema_name).category


class Extractors:
    """The opened networks of a choice.

    Raises:
        ModelError: weights that are absent or break their card's contract.
    """

    def __init__(
        self,
        choice: ExtractorChoice,
        *,
        models_dir: Path | None = None,
        providers: Sequence[str] = DEFAULT_PROVIDERS,
        threads: int = 1,
    ) -> None:
        self.choice = choice
        options = {"providers": providers, "threads": threads}
        self.detector = (
            Detector(choice.detector, _path(choice.detector, models_dir), **options) if choice.detector else None
        )
        opened = [KeypointHead(card, _path(card, models_dir), **options) for card in choice.heads]
        self.heads: dict[Category, KeypointHead | PersonHead] = {
            head.card.category: head for head in opened if head.card.category != "person"
        }
        people = [head for head in opened if head.card.category == "person"]
        if people:
            full = next((head for head in people if head.schema_name == "wholebody133"), None)
            small = next((head for head in people if head.schema_name == "coco17"), None)
            self.heads["person"] = PersonHead(full, small=small) if full else people[0]
        self.fields = [FieldModel(card, _path(card, models_dir), **options) for card in choice.fields]

    @property
    def left_out(self) -> dict[str, int]:
        """By card: what was seen beyond the card's most in a frame and not looked at, over all frames so far."""
        models = (*((self.detector,) if self.detector else ()), *self.fields)
        return {model.card.name: model.left_out for model in models}


def _wanted(names: Sequence[str] | None, cards: Mapping[str, AnyCard]) -> list[AnyCard]:
    if names is None:
        chosen = [name for name in cards if not name.startswith(STREET_PREFIX)]
        ranked = {name: rank for rank, name in enumerate(_PREFERENCE)}
        return [cards[name] for name in sorted(chosen, key=lambda name: (ranked.get(name, -1), name))]
    chosen = []
    for name in names:
        group = [card for card in cards if card.startswith(STREET_PREFIX)] if name == "street" else [name]
        unknown = [card for card in group if card not in cards]
        if unknown or not group:
            raise ConfigError(f"no model card is called {name!r}; choose street or some of {', '.join(cards)}")
        chosen += [card for card in group if card not in chosen]
    return [cards[name] for name in chosen]


def _first(heads: Sequence[SimccCard], category: Category) -> tuple[SimccCard, ...]:
    return tuple(head for head in heads if head.category == category)[:1]


def _person_heads(heads: Sequence[SimccCard]) -> tuple[SimccCard, ...]:
    people = [head for head in heads if head.category == "person"]
    full = [head for head in people if head.schema_name == "wholebody133"][:1]
    joints = [head for head in people if head.schema_name == "coco17"]
    # Beside whole bodies the joints' network serves small people only: the cheapest will do.
    return (*full, *joints[-1:]) if full else tuple(joints[:1])


def _one_per_category(fields: Sequence[CifcafCard], *, taken: set[Category]) -> tuple[CifcafCard, ...]:
    chosen, covered = [], set(taken)
    for card in fields:
        categories = {head_category(name) for name in _schemas(card)}
        if categories - covered:
            chosen.append(card)
            covered |= categories
    return tuple(chosen)


def _schemas(card: CifcafCard) -> tuple[str, ...]:
    return tuple(head.schema_name for head in card.heads)


def _path(card: ModelCard, models_dir: Path | None) -> Path:
    path = find_weights(card, models_dir)
    if path is None:
        raise ModelError(f"{card.name}: its weights {card.file} are not there; {card.source}")
    return path
