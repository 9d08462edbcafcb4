"""Which cards label a job: cars in boxes, or bottom-up where no head takes them."""

from pathlib import Path

import pytest

from labeling.extractors import choose_extractors
from labeling.model_cards import write_card
from training.street_recipes import CAR_FIELDS, recipe

LANES = "street_lane24"


@pytest.fixture
def models_dir(tmp_path: Path) -> Path:
    """A folder with one more street card, of a network that finds cars bottom-up, and a file for its weights."""
    card = recipe(CAR_FIELDS).card
    write_card(card, tmp_path / f"{CAR_FIELDS}.toml")
    (tmp_path / card.file).touch()
    return tmp_path


def test_bottom_up_cars_change_nothing_beside_a_head_for_cars(models_dir: Path) -> None:
    choice = choose_extractors(["street"], models_dir=models_dir)
    assert choice == choose_extractors(["street"])
    assert [head.category for head in choice.heads] == ["car", "person"] and choice.fields[0].name == LANES
    assert not choice.missing_categories


@pytest.mark.parametrize(
    ("boxes", "missing"),
    [((), ("person",)), (("street_detector", "street_coco17"), ())],
    ids=["no detector", "people in boxes"],
)
def test_cars_come_bottom_up_where_no_head_takes_them(
    models_dir: Path, boxes: tuple[str, ...], missing: tuple[str, ...]
) -> None:
    choice = choose_extractors([*boxes, CAR_FIELDS, LANES], models_dir=models_dir)
    assert [card.name for card in choice.fields] == [CAR_FIELDS, LANES]
    assert choice.missing_categories == missing
