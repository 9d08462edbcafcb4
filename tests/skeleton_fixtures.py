"""Plausible cars, people and lanes as labels, from shapes in metres seen by a pinhole camera."""

import numpy as np

from labeling.labels import Keypoints
from labeling.schemas import facts, keypoint_schema

FOCAL = 1056.0
# The left half of car66 and its plates, metres: to the right, up, ahead. The right half mirrors it, point i as 57 - i.
_LEFT = """-.5 .78 2.15  -.5 .62 2.2  -.82 .8 1.9  -.85 .65 1.95  -.85 .5 2.0  -.8 .35 2.1  -.88 .25 1.75  -.9 .32 1.35
-.6 1.4 .3  -.8 .95 .95  -.9 .3 .95  -.62 1.42 -.1  -.85 .92 -.1  -.9 .8 .2  -.9 .8 .02  -.9 .28 -.1  -.75 .95 -1.25
-.9 .8 -.75  -.9 .8 -.95  -.9 .3 -.95  -.9 .32 -1.35  -.88 .3 -1.75  -.8 .9 -1.9  -.85 .7 -1.95  -.58 1.38 -.95
-.55 .9 -2.1  -.55 .7 -2.15  -.5 .5 -2.2  -.85 .4 -2.1"""
_PLATES = (
    """.25 .5 2.25  -.25 .5 2.25  .25 .38 2.25  -.25 .38 2.25  -.25 .8 -2.2  .25 .8 -2.2  .25 .65 -2.2  -.25 .65 -2.2"""
)
# 17 COCO joints of a person mid-stride, metres: to the right, up.
_JOINTS = """0 1.6  .03 1.64  -.03 1.64  .08 1.62  -.08 1.62  .2 1.4  -.2 1.4  .28 1.12  -.3 1.15  .22 .9  -.22 .92
.13 .9  -.13 .9  .2 .5  -.18 .48  .12 .06  -.3 .1"""


def _numbers(text: str, columns: int) -> np.ndarray:
    return np.array(text.split(), np.float64).reshape(-1, columns)


def car66_shape() -> np.ndarray:
    """(66, 3) float64, metres: to the right, up, ahead."""
    left = _numbers(_LEFT, 3)
    return np.concatenate([left, (left * [-1, 1, 1])[::-1], _numbers(_PLATES, 3)])


def label(category, schema: str, points: np.ndarray, *, frame: int = 0, track_id: int = 0) -> Keypoints:
    """A label whose box bounds the present points."""
    points = np.asarray(points, np.float32)
    present = points[points[:, 2] > 0, :2]
    box = np.concatenate([present.min(0), present.max(0)]) if len(present) else np.zeros(4)
    return Keypoints(
        frame=frame, track_id=track_id, category=category, schema=schema, score=0.9, box_xyxy=box.astype(np.float32),
        points=points, point_source=(points[:, 2] > 0).astype(np.int8),
    )  # fmt: skip


def car(
    *, right_m: float = 0.0, ahead_m: float = 12.0, heading_deg: float = 0.0, schema: str = "car66",
    camera_m: float = 1.5, frame: int = 0, track_id: int = 0, hide_far_side: bool = False,
) -> Keypoints:  # fmt: skip
    """A car seen from ``camera_m`` above the road; heading 0 drives away from the camera."""
    shape = car66_shape()
    turn = np.radians(heading_deg)
    right = right_m + shape[:, 0] * np.cos(turn) + shape[:, 2] * np.sin(turn)
    ahead = ahead_m - shape[:, 0] * np.sin(turn) + shape[:, 2] * np.cos(turn)
    points = np.column_stack([
        527.5 + FOCAL * right / ahead, 351.5 + FOCAL * (camera_m - shape[:, 1]) / ahead, np.ones(66),
    ])  # fmt: skip
    if hide_far_side:
        middle = np.median(ahead)
        points[ahead > middle + 0.3] = 0
    if schema == "car24":
        points = points[facts()["car24"]["car66_index"]]
    return label("car", schema, points, frame=frame, track_id=track_id)


def person(
    *, right_m: float = 0.0, ahead_m: float = 8.0, schema: str = "wholebody133",
    camera_m: float = 1.5, score: float = 1.0, frame: int = 0, track_id: int = 0,
) -> Keypoints:  # fmt: skip
    """A person facing the camera, with hands and a face when the schema has them."""
    joints = _numbers(_JOINTS, 2)
    shape = joints
    if schema == "wholebody133":
        feet = np.array([[0.1, 0], [0.14, 0], [0.12, 0.04], [-0.28, 0.02], [-0.33, 0.03], [-0.3, 0.06]])
        around = np.linspace(0, 2 * np.pi, 68, endpoint=False)
        face = [0, 1.62] + 0.1 * np.column_stack([0.8 * np.sin(around), np.cos(around)])
        fingers = [[0.0, 0.0]] + [[0.02 * (i - 2), -0.03 * j] for i in range(5) for j in range(1, 5)]
        hands = [joints[wrist] + [0, -0.03] + np.array(fingers) for wrist in (9, 10)]
        shape = np.concatenate([joints, feet, face, *hands])
    points = np.column_stack([
        527.5 + FOCAL * (right_m + shape[:, 0]) / ahead_m, 351.5 + FOCAL * (camera_m - shape[:, 1]) / ahead_m,
        np.full(len(shape), score),
    ])  # fmt: skip
    return label("person", schema, points, frame=frame, track_id=track_id)


def lane(
    *, right_m: float = 0.0, bend: float = 0.0, camera_m: float = 1.5, frame: int = 0, track_id: int = 0
) -> Keypoints:
    """A lane line from 4 to 60 m ahead, evenly spaced in depth, so unevenly in the picture."""
    ahead = np.linspace(4, 60, keypoint_schema("lane24").point_count)
    points = np.column_stack([
        527.5 + FOCAL * (right_m + bend * ahead**2) / ahead, 351.5 + FOCAL * camera_m / ahead, np.ones(len(ahead)),
    ])  # fmt: skip
    return label("lane", "lane24", points, frame=frame, track_id=track_id)


def busy_street(*, cars: int = 20, people: int = 5, schema: str = "car66", seed: int = 0) -> list[Keypoints]:
    """``cars`` cars, 4 lanes and ``people`` people spread over a wide road."""
    rng = np.random.default_rng(seed)
    labels = [lane(right_m=x, track_id=900 + i) for i, x in enumerate((-5.4, -1.8, 1.8, 5.4))]
    for i in range(cars):
        ahead = float(rng.uniform(7, 45))
        right = float(rng.uniform(-0.48, 0.48) * ahead)
        labels.append(
            car(right_m=right, ahead_m=ahead, heading_deg=float(rng.uniform(-40, 220)), schema=schema, track_id=i)
        )
    for i in range(people):
        ahead = float(rng.uniform(5, 20))
        labels.append(person(right_m=float(rng.uniform(-0.45, 0.45) * ahead), ahead_m=ahead, track_id=500 + i))
    return labels
