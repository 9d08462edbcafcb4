"""A clip's trajectory as a picture: from above with where the camera looks, and its speed and yaw rate over time."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dataset.inspection import clip_verdict
from dataset.layout import SELECTION, parse_run_item
from dataset.receipts import outputs_present, read_receipts
from dataset.selection import read_selection
from dataset.tables import EgoTable, read_ego
from dataset.trajectory_marks import FAINT, GRID, INK, add_line, legend_marks, tidy
from dataset.trajectory_plan import draw_plan, plan_of
from labeling.camera import rebased_trajectory
from labeling.errors import DataError

_DPI = 110
_WIDE = 1.9
"""A plan that is wider for its height lies above the curves."""
_NARROWEST = 0.6
_ABOVE_IN = (10.2, 5.6)
"""Width of a plan above the curves, and height of all that is below and above it."""
_BESIDE_IN = (5.0, 5.4)
"""Width of curves beside a plan, and the plan's height."""


def clip_motion(job: Path, key: str) -> EgoTable:
    """The stored camera motion of a clip, re-based to its first frame, seconds from there.

    Raises:
        DataError: no such clip, or no receipt says that one of its runs has a trajectory.
    """
    row = clip_verdict(job, key)
    # Runs of an earlier selection keep their receipts: those that begin and end with clips kept now come first.
    kept = [other for other in read_selection(job / SELECTION).kept if other.video_id == row.video_id]
    starts, ends = {other.start for other in kept}, {other.end for other in kept}
    runs = sorted(_told_runs(job, row.video_id), key=lambda run: (run[0] in starts) + (run[1] in ends), reverse=True)
    for start, end, path in runs:
        if start <= row.start and row.end <= end:
            return sliced(read_ego(path), row.start - start, row.end - start)
    why = row.reason or f"run `animatic ego {job}`"
    raise DataError(f"{job}: has no trajectory of {key} ({why})")


def _told_runs(job: Path, video_id: str) -> Iterator[tuple[int, int, Path]]:
    """Start, end and file of a video's runs whose trajectories are done: what a receipt says, not what lies there."""
    for receipt in read_receipts(job, "ego").values():
        video, run = parse_run_item(receipt.item)
        if video == video_id and receipt.state == "done" and outputs_present(job, receipt):
            yield run.start, run.end, job / receipt.output(".ego.parquet").path


def sliced(ego: EgoTable, start: int, end: int) -> EgoTable:
    """Rows ``[start, end)``, re-based to the first of them, seconds from there."""
    rows, times = slice(start, end), ego.trajectory.timestamps_s[start:end]
    return replace(
        ego, frame=ego.frame[rows], mode=ego.mode[rows], confidence=ego.confidence[rows],
        trajectory=rebased_trajectory(times - times[0], ego.trajectory.cam_to_world[rows]),
        scale_source=ego.scale_source[rows], scale_sigma=ego.scale_sigma[rows],
    )  # fmt: skip


def speeds_m_s(ego: EgoTable) -> np.ndarray:
    """(T,) speed along where the camera looks, negative backwards; the first repeats the second."""
    poses, times = ego.trajectory.cam_to_world, ego.trajectory.timestamps_s
    if len(poses) < 2:
        return np.zeros(len(poses))
    steps = np.diff(poses[:, :3, 3], axis=0)
    ahead = np.where(np.einsum("ti,ti->t", steps, poses[:-1, :3, 2]) < 0, -1.0, 1.0)
    speed = ahead * np.linalg.norm(steps, axis=1) / np.diff(times)
    return np.concatenate([speed[:1], speed])


def yaw_rates_deg_s(ego: EgoTable) -> np.ndarray:
    """(T,) rate of turning about the camera's vertical, positive to the right; the first repeats the second."""
    poses, times = ego.trajectory.cam_to_world, ego.trajectory.timestamps_s
    if len(poses) < 2:
        return np.zeros(len(poses))
    turn = np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]
    rate = np.degrees(np.arctan2(turn[:, 0, 2], turn[:, 2, 2])) / np.diff(times)
    return np.concatenate([rate[:1], rate])


def draw_trajectory(ego: EgoTable, *, title: str) -> Figure:
    """The picture of a clip; a way that goes far ahead lies above the curves, any other beside them.

    Args:
        ego: of ``clip_motion``.
        title: what the clip is called.
    """
    plan = plan_of(ego)
    figure, (above, speed, yaw, sure) = _panels(plan.aspect)
    draw_plan(above, ego, plan)
    metres_s = speeds_m_s(ego)
    _draw_curve(speed, ego, metres_s, "speed, m/s", spread=np.abs(metres_s) * ego.scale_sigma, least=(0.0, 1.0))
    _draw_curve(yaw, ego, yaw_rates_deg_s(ego), "yaw rate, deg/s, right is positive", least=(-2.0, 2.0))
    _draw_curve(sure, ego, ego.confidence.astype(np.float64), _confidence_words(ego), least=(0.0, 1.0), filled=True)
    sure.set_yticks([0, 0.5, 1])
    sure.set_xlabel("seconds from the clip's start", color=FAINT)
    for axes in (speed, yaw):
        axes.tick_params(labelbottom=False)
    # The blank line keeps room for the title, which is larger.
    figure.suptitle(f"\n\n{_facts(ego)}", x=0.012, ha="left", fontsize=9.5, color=FAINT, linespacing=1.5)
    height = figure.get_figheight()
    figure.text(0.012, 1 - 0.12 / height, title, ha="left", va="top", fontsize=15, color=INK, fontweight="bold")
    sigma = Line2D([], [], color="#a0aec0", alpha=0.5, linewidth=7, label="one sigma of the scale")
    figure.legend(
        handles=[*legend_marks(ego), sigma], loc="upper right", ncols=6, frameon=False, fontsize=9.5, labelcolor=INK,
        handlelength=2.6, columnspacing=1.4,
    )  # fmt: skip
    return figure


