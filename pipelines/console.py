"""What a person sees: a progress bar per stage, one line for each failure, and numbers in readable units."""

import time
from collections import Counter
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from dataset.receipts import Receipt, reason_counts
from pipelines.label import StageReport


def make_console(*, stderr: bool = False) -> Console:
    """A console that never wraps what a script may want to read."""
    console = Console(stderr=stderr, highlight=False, soft_wrap=True)
    return console if console.is_terminal else Console(stderr=stderr, highlight=False, soft_wrap=True, width=160)


class ConsoleReporter:
    """Shows stages as they run: bars on a terminal, a line per stage elsewhere."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = console or make_console()
        self._progress: Progress | None = None
        self._task: TaskID | None = None
        self._notice = ("", 0.0)

    def stage_started(self, stage: str, *, items: int, weight: float, current: int) -> None:
        """Open the stage's bar."""
        if items == 0 or not self.console.is_terminal:
            return
        self._progress = Progress(
            TextColumn("{task.description:>10}"), BarColumn(bar_width=30),
            TextColumn("{task.fields[done]}/{task.fields[of]}"), TimeRemainingColumn(),
            console=self.console, transient=True,
        )  # fmt: skip
        self._progress.start()
        self._task = self._progress.add_task(stage, total=weight, done=0, of=items)

    def item_finished(self, receipt: Receipt, *, weight: float) -> None:
        """Move the bar; a failure is shown at once."""
        if receipt.state == "failed":
            self.console.print(f"[red]{receipt.stage:>10}[/] {receipt.item}: {escape(receipt.message)}")
        if self._progress is not None and self._task is not None:
            done = self._progress.tasks[0].fields["done"] + 1
            self._progress.update(self._task, advance=weight, done=done)

    def stage_finished(self, report: StageReport) -> None:
        """One line that says what came of it."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None
        if report.stage in ("source", "shards") and not report.failed:
            return
        words = selection_words(report.made) or [f"{report.count('done')} done"]
        words += dropped_words(reason_counts(receipt.reason for receipt in report.made if receipt.state == "dropped"))
        words += [f"[red]{len(report.failed)} failed[/]"] if report.failed else []
        words += [f"{report.current} up to date"] if report.current else []
        words += left_out_words(report.made)
        self.console.print(f"[bold]{report.stage:>10}[/] {', '.join(words)} [dim]({duration(report.seconds)})[/]")

    def waiting(self, message: str) -> None:
        """Say once a minute what is waited for."""
        text, at = self._notice
        if text != message or time.monotonic() - at > 60:
            self.console.print(f"[yellow]waiting[/] {escape(message)}")
            self._notice = (message, time.monotonic())


def selection_words(receipts: Sequence[Receipt]) -> list[str]:
    """What a selection that was made keeps and drops: it is one item, whatever becomes of how many clips."""
    made = [receipt.facts for receipt in receipts if receipt.stage == "select" and receipt.state == "done"]
    return [words for facts in made for words in (f"{facts['kept']} kept", *dropped_words(facts["dropped"]))]


def dropped_words(dropped: Mapping[str, int]) -> list[str]:
    """``2 dropped (objects)``: a reason is a slug, and takes no plural."""
    return [f"{count} dropped ({reason})" for reason, count in dropped.items()]


def left_out_words(receipts: Sequence[Receipt]) -> list[str]:
    """What networks saw beyond their cards' most in a frame, as one remark for each card."""
    total: Counter[str] = Counter()
    for receipt in receipts:
        total.update(receipt.facts.get("left_out", {}))
    return [f"[yellow]{card} saw {count} more than its card allows in a frame[/]" for card, count in total.items()]


def counting_bar() -> Progress:
    """A bar that counts items; nothing where no person looks."""
    console = make_console()
    return Progress(
        TextColumn("{task.description:>10}"), BarColumn(bar_width=30), MofNCompleteColumn(), TimeRemainingColumn(),
        console=console, transient=True, disable=not console.is_terminal,
    )  # fmt: skip


def print_error(error: Exception) -> None:
    """One line on standard error."""
    make_console(stderr=True).print(f"[bold red]error:[/] {escape(' '.join(str(error).split()))}")


def counted(number: int, noun: str) -> str:
    """A number of things, in words: ``1 clip``, ``2 clips``."""
    return f"{number} {noun}{'s' * (number != 1)}"


def shortened(lines: Sequence[str], most: int) -> list[str]:
    """The first ``most`` of some lines, and how many there are beyond them."""
    return [*lines[:most], *([f"... and {len(lines) - most} more"] if len(lines) > most else [])]


def print_damaged(lines: Sequence[str], console: Console, *, most: int = 3) -> None:
    """Which videos are damaged, and how; of many, the first ``most``."""
    for line in shortened(lines, most):
        console.print(f"[yellow]damaged[/] {escape(line)}")


def print_twins(holders: Mapping[str, str], console: Console, *, most: int = 3) -> None:
    """Which videos are dropped because others, by video id, have the same bytes; of many, the first ``most``."""
    lines = [
        f"{name} is {holder} again, byte for byte: its clips are dropped (same_as)"
        for name, holder in sorted(holders.items())
    ]
    for line in shortened(lines, most):
        console.print(f"[yellow]note[/] {escape(line)}")


def print_failures(failed: Sequence[Receipt], console: Console, *, most: int = 20) -> None:
    """Which items failed, and why; of many, the first ``most``."""
    if not failed:
        return
    table = Table(title=f"{len(failed)} failed", title_style="bold red", title_justify="left", box=None, pad_edge=False)
    for column in ("stage", "item", "reason", "again?"):
        table.add_column(column, style="dim" if column == "stage" else "")
    for receipt in failed[:most]:
        again = "run again" if receipt.retryable else "no"
        table.add_row(receipt.stage, receipt.item, escape(receipt.message), again)
    console.print(table)
    if len(failed) > most:
        console.print(f"... and {len(failed) - most} more; `animatic status` counts them by reason")


def duration(seconds: float) -> str:
    """Seconds in a person's units."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    if seconds < 3600:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h"


def file_size(size: float) -> str:
    """Bytes in a person's units, powers of 1000."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 999.5:
            return f"{size:.0f} {unit}" if unit == "B" else f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"
