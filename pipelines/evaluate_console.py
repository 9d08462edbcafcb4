"""``animatic evaluate`` as a person sees it: figures side by side, what could not be estimated, and notes."""

from pathlib import Path

from rich.markup import escape
from rich.table import Table

from pipelines.console import counting_bar, make_console
from pipelines.evaluate import EvaluateOptions, evaluate
from training.evaluation_report import FIGURES, SAMPLES, TRUE_SKELETONS, Figure, Report, SetSummary
from training.metrics import Interval

_HEADS = {
    SAMPLES: "samples", TRUE_SKELETONS: "over true skeletons", "truth video": "truth video\n(noise floor)",
    "constant velocity": "constant\nvelocity", "first frame": "first frame\nheld",
}  # fmt: skip
_BETTER = {"lower": "less", "higher": "more", "neither": ""}


def show_evaluation(job: Path, samples: Path, options: EvaluateOptions) -> int:
    """Evaluate, print, and return the exit code: 1 where not one sample could be read.

    Raises:
        AnimaticError: as ``evaluate``.
    """
    console = make_console()
    with counting_bar() as progress:
        task = progress.add_task("evaluate", total=None)
        found = evaluate(
            job, samples, options, on_clip=lambda done, total: progress.update(task, completed=done, total=total)
        )
    console.print(figure_table(found.report, title=f"{samples.name}: {described(found.report)}"))
    console.print(coverage_table(found.report))
    for note in found.notes:
        console.print(f"[yellow]note[/] {escape(note)}")
    console.print(str(found.file))
    return int(found.report.sets[SAMPLES].coverage["video"].estimated == 0)


def described(report: Report) -> str:
    """What was judged, in a line."""
    judged = report.sets[SAMPLES]
    geometry = next(iter(judged.geometries), "nothing readable")
    points = "-".join(str(one) for one in dict.fromkeys(judged.points))
    return f"{judged.samples} samples of {report.clips} clips, {report.videos} videos; {geometry}; {points} points"


def figure_table(report: Report, *, title: str = "") -> Table:
    """Figures down, sets across: means, intervals (95 %, over source videos) of what is judged, clips if not all."""
    shown = [name for name, summary in report.sets.items() if summary.samples]
    attributed = TRUE_SKELETONS in shown
    table = Table(title=escape(title), title_justify="left", box=None, pad_edge=False)
    table.add_column("", style="bold")
    table.add_column("better", style="dim")
    for name in shown:
        table.add_column(_HEADS.get(name, name), justify="right")
    if attributed:
        table.add_column("samples less\nover true skeletons", justify="right")
    for figure in FIGURES:
        if not any(figure.name in report.sets[name].figures for name in shown):
            continue
        cells = [
            _cell(report.sets[name], figure, clips=report.clips, judged=name in (SAMPLES, TRUE_SKELETONS))
            for name in shown
        ]
        if attributed:
            difference = report.differences[TRUE_SKELETONS].get(figure.name)
            cells.append("" if difference is None else _interval(difference, figure, signed=True))
        table.add_row(_label(figure, report.sets[SAMPLES]), _BETTER[figure.better], *cells)
    return table


def coverage_table(report: Report) -> Table:
    """What was estimated of how many samples, and why the others failed."""
    table = Table(title="estimated", title_justify="left", box=None, pad_edge=False)
    for column in ("set", "part", "samples", "failed, and why"):
        table.add_column(column, justify="right" if column == "samples" else "left")
    for name, summary in report.sets.items():
        for part, coverage in summary.coverage.items():
            if name not in (SAMPLES, TRUE_SKELETONS) and not coverage.reasons:
                continue
            reasons = "; ".join(f"{count} {escape(reason)}" for reason, count in coverage.reasons.items())
            colour = "" if coverage.estimated == coverage.of else "[red]"
            share = f"{colour}{coverage.estimated} of {coverage.of}"
            table.add_row(name, part, share, reasons)
    return table


def _label(figure: Figure, judged: SetSummary) -> str:
    count = "-".join(str(one) for one in dict.fromkeys(judged.samples_per_clip))
    unit = f" [dim]{figure.unit}[/]" if figure.unit else ""
    return f"{figure.label.format(k=count)}{unit}"


def _cell(summary: SetSummary, figure: Figure, *, clips: int, judged: bool) -> str:
    found = summary.figures.get(figure.name)
    if found is None:
        return "[dim]-[/]"
    some = summary.clips[figure.name]
    text = _interval(found, figure) if judged else f"{found.mean:.{figure.digits}f}"
    return text + ("" if some == clips else f" [dim]({some} clips)[/]")


def _interval(found: Interval, figure: Figure, *, signed: bool = False) -> str:
    digits = figure.digits
    mean = f"{found.mean:+.{digits}f}" if signed else f"{found.mean:.{digits}f}"
    return f"{mean} [dim]\\[{found.low:.{digits}f}, {found.high:.{digits}f}][/]"
