"""Draws the golden skeletons: ``python tests/golden/make_skeleton_goldens.py``; look at them before committing."""

import sys
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
if __name__ == "__main__":
    sys.path[:0] = [str(HERE.parents[1]), str(HERE.parent)]

from skeleton_fixtures import car, lane, person  # noqa: E402

from labeling.labels import Keypoints  # noqa: E402
from labeling.skeleton_video import draw_skeletons  # noqa: E402

WIDTH, HEIGHT = 384, 256


def scenes() -> dict[str, list[Keypoints]]:
    """What each golden picture shows: one category each, then all together."""
    cars = [car(right_m=-3.0, ahead_m=11, heading_deg=20, track_id=1), car(right_m=3.6, ahead_m=16, heading_deg=170)]
    small = [car(right_m=2.5, ahead_m=9, heading_deg=-25, schema="car24"), car(right_m=-4, ahead_m=20, schema="car24")]
    lanes = [lane(right_m=-1.8), lane(right_m=1.8), lane(right_m=5.4, bend=-0.002)]
    people = [
        person(right_m=-1.2, ahead_m=4.5, track_id=1), person(right_m=0.6, ahead_m=5, schema="coco17", track_id=2),
        person(right_m=2.0, ahead_m=6, score=0.5, track_id=3),
    ]  # fmt: skip
    street = [*lanes, *cars, car(right_m=0.3, ahead_m=14, schema="car24"), person(right_m=1.8, ahead_m=8)]
    return {"car66": cars, "car24": small, "lane24": lanes, "person": people, "street": street}


def draw(labels: list[Keypoints]) -> np.ndarray:
    """(256, 384, 3) uint8 RGB."""
    return draw_skeletons(labels, width=WIDTH, height=HEIGHT)


def main() -> None:
    """Write one PNG for each scene beside this file."""
    for name, labels in scenes().items():
        cv2.imwrite(str(HERE / f"skeleton_{name}.png"), draw(labels)[..., ::-1])


if __name__ == "__main__":
    main()
