"""What a run tells: a line on the terminal, trackers through accelerate, and ``metrics.jsonl``."""

import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from dataset.receipts import make_folder, storage_errors

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
        self._task = self._progress.add_task("train", total=steps, completed=start, loss="-", rate="", memory="")
        if self._main:
            make_folder(out)
            kept = [line for line in self._lines() if json.loads(line)["step"] <= start]
            with storage_errors(self._path):
                self._path.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")

    def _lines(self) -> list[str]:
        return self._path.read_text(encoding="utf-8").split("\n")[:-1] if self._path.is_file() else []

    def __enter__(self) -> "RunLog":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

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
    """The lines of a run's ``metrics.jsonl``."""
    path = out / METRICS
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.is_file() else []
