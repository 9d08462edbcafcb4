"""Speed against accuracy: the methods of a stage measured side by side, as JSON and as a picture.

A chart's module (one a stage, see ``CHARTS``) says what is measured and returns a ``Chart``; here it is written and
drawn with its Pareto front. Methods are timed interleaved, since machines are shared: whatever slows one slows all.
"""

import importlib
import json
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dataset.receipts import atomic_write, storage_errors, try_folder
from labeling.errors import ConfigError
from pipelines.label_placing import place_labels

CHARTS: dict[str, str] = {
    "count": "pipelines.charts_count",
    "ego": "pipelines.charts_ego",
    "ego-video": "pipelines.charts_ego_video",
    "train": "pipelines.charts_train",
    "generate": "pipelines.charts_generate",
    "detect": "pipelines.charts_detect",
    "keypoints": "pipelines.charts_keypoints",
    "track": "pipelines.charts_track",
}
"""The module of each chart; it has ``chart(name, *, quick) -> Chart``."""
CostKind = Literal["ms_per_frame", "ms_per_step", "ms_per_clip"]


_LETTER_PX = 8.4
_NAMED_DIGITS = "125"
"""First digits of the ticks of a log axis that are named."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Milliseconds per frame."""

    median: float
    """The middle; over clips the mean of all their frames, since their methods differ in what each clip costs."""
    p95: float
    """The upper end; over clips the dearest."""
    runs: int
    """How many measurements."""
    over: Literal["runs", "clips", "videos", "frames"] = "runs"
    """What was measured so often."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Error:
    """How far from the truth, in the metric and unit that every point of a chart shares."""

    metric: str
    unit: str
    median: float
    p95: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ChartPoint:
    """One method at one setting."""

    method: str
    settings: dict[str, Any] = field(default_factory=dict)
    ms_per_frame: Cost
    error: Error
    more_errors: tuple[Error, ...] = ()
    """By other metrics, the same ones for every point of a chart; each is drawn below the first."""
    reference: bool = False
    """The best that can be run at all, or the trivial method: drawn apart."""
    group: str = ""
    """Only points of one group vie with each other: each has a front of its own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """What was measured, on what, where."""

    stage: str
    data: str
    points: tuple[ChartPoint, ...]
    machine: str
    threads: int = 1
    cost: CostKind = "ms_per_frame"
    """What the points' ``ms_per_frame`` counts; in the JSON it goes by this name."""
    left_out: tuple[str, ...] = ()
    """Methods that could not be measured here, each with its reason."""


def machine_name() -> str:
    """The processor, its cores, and the system: what a figure was measured on."""
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else model}, {max(1, len(names))} cores, {platform.system()}"


def interleaved_ms(methods: Sequence[Callable[[], int]], *, runs: int) -> list[Cost]:
    """Cost of each method; a method runs once and returns how many frames it did.

    The methods take turns, ``runs`` times, and processor time of this process is counted, so that what else runs on the
    machine weighs on all of them alike, and little.
    """
    samples: list[list[float]] = [[] for _ in methods]
    for _ in range(runs):
        for method, taken in zip(methods, samples, strict=True):
            start = time.process_time()
            frames = method()
            taken.append((time.process_time() - start) * 1000 / max(1, frames))
    return [Cost(median=float(np.median(taken)), p95=float(np.percentile(taken, 95)), runs=runs) for taken in samples]


def cost_label(chart: Chart) -> str:
    """The unit of a chart's cost, in words."""
    return chart.cost.replace("_", " ")


def pareto_front(points: Sequence[ChartPoint]) -> list[ChartPoint]:
    """The points that no other beats in both cost and error, cheapest first."""
    front: list[ChartPoint] = []
    for point in sorted(points, key=lambda point: (point.ms_per_frame.median, point.error.median)):
        if not front or point.error.median < front[-1].error.median:
            front.append(point)
    return front


def run_chart(name: str, *, out: Path, quick: bool = False) -> Chart:
    """Measure the chart called ``name`` and write ``chart-<name>.json`` and ``.png`` into ``out``.

    Raises:
        ConfigError: no chart has that name.
        StorageError: ``out`` cannot be written to.
    """
    if name not in CHARTS:
        raise ConfigError(f"no chart is called {name!r}; choose one of {', '.join(CHARTS)}")
    # Before the minutes are spent.
    try_folder(out)
    chart: Chart = importlib.import_module(CHARTS[name]).chart(name, quick=quick)
    write_chart(chart, out)
    return chart


def write_chart(chart: Chart, out: Path) -> None:
    """``chart-<stage>.json`` and ``chart-<stage>.png`` in the folder ``out``."""
    tree = asdict(chart)
    for point in tree["points"]:
        point[chart.cost] = point.pop("ms_per_frame")
    text = json.dumps(tree, indent=1, ensure_ascii=False) + "\n"
    atomic_write(out / f"chart-{chart.stage}.json", text.encode())
    picture = out / f"chart-{chart.stage}.png"
    with storage_errors(picture):
        draw_chart(chart, picture)


