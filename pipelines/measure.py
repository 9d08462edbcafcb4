"""``animatic chart`` and ``animatic stability``: measure, write, and show what was found."""

from pathlib import Path

from rich.markup import escape
from rich.table import Table

from pipelines.charts import cost_label, pareto_front, run_chart
from pipelines.console import make_console
from pipelines.stability import run_stability


def show_chart(stage: str, *, out: Path, quick: bool = False) -> int:
    """Measure a chart and print its points, cheapest first.

    Raises:
        ConfigError: no chart has that name.
    """
    chart = run_chart(stage, out=out, quick=quick)
    front = {id(point) for point in pareto_front(chart.points)}
    unit = chart.points[0].error
    table = Table(title=f"{stage}: {chart.data}", title_justify="left", box=None, pad_edge=False)
    table.add_column("method", style="bold")
    for column in (cost_label(chart), "p95", f"{unit.metric}, {unit.unit}", "p95"):
        table.add_column(column, justify="right")
    table.add_column("")
    for point in sorted(chart.points, key=lambda point: point.ms_per_frame.median):
        mark = "reference" if point.reference else "front" if id(point) in front else ""
        cells = (point.ms_per_frame.median, point.ms_per_frame.p95, point.error.median, point.error.p95)
        table.add_row(escape(point.method), *(f"{cell:.4g}" for cell in cells), mark)
    console = make_console()
    console.print(table)
    for line in chart.left_out:
        console.print(f"left out: {escape(line)}")
    console.print(f"{chart.machine}; {out / f'chart-{stage}.json'}, {out / f'chart-{stage}.png'}")
    return 0


def show_stability(stage: str, *, out: Path, quick: bool = False) -> int:
    """Play a stage's failure scenarios and print the table; 1 where one of our own methods does not hold its bound.

    Raises:
        ConfigError: no table has that name.
    """
    found = run_stability(stage, out=out, quick=quick)
    table = Table(title=f"{stage}: {found.data}", title_justify="left", box=None, pad_edge=False)
    for column in ("scenario", "method", "figure", "bound", "verdict", "note"):
        table.add_column(column, justify="right" if column == "figure" else "left")
    colours = {"held": "green", "not held": "red", "reported": "dim"}
    for row in found.rows:
        figure = f"{row.figure:.4g} {row.unit}".strip()
        verdict = f"[{colours[row.verdict]}]{row.verdict}[/]"
        table.add_row(escape(row.scenario), escape(row.method), escape(figure), row.bound, verdict, escape(row.note))
    console = make_console()
    console.print(table)
    console.print(str(out / f"stability-{stage}.json"))
    return int(bool(found.failed))
