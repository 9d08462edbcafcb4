"""``animatic chart ego``: milliseconds a frame against rotation, direction and displacement, from none to the best."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from labeling.errors import DataError
from pipelines import ego_methods as methods
from pipelines.charts import Chart, ChartPoint, Error, interleaved_ms, machine_name
from pipelines.ego_clips import TURNING_FRAME, highway_clip, kitti_clip, street_clip
from pipelines.ego_errors import direction_errors_deg, rotation_errors_deg, window_errors_m
from pipelines.ego_methods import EgoClip, Method

_REFERENCES = ("constant zero", "ladder + windowed refinement")


def chart(name: str, *, quick: bool = False) -> Chart:
    """Mean displacement error over 5 s with one fitted scale, then rotation and direction, a step at a time.

    Truth is KITTI 03 (10 fps; GPS and IMU) where it is there, and street drives (exact). An error is the
    mean over the clips of each clip's median (or 95th percentile) over its windows or steps, so that a long clip has no
    more votes than a short one; each clip's own figures stand in the settings.
    """
    clips = _clips(quick)
    found: dict[str, list[np.ndarray]] = {method: [] for method in _METHODS}
    timed = [
        partial(_timed, estimate, clip_of(clips[0]), found[method]) for method, (estimate, clip_of) in _METHODS.items()
    ]
    costs = interleaved_ms(timed, runs=1 if quick else 2)
    for method, (estimate, clip_of) in _METHODS.items():
        found[method] = [found[method][0], *(estimate(clip_of(clip)) for clip in clips[1:])]
    points = []
    for (method, poses), cost in zip(found.items(), costs, strict=True):
        displacement, *others = _errors(poses, clips)
        points.append(
            ChartPoint(
                method=method, settings=_figures(poses, clips), ms_per_frame=cost, error=displacement,
                more_errors=tuple(others), reference=method in _REFERENCES,
            )
        )  # fmt: skip
    data = ", ".join(f"{clip.name} ({len(clip.frames)})" for clip in clips)
    data += f" frames; cost on the first, {clips[0].frames[0].shape[1]}x{clips[0].frames[0].shape[0]}"
    return Chart(stage=name, data=data, points=tuple(points), machine=machine_name())


def _errors(poses: list[np.ndarray], clips: list[EgoClip]) -> list[Error]:
    """Displacement, rotation and direction over all clips."""
    pairs = [(mine, clip.truth) for mine, clip in zip(poses, clips, strict=True)]
    windows = [
        window_errors_m(mine, clip.truth, frames=_window(clip), fit_scale=True)
        for mine, clip in zip(poses, clips, strict=True)
    ]
    turns = [rotation_errors_deg(*pair) for pair in pairs]
    directions = [direction_errors_deg(*pair, least_m=0.1, ground_plane=True) for pair in pairs]
    return [
        _error("displacement in 5 s, one fitted scale", "m", windows),
        _error("rotation a frame", "degrees", turns),
        _error("direction in the ground plane", "degrees", directions),
    ]


def _error(metric: str, unit: str, parts: list[np.ndarray]) -> Error:
    median, high = (float(np.mean([np.percentile(part, share) for part in parts])) for share in (50, 95))
    return Error(metric=metric, unit=unit, median=_round(median), p95=_round(high))


def _clips(quick: bool) -> list[EgoClip]:
    if quick:
        return [street_clip("sharp_turn", start=TURNING_FRAME, frames=30)]
    streets = [street_clip("sharp_turn"), street_clip("traffic"), highway_clip()]
    try:
        return [kitti_clip(frames=200), *streets]
    except DataError:
        return streets


def _window(clip: EgoClip) -> int:
    """Frames in five seconds, counting both ends; no more than the clip has."""
    rate = 1.0 / float(np.median(np.diff(clip.times_s)))
    return min(round(5 * rate) + 1, len(clip.frames))


def _timed(estimate: Method, clip: EgoClip, found: list[np.ndarray]) -> int:
    """One run, whose answer is kept; returns how many frames it did."""
    found.append(estimate(clip))
    return len(clip.frames)


def _figures(poses: list[np.ndarray], clips: list[EgoClip]) -> dict[str, dict[str, float]]:
    """Every clip's figures, by name."""
    return {
        clip.name: {
            "rotation_deg_per_frame": _round(np.median(rotation_errors_deg(mine, clip.truth))),
            "direction_deg": _round(np.median(direction_errors_deg(mine, clip.truth, least_m=0.1))),
            "direction_ground_plane_deg": _round(
                np.median(direction_errors_deg(mine, clip.truth, least_m=0.1, ground_plane=True))
            ),
            "displacement_5s_fitted_m": _round(
                np.median(window_errors_m(mine, clip.truth, frames=_window(clip), fit_scale=True))
            ),
            "displacement_5s_metric_m": _round(
                np.median(window_errors_m(mine, clip.truth, frames=_window(clip), fit_scale=False))
            ),
        }
        for mine, clip in zip(poses, clips, strict=True)
    }


def _round(value: float) -> float:
    return round(float(value), 4)


def _same(clip: EgoClip) -> EgoClip:
    return clip


def _full(clip: EgoClip) -> EgoClip:
    """KITTI again at its full size; other clips as they are."""
    return kitti_clip(scale=1.0, frames=len(clip.frames)) if clip.name == "KITTI 03" else clip


_METHODS: dict[str, tuple[Method, Callable[[EgoClip], EgoClip]]] = {
    "constant zero": (methods.constant_zero, _same),
    "constant forward speed": (methods.constant_speed, _same),
    "phase correlation": (methods.phase_correlation, _same),
    "rotation only": (methods.rotation_only, _same),
    "stock findEssentialMat + recoverPose": (methods.stock_opencv, _same),
    "stock, no distance limit": (partial(methods.stock_opencv, distance_limit=1e9), _same),
    "MAGSAC": (partial(methods.stock_opencv, method=cv2.USAC_MAGSAC, distance_limit=1e9), _same),
    "IRLS alone": (methods.irls_alone, _same),
    "ladder at 1/3": (partial(methods.ladder, long_side=414), _same),
    "ladder at 1/2 (default)": (methods.ladder, _same),
    "ladder at full size": (partial(methods.ladder, long_side=1242, corners=480), _full),
    "ORB matching": (methods.orb_matching, _same),
    "ladder + windowed refinement": (methods.ladder_refined, _same),
}