def draw_chart(chart: Chart, path: Path) -> None:
    """The picture: cost on a log axis, error upwards, the front as a line, every point named; a panel a metric."""
    from matplotlib.figure import Figure

    errors = zip(*((point.error, *point.more_errors) for point in chart.points), strict=True)
    least = _least_drawn(chart.points)
    panels = [
        [_as_drawn(point, error, least) for point, error in zip(chart.points, row, strict=True)] for row in errors
    ]
    height = 6.4 if len(panels) == 1 else 5.2 * len(panels)
    figure = Figure(figsize=(10, height), dpi=120, layout="constrained")
    every_axes = figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0]
    for axes, points in zip(every_axes, panels, strict=True):
        _draw_panel(axes, points)
    every_axes[0].set_title(f"{chart.stage}: {chart.data}\n", fontsize=11, loc="left", wrap=True)
    every_axes[0].text(
        0, 1.012, f"{chart.machine}; {chart.threads} thread{'s' if chart.threads > 1 else ''}; diamonds: references; "
        "line: Pareto front", transform=every_axes[0].transAxes, fontsize=8, color="#4a5568",
    )  # fmt: skip
    floor = f"; below {least:.2g} drawn at {least:.2g}" if least else ""
    left_out = "".join(f"\nleft out: {line}" for line in chart.left_out)
    every_axes[-1].set_xlabel(f"cost, {cost_label(chart)} (log{floor}){left_out}")
    figure.draw_without_rendering()
    for axes, points in zip(every_axes, panels, strict=True):
        _name_points(axes, points)
    figure.savefig(path)


def _least_drawn(points: Sequence[ChartPoint]) -> float:
    """Costs below a hundredth of the usual one are drawn there, since nobody chooses among them; 0 where none is."""
    costs = [point.ms_per_frame.median for point in points]
    least = float(f"{np.median(costs) / 100:.1g}")
    return least if min(costs) < least else 0.0


def _as_drawn(point: ChartPoint, error: Error, least_ms: float) -> ChartPoint:
    cost = replace(point.ms_per_frame, median=max(point.ms_per_frame.median, least_ms))
    return replace(point, ms_per_frame=cost, error=error, more_errors=())


def _draw_panel(axes: Any, points: Sequence[ChartPoint]) -> None:
    groups = dict.fromkeys(point.group for point in points)
    fronts = [pareto_front([point for point in points if point.group == group]) for group in groups]
    for front in fronts:
        axes.step(
            [point.ms_per_frame.median for point in front], [point.error.median for point in front], where="post",
            color="#2b6cb0", alpha=0.5, linewidth=1.5, zorder=1,
        )  # fmt: skip
    for point in points:
        colour = "#c05621" if point.reference else "#2b6cb0" if any(point in front for front in fronts) else "#718096"
        axes.scatter(
            point.ms_per_frame.median, point.error.median, s=46, color=colour, zorder=3,
            marker="D" if point.reference else "o",
        )  # fmt: skip
    axes.set_xscale("log")
    errors = [point.error.median for point in points if point.error.median > 0]
    if len(errors) > 1 and max(errors) > 30 * min(errors):
        # Zero, the reference's own error, has no logarithm.
        least = 10.0 ** np.floor(np.log10(min(errors)))
        axes.set_yscale("symlog", linthresh=least) if len(errors) < len(points) else axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() != "linear":
            axis.set_major_formatter(_named_tick)
            axis.set_minor_formatter(_named_tick)
            axis.set_tick_params(which="both", length=4, pad=4)
    axes.margins(x=0.18, y=0.12)
    axes.set_ylabel(f"{points[0].error.metric}, {points[0].error.unit}")
    axes.grid(True, which="both", alpha=0.2)
    axes.spines[["top", "right"]].set_visible(False)


def _named_tick(value: float, _: int | None = None) -> str:
    """A number as people write it, and nothing for the ticks between."""
    return f"{value:g}" if value == 0 or f"{abs(value):e}"[0] in _NAMED_DIGITS else ""


def _name_points(axes: Any, points: Sequence[ChartPoint]) -> None:
    """Names beside the points, clear of each other and of the points."""
    at = axes.transData.transform([(point.ms_per_frame.median, point.error.median) for point in points])
    to_points = 72 / axes.figure.dpi
    placed = place_labels(at, [_LETTER_PX * len(point.method) for point in points], axes.bbox.extents)
    for point, (right, up) in zip(points, placed, strict=True):
        name = axes.annotate(
            point.method, (point.ms_per_frame.median, point.error.median), fontsize=8.5, va="center", color="#1a202c",
            xytext=(right * to_points, up * to_points), textcoords="offset points", zorder=4,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.6},
            arrowprops={"arrowstyle": "-", "color": "#a0aec0", "lw": 0.5},
        )  # fmt: skip
        # Names must not move what they were placed against.
        name.set_in_layout(False)
