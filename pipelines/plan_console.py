"""``animatic plan``: the plan as a table."""

import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from pipelines.commands import JobOptions
from pipelines.console import counted, make_console, print_damaged, print_twins
from pipelines.plan import JobPlan, plan_job


def show_plan(videos: Sequence[Path], options: JobOptions, *, parts: int, as_json: bool) -> int:
    """Plan and print.

    Raises:
        AnimaticError: settings, models or videos that the job could not use either.
    """
    workers = options.workers or max(1, os.cpu_count() or 1)
    plan = plan_job(videos, options, workers=workers, parts=parts)
    if as_json:
        summary = {"core_hours": plan.core_hours, "disk_bytes": plan.disk_bytes, "hours_per_host": plan.hours_per_host}
        print(json.dumps(asdict(plan) | summary, indent=1))
        return 0
    console = make_console()
    for reason in plan.broken:
        console.print(f"[red]left out[/] {escape(reason)}")
    print_damaged(plan.damaged, console)
    print_twins(plan.twins, console)
    if plan.too_short:
        verb = "is" if plan.too_short == 1 else "are"
        console.print(
            f"[yellow]note[/] {plan.too_short} of {counted(plan.videos, 'video')} {verb} shorter than a clip "
            f"({plan.clip_frames} frames)"
        )
    console.print(
        f"{counted(plan.videos, 'video')}, {hours(plan.source_hours)} of footage; {counted(plan.clips, 'clip')}, "
        f"{plan.kept_clips} kept, {plan.sampled_clips} taken ({hours(plan.clip_hours)})"
    )
    console.print(_table(plan))
    hosts = f"on each of {plan.parts} hosts (the busiest has {plan.largest_part:.0%})" if plan.parts > 1 else "here"
    console.print(
        f"[bold]{hours(plan.hours_per_host)}[/] {hosts} with {counted(plan.workers, 'worker')}, "
        f"[bold]{size(plan.disk_bytes)}[/] of disk; measured on {plan.calibration_s:.3g} s "
        f"of the footage ({counted(plan.calibration_clips, 'clip')} of {counted(plan.calibration_videos, 'video')})"
    )
    return 0


def _table(plan: JobPlan) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("stage", style="bold")
    for column in ("core time", "disk"):
        table.add_column(column, justify="right")
    for stage in plan.stages:
        table.add_row(stage.stage, hours(stage.core_hours), size(stage.disk_bytes) if stage.disk_bytes else "")
    table.add_row("all", hours(plan.core_hours), size(plan.disk_bytes), style="bold")
    return table


def hours(value: float) -> str:
    """Hours in the unit that reads best."""
    if value >= 1:
        return f"{value:,.1f} h"
    return f"{value * 60:.1f} min" if value * 60 >= 1 else f"{value * 3600:.1f} s"


def size(count: float) -> str:
    """Bytes in the unit that reads best (powers of 1000)."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:,.1f} TB"
