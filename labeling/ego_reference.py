"""The ``world`` ego video drawn by VTK: a textured sphere seen from inside, and a disc for each speck of dust.

A second opinion on the default renderer, many times slower. VTK needs a system OpenGL or OSMesa library and ends the
whole process without one, so a subprocess tries it first.
"""

import functools
import subprocess
import sys
from collections.abc import Iterator

import numpy as np

from labeling.camera import Intrinsics, Trajectory
from labeling.ego_dust import SPECK_COLOUR, Specks, fill_cube, specks_in_view
from labeling.ego_sphere import SPHERE_RADIUS_M, CheckRaster, world_raster
from labeling.errors import ConfigError

PACKAGE = "libosmesa6"

_PROBE = """
import pyvista
plotter = pyvista.Plotter(off_screen=True, window_size=(16, 16))
plotter.add_mesh(pyvista.Sphere())
assert plotter.screenshot(return_img=True).shape == (16, 16, 3)
"""
_PROBE_SECONDS = 60
_FACETS_AROUND, _FACETS_DOWN = 512, 256
_CORNERS = 24
_SAMPLES = 8
_CLIP_M = (0.05, 4 * SPHERE_RADIUS_M)


@functools.cache
def missing_library() -> str | None:
    """None where VTK can draw; else a sentence that says what to install. Tried once, in a subprocess."""
    try:
        tried = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, timeout=_PROBE_SECONDS, check=False)
        if tried.returncode == 0:
            return None
        cause = f"VTK's trial ended with code {tried.returncode}"
    except (OSError, subprocess.TimeoutExpired) as error:
        cause = str(error)
    return (
        f"the reference renderer cannot draw here ({cause}); install the system package {PACKAGE} "
        "(apt-get install libosmesa6), or leave the renderer at 'remap', which stands in for it now"
    )


def reference_frames(trajectory: Trajectory, *, intrinsics: Intrinsics, seed: int) -> Iterator[np.ndarray]:
    """The frames that ``ego_frames`` makes in style ``world``, drawn by VTK.

    Args:
        trajectory: a clip's.
        intrinsics: of the picture to draw, which has its size.
        seed: of the dust.

    Yields:
        (height, width, 3) uint8, RGB.

    Raises:
        ConfigError: VTK finds no OpenGL; the message says what to install.
    """
    missing = missing_library()
    if missing is not None:
        raise ConfigError(missing)
    return _frames(trajectory, intrinsics, seed)


def _frames(trajectory: Trajectory, camera: Intrinsics, seed: int) -> Iterator[np.ndarray]:
    import pyvista  # ends the process where there is no OpenGL, so never at import

    cube = fill_cube(camera, seed=seed)
    plotter = pyvista.Plotter(off_screen=True, window_size=[camera.width, camera.height], lighting="none")
    try:
        plotter.enable_anti_aliasing("msaa", multi_samples=_SAMPLES)
        plotter.background_color = "black"  # pyright: ignore[reportAttributeAccessIssue]
        plotter.add_mesh(_sphere_mesh(), texture=_texture(world_raster(camera)), lighting=False)
        _set_lens(plotter.camera, camera)
        for motion in trajectory.cam_to_world:
            _set_motion(plotter.camera, motion)
            specks = specks_in_view(cube, motion, intrinsics=camera)
            plotter.add_mesh(
                _speck_mesh(specks, motion, camera), scalars="rgba", rgba=True, lighting=False, name="specks",
                reset_camera=False,
            )  # fmt: skip
            plotter.camera.clipping_range = _CLIP_M
            yield np.array(plotter.screenshot(return_img=True))
    finally:
        plotter.close()


def _sphere_mesh():
    """The sphere with its azimuth and polar angle as texture coordinates; the seam's points are there twice."""
    import pyvista

    u, v = np.meshgrid(np.linspace(0.0, 1.0, _FACETS_AROUND + 1), np.linspace(0.0, 1.0, _FACETS_DOWN + 1))
    azimuth, polar = (u - 0.5) * 2 * np.pi, v * np.pi
    # The inverse of labeling.ego_sphere: azimuth = atan2(-z, x), polar angle = acos(y / radius).
    points = np.stack([np.sin(polar) * np.cos(azimuth), np.cos(polar), -np.sin(polar) * np.sin(azimuth)], axis=-1)
    index = np.arange(u.size).reshape(u.shape)
    corners = [index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]]
    quads = np.stack([np.full_like(corners[0], 4), *corners], axis=-1)
    mesh = pyvista.PolyData(SPHERE_RADIUS_M * points.reshape(-1, 3), faces=quads.ravel())
    # A picture's first row is its top, and VTK counts upwards.
    mesh.active_texture_coordinates = np.column_stack([u.ravel(), 1.0 - v.ravel()])
    return mesh


def _texture(raster: CheckRaster):
    import pyvista

    texture = pyvista.Texture(raster.picture())
    texture.InterpolateOn()
    texture.MipmapOff()
    return texture


def _speck_mesh(specks: Specks, motion: np.ndarray, camera: Intrinsics):
    """Discs that face the camera, in the order of ``specks``, so that far ones are blended first."""
    import pyvista

    turn = np.linspace(0.0, 2 * np.pi, _CORNERS, endpoint=False)
    # Pixels of the disc's rim, then the points at the speck's depth that are seen there.
    x = specks.x[:, None] + specks.radius[:, None] * np.cos(turn)
    y = specks.y[:, None] + specks.radius[:, None] * np.sin(turn)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    points = (rays * specks.depth_m[:, None, None]) @ motion[:3, :3].T + motion[:3, 3]
    index = np.arange(points[..., 0].size).reshape(x.shape)
    discs = np.concatenate([np.full((len(index), 1), _CORNERS), index], axis=1)
    mesh = pyvista.PolyData(points.reshape(-1, 3), faces=discs.ravel())
    colour = np.broadcast_to(np.array(SPECK_COLOUR, np.float64), (len(index), 3))
    mesh.cell_data["rgba"] = np.rint(np.column_stack([colour, 255 * specks.opacity])).astype(np.uint8)
    return mesh


def _set_lens(view, camera: Intrinsics) -> None:
    """An explicit projection: a view angle alone knows neither two focal lengths nor a centre off the middle."""
    from vtkmodules.vtkCommonMath import vtkMatrix4x4

    near, far = _CLIP_M
    # A pixel's centre is half a pixel from its corner, where OpenGL counts from.
    right, down = 1 - (2 * camera.cx + 1) / camera.width, (2 * camera.cy + 1) / camera.height - 1
    rows = [
        [2 * camera.fx / camera.width, 0, right, 0],
        [0, 2 * camera.fy / camera.height, down, 0],
        [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
        [0, 0, -1, 0],
    ]
    matrix = vtkMatrix4x4()
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            matrix.SetElement(i, j, value)
    view.SetExplicitProjectionTransformMatrix(matrix)
    view.UseExplicitProjectionTransformMatrixOn()


def _set_motion(view, motion: np.ndarray) -> None:
    # OpenCV's y points down, VTK's view-up up.
    view.position = motion[:3, 3]
    view.focal_point = motion[:3, 3] + motion[:3, 2]
    view.up = -motion[:3, 1]
