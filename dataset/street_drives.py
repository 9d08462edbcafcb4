"""How the synthetic street's camera drives: a road's shape as curvature along its length, and speed over time.

The road is a curve on the ground, ``StreetPath``; the camera's place on it is an arc length per frame. Street axes are
x right, y down, z forward, ground at y = 0 (or at minus the path's elevation), metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labeling.camera import Trajectory, rigid

_STEP_M = 0.25
_LEAD_IN_M = 120.0
_LEAD_OUT_M = 320.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreetPath:
    """The line that the camera drives along, sampled every ``step_m`` from ``start_m``."""

    start_m: float
    """Arc length of the first sample (negative: the road begins behind the camera)."""
    step_m: float
    points_xz: np.ndarray
    """(N, 2) float64, metres."""
    heading: np.ndarray
    """(N,) float64, radians, unwrapped; 0 looks along z, positive turns right."""
    elevation: np.ndarray
    """(N,) float64, height of the ground, metres."""
    bend: np.ndarray
    """(N,) float64, signed curvature, 1/m, positive to the right."""

    @property
    def end_m(self) -> float:
        """Arc length of the last sample."""
        return self.start_m + self.step_m * (len(self.points_xz) - 1)

    def at(self, arc_m: np.ndarray | float, lateral_m: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """(..., 3) ground points ``lateral_m`` to the right of the line at ``arc_m``, and (...,) headings."""
        last = len(self.points_xz) - 1
        place = np.clip((np.asarray(arc_m, np.float64) - self.start_m) / self.step_m, 0, last)
        before = np.minimum(place.astype(np.int64), last - 1)
        share = place - before

        def between(values: np.ndarray) -> np.ndarray:
            return values[before] * (1 - share) + values[before + 1] * share

        x, z = between(self.points_xz[:, 0]), between(self.points_xz[:, 1])
        heading, height = between(self.heading), between(self.elevation)
        out = np.stack(
            np.broadcast_arrays(x + lateral_m * np.cos(heading), -height, z - lateral_m * np.sin(heading)), -1
        )
        return out, np.broadcast_to(heading, out.shape[:-1])

    def curvature(self, arc_m: np.ndarray) -> np.ndarray:
        """Signed curvature, 1/m, positive to the right."""
        grid = np.arange(len(self.bend))
        return np.interp((np.asarray(arc_m) - self.start_m) / self.step_m, grid, self.bend)


def path_from_bends(bends: Sequence[tuple[float, float, float]], *, length_m: float) -> StreetPath:
    """A road from ``(from_m, to_m, turn_rad)`` bends: curvature rises and falls as a raised cosine over each."""
    arc = np.arange(-_LEAD_IN_M, length_m + _LEAD_OUT_M + _STEP_M / 2, _STEP_M)
    curvature = np.zeros_like(arc)
    for start, end, turn in bends:
        inside = (arc >= start) & (arc <= end)
        phase = (arc[inside] - start) / (end - start)
        curvature[inside] += turn / (end - start) * (1 - np.cos(2 * np.pi * phase))
    heading = np.concatenate([[0.0], np.cumsum(0.5 * (curvature[1:] + curvature[:-1]) * _STEP_M)])
    middle = 0.5 * (heading[1:] + heading[:-1])
    steps = np.stack([np.sin(middle), np.cos(middle)], -1) * _STEP_M
    points = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    origin = round(_LEAD_IN_M / _STEP_M)
    return StreetPath(
        start_m=-_LEAD_IN_M, step_m=_STEP_M, points_xz=_about(points, heading, origin),
        heading=heading - heading[origin], elevation=np.zeros_like(arc), bend=curvature,
    )  # fmt: skip


def _about(points: np.ndarray, heading: np.ndarray, origin: int) -> np.ndarray:
    """Points shifted and turned so that sample ``origin`` is at zero, looking along z."""
    c, s = np.cos(heading[origin]), np.sin(heading[origin])
    x, z = (points - points[origin]).T
    return np.stack([c * x - s * z, s * x + c * z], -1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """A camera's way through the street."""

    path: StreetPath
    arc_m: np.ndarray
    """(T,) float64: arc length of the camera per frame."""
    cam_to_street: np.ndarray
    """(T, 4, 4) float64, street axes."""


