"""Keypoint schemas and the label record."""

from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from labeling.errors import ConfigError, DataError
from labeling.labels import UNTRACKED, Keypoints
from labeling.schemas import CATEGORIES, keypoint_schema

COUNTS = {
    "car66": (66, 108),
    "car24": (24, 49),
    "lane24": (24, 23),
    "wholebody133": (133, 59),
    "coco17": (17, 19),
    "openpose18": (18, 17),
}


@pytest.mark.parametrize("name", COUNTS)
def test_tables_have_the_published_sizes(name: str) -> None:
    schema = keypoint_schema(name)
    assert (schema.point_count, len(schema.edges)) == COUNTS[name]
    assert schema.category in CATEGORIES
    assert len(set(schema.point_names)) == schema.point_count
    assert all(0 <= a < schema.point_count and 0 <= b < schema.point_count and a != b for a, b in schema.edges)


def test_unknown_schema_lists_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="car24"):
        keypoint_schema("car23")


def record(**changes: Any) -> Keypoints:
    values: dict[str, Any] = {
        "frame": 0,
        "category": "car",
        "schema": "car24",
        "score": 0.9,
        "box_xyxy": np.zeros(4, np.float32),
        "points": np.zeros((24, 3), np.float32),
        "point_source": np.zeros(24, np.int8),
    }
    return Keypoints(**(values | changes))


def test_record_knows_its_present_points() -> None:
    points = np.zeros((24, 3), np.float32)
    points[5] = (3, 4, 0.5)
    assert record(points=points).present.nonzero()[0].tolist() == [5]


def test_a_record_under_another_number_is_the_same_otherwise() -> None:
    first = record(score=0.7)
    for changes in ({"frame": 5}, {"track_id": 3}, {"frame": 0, "track_id": 0}):
        twin = first.renumbered(**changes)
        kept = {field.name for field in fields(first)} - set(changes)
        assert {name: getattr(twin, name) for name in changes} == changes
        assert all(getattr(twin, name) is getattr(first, name) for name in kept)
    assert (first.frame, first.track_id) == (0, UNTRACKED)


@pytest.mark.parametrize(
    "changes",
    [
        {"points": np.zeros((17, 3), np.float32)},
        {"box_xyxy": np.array([0, 0, np.nan, 1], np.float32)},
        {"score": float("inf")},
    ],
    ids=["schema", "box", "score"],
)
def test_record_refuses_rubbish(changes: dict) -> None:
    with pytest.raises(DataError):
        record(**changes)
