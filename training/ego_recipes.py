"""Trajectories from words: ``straight 10m/s``, ``left 30deg``, ``right 45deg 8m/s``, ``reverse 3m/s``, ``still``."""

import math
import re

import numpy as np

from labeling.camera import Trajectory, rebased_trajectory, rigid
from labeling.errors import ConfigError

_DEFAULT_SPEED_M_S, _DEFAULT_TURN_DEG = 8.0, 30.0
_WORDS = ("straight", "left", "right", "reverse", "still")
_NUMBER = re.compile(r"^(\d+(?:\.\d+)?)(m/s|km/h|deg)$")
_EXAMPLES = "straight 10m/s | left 30deg | right 45deg 8m/s | reverse 3m/s | still"


def recipe_trajectory(recipe: str, *, frames: int, fps: float) -> Trajectory:
    """A drive of constant speed and constant turn rate in the ground plane.

    Args:
        recipe: one of the words, then a speed (``m/s``, ``km/h``) and the angle turned over the clip (``deg``); 8 m/s
            and 30 deg where they are not given.
        frames: poses.
        fps: poses per second.

    Raises:
        ConfigError: words that are not understood.
    """
    word, *rest = recipe.lower().split() or [""]
    numbers = [_NUMBER.match(part) for part in rest]
    if word not in _WORDS or not all(numbers):
        raise ConfigError(f"ego recipe {recipe!r} is not understood; write {_EXAMPLES}, or give a trajectory file")
    values = {match[2]: float(match[1]) for match in numbers if match}
    speed = values.get("m/s", values.get("km/h", _DEFAULT_SPEED_M_S * 3.6) / 3.6)
    angle_deg = values.get("deg", _DEFAULT_TURN_DEG)
    if word == "still":
        speed = 0.0
    # y points down, so a turn to the right is positive about it.
    turn = {"left": -1, "right": 1}.get(word, 0) * math.radians(angle_deg)
    return _drive(speed * (-1 if word == "reverse" else 1), turn, frames=frames, fps=fps)


def _drive(speed_m_s: float, turn_rad: float, *, frames: int, fps: float) -> Trajectory:
    share = np.arange(frames) / max(1, frames - 1)
    heading = turn_rad * share
    seconds = max(1, frames - 1) / fps
    length = speed_m_s * seconds * share
    if turn_rad:
        # An arc of constant curvature, in closed form.
        radius = speed_m_s * seconds / turn_rad
        x, z = radius * (1 - np.cos(heading)), radius * np.sin(heading)
    else:
        x, z = np.zeros(frames), length
    poses = [rigid(_about_y(angle), np.array([px, 0.0, pz])) for angle, px, pz in zip(heading, x, z, strict=True)]
    return rebased_trajectory(np.arange(frames) / fps, np.stack(poses))


def _about_y(angle: float) -> np.ndarray:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