def drive_along(
    path: StreetPath, speed_mps: np.ndarray, *, fps: float, height_m: float, pitch_deg: float, yaw: np.ndarray
) -> Drive:
    """The drive with the given speed per frame (T,), looking along the road plus ``yaw`` (T,) radians to the right.

    ``pitch_deg`` is positive when the camera looks down.
    """
    middle = 0.5 * (speed_mps[1:] + speed_mps[:-1])
    arc = np.concatenate([[0.0], np.cumsum(middle) / fps])
    ground, heading = path.at(arc)
    angle = heading + yaw
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    turn = np.stack([np.stack([c, zero, s], -1), np.stack([zero, one, zero], -1), np.stack([-s, zero, c], -1)], -2)
    position = ground + np.array([0.0, -height_m, 0.0])
    return Drive(path=path, arc_m=arc, cam_to_street=rigid(turn @ pitch_matrix(pitch_deg), position))


def pitch_matrix(pitch_deg: float) -> np.ndarray:
    """(3, 3) camera to level: positive looks down (OpenCV's y is down)."""
    p = np.radians(pitch_deg)
    return np.array([[1, 0, 0], [0, np.cos(p), np.sin(p)], [0, -np.sin(p), np.cos(p)]])


def speed_profile(keys: Sequence[tuple[float, float]], *, frames: int, fps: float) -> np.ndarray:
    """(T,) m/s from ``(time_s, speed)`` keys, eased between them (so that acceleration starts and ends at zero)."""
    times, speeds = np.array(keys, np.float64).T
    now = np.arange(frames) / fps
    index = np.clip(np.searchsorted(times, now, side="right") - 1, 0, len(times) - 1)
    after = np.minimum(index + 1, len(times) - 1)
    share = np.clip((now - times[index]) / np.maximum(times[after] - times[index], 1e-9), 0, 1)
    return speeds[index] + (speeds[after] - speeds[index]) * share * share * (3 - 2 * share)


def wandering(rng: np.random.Generator, *, seconds: float) -> tuple[list, list]:
    """A made-up drive: speed keys with stops, and bends, gentle and sharp, for ``drive``."""
    speeds: list[tuple[float, float]] = []
    time, moving = 0.0, float(rng.uniform(6, 12))
    while time < seconds + 1:
        speeds += [(time, moving), (time + rng.uniform(3, 6), moving)]
        time = speeds[-1][0] + rng.uniform(2.5, 4)
        if rng.random() < 0.3:
            speeds += [(time, 0.0), (time + rng.uniform(1, 2.5), 0.0)]
            time = speeds[-1][0] + rng.uniform(2.5, 4)
        moving = float(rng.uniform(4, 13))
    bends: list[tuple[float, float, float]] = []
    arc = float(rng.uniform(20, 50))
    while arc < seconds * 13 + 200:
        sharp = rng.random() < 0.3
        length = float(rng.uniform(26, 34) if sharp else rng.uniform(50, 110))
        turn = float(rng.uniform(0.9, 1.5) if sharp else rng.uniform(0.15, 0.6)) * (1 if rng.random() < 0.5 else -1)
        if bends and sharp:  # Alternate, so that the road does not close on itself.
            turn = -np.sign(bends[-1][2]) * abs(turn)
        bends.append((arc, arc + length, turn))
        arc += length + float(rng.uniform(25, 70))
    return speeds, bends


