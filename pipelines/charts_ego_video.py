"""``animatic chart ego-video``: milliseconds a frame of the ego video's renderers against their distance from VTK's."""

from collections.abc import Callable, Iterator
from functools import partial

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from labeling.camera import Intrinsics, Trajectory, prior_intrinsics, rebased_trajectory, rigid
from labeling.ego_dust import draw_specks, fill_cube, specks_in_view
from labeling.ego_reference import missing_library, reference_frames
from labeling.ego_released import released_frames
from labeling.ego_sphere import SPHERE_RADIUS_M, Lens, grid_step, world_raster
from labeling.ego_video import world_frames
from labeling.skeleton_video import LABEL_HEIGHT, LABEL_WIDTH
from pipelines.charts import Chart, ChartPoint, Cost, Error, interleaved_ms, machine_name

WIDTH, HEIGHT = LABEL_WIDTH, LABEL_HEIGHT
EXACT, REFERENCE, TRIVIAL = "every pixel", "pyvista (VTK)", "black"
_STEPS = (2, 4, 8, 16, 32)
_EDGE = np.ones((5, 5), np.uint8)
_SEED = 0

Renderer = Callable[[Trajectory], Iterator[np.ndarray]]


def chart(name: str, *, quick: bool = False) -> Chart:
    """Mean difference from the reference over whole pictures, against milliseconds a frame without encoding.

    A drive of 13 m/s with a turn of 60 degrees at 1056x704, 500 specks in view. The reference is VTK where it can draw,
    else every pixel's own coordinates. Beside it stand the difference away from the edges of checks and specks, and
    that from every pixel's coordinates in the same style (the released style is another look than the reference's).
    """
    frames, runs = (3, 2) if quick else (8, 8)
    width, height = (WIDTH // 4, HEIGHT // 4) if quick else (WIDTH, HEIGHT)
    camera, trajectory = prior_intrinsics(width, height), turning_drive()
    missing = missing_library()
    methods = renderers(camera, with_reference=missing is None)
    streams = {method: draw(trajectory) for method, draw in methods.items()}
    drawn = {method: [next(stream) for _ in range(frames)] for method, stream in streams.items()}
    costs = interleaved_ms([partial(_draw_on, stream, frames) for stream in streams.values()], runs=runs)
    own = [
        picture for picture, _ in zip(released_frames(trajectory, **_size(camera), step=1), range(frames), strict=False)
    ]
    reference = drawn[REFERENCE if missing is None else EXACT]
    points = [
        _point(method, drawn[method], reference, own if method.startswith("released") else drawn[EXACT], cost)
        for method, cost in zip(methods, costs, strict=True)
    ]
    return Chart(
        stage=name, data=f"{width}x{height}, a turning drive, no encoding; VTK: all of its threads",
        points=tuple(points), machine=machine_name(), left_out=(f"{REFERENCE}: {missing}",) if missing else (),
    )  # fmt: skip


def _point(
    method: str, pictures: list[np.ndarray], reference: list[np.ndarray], exact: list[np.ndarray], cost: Cost
) -> ChartPoint:
    errors = [
        _error("mean difference from the reference", differences(pictures, reference)),
        _error("the same, away from edges", differences(pictures, reference, edges=False)),
        _error("from every pixel, same style", differences(pictures, exact)),
    ]
    return ChartPoint(
        method=method, ms_per_frame=cost, error=errors[0], more_errors=(errors[1], errors[2]),
        reference=method in (TRIVIAL, REFERENCE),
    )  # fmt: skip


def _error(metric: str, apart: np.ndarray) -> Error:
    median, p95 = (round(float(value), 5) for value in (np.median(apart), np.percentile(apart, 95)))
    return Error(metric=metric, unit="grey levels of 255", median=median, p95=p95)


def turning_drive(frames: int = 200) -> Trajectory:
    """13 m/s with a turn of 60 degrees in all."""
    share = np.linspace(0, 1, frames)
    rotation = Rotation.from_euler("y", (60 * share)[:, None], degrees=True).as_matrix()
    return rebased_trajectory(np.arange(frames) / 24, rigid(rotation, np.outer(share, [10, 0, 13 * frames / 24])))


def renderers(camera: Intrinsics, *, with_reference: bool) -> dict[str, Renderer]:
    """Every way to draw an ego video, by name."""
    default = grid_step(Lens(fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy))
    found: dict[str, Renderer] = {TRIVIAL: partial(_black, camera=camera)}
    for step in _STEPS:
        name = f"grid of {step}{' (default)' * (step == default)}"
        found[name] = partial(world_frames, intrinsics=camera, seed=_SEED, step=step)
    found[EXACT] = partial(world_frames, intrinsics=camera, seed=_SEED, step=1)
    found["grid of 8, numpy, remap"] = partial(_remapped, camera=camera, step=8)
    found["every pixel, numpy"] = partial(_remapped, camera=camera, step=1)
    found["released style (another look)"] = partial(released_frames, **_size(camera))
    if with_reference:
        found[REFERENCE] = partial(reference_frames, intrinsics=camera, seed=_SEED)
    return found


def _size(camera: Intrinsics) -> dict[str, int]:
    return {"width": camera.width, "height": camera.height}


def looked_up(motion: np.ndarray, texture: np.ndarray, camera: Intrinsics, *, step: int) -> np.ndarray:
    """The sphere from numpy coordinates on every ``step``-th pixel and one ``cv2.remap``; seams are not mended.

    Args:
        motion: (4, 4) camera to world.
        texture: (h, w, 3) uint8, of ``CheckRaster.picture``.
        camera: of the picture.
        step: pixels between coordinates; must divide the picture's sides.
    """
    # Resizing puts a node in the middle of its step.
    x = np.arange(camera.width // step) * step + (step - 1) / 2
    y = np.arange(camera.height // step) * step + (step - 1) / 2
    rays = np.stack(np.broadcast_arrays((x - camera.cx) / camera.fx, ((y - camera.cy) / camera.fy)[:, None], 1.0), -1)
    u, v = np.moveaxis(_on_sphere(rays @ motion[:3, :3].T, motion[:3, 3]), -1, 0)
    height, width = texture.shape[:2]
    u, v = u * width - 0.5, v * height - 0.5
    if step > 1:
        size = (camera.width, camera.height)
        u, v = (cv2.resize(one.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) for one in (u, v))
    return cv2.remap(texture, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)


def differences(pictures: list[np.ndarray], others: list[np.ndarray], *, edges: bool = True) -> np.ndarray:
    """(T,) mean absolute difference of two lists of pictures, frame by frame, grey levels.

    Args:
        pictures: (H, W, 3) uint8 each.
        others: as many.
        edges: False leaves out what lies within two pixels of a change of colour in ``others``.
    """
    return np.array([_difference(a, b, edges=edges) for a, b in zip(pictures, others, strict=True)])


def _difference(picture: np.ndarray, other: np.ndarray, *, edges: bool) -> float:
    apart = np.abs(picture.astype(np.int16) - other).mean(axis=2)
    if not edges:
        flat = (cv2.dilate(other, _EDGE) == cv2.erode(other, _EDGE)).all(axis=2)
        apart = apart[flat]
    return float(apart.mean()) if apart.size else 0.0


def _on_sphere(rays: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(..., 2) azimuth and polar angle, each in [0, 1], where rays from a place meet the sphere."""
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    along = rays @ position
    points = position + rays * (np.sqrt(along**2 + SPHERE_RADIUS_M**2 - position @ position) - along)[..., None]
    azimuth = np.arctan2(-points[..., 2], points[..., 0]) / (2 * np.pi) + 0.5
    return np.stack([azimuth, np.arccos(np.clip(points[..., 1] / SPHERE_RADIUS_M, -1, 1)) / np.pi], axis=-1)


def _remapped(trajectory: Trajectory, *, camera: Intrinsics, step: int) -> Iterator[np.ndarray]:
    texture, cube = world_raster(camera).picture(), fill_cube(camera, seed=_SEED)
    for motion in trajectory.cam_to_world:
        picture = looked_up(motion, texture, camera, step=step)
        draw_specks(picture, specks_in_view(cube, motion, intrinsics=camera))
        yield picture


def _black(trajectory: Trajectory, *, camera: Intrinsics) -> Iterator[np.ndarray]:
    for _ in range(len(trajectory)):
        yield np.zeros((camera.height, camera.width, 3), np.uint8)


def _draw_on(stream: Iterator[np.ndarray], frames: int) -> int:
    """Draw some more of a clip."""
    return sum(1 for _ in zip(range(frames), stream, strict=False))
