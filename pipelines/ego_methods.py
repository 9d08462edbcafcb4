"""Ways to estimate ego-motion, from none to the ladder: what ``chart ego`` and ``stability ego`` compare.

Methods that cannot know lengths take steps of one constant speed; the chart's displacement error fits one scale.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from labeling.camera import Intrinsics, invert, rigid
from labeling.ego_corners import TrackSettings
from labeling.ego_models import fit_moving, fit_turning
from labeling.ego_motion import EgoMotion, EgoSettings, estimate_ego_motion, solve_run
from labeling.ego_refinement import refined_poses
from labeling.ego_steps import FORWARD
from labeling.ego_tracks import matched, track_run

ASSUMED_SPEED_M_S = 8.0
"""Of methods that see no lengths."""
STOCK = "stock OpenCV"
"""Name of ``stock_opencv`` in the stability table."""
UNCALIBRATED = "not calibrated"
"""Name of the project's own estimate with a camera that is believed as it is told."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EgoClip:
    """Pictures of a drive with their truth."""

    name: str
    frames: Sequence[np.ndarray]
    """(H, W, 3) uint8 RGB each."""
    times_s: np.ndarray
    intrinsics: Intrinsics
    truth: np.ndarray
    """(T, 4, 4) camera to world, metres."""
    camera_height_m: float = 1.5


Method = Callable[[EgoClip], np.ndarray]
"""Gives (T, 4, 4) camera to world."""


def default_motion(clip: EgoClip, settings: EgoSettings | None = None) -> EgoMotion:
    """The project's own estimate."""
    return estimate_ego_motion(
        clip.frames, clip.times_s, intrinsics=clip.intrinsics, camera_height_m=clip.camera_height_m, settings=settings
    )


def default_and_stock(clip: EgoClip) -> list[tuple[str, np.ndarray]]:
    """The two methods of the stability table by name, each with its (T, 4, 4) camera to world."""
    return [("default", default_motion(clip).trajectory.cam_to_world), (STOCK, stock_opencv(clip))]


def constant_zero(clip: EgoClip) -> np.ndarray:
    """The camera never moves."""
    return np.tile(np.eye(4), (len(clip.frames), 1, 1))


def constant_speed(clip: EgoClip) -> np.ndarray:
    """The camera drives straight on."""
    return _chain(clip, (np.eye(3) for _ in clip.frames[1:]))


def phase_correlation(clip: EgoClip) -> np.ndarray:
    """The upper half's shift as yaw and pitch; straight on."""

    def turns() -> Iterator[np.ndarray]:
        before = None
        for frame in clip.frames:
            grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
            small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            here = small[: small.shape[0] // 2].astype(np.float32)
            if before is not None:
                (dx, dy), _ = cv2.phaseCorrelate(before, here)
                pitch, yaw = -2 * dy / clip.intrinsics.fy, 2 * dx / clip.intrinsics.fx
                yield cv2.Rodrigues(np.array([pitch, yaw, 0.0]))[0]
            before = here

    return _chain(clip, turns())


def rotation_only(clip: EgoClip) -> np.ndarray:
    """The rotation that most corners agree on; straight on."""
    rotation = np.eye(3)

    def turns() -> Iterator[np.ndarray]:
        nonlocal rotation
        for first, second, focal in _pairs(clip):
            scales = np.geomspace(6.0, 0.5, 8) / focal
            rotation = fit_turning(first, second, np.ones(len(first)), rotation, scales)
            yield rotation

    return _chain(clip, turns())


def irls_alone(clip: EgoClip) -> np.ndarray:
    """Rotation and direction from the last motion, one pair after another: no ladder, no windows, no road."""
    rotation, axis = np.eye(3), FORWARD

    def steps() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        nonlocal rotation, axis
        for first, second, focal in _pairs(clip):
            noise = 0.1 / focal
            rotation, axis, _ = fit_moving(
                first, second, np.ones(len(first)), rotation, axis, noise * np.geomspace(30, 3, 10), noise, axis, 0.0
            )
            yield rotation, axis

    return _chain_steps(clip, steps())


def stock_opencv(clip: EgoClip, *, method: int = cv2.RANSAC, distance_limit: float | None = None) -> np.ndarray:
    """``findEssentialMat`` and ``recoverPose``; ``distance_limit`` is in baselines (OpenCV's own is 50)."""
    rotation, axis = np.eye(3), FORWARD

    def steps() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        nonlocal rotation, axis
        for first, second, focal in _pairs(clip):
            found = _essential(first, second, focal, method=method, distance_limit=distance_limit)
            if found is not None:
                rotation, axis = found
            yield rotation, axis

    return _chain_steps(clip, steps())


def orb_matching(clip: EgoClip) -> np.ndarray:
    """ORB features matched by brute force, then ``findEssentialMat`` and ``recoverPose`` without the limit."""
    orb, matcher = cv2.ORB.create(nfeatures=800), cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    camera = clip.intrinsics
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    rotation, axis = np.eye(3), FORWARD

    def steps() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        nonlocal rotation, axis
        before = None
        for frame in clip.frames:
            points, words = orb.detectAndCompute(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), None)
            here = (np.array([point.pt for point in points]).reshape(-1, 2), words)
            if before is not None:
                if before[1] is not None and words is not None:
                    pairs = [(match.queryIdx, match.trainIdx) for match in matcher.match(before[1], words)]
                    one, two = np.array(pairs, int).reshape(-1, 2).T
                    first, second = (before[0][one] - centre) / focal, (here[0][two] - centre) / focal
                    found = _essential(first, second, float(camera.fx), method=cv2.RANSAC, distance_limit=1e9)
                    rotation, axis = found if found is not None else (rotation, axis)
                yield rotation, axis
            before = here

    return _chain_steps(clip, steps())


