"""Windowed refinement: steps made to agree with the motions seen over several frames at once.

The accuracy ceiling of the ladder, at several times its cost: besides each step, pairs of frames further apart are
fitted, and small corrections of all turns and directions are solved for together, each pair weighing by its
information. Lengths are left as they were.
"""

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from labeling.camera import Intrinsics, invert, rebased_trajectory, rigid
from labeling.ego_models import fit_moving, rotation_from_vector, tangent_basis
from labeling.ego_motion import EgoMotion
from labeling.ego_tracks import RunTracks, matched

_REACHES = (1, 2, 3, 5)
_LEAST_CORNERS = 30
_LINK = 1e8
"""Inverse variance, per square radian, of the difference between the changes of neighbouring steps."""


def refined_poses(tracks: RunTracks, motion: EgoMotion, *, intrinsics: Intrinsics, noise_px: float = 0.1) -> np.ndarray:
    """(T, 4, 4) camera to world of a run in which every frame is shown once, refined.

    Args:
        tracks: the run's corners.
        motion: as solved from them.
        intrinsics: of the run's pictures.
        noise_px: standard deviation of a corner, working pixels.
    """
    camera = intrinsics.resized(tracks.width, tracks.height)
    poses = motion.trajectory.cam_to_world
    steps = invert(poses[1:]) @ poses[:-1]
    moving = motion.mode[1:] == "moving"
    normal, right = _even_changes(moving), np.zeros(5 * len(steps))
    for reach in _REACHES:
        for start in range(len(steps) - reach + 1):
            inside = slice(start, start + reach)
            found = None
            if moving[inside].all():
                found = _pair(tracks, camera, steps[inside], start, reach, noise_px / camera.fx)
            if found is not None:
                block = slice(5 * start, 5 * (start + reach))
                right[block] += found[1]
                for above in range(5 * reach):
                    normal[-1 - above, block][above:] += np.diagonal(found[0], above)
    change = solveh_banded(normal, right).reshape(-1, 5)
    return rebased_trajectory(motion.trajectory.timestamps_s, _chained(steps, change)).cam_to_world


def _even_changes(moving: np.ndarray) -> np.ndarray:
    """(25, 5 m) banded normal matrix, as LAPACK wants its upper half, that ties each step's change to its neighbour's.

    The steps were smoothed already: what is left to mend is slow, and a change from one step to the next would only put
    noise back. Ones on the diagonal keep what nothing speaks of where it was.
    """
    count = len(moving)
    link = _LINK * np.repeat(moving[1:] & moving[:-1], 5)
    normal = np.zeros((5 * max(_REACHES), 5 * count))
    normal[-1] = 1.0
    normal[-1, 5:] += link
    normal[-1, : 5 * (count - 1)] += link
    normal[-6, 5:] -= link
    return normal


def _pair(
    tracks: RunTracks, camera: Intrinsics, steps: np.ndarray, start: int, reach: int, noise: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Normal matrix and right side that one pair of frames adds for the corrections of the steps between them."""
    before, after = tracks.frames[start], tracks.frames[start + reach]
    one, two = matched(before, after)
    if len(one) < _LEAST_CORNERS:
        return None
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    first, second = (before.points_px[one] - centre) / focal, (after.points_px[two] - centre) / focal
    whole = np.eye(4)
    for step in steps:
        whole = step @ whole
    length = float(np.linalg.norm(whole[:3, 3]))
    if length < 1e-6:
        return None
    axis = whole[:3, 3] / length
    scales = noise * np.array([12.0, 6.0, 3.0, 3.0, 3.0])
    rotation, found, information = fit_moving(
        first, second, np.ones(len(first)), whole[:3, :3], axis, scales, noise, axis, 0.0
    )
    found = found if found @ axis >= 0 else -found
    if found @ axis < 0.9:
        return None
    basis = tangent_basis(found)
    wanted = np.concatenate([Rotation.from_matrix(rotation @ whole[:3, :3].T).as_rotvec(), basis @ (found - axis)])
    jacobian = _jacobian(steps, basis / length)
    # Corners of one pair share errors that more corners do not average away.
    information = information * min(1.0, 60.0 / len(first))
    return jacobian.T @ information @ jacobian, jacobian.T @ information @ wanted


def _jacobian(steps: np.ndarray, basis_per_metre: np.ndarray) -> np.ndarray:
    """(5, 5 k): how a pair's rotation vector and direction follow its steps' corrections."""
    out = np.zeros((5, 5 * len(steps)))
    to_last = np.eye(3)
    behind = [np.zeros(3)]
    for step in steps:
        behind.append(step[:3, :3] @ behind[-1] + step[:3, 3])
    for index in range(len(steps) - 1, -1, -1):
        step = steps[index]
        column = 5 * index
        out[:3, column : column + 3] = to_last
        # A turn of this step swings everything that lies behind it: omega x p.
        swung = to_last @ _cross(-(step[:3, :3] @ behind[index]))
        out[3:, column : column + 3] = basis_per_metre @ swung
        own = float(np.linalg.norm(step[:3, 3]))
        tangent = tangent_basis(step[:3, 3] / own) if own > 1e-9 else np.zeros((2, 3))
        out[3:, column + 3 : column + 5] = basis_per_metre @ to_last @ (own * tangent.T)
        to_last = to_last @ step[:3, :3]
    return out


def _cross(vector: np.ndarray) -> np.ndarray:
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _chained(steps: np.ndarray, change: np.ndarray) -> np.ndarray:
    poses = [np.eye(4)]
    for step, delta in zip(steps, change, strict=True):
        own = float(np.linalg.norm(step[:3, 3]))
        shift = step[:3, 3]
        if own > 1e-9:
            shift = shift / own + delta[3:] @ tangent_basis(shift / own)
            shift = own * shift / np.linalg.norm(shift)
        poses.append(poses[-1] @ invert(rigid(rotation_from_vector(delta[:3]) @ step[:3, :3], shift)))
    return np.array(poses)
