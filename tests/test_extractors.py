"""Which cards label a job: cars in boxes, or bottom-up where no head takes them."""

import pytest

from labeling.extractors import Extractors, choose_extractors
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
