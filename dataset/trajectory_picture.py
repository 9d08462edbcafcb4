"""A clip's trajectory as a picture: from above with where the camera looks, and its speed and yaw rate over time."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon

from dataset.inspection import clip_verdict
from dataset.layout import SELECTION, parse_run_item
from dataset.receipts import outputs_present, read_receipts
from dataset.selection import read_selection
from dataset.tables import EgoTable, read_ego
from labeling.camera import rebased_trajectory
from labeling.errors import DataError

MODE_COLOURS = {
    "moving": "#2b6cb0", "turning": "#dd6b20", "still": "#718096", "held": "#b83280", "cut": "#c53030",
    "missing": "#c53030",
}  # fmt: skip
_INK, _FAINT, _GRID = "#1a202c", "#4a5568", "#cbd5e0"
_LEAST_SPAN_M = 6.0
_PALEST = 0.3
_SHADES = 12


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
    """The picture of a clip.

    Args:
        ego: of ``clip_motion``.
        title: what the clip is called.
    """
    figure = Figure(figsize=(11, 10), dpi=110, layout="constrained")
    figure.get_layout_engine().set(h_pad=0.06, hspace=0.02)  # type: ignore[union-attr]
    plan, speed, yaw, sure = figure.subplots(4, 1, gridspec_kw={"height_ratios": [5.2, 1.7, 1.7, 0.55]})
    colours = _colours(ego)
    _draw_plan(plan, ego, colours)
    times = ego.trajectory.timestamps_s
    metres_s = speeds_m_s(ego)
    _draw_curve(
        speed, times, metres_s, colours, "speed\nm/s", spread=np.abs(metres_s) * ego.scale_sigma, least=(0.0, 1.0)
    )
    _draw_curve(yaw, times, yaw_rates_deg_s(ego), colours, "yaw rate\ndeg/s\n(+ right)", spread=None, least=(-2.0, 2.0))
    _draw_confidence(sure, times, ego, colours)
    for axes in (speed, yaw):
        axes.tick_params(labelbottom=False)
    figure.suptitle(title, x=0.012, ha="left", fontsize=15, color=_INK, fontweight="bold")
    plan.set_title(_facts(ego), loc="left", fontsize=9.5, color=_FAINT, pad=8, linespacing=1.5)
    figure.legend(
        handles=_legend(ego), loc="upper right", ncols=6, frameon=False, fontsize=9.5, labelcolor=_INK,
        handlelength=1.6, columnspacing=1.4,
    )  # fmt: skip
    return figure


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


def _colours(ego: EgoTable) -> np.ndarray:
    """(T, 4) RGBA: the mode's colour, paler where it is less sure."""
    from matplotlib.colors import to_rgb

    rgb = np.array([to_rgb(MODE_COLOURS.get(mode, _INK)) for mode in ego.mode])
    # In steps, so that equal pieces can be drawn as one line.
    sure = np.round(np.clip(ego.confidence.astype(np.float64), 0, 1) * _SHADES) / _SHADES
    strength = _PALEST + (1 - _PALEST) * sure
    return np.concatenate([rgb * strength[:, None] + (1 - strength[:, None]), np.ones((len(rgb), 1))], axis=1)


def _draw_plan(axes: Axes, ego: EgoTable, colours: np.ndarray) -> None:
    """From above, forward to the right and left upwards."""
    poses = ego.trajectory.cam_to_world
    way = np.stack([poses[:, 2, 3], -poses[:, 0, 3]], axis=1)
    looks = np.stack([poses[:, 2, 2], -poses[:, 0, 2]], axis=1)
    low, high = way.min(axis=0), way.max(axis=0)
    span = max(_LEAST_SPAN_M, float((high - low).max()))
    size = 0.032 * span
    half_angle = math.atan(ego.intrinsics.width / 2 / ego.intrinsics.fx)
    moments = _whole_seconds(ego.trajectory.timestamps_s)
    for moment in moments:
        axes.add_patch(_view_triangle(way[moment], looks[moment], size, half_angle, colours[moment]))
    _draw_labels(axes, way, looks, moments, size, ego.trajectory.timestamps_s)
    _add_line(axes, way, colours, width=3.2)
    axes.plot(*way[0], "o", color=_INK, markersize=6, zorder=6)
    middle, reach = (low + high) / 2, (high - low) / 2
    pad = np.maximum(reach + 3.2 * size, _LEAST_SPAN_M / 2 * np.array([1.0, 0.5]))
    axes.margins(0)
    axes.update_datalim([middle - pad, middle + pad])
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("forward of the first camera, m", color=_FAINT)
    axes.set_ylabel("left, m", color=_FAINT)
    _tidy(axes)


def _whole_seconds(times_s: np.ndarray) -> list[int]:
    """Rows nearest to each whole second."""
    wanted = np.arange(math.floor(float(times_s[-1]) + 1e-6) + 1)
    return [int(np.abs(times_s - second).argmin()) for second in wanted]