def ladder(clip: EgoClip, *, long_side: int = 640, corners: int = 320) -> np.ndarray:
    """The project's own, on pictures of this size."""
    settings = EgoSettings(tracks=TrackSettings(long_side=long_side, corners=corners))
    return default_motion(clip, settings).trajectory.cam_to_world


def ladder_refined(clip: EgoClip, *, long_side: int = 640) -> np.ndarray:
    """The ladder, then windowed refinement."""
    tracks = track_run(clip.frames, clip.times_s, settings=TrackSettings(long_side=long_side))
    motion = solve_run(tracks, intrinsics=clip.intrinsics, camera_height_m=clip.camera_height_m)
    return refined_poses(tracks, motion, intrinsics=clip.intrinsics)


def _pairs(clip: EgoClip) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """Normalised corners of consecutive frames, and the working picture's focal length."""
    tracks = track_run(clip.frames, clip.times_s)
    camera = clip.intrinsics.resized(tracks.width, tracks.height)
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    for before, after in zip(tracks.frames[:-1], tracks.frames[1:], strict=True):
        one, two = matched(before, after)
        yield (before.points_px[one] - centre) / focal, (after.points_px[two] - centre) / focal, camera.fx


def _essential(
    first: np.ndarray, second: np.ndarray, focal: float, *, method: int, distance_limit: float | None
) -> tuple[np.ndarray, np.ndarray] | None:
    if len(first) < 8:
        return None
    eye = np.eye(3)
    essential, mask = cv2.findEssentialMat(
        first, second, eye, method=method, prob=0.999, threshold=0.5 / focal, maxIters=1000
    )
    if essential is None or essential.shape != (3, 3):
        return None
    if distance_limit is None:
        _, rotation, axis, _ = cv2.recoverPose(essential, first, second, eye, mask=mask)
    else:
        _, rotation, axis, _, _ = cv2.recoverPose(
            essential, first, second, eye, distanceThresh=distance_limit, mask=mask
        )
    return rotation, axis[:, 0]


def _chain(clip: EgoClip, turns: Iterator[np.ndarray]) -> np.ndarray:
    return _chain_steps(clip, ((rotation, FORWARD) for rotation in turns))


def _chain_steps(clip: EgoClip, steps: Iterator[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    poses = [np.eye(4)]
    for (rotation, axis), elapsed in zip(steps, np.diff(clip.times_s), strict=True):
        poses.append(poses[-1] @ invert(rigid(rotation, axis * ASSUMED_SPEED_M_S * elapsed)))
    return np.array(poses)
