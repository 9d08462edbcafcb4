"""Cameras: intrinsics, how a source picture maps onto the working picture, SE(3), trajectories and their files.

Axes are OpenCV's: x right, y down, z forward; metres. Pixel centres lie on integers. ``a_to_b`` is the 4x4 matrix that
takes coordinates in frame a to coordinates in frame b; ``cam_to_world`` is the usual pose of a camera.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from labeling.errors import TrajectoryError

IntrinsicsSource = Literal["given", "metadata", "estimated", "prior"]

_ROTATION_TOLERANCE = 1e-3
_FOCAL_LIMITS = (0.2, 5.0)
_FARTHEST_M = 1e8
"""Of a position in a file: more than the earth is round."""
_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureMap:
    """How a source picture becomes the working picture: scaled to cover it, then centre-cropped."""

    source_width: int
    source_height: int
    scaled_width: int
    """Even, at least ``width``."""
    scaled_height: int
    """Even, at least ``height``."""
    crop_x: int
    """Even column offset of the crop in the scaled picture."""
    crop_y: int
    """Even row offset."""
    width: int
    height: int

    @property
    def scale_x(self) -> float:
        """Scaled pixels per source pixel along x; both axes are rounded to even sizes, so they may differ."""
        return self.scaled_width / self.source_width

    @property
    def scale_y(self) -> float:
        """Scaled pixels per source pixel along y."""
        return self.scaled_height / self.source_height


def cover_map(source_width: int, source_height: int, *, width: int, height: int) -> PictureMap:
    """The map of a source picture onto ``width`` x ``height``: scale to cover, centre-crop, everything even."""
    scale = max(width / source_width, height / source_height)
    scaled_width = max(width, 2 * round(source_width * scale / 2))
    scaled_height = max(height, 2 * round(source_height * scale / 2))
    return PictureMap(
        source_width=source_width, source_height=source_height,
        scaled_width=scaled_width, scaled_height=scaled_height,
        crop_x=2 * ((scaled_width - width) // 4), crop_y=2 * ((scaled_height - height) // 4),
        width=width, height=height,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Intrinsics:
    """A pinhole camera without distortion.

    Raises:
        TrajectoryError: a focal length that is not finite, not positive, or outside of 0.2 to 5 times the picture's
            longer side (136 to 11 degrees across): one given in millimetres, or for another picture.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    source: IntrinsicsSource
    """Where the focal length came from."""
    focal_sigma: float = 0.0
    """One sigma of the focal length, relative to it (0.2 = 20 %)."""

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, self.focal_sigma)
        longest = max(self.width, self.height)
        if not all(map(math.isfinite, numbers)) or not (
            longest * _FOCAL_LIMITS[0] <= min(self.fx, self.fy) <= max(self.fx, self.fy) <= longest * _FOCAL_LIMITS[1]
        ):
            raise TrajectoryError(
                f"intrinsics fx={self.fx:g} fy={self.fy:g} cx={self.cx:g} cy={self.cy:g} do not fit a picture of "
                f"{self.width}x{self.height}; give focal lengths in pixels of that picture, {_FOCAL_LIMITS[0]:g} to "
                f"{_FOCAL_LIMITS[1]:g} times its longer side"
            )

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) float64, K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def mapped(self, picture: PictureMap) -> "Intrinsics":
        """The same camera after the picture was scaled and cropped: ``c' = (c + 0.5) s - 0.5 - crop``, ``f' = f s``."""
        return replace(
            self, width=picture.width, height=picture.height,
            fx=self.fx * picture.scale_x, fy=self.fy * picture.scale_y,
            cx=(self.cx + 0.5) * picture.scale_x - 0.5 - picture.crop_x,
            cy=(self.cy + 0.5) * picture.scale_y - 0.5 - picture.crop_y,
        )  # fmt: skip

    def resized(self, width: int, height: int) -> "Intrinsics":
        """The same camera with its whole picture resized, uncropped."""
        whole = PictureMap(
            source_width=self.width, source_height=self.height, scaled_width=width, scaled_height=height,
            crop_x=0, crop_y=0, width=width, height=height,
        )  # fmt: skip
        return self.mapped(whole)


def prior_intrinsics(width: int, height: int) -> Intrinsics:
    """What is assumed of an unknown camera, in pixels of the *source*: f = max(width, height), centre in the middle."""
    focal = float(max(width, height))
    return Intrinsics(
        width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2,
        source="prior", focal_sigma=0.25,
    )  # fmt: skip