def drive_given(trajectory: Trajectory, *, height_m: float, pitch_deg: float) -> Drive:
    """Lay a road under a given trajectory: level found from it, elevation and bends followed.

    The way down is the mean of (heading x camera's x axis) over frames that move, so a pitched camera is seen for what
    it is; a camera that never moves is taken to be pitched by ``pitch_deg``.
    """
    poses = trajectory.cam_to_world
    down = _down(poses, pitch_deg)
    forward = poses[0, :3, 2] - down * (poses[0, :3, 2] @ down)
    forward /= np.linalg.norm(forward)
    level = np.stack([np.cross(down, forward), down, forward])
    street = rigid(level, np.array([0.0, -height_m, 0.0])) @ poses
    path, arc = _path_under(street, height_m)
    return Drive(path=path, arc_m=arc, cam_to_street=street)


def _down(poses: np.ndarray, pitch_deg: float) -> np.ndarray:
    steps = np.diff(poses[:, :3, 3], axis=0)
    far = np.linalg.norm(steps, axis=1) > 0.02
    if not far.any():
        return pitch_matrix(pitch_deg).T[:, 1]
    facing = np.sign(np.einsum("ij,ij->i", steps, poses[:-1, :3, 2]))[:, None]
    downs = np.cross(steps * facing, poses[:-1, :3, 0])[far]
    down = downs.sum(axis=0)
    return down / np.linalg.norm(down)


def _path_under(street: np.ndarray, height_m: float) -> tuple[StreetPath, np.ndarray]:
    """The road below cameras in street axes, made longer at both ends, and each camera's arc length on it."""
    ground = street[:, :3, 3] + np.array([0.0, height_m, 0.0])
    looking = street[:, :3, 2] * np.array([1.0, 0.0, 1.0])
    steps = np.diff(ground, axis=0)
    backwards = np.einsum("ij,ij->i", steps, looking[:-1]).sum() < 0
    order = np.arange(len(ground))[:: -1 if backwards else 1]
    kept = [order[0]]
    for index in order[1:]:  # A knot every two metres of progress; standing and creeping back add none.
        if (ground[index] - ground[kept[-1]]) @ looking[index] > 2.0 * np.linalg.norm(looking[index]):
            kept.append(index)
    knots = ground[kept]
    first, last = looking[kept[0]], looking[kept[-1]]
    if len(knots) > 2:
        first, last = knots[1] - knots[0], knots[-1] - knots[-2]
    ends = [v * np.array([1.0, 0.0, 1.0]) / np.linalg.norm(v[[0, 2]]) for v in (first, last)]
    before = knots[0] - np.arange(_LEAD_IN_M, 0, -2.0)[:, None] * ends[0]
    after = knots[-1] + np.arange(2.0, _LEAD_OUT_M, 2.0)[:, None] * ends[1]
    line = np.concatenate([before, knots, after])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[:, [0, 2]], axis=0), axis=1))])
    arc = np.arange(0.0, length[-1], _STEP_M)
    smooth = np.stack([_smoothed(np.interp(arc, length, axis)) for axis in line.T], -1)
    tangent = np.gradient(smooth[:, [0, 2]], axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 0], tangent[:, 1]))
    path = StreetPath(
        start_m=0.0, step_m=_STEP_M, points_xz=smooth[:, [0, 2]], heading=heading, elevation=-smooth[:, 1],
        bend=np.gradient(heading, _STEP_M),
    )  # fmt: skip
    nearest = 4 * np.argmin(np.linalg.norm(ground[:, None, [0, 2]] - path.points_xz[None, ::4], axis=-1), axis=1)
    ahead = np.stack([np.sin(path.heading[nearest]), np.cos(path.heading[nearest])], -1)
    rest = np.einsum("ij,ij->i", ground[:, [0, 2]] - path.points_xz[nearest], ahead)
    return path, nearest * _STEP_M + rest


def _smoothed(values: np.ndarray, radius: int = 24) -> np.ndarray:
    kernel = np.hanning(2 * radius + 1)
    slopes = np.linspace(1, radius, radius)
    before = values[0] - (values[1] - values[0]) * slopes[::-1]
    after = values[-1] + (values[-1] - values[-2]) * slopes
    return np.convolve(np.concatenate([before, values, after]), kernel / kernel.sum(), mode="valid")
