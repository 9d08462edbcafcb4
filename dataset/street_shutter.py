"""A rolling shutter for the synthetic street: each band of rows sees the world at its own time."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from dataset.street_traffic import CarActor, PersonActor
from labeling.camera import rigid

BANDS = 24
"""Bands of a picture: a turn of 30 degrees a second and 30 ms between first and last row lean by 0.7 px a band at a
focal length of 1056 px."""


def row_bands(height: int, *, shutter_s: float, fps: float) -> Iterator[tuple[tuple[int, int], float]]:
    """Bands of rows ``[start, end)`` and when they are seen, in frames after the picture's middle row.

    Args:
        height: of the picture, rows.
        shutter_s: seconds from the first row to the last.
        fps: frames a second.
    """
    edges = np.linspace(0, height, min(BANDS, height) + 1).round().astype(int).tolist()
    for start, end in zip(edges[:-1], edges[1:], strict=True):
        middle = (start + end - 1) / 2
        yield (start, end), (middle / max(height - 1, 1) - 0.5) * shutter_s * fps


def _neighbours(count: int, moment: float) -> tuple[int, int, float]:
    """The frames before and after a moment and the share between them; below 0 or above 1 outside of all frames."""
    before = min(max(math.floor(moment), 0), max(count - 2, 0))
    return before, min(before + 1, count - 1), moment - before if count > 1 else 0.0


def pose_between(cam_to_world: np.ndarray, moment: float) -> np.ndarray:
    """(4, 4) of (T, 4, 4) at a moment between frames: steady motion from each to the next, and on at either end."""
    before, after, share = _neighbours(len(cam_to_world), moment)
    first, second = cam_to_world[before], cam_to_world[after]
    turn = Rotation.from_matrix(first[:3, :3].T @ second[:3, :3]).as_rotvec()
    rotation = first[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    return rigid(rotation, first[:3, 3] + share * (second[:3, 3] - first[:3, 3]))


def car_between(car: CarActor, moment: float) -> CarActor:
    """A car with a single frame: where it is at a moment between its own frames."""
    before, after, share = _neighbours(len(car.position), moment)
    nearest = before if share < 0.5 else after
    return replace(
        car, position=_mixed(car.position, before, after, share), braking=car.braking[nearest : nearest + 1],
        heading=_turned(car.heading, before, after, share),
    )  # fmt: skip


def person_between(person: PersonActor, moment: float) -> PersonActor:
    """A person with a single frame: where they are at a moment between their own frames."""
    before, after, share = _neighbours(len(person.position), moment)
    return replace(
        person, position=_mixed(person.position, before, after, share),
        heading=_turned(person.heading, before, after, share),
        walked_m=_mixed(person.walked_m, before, after, share),
    )  # fmt: skip


def _mixed(values: np.ndarray, before: int, after: int, share: float) -> np.ndarray:
    return (values[before] + share * (values[after] - values[before]))[None]


def _turned(angles: np.ndarray, before: int, after: int, share: float) -> np.ndarray:
    change = (angles[after] - angles[before] + np.pi) % (2 * np.pi) - np.pi
    return np.array([angles[before] + share * change])