def metadata_intrinsics(width: int, height: int, *, focal_35mm: float) -> Intrinsics:
    """The camera of a file that says its focal length for 35 mm film, mm; in pixels of the *source*.

    The picture's diagonal stands for the film's; crops of stabilisation and of other aspects are why it is off by some.
    """
    focal = focal_35mm / _FILM_DIAGONAL_MM * math.hypot(width, height)
    return replace(prior_intrinsics(width, height), fx=focal, fy=focal, source="metadata", focal_sigma=0.1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Camera poses over time, relative to the first.

    Raises:
        TrajectoryError: wrong shapes, numbers that are not finite, rotations that are not, time running backwards, or a
            first pose that is not the identity.
    """

    timestamps_s: np.ndarray
    """(T,) float64, strictly increasing."""
    cam_to_world: np.ndarray
    """(T, 4, 4) float64, SE(3), metres, OpenCV axes, first row is the identity."""

    def __post_init__(self) -> None:
        check_times(self.timestamps_s)
        check_poses(self.cam_to_world)
        if len(self.timestamps_s) != len(self.cam_to_world):
            raise TrajectoryError(
                f"{len(self.timestamps_s)} timestamps for {len(self.cam_to_world)} poses; give one for each pose"
            )
        if not np.allclose(self.cam_to_world[0], np.eye(4), atol=1e-6):
            raise TrajectoryError(
                "cam_to_world[0] must be the identity; use rebased_trajectory on poses in another frame"
            )

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def slice(self, start: int, end: int) -> "Trajectory":
        """Poses ``[start, end)``, re-based to the first of them; timestamps are kept."""
        return rebased_trajectory(self.timestamps_s[start:end], self.cam_to_world[start:end])

    @property
    def positions(self) -> np.ndarray:
        """(T, 3) float64, metres."""
        return self.cam_to_world[:, :3, 3]

    @property
    def path_length_m(self) -> float:
        """Length of the way that was driven."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())


def rebased_trajectory(timestamps_s: np.ndarray, cam_to_world: np.ndarray) -> Trajectory:
    """A trajectory from poses in any world frame: re-based to the first pose.

    Raises:
        TrajectoryError: as ``Trajectory``.
    """
    times = np.asarray(timestamps_s, dtype=np.float64)
    poses = np.asarray(cam_to_world, dtype=np.float64)
    check_poses(poses)
    relative = invert(poses[0]) @ poses
    relative[0] = np.eye(4)
    return Trajectory(timestamps_s=times, cam_to_world=relative)


def check_times(timestamps_s: np.ndarray) -> None:
    """Raise ``TrajectoryError`` unless times are (T,), finite and strictly increasing."""
    if timestamps_s.ndim != 1 or len(timestamps_s) == 0 or not np.isfinite(timestamps_s).all():
        raise TrajectoryError(f"timestamps must be (T,) finite seconds with T >= 1, got shape {timestamps_s.shape}")
    backwards = np.flatnonzero(np.diff(timestamps_s) <= 0)
    if len(backwards):
        at = int(backwards[0])
        raise TrajectoryError(
            f"time does not increase from row {at} ({timestamps_s[at]:g} s) to the next ({timestamps_s[at + 1]:g} s); "
            "sort the rows and drop repeated ones"
        )


def check_poses(cam_to_world: np.ndarray) -> None:
    """Raise ``TrajectoryError`` unless the matrices are (T, 4, 4) and SE(3)."""
    if cam_to_world.ndim != 3 or cam_to_world.shape[1:] != (4, 4) or len(cam_to_world) == 0:
        raise TrajectoryError(f"cam_to_world must be (T, 4, 4) with T >= 1, got {cam_to_world.shape}")
    if not np.isfinite(cam_to_world).all():
        raise TrajectoryError("cam_to_world holds numbers that are not finite; drop those frames first")
    rotations = cam_to_world[:, :3, :3]
    error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = np.flatnonzero((error > _ROTATION_TOLERANCE) | (np.linalg.det(rotations) < 0))
    if len(wrong) or not np.allclose(cam_to_world[:, 3], [0, 0, 0, 1]):
        at = int(wrong[0]) if len(wrong) else 0
        raise TrajectoryError(
            f"cam_to_world[{at}] is not a rigid motion (R R^T is off by {error[at]:.2g}); "
            "give rotations with determinant +1 and a last row of 0 0 0 1"
        )


def invert(a_to_b: np.ndarray) -> np.ndarray:
    """(..., 4, 4) rigid motions, inverted: b_to_a."""
    rotation_ba = np.swapaxes(a_to_b[..., :3, :3], -1, -2)
    inverse = np.zeros_like(a_to_b)
    inverse[..., :3, :3] = rotation_ba
    inverse[..., :3, 3:] = -rotation_ba @ a_to_b[..., :3, 3:]
    inverse[..., 3, 3] = 1.0
    return inverse


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(..., 4, 4) from (..., 3, 3) and (..., 3)."""
    rotation = np.asarray(rotation, dtype=np.float64)
    out = np.zeros((*rotation.shape[:-2], 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1.0
    return out


def rotation_angle_deg(rotation: np.ndarray) -> np.ndarray:
    """Angle of (..., 3, 3) rotations, degrees, 0 to 180."""
    return np.degrees(Rotation.from_matrix(rotation.reshape(-1, 3, 3)).magnitude()).reshape(rotation.shape[:-2])


def resample(trajectory: Trajectory, timestamps_s: np.ndarray) -> Trajectory:
    """The trajectory at other times inside its span: positions linear, rotations slerped; re-based to the first.

    Raises:
        TrajectoryError: a time lies outside the span.
    """
    times = np.asarray(timestamps_s, dtype=np.float64)
    check_times(times)
    first, last = trajectory.timestamps_s[0], trajectory.timestamps_s[-1]
    if times[0] < first - 1e-9 or times[-1] > last + 1e-9:
        raise TrajectoryError(
            f"times {times[0]:g} to {times[-1]:g} s leave the trajectory's {first:g} to {last:g} s; trim them first"
        )
    if len(trajectory) == 1:
        return rebased_trajectory(times, np.repeat(np.eye(4)[None], len(times), axis=0))
    times = np.clip(times, first, last)
    rotations = Slerp(trajectory.timestamps_s, Rotation.from_matrix(trajectory.cam_to_world[:, :3, :3]))(times)
    positions = np.stack([np.interp(times, trajectory.timestamps_s, axis) for axis in trajectory.positions.T], axis=-1)
    return rebased_trajectory(times, rigid(rotations.as_matrix(), positions))


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write ``timestamp_s tx ty tz qx qy qz qw`` rows, camera to world."""
    quaternions_xyzw = Rotation.from_matrix(trajectory.cam_to_world[:, :3, :3]).as_quat()
    rows = np.column_stack([trajectory.timestamps_s, trajectory.positions, quaternions_xyzw])
    np.savetxt(path, rows, fmt="%.9f", header="timestamp_s tx ty tz qx qy qz qw")


def read_tum(path: Path) -> Trajectory:
    """A trajectory from a TUM file, re-based to its first row.

    Raises:
        TrajectoryError: not 8 numbers a row, quaternions of length far from one, or as ``Trajectory``.
    """
    rows = _read_rows(path, columns=8)
    lengths = np.linalg.norm(rows[:, 4:], axis=1)
    # Written so that a length that is no number is none either.
    wrong = ~(np.abs(lengths - 1) <= 1e-2)
    if wrong.any():
        at = int(np.argmax(wrong))
        raise TrajectoryError(f"{path}: row {at} has a quaternion of length {lengths[at]:.3g}; give unit qx qy qz qw")
    check_times(rows[:, 0])
    _check_positions(rows[:, 1:4], path)
    return rebased_trajectory(rows[:, 0], rigid(Rotation.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4]))


