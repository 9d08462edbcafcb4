"""A trajectory as a picture: a checkerboard sphere that turns with the camera and dust that flies past it.

Style ``world`` (the default) is a true rendering of a world: a sphere of radius 500 m around the clip's first camera,
and dust in it (``labeling.ego_dust`` states its near plane and its sizes). Style ``released`` is the released
renderer's look, for its adapters only. ``labeling.ego_reference`` draws the ``world`` scene with VTK instead.
"""

import warnings
from collections.abc import Iterator
from typing import Literal

import numpy as np

from labeling.camera import Intrinsics, Trajectory, prior_intrinsics
from labeling.ego_dust import draw_specks, fill_cube, specks_in_view
from labeling.ego_released import released_frames
from labeling.ego_sphere import Lens, draw_sphere, world_raster
from labeling.errors import ConfigError

EgoStyle = Literal["world", "released"]
EgoRenderer = Literal["remap", "pyvista"]


def ego_frames(
    trajectory: Trajectory, *, width: int, height: int, intrinsics: Intrinsics | None = None,
    style: EgoStyle = "world", seed: int = 0, renderer: EgoRenderer = "remap",
) -> Iterator[np.ndarray]:  # fmt: skip
    """The ego video of a trajectory, one frame for each of its poses.

    Args:
        trajectory: a clip's, relative to its first camera.
        width: of the picture, pixels.
        height: of the picture, pixels.
        intrinsics: the camera's, of any picture size (resized to this one); without them the prior's. ``released``
            takes no notice of them.
        style: ``world`` or ``released``.
        seed: of the dust; the sphere's colours never change, and ``released`` has its own seed.
        renderer: ``remap``, or the reference ``pyvista``, for which ``remap`` stands in, with a warning that says what
            to install, where VTK finds no OpenGL.

    Yields:
        (height, width, 3) uint8, RGB.

    Raises:
        ConfigError: a size is not positive, or the reference renderer is asked for the released style.
        TrajectoryError: the camera drives out of the sphere; render clips, not whole runs.
    """
    if width <= 0 or height <= 0:
        raise ConfigError(f"cannot draw an ego video of {width}x{height}; give a positive size")
    if style == "released":
        if renderer == "pyvista":
            raise ConfigError("the reference renderer knows only the style 'world'; leave renderer at 'remap'")
        return released_frames(trajectory, width=width, height=height)
    camera = (intrinsics or prior_intrinsics(width, height)).resized(width, height)
    if renderer == "pyvista":
        from labeling import ego_reference  # loads VTK, which the main job never needs

        missing = ego_reference.missing_library()
        if missing is None:
            return ego_reference.reference_frames(trajectory, intrinsics=camera, seed=seed)
        warnings.warn(missing, RuntimeWarning, stacklevel=2)
    return world_frames(trajectory, intrinsics=camera, seed=seed)


def world_frames(
    trajectory: Trajectory, *, intrinsics: Intrinsics, seed: int = 0, step: int | None = None
) -> Iterator[np.ndarray]:
    """The frames of style ``world`` by the default renderer.

    Args:
        trajectory: a clip's.
        intrinsics: of the picture to draw, which has its size.
        seed: of the dust.
        step: as in ``draw_sphere``.

    Yields:
        (height, width, 3) uint8, RGB.

    Raises:
        TrajectoryError: the camera drives out of the sphere.
    """
    raster, cube = world_raster(intrinsics), fill_cube(intrinsics, seed=seed)
    lens = Lens(fx=intrinsics.fx, fy=intrinsics.fy, cx=intrinsics.cx, cy=intrinsics.cy)
    width, height = intrinsics.width, intrinsics.height
    for motion in trajectory.cam_to_world:
        picture = draw_sphere(motion, raster=raster, lens=lens, width=width, height=height, step=step)
        draw_specks(picture, specks_in_view(cube, motion, intrinsics=intrinsics))
        yield picture
