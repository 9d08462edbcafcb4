"""Keypoint schemas as tables: which points a car, a lane or a person has, and which of them are joined.

The tables live in ``keypoint_schemas.json``, facts with their sources named there: ApolloCar3D's car points in
OpenPifPaf's order, COCO-WholeBody, OpenPose's body order as DWPose draws it.
"""

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from labeling.errors import ConfigError

Category = Literal["car", "person", "lane"]
CATEGORIES: tuple[Category, ...] = ("car", "person", "lane")

_TABLES = Path(__file__).with_name("keypoint_schemas.json")
_CATEGORY_OF: dict[str, Category] = {
    "car66": "car",
    "car24": "car",
    "lane24": "lane",
    "wholebody133": "person",
    "coco17": "person",
    "openpose18": "person",
}
# COCO's skeleton over its 17 joints (Lin et al. 2014), zero-based.
_COCO17_EDGES = (
    (15, 13), (13, 11), (16, 14), (14, 12), (11, 12), (5, 11), (6, 12), (5, 6), (5, 7), (6, 8), (7, 9), (8, 10),
    (1, 2), (0, 1), (0, 2), (1, 3), (2, 4), (3, 5), (4, 6),
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class KeypointSchema:
    """One table: K named points and E edges between them."""

    name: str
    category: Category
    point_names: tuple[str, ...]
    """K names, in the order of the network's output."""
    edges: tuple[tuple[int, int], ...]
    """E pairs of zero-based point indices."""

    @property
    def point_count(self) -> int:
        """K."""
        return len(self.point_names)


@functools.cache
def facts() -> dict:
    """The raw tables, for what only one drawing needs (OpenPose colours, the slices of ``wholebody133``)."""
    return json.loads(_TABLES.read_text(encoding="utf-8"))


@functools.cache
def keypoint_schema(name: str) -> KeypointSchema:
    """The schema called ``name``.

    Raises:
        ConfigError: no schema has that name.
    """
    if name not in _CATEGORY_OF:
        raise ConfigError(f"keypoint schema {name!r} is not known; choose one of {', '.join(_CATEGORY_OF)}")
    if name == "coco17":
        names, edges = tuple(facts()["wholebody133"]["names"][:17]), _COCO17_EDGES
    else:
        table = facts()[name]
        names = tuple(table["names"])
        pairs = table.get("edges_zero_based") or table.get("limbs_zero_based") or _wholebody_edges(table)
        edges = tuple((int(a), int(b)) for a, b in pairs)
    return KeypointSchema(name=name, category=_CATEGORY_OF[name], point_names=names, edges=edges)


def _wholebody_edges(table: dict) -> list[tuple[int, int]]:
    hands = [table["slices"]["left_hand"][0], table["slices"]["right_hand"][0]]
    fingers = [(start + a, start + b) for start in hands for a, b in table["hand_edges_zero_based_within_hand"]]
    return [*_COCO17_EDGES, *fingers]
