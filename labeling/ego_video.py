"""A trajectory as a picture: a checkerboard sphere that turns with the camera and dust that flies past it."""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from labeling.camera import Intrinsics, Trajectory

EgoStyle = Literal["world", "released"]
EgoRenderer = Literal["remap", "pyvista"]


def ego_frames(
    trajectory: Trajectory, *, width: int, height: int, intrinsics: Intrinsics | None = None,
    style: EgoStyle = "world", seed: int = 0, renderer: EgoRenderer = "remap",
) -> Iterator[np.ndarray]:  # fmt: skip
    """The ego video of a trajectory, one frame for each of its poses."""
    raise NotImplementedError