def read_kitti(path: Path, *, fps: float) -> Trajectory:
    """A trajectory from a KITTI pose file, one row per frame at ``fps``, re-based to its first row.

    Raises:
        TrajectoryError: not 12 numbers a row, or as ``Trajectory``.
    """
    rows = _read_rows(path, columns=12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    _check_positions(poses[:, :3, 3], path)
    return rebased_trajectory(np.arange(len(rows)) / fps, poses)


def _check_positions(positions_m: np.ndarray, path: Path) -> None:
    """Raise ``TrajectoryError`` for a position that is on no road: what is not finite is told of by ``Trajectory``."""
    wrong = (np.abs(positions_m) > _FARTHEST_M).any(axis=1)
    if wrong.any():
        at = int(np.argmax(wrong))
        far = float(np.abs(positions_m[at]).max())
        raise TrajectoryError(f"{path}: row {at} lies {far:.3g} m from the origin; give metres below {_FARTHEST_M:g}")


def _read_rows(path: Path, *, columns: int) -> np.ndarray:
    try:
        rows = np.loadtxt(path, dtype=np.float64, ndmin=2, encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise TrajectoryError(f"{path}: cannot be read as {columns} numbers a row ({error})") from error
    if rows.shape[1:] != (columns,) or len(rows) == 0:
        raise TrajectoryError(f"{path}: needs rows of {columns} numbers, got a table of {rows.shape}")
    return rows
