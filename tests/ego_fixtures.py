"""Corner tracks of a made-up street with exact truth: no pictures, so that geometry is tested alone and in no time."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from labeling.camera import Intrinsics, Trajectory, invert, rigid
from labeling.ego_corners import FrameTracks
from labeling.ego_tracks import RunTracks

WIDTH, HEIGHT = 640, 428


def camera(focal_px: float = 640.0) -> Intrinsics:
    """A camera with a known focal length, pixels of a 640x428 picture."""
    return Intrinsics(
        width=WIDTH, height=HEIGHT, fx=focal_px, fy=focal_px, cx=(WIDTH - 1) / 2, cy=(HEIGHT - 1) / 2, source="given"
    )


def write_kitti(trajectory: Trajectory, path: Path) -> None:
    """A row-major 3x4 camera-to-world matrix per row; KITTI's files carry no times."""
    np.savetxt(path, trajectory.cam_to_world[:, :3].reshape(-1, 12), fmt="%.9e")


def driven(
    speeds_m_s: np.ndarray, yaw_rates_deg_s: np.ndarray | float = 0.0, *, fps: float = 24.0, pitch_deg: float = 0.0
) -> np.ndarray:
    """(T, 4, 4) camera to world of a car that drives along its own axis; positive yaw turns right, pitch looks down."""
    speeds = np.asarray(speeds_m_s, dtype=np.float64)
    rates = np.broadcast_to(np.asarray(yaw_rates_deg_s, dtype=np.float64), speeds.shape)
    yaw = np.concatenate([[0.0], np.cumsum(np.radians(rates[1:]) / fps)])
    middle = yaw - np.radians(rates) / fps / 2
    steps = np.stack([np.sin(middle), np.zeros_like(yaw), np.cos(middle)], axis=1) * (speeds / fps)[:, None]
    steps[0] = 0.0
    turn = Rotation.from_euler("y", yaw[:, None]) * Rotation.from_euler("x", -np.radians(pitch_deg))
    return rigid(turn.as_matrix(), np.cumsum(steps, axis=0))


