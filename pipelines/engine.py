"""The local pool: items on worker processes, a receipt for each; a worker that dies does not take the job along."""

import contextlib
import ctypes
import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from dataset.receipts import (
    Receipt,
    ReceiptLog,
    worker_name,
)
from labeling.errors import ConfigError, StorageError
from pipelines.items import Task, base_receipt, perform, sweep_staging

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_LEAST_FREE_BYTES = 1 << 20
_DEATHS_ALLOWED = 2
"""A worker that dies is often just the one the system chose to kill; an item that kills two is at fault."""


@contextlib.contextmanager
def minding_workers() -> Iterator[None]:
    """Say it where processes cannot start, or a pool's die: it is no fault of the code, and no reader who has left.

    Raises:
        ConfigError: a process ended while it was being started, or one of a pool's died.
    """
    try:
        yield
    except BrokenPipeError as error:
        raise ConfigError(
            "a worker ended while it was being started, for lack of memory most likely; give fewer --workers"
        ) from error
    except BrokenProcessPool as error:
        raise ConfigError(
            "a worker died, of lack of memory most likely; give fewer --workers: what is done is kept"
        ) from error


class Engine:
    """Worker processes that stay for the length of a job.

    Args:
        root: the job's folder.
        workers: processes; 0 works in this process (for tests and debuggers).
    """

    def __init__(self, root: Path, *, workers: int) -> None:
        self._root, self._count = root, workers
        self._workers: list[_Worker] = []
        self._name = worker_name()
        sweep_staging(root)

    def __enter__(self) -> "Engine":
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.stop()
        self._workers.clear()
        sweep_staging(self._root)

    def run(self, tasks: Sequence[Task]) -> Iterator[Receipt]:
        """Work on every task and yield receipts as they come, in no order.

        Stops early when the disk is full, since every further item would be made in vain.
        """
        if self._count == 0:
            yield from self._run_here(tasks)
            return
        waiting = deque(sorted(tasks, key=lambda task: -task.item.weight))
        deaths: dict[str, int] = {}
        stopped = False
        while True:
            if not stopped:
                self._hand_out(waiting)
            busy = [worker for worker in self._workers if worker.task is not None]
            if not busy:
                return
            for worker in _ready(busy):
                receipt = self._collect(worker, waiting, deaths)
                if receipt is not None:
                    stopped = stopped or _disk_full(receipt, self._root)
                    yield receipt

    def _run_here(self, tasks: Sequence[Task]) -> Iterator[Receipt]:
        for task in tasks:
            receipt = perform(self._root, task, ReceiptLog(self._root, task.item.stage, worker=self._name))
            yield receipt
            if _disk_full(receipt, self._root):
                return

    def _hand_out(self, waiting: deque[Task]) -> None:
        # A worker that died while it waited is nobody's fault: it must not count against the item it would get.
        for worker in [worker for worker in self._workers if worker.task is None and not worker.process.is_alive()]:
            worker.stop()
            self._workers.remove(worker)
        while len(self._workers) < self._count and len(self._workers) < len(waiting) + self._busy:
            self._workers.append(_Worker(self._root))
        for worker in self._workers:
            if worker.task is None and waiting:
                worker.give(waiting.popleft())

    @property
    def _busy(self) -> int:
        return sum(worker.task is not None for worker in self._workers)

    def _collect(self, worker: "_Worker", waiting: deque[Task], deaths: dict[str, int]) -> Receipt | None:
        task = worker.task
        assert task is not None
        receipt = worker.take()
        if receipt is not None:
            return receipt
        self._workers.remove(worker)
        name = task.item.name
        deaths[name] = deaths.get(name, 0) + 1
        if deaths[name] < _DEATHS_ALLOWED:
            waiting.appendleft(task)
            return None
        receipt = replace(
            base_receipt(task), state="failed", reason="died", retryable=True,
            message=f"its worker died twice ({worker.death}); give fewer --workers if memory is short",
        )  # fmt: skip
        with contextlib.suppress(StorageError):
            ReceiptLog(self._root, task.item.stage, worker=self._name).append(receipt)
        return receipt


def _disk_full(receipt: Receipt, root: Path) -> bool:
    """Whether an item failed for want of space for all, rather than for its own sake (as a limit on file sizes)."""
    if receipt.state != "failed" or receipt.reason != StorageError.reason:
        return False
    message = receipt.message.lower()
    told = any(words in message for words in ("no space left", "quota exceeded"))
    return told or shutil.disk_usage(root).free < _LEAST_FREE_BYTES


def _ready(busy: Sequence["_Worker"]) -> list["_Worker"]:
    by_handle: dict[Any, _Worker] = {}
    for worker in busy:
        by_handle[worker.connection] = worker
        by_handle[worker.process.sentinel] = worker
    return list(dict.fromkeys(by_handle[handle] for handle in wait(list(by_handle))))


class _Worker:
    """A process that works on one task at a time."""

    def __init__(self, root: Path) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        self.process = context.Process(target=_serve, args=(root, other, os.getpid()), daemon=True)
        self.task: Task | None = None
        with _one_thread_each(), minding_workers():
            self.process.start()
        other.close()

    @property
    def death(self) -> str:
        """What ended it, in words."""
        code = self.process.exitcode
        if code is not None and code < 0:
            return signal.Signals(-code).name
        return f"exit code {code}"

    def give(self, task: Task) -> None:
        """Hand a task over; a process that is dead already is found out by ``take``."""
        self.task = task
        with contextlib.suppress(OSError):
            self.connection.send(task)

    def take(self) -> Receipt | None:
        """The task's receipt, or ``None`` if the process died over it."""
        try:
            receipt = self.connection.recv() if self.connection.poll() else None
        except (EOFError, OSError):
            receipt = None
        if receipt is None:
            self.process.join(timeout=5)
            self.stop()
        self.task = None
        return receipt

    def stop(self) -> None:
        """End the process; nothing is lost, since only receipts count."""
        self.connection.close()
        if self.task is not None or not self.process.is_alive():
            self.process.kill()
        self.process.join(timeout=5)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
    """Libraries read these variables when they are imported, so they must be set before the process starts."""
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update({name: "1" for name, value in before.items() if value is None})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)


def _serve(root: Path, connection: Connection, parent: int) -> None:
    """A worker's life: until its parent closes the connection, or dies."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _die_with_parent(parent)
    name = worker_name()
    while True:
        try:
            task = connection.recv()
        except (EOFError, OSError):
            return
        receipt = perform(root, task, ReceiptLog(root, task.item.stage, worker=name))
        try:
            connection.send(receipt)
        except OSError:
            return


def _die_with_parent(parent: int) -> None:
    """An orphan that went on would work on an item that the next start of the job works on too."""
    with contextlib.suppress(OSError, AttributeError):
        kill_when_parent_dies = 1  # PR_SET_PDEATHSIG, prctl(2); other systems have only the watch below
        ctypes.CDLL(None, use_errno=True).prctl(kill_when_parent_dies, signal.SIGKILL)
    threading.Thread(target=_watch_parent, args=(parent,), daemon=True).start()


def _watch_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.2)
    os._exit(1)
