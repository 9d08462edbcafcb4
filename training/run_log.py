"""What a run tells: a line on the terminal, trackers through accelerate, and ``metrics.jsonl``."""

import json
import resource
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from dataset.receipts import atomic_write, make_folder, storage_errors

METRICS = "metrics.jsonl"


def peak_memory_gib() -> float:
    """The device's peak if there is one, else this process's."""
    if torch.cuda.is_available():
        return torch.cuda.max_memory_allocated() / 2**30
    # Linux counts in KiB, macOS in bytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**30 if sys.platform == "darwin" else 2**20)


class RunLog:
    """Writes on the main process only.

    Args:
        accelerator: its trackers are fed.
        out: the run's folder.
        steps: of the whole run.
        start: the step that this process begins at; later lines of an earlier try are dropped.
        samples_per_step: the global batch.
        quiet: no line on the terminal.
    """

    def __init__(
        self, accelerator: Accelerator, out: Path, *, steps: int, start: int, samples_per_step: int, quiet: bool
    ) -> None:
        self._accelerator, self._path = accelerator, out / METRICS
        self._main = accelerator.is_main_process
        self._samples, self._start, self._began = samples_per_step, start, time.perf_counter()
        self._progress = Progress(
            TextColumn("[bold]{task.description}"), BarColumn(bar_width=20),
            TextColumn("{task.completed}/{task.total} loss {task.fields[loss]} {task.fields[rate]}"),
            TimeRemainingColumn(), TextColumn("{task.fields[memory]}"),
            console=Console(stderr=True), disable=quiet or not self._main, refresh_per_second=1,
        )  # fmt: skip
        self._told_at_start: set[str] = set()
        self._task = self._progress.add_task("train", total=steps, completed=start, loss="-", rate="", memory="")
        if self._main:
            make_folder(out)
            with storage_errors(self._path):
                kept = [(line, values) for line, values in _whole_lines(self._path) if values["step"] <= start]
                atomic_write(self._path, "".join(f"{line}\n" for line, _ in kept).encode())
            self._told_at_start.update(name for _, values in kept if values["step"] == start for name in values)

    def __enter__(self) -> "RunLog":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def lacks_at_start(self, name: str) -> bool:
        """Whether an earlier try told no such number of the step that this one begins at; the same on all processes."""
        lacks = torch.tensor(float(self._main and name not in self._told_at_start), device=self._accelerator.device)
        return float(self._accelerator.reduce(lacks, "sum")) > 0  # type: ignore[arg-type]

    def step(self, step: int, values: dict[str, float]) -> None:
        """After optimiser step ``step`` (from 1)."""
        seconds = max(time.perf_counter() - self._began, 1e-9)
        rate = (step - self._start) / seconds
        speeds = {
            "steps_per_second": rate,
            "samples_per_second": rate * self._samples,
            "peak_memory_gib": peak_memory_gib(),
        }
        self._progress.update(
            self._task, completed=step, loss=f"{values['loss']:.4f}", memory=f"{speeds['peak_memory_gib']:.1f} GiB",
            rate=f"{rate:.2f} steps/s {rate * self._samples:.1f} samples/s",
        )  # fmt: skip
        self.write(step, {**values, **speeds})

    def write(self, step: int, values: dict[str, float]) -> None:
        """Numbers of a step, to the trackers and the file."""
        with storage_errors(self._path):
            self._accelerator.log(values, step=step)
            if self._main:
                with self._path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({"step": step, **values}, sort_keys=True) + "\n")


def read_metrics(out: Path) -> list[dict[str, Any]]:
    """The lines of a run's ``metrics.jsonl``; damaged ones are left out with a warning."""
    return [values for _, values in _whole_lines(out / METRICS)]


def _whole_lines(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """(line, its values) of the lines that tell a step; a torn last line is ignored, others are warned of."""
    whole: list[tuple[str, dict[str, Any]]] = []
    if not path.is_file():
        return whole
    *lines, _torn = path.read_bytes().split(b"\n")
    for number, line in enumerate(lines, start=1):
        try:
            values = json.loads(line)
            if not isinstance(values["step"], int):
                raise TypeError(f"step is {values['step']!r}")
            whole.append((line.decode(), values))
        except (ValueError, KeyError, TypeError) as error:
            warnings.warn(f"leaving out {path}:{number}, which tells no step ({error!r})", stacklevel=3)
    return whole
