"""Which cards label a job: cars in boxes, or bottom-up where no head takes them."""

from pathlib import Path

import onnx_fixtures
import pytest

from labeling.errors import ConfigError
from labeling.extractors import Extractors, choose_extractors
from labeling.model_cards import write_card
from labeling.observation import FieldLook, ObjectLook, looks_of

FIELDS = "street_fields"


def test_bottom_up_cars_are_not_looked_at_beside_a_head_for_cars() -> None:
    choice = choose_extractors(["street"])
    assert [head.category for head in choice.heads] == ["car", "person"]
    assert [card.name for card in choice.fields] == [FIELDS] and not choice.missing_categories
    boxes, bottom_up = looks_of(Extractors(choice))
    assert isinstance(boxes, ObjectLook) and boxes.categories == ["car", "person"]
    assert isinstance(bottom_up, FieldLook) and bottom_up.categories == ["lane"]


@pytest.mark.parametrize(
    ("boxes", "missing"),
    [((), ("person",)), (("street_detector", "street_coco17"), ())],
    ids=["no detector", "people in boxes"],
)
def test_cars_come_bottom_up_where_no_head_takes_them(boxes: tuple[str, ...], missing: tuple[str, ...]) -> None:
    choice = choose_extractors([*boxes, FIELDS])
    assert [card.name for card in choice.fields] == [FIELDS]
    assert choice.missing_categories == missing
    looks = looks_of(Extractors(choice))
    assert isinstance(looks[-1], FieldLook) and looks[-1].categories == ["car", "lane"] and looks[-1].carries


@pytest.mark.parametrize(
    ("names", "idle"),
    [(["street_car24", FIELDS], "street_car24"), (["street_detector", "street_coco17", "mine"], "mine")],
    ids=["a head without a detector", "a second head for people"],
)
def test_a_card_that_would_have_no_part_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: list[str], idle: str
) -> None:
    own_card(tmp_path)
    monkeypatch.setenv("ANIMATIC_MODELS", str(tmp_path))
    with pytest.raises(ConfigError, match=f"{idle} has no part beside street_"):
        choose_extractors(names)


def test_cards_are_found_beside_weights_wherever_these_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own_card(tmp_path)
    assert [card.name for card in choose_extractors(["street_detector", "mine"], models_dir=tmp_path).heads] == ["mine"]
    monkeypatch.setenv("ANIMATIC_MODELS", str(tmp_path))
    assert [card.name for card in choose_extractors(["street_detector", "mine"]).heads] == ["mine"]


def own_card(folder: Path) -> None:
    """A head for people called ``mine``, and its weights."""
    card = onnx_fixtures.simcc_card(name="mine", file="mine.onnx")
    onnx_fixtures.random_simcc(folder / "mine.onnx", points=17, width=64, height=96)
    write_card(card, folder / "mine.toml")