def _view_triangle(at: np.ndarray, looks: np.ndarray, size: float, half_angle: float, colour: np.ndarray) -> Polygon:
    """What the camera sees: its place and the two sides of its view."""
    ahead = looks / max(float(np.linalg.norm(looks)), 1e-9)
    side = np.array([-ahead[1], ahead[0]]) * math.tan(min(half_angle, 1.2))
    corners = np.stack([at, at + 2 * size * (ahead + side), at + 2 * size * (ahead - side)])
    return Polygon(corners, closed=True, facecolor=(*colour[:3], 0.22), edgecolor=colour, linewidth=1.1, zorder=3)


def _draw_labels(
    axes: Axes, way: np.ndarray, looks: np.ndarray, moments: Sequence[int], size: float, times_s: np.ndarray
) -> None:
    """Seconds beside the way, on the side that it does not bend to; those that would lie on one another as one."""
    ahead = looks / np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), 1e-9)
    outside = -1.0 if ahead[0, 0] * ahead[-1, 1] - ahead[0, 1] * ahead[-1, 0] > 0 else 1.0
    spots = way + outside * 1.5 * size * np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    groups: list[list[int]] = []
    for moment in moments:
        if groups and np.linalg.norm(spots[moment] - spots[groups[-1][0]]) < 2.2 * size:
            groups[-1].append(moment)
        else:
            groups.append([moment])
    for group in groups:
        first, last = times_s[group[0]], times_s[group[-1]]
        axes.annotate(
            f"{first:.0f} to {last:.0f} s" if len(group) > 1 else f"{first:.0f} s", spots[group[0]], fontsize=9,
            color=_FAINT, ha="center", va="center", zorder=7,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.8},
        )  # fmt: skip


def _draw_curve(
    axes: Axes, times_s: np.ndarray, values: np.ndarray, colours: np.ndarray, name: str, *,
    spread: np.ndarray | None, least: tuple[float, float],
) -> None:  # fmt: skip
    """A curve over time; ``spread`` is one sigma either way, ``least`` the range of values that is always shown."""
    low, high = values, values
    if spread is not None:
        low, high = values - spread, values + spread
        axes.fill_between(times_s, low, high, color="#a0aec0", alpha=0.3, linewidth=0, zorder=1)
    axes.axhline(0.0, color=_GRID, linewidth=1.0, zorder=0)
    _add_line(axes, np.stack([times_s, values], axis=1), colours, width=2.4)
    bottom, top = min(least[0], float(low.min())), max(least[1], float(high.max()))
    pad = 0.08 * (top - bottom)
    axes.set_ylim(bottom - pad, top + pad)
    axes.set_xlim(float(times_s[0]), max(float(times_s[-1]), float(times_s[0]) + 0.1))
    axes.set_ylabel(name, rotation=0, ha="right", va="center", color=_FAINT, labelpad=8)
    _tidy(axes)


def _draw_confidence(axes: Axes, times_s: np.ndarray, ego: EgoTable, colours: np.ndarray) -> None:
    """A strip: bars as high as the confidence, in the colours of the curves."""
    edges = np.append(times_s, times_s[-1] + (times_s[-1] - times_s[-2] if len(times_s) > 1 else 0.1))
    axes.bar(
        edges[:-1], ego.confidence, width=np.diff(edges), align="edge", color=colours[:, :3], linewidth=0, zorder=2
    )
    axes.set_ylim(0, 1.02)
    axes.set_yticks([0, 1])
    axes.set_xlim(float(times_s[0]), max(float(times_s[-1]), float(times_s[0]) + 0.1))
    axes.set_xlabel("seconds from the clip's start", color=_FAINT)
    axes.set_ylabel("confidence", rotation=0, ha="right", va="center", color=_FAINT, labelpad=8)
    _tidy(axes)


def _add_line(axes: Axes, points: np.ndarray, colours: np.ndarray, *, width: float) -> None:
    """A line whose piece that leads to a point has the point's colour."""
    if len(points) < 2:
        axes.plot(*points[0], "o", color=tuple(colours[0]), markersize=width * 1.5, zorder=4)
        return
    changes = np.flatnonzero((np.diff(colours[1:], axis=0) != 0).any(axis=1)) + 1
    ends = [0, *changes.tolist(), len(points) - 1]
    pieces = [points[start : end + 1] for start, end in zip(ends[:-1], ends[1:], strict=True)]
    shades = [tuple(colours[start + 1]) for start in ends[:-1]]
    axes.add_collection(LineCollection(pieces, colors=shades, linewidths=width, capstyle="round", zorder=4))


def _tidy(axes: Axes) -> None:
    axes.grid(True, color=_GRID, alpha=0.55, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(colors=_FAINT, labelsize=9, length=0)
    axes.spines[["top", "right", "left", "bottom"]].set_visible(False)


def _legend(ego: EgoTable) -> list[Line2D]:
    known = [mode for mode in MODE_COLOURS if mode in set(ego.mode)]
    lines = [Line2D([], [], color=MODE_COLOURS[mode], linewidth=3, label=mode) for mode in known]
    return [
        *lines,
        Line2D([], [], color="#cbd5e0", linewidth=3, label="paler: less sure"),
        Line2D([], [], color="#a0aec0", alpha=0.4, linewidth=7, label="one sigma of the scale"),
    ]


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