def _panels(aspect: float) -> tuple[Figure, list[Axes]]:
    """A figure of the plan and three curves, sized so that the plan has as little empty as can be."""
    if aspect > _WIDE:
        height = max(1.6, _ABOVE_IN[0] / aspect)
        figure = Figure(figsize=(_ABOVE_IN[0] + 0.8, height + _ABOVE_IN[1]), dpi=_DPI, layout="constrained")
        panels = list(figure.subplots(4, 1, gridspec_kw={"height_ratios": [height, 1.5, 1.5, 1.0]}))
    else:
        width = _BESIDE_IN[1] * max(aspect, _NARROWEST)
        figure = Figure(figsize=(width + _BESIDE_IN[0] + 0.8, _BESIDE_IN[1] + 1.4), dpi=_DPI, layout="constrained")
        grid = figure.add_gridspec(3, 2, width_ratios=[width, _BESIDE_IN[0]], height_ratios=[1.5, 1.5, 1.0])
        panels = [figure.add_subplot(grid[:, 0]), *(figure.add_subplot(grid[row, 1]) for row in range(3))]
    figure.get_layout_engine().set(h_pad=0.06, hspace=0.02)  # type: ignore[union-attr]
    return figure, panels


def write_trajectory_picture(job: Path, key: str, path: Path) -> None:
    """Write the picture of a clip's trajectory; the file's ending says of which kind.

    Raises:
        DataError: no such clip, no trajectory yet, or a picture that cannot be written.
    """
    if not path.suffix:
        # Matplotlib would write a PNG under a name of its own.
        raise DataError(f"{path}: is no picture's name; end it in .png")
    figure = draw_trajectory(clip_motion(job, key), title=key)
    try:
        figure.savefig(path)
    except ValueError as error:
        raise DataError(f"{path}: is no picture's name ({error}); end it in .png") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror}); give a folder that is there") from error


def _draw_curve(
    axes: Axes, ego: EgoTable, values: np.ndarray, name: str, *, least: tuple[float, float],
    spread: np.ndarray | None = None, filled: bool = False,
) -> None:  # fmt: skip
    """A curve over time; ``spread`` is one sigma either way, ``least`` the range of values that is always shown."""
    times_s = ego.trajectory.timestamps_s
    low, high = values, values
    if spread is not None:
        low, high = values - spread, values + spread
        axes.fill_between(times_s, low, high, color="#a0aec0", alpha=0.3, linewidth=0, zorder=1)
    if filled:
        axes.fill_between(times_s, 0.0, values, color=GRID, alpha=0.35, linewidth=0, zorder=1)
    axes.axhline(0.0, color=GRID, linewidth=1.0, zorder=0)
    add_line(axes, np.stack([times_s, values], axis=1), ego, width=2.4)
    bottom, top = min(least[0], float(low.min())), max(least[1], float(high.max()))
    pad = 0.08 * (top - bottom)
    axes.set_ylim(bottom - pad, top + pad)
    axes.set_xlim(float(times_s[0]), max(float(times_s[-1]), float(times_s[0]) + 0.1))
    axes.set_title(name, loc="left", fontsize=9.5, color=FAINT, pad=3)
    tidy(axes)


def _confidence_words(ego: EgoTable) -> str:
    """The figures of the confidence, which near 1 no curve tells."""
    lowest = int(ego.confidence.argmin())
    when = float(ego.trajectory.timestamps_s[lowest])
    return f"confidence, median {np.median(ego.confidence):.2f}, least {ego.confidence[lowest]:.2f} at {when:.1f} s"


def _facts(ego: EgoTable) -> str:
    """What was driven, and the camera that it was seen through."""
    camera, road = ego.intrinsics, ego.road
    turned = float(np.sum(yaw_rates_deg_s(ego)[1:] * np.diff(ego.trajectory.timestamps_s)))
    driven = f"{ego.trajectory.path_length_m:.1f} m driven"
    if abs(turned) >= 0.5:
        driven += f", {abs(turned):.0f} degrees to the {'right' if turned > 0 else 'left'}"
    scale = ", ".join(sorted(set(ego.scale_source)))
    lens = f"focal length {camera.fx:.0f} px of {camera.width} ({camera.source}, sigma {camera.focal_sigma:.0%})"
    height = f"camera {road['height_m']:.2f} m high ({road.get('height_source', 'given')})"
    tilt = ""
    if road.get("pitch_rad") is not None:
        degrees = round(math.degrees(float(road["pitch_rad"] or 0.0)), 1)
        way = "level" if degrees == 0 else f"looking {abs(degrees):.1f} degrees {'down' if degrees > 0 else 'up'}"
        tilt = f", {way} ({road.get('pitch_source', 'estimated')})"
    return f"{driven}; metres from: {scale}, sigma {float(np.median(ego.scale_sigma)):.0%}\n{lens}; {height}{tilt}"