def tracks_of(
    cam_to_world: np.ndarray,
    *,
    focal_px: float = 640.0,
    fps: float = 24.0,
    noise_px: float = 0.1,
    seed: int = 0,
    scene: str = "street",
    corners: int = 260,
    traffic: float = 0.0,
    bonnet: float = 0.0,
    camera_height_m: float = 1.5,
) -> RunTracks:
    """What a perfect tracker with white noise would see.

    Args:
        cam_to_world: (T, 4, 4), metres, level ground under the first camera.
        scene: "street" (road and houses), "road" (the plane alone), "wall" (a plane across the road, 30 m ahead).
        traffic: share of the corners that sit on cars crossing from left to right.
        bonnet: share of the corners that rest at the bottom of the picture.
    """
    rng = np.random.default_rng(seed)
    world = _points(rng, cam_to_world, scene, camera_height_m)
    world_to_cam = invert(cam_to_world)
    count = len(cam_to_world)
    focal, centre = focal_px, np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    alive = np.zeros(0, np.int64)
    still = rng.uniform([40, HEIGHT * 0.88], [WIDTH - 40, HEIGHT - 4], (int(bonnet * corners), 2))
    frames = []
    for index in range(count):
        seen = world @ world_to_cam[index, :3, :3].T + world_to_cam[index, :3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = seen[:, :2] / seen[:, 2:] * focal + centre
        inside = (seen[:, 2] > 2) & (seen[:, 2] < 120) & (pixel > 3).all(axis=1)
        inside &= (pixel < np.array([WIDTH - 3, HEIGHT - 3])).all(axis=1)
        alive = alive[inside[alive]]
        alive = _topped_up(rng, alive, inside, pixel, corners)
        points, ids = pixel[alive], alive.copy()
        if traffic:
            points, ids = _with_traffic(points, ids, traffic, index / fps, len(world))
        points = np.concatenate([points, still])
        ids = np.concatenate([ids, 10**8 + np.arange(len(still))])
        order = np.argsort(ids)
        noisy = points[order] + rng.normal(0, noise_px, (len(points), 2))
        frames.append(
            FrameTracks(
                ids=ids[order], points_px=noisy.astype(np.float32),
                forward_backward_px=np.full(len(ids), noise_px, np.float32), cut=False, repeated=False,
            )
        )  # fmt: skip
    return RunTracks(
        width=WIDTH, height=HEIGHT, source_width=WIDTH, source_height=HEIGHT, times_s=np.arange(count) / fps,
        frames=tuple(frames),
    )  # fmt: skip


def _points(rng: np.random.Generator, cam_to_world: np.ndarray, scene: str, height_m: float) -> np.ndarray:
    path = cam_to_world[:, :3, 3]
    if scene == "wall":
        return np.stack([rng.uniform(-30, 30, 4000), rng.uniform(-20, 20, 4000), np.full(4000, 30.0)], axis=1)
    low, high = path.min(axis=0) - 90, path.max(axis=0) + 90
    count = int(min(25_000, 0.5 * (high[0] - low[0]) * (high[2] - low[2])))
    ground = rng.uniform(low, high, (count, 3))
    near = path[:: max(1, len(path) // 40)]
    close = np.concatenate([ground, (near[:, None] + rng.uniform(-9, 9, (len(near), 60, 3))).reshape(-1, 3)])
    close[:, 1] = height_m
    if scene == "road":
        return close
    houses = rng.uniform(low, high, (count // 2, 3))
    houses[:, 1] = rng.uniform(-7, height_m, len(houses))
    beside = np.linalg.norm(houses[:, None, ::2] - near[None, :, ::2], axis=-1).min(axis=1) > 5
    return np.concatenate([close, houses[beside]])


def _topped_up(
    rng: np.random.Generator, alive: np.ndarray, inside: np.ndarray, pixel: np.ndarray, corners: int
) -> np.ndarray:
    """Add visible points, at most two for each cell of 32 pixels."""
    fresh = np.setdiff1d(np.flatnonzero(inside), alive)
    rng.shuffle(fresh)
    order = np.concatenate([alive, fresh])
    cell = (pixel[order] // 32).astype(int)
    index = cell[:, 1] * 100 + cell[:, 0]
    by_cell = np.argsort(index, kind="stable")
    sorted_index = index[by_cell]
    rank = np.empty(len(order), int)
    rank[by_cell] = np.arange(len(order)) - np.searchsorted(sorted_index, sorted_index)
    good = order[(rank < 2) | (np.arange(len(order)) < len(alive))]
    return np.sort(good[:corners])


def _with_traffic(
    points: np.ndarray, ids: np.ndarray, share: float, now_s: float, first_id: int
) -> tuple[np.ndarray, np.ndarray]:
    """Replace a share of the corners by corners on two cars that cross the picture at 150 and 240 pixels a second."""
    wanted = int(share * len(points))
    layout = np.random.default_rng(99).uniform([0, 190], [WIDTH, 330], (4000, 2))
    speed = np.where(np.arange(len(layout)) % 2 == 0, 150.0, 240.0)
    moved = layout + np.stack([speed * now_s, np.zeros(len(layout))], axis=1)
    # Cars come in from the left: wrap their corners round under a new id.
    laps = np.floor(moved[:, 0] / WIDTH).astype(int)
    moved[:, 0] -= laps * WIDTH
    cars = np.arange(len(layout))[:wanted]
    # By a scrambled id, so that the same corners stay from frame to frame.
    keep = np.sort(np.argsort(ids * 2654435761 % 2**32)[: len(points) - wanted])
    car_ids = first_id + cars + 5000 * (1 + laps[cars])
    return np.concatenate([points[keep], moved[cars]]), np.concatenate([ids[keep], car_ids])
