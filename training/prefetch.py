"""One batch ahead: taking a batch from loader workers costs milliseconds of its own, which a thread can hide."""

import contextlib
import queue
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

from torch.utils.data import DataLoader

from labeling.errors import AnimaticError

_LOOK_S = 0.1
"""How often a waiting thread looks whether the other one still lives."""
_LEAVE_S = 10.0
"""How long the thread may take to end; a worker that hangs must not hang the run."""


class Prefetched:
    """A loader's batches, fetched ahead by a thread; a context manager, entered by the thread that takes the batches.

    Args:
        loader: iterated once.
        depth: batches that wait at most.
    """

    def __init__(self, loader: DataLoader, *, depth: int = 4) -> None:
        self._loader = loader
        self._ready: queue.Queue[tuple[str, Any]] = queue.Queue(maxsize=depth)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._fetch, name="prefetch", daemon=True)

    def __enter__(self) -> "Prefetched":
        # Workers are forked here, before there is a second thread whose locks they could inherit.
        self._batches = iter(self._loader)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        until = time.monotonic() + _LEAVE_S
        while self._thread.is_alive() and time.monotonic() < until:
            # It may be waiting for room.
            with contextlib.suppress(queue.Empty):
                while True:
                    self._ready.get_nowait()
            self._thread.join(_LOOK_S)

    def _fetch(self) -> None:
        try:
            for batch in self._batches:
                self._ready.put(("batch", batch))
                if self._closed.is_set():
                    return
            self._ready.put(("end", None))
        except BaseException as error:
            # It belongs to whoever waits for the batch.
            self._ready.put(("error", _in_its_own_words(error)))

    def __iter__(self) -> Iterator[Any]:
        return self

    def __next__(self) -> Any:
        kind, content = self._take()
        if kind == "error":
            raise content
        if kind == "end":
            raise StopIteration
        return content

    def _take(self) -> tuple[str, Any]:
        while True:
            # Looked at before the queue: what a thread puts just before it ends is not lost.
            running = self._thread.is_alive()
            try:
                return self._ready.get(timeout=_LOOK_S if running else 0.001)
            except queue.Empty:
                if not running:
                    return "end", None


def _in_its_own_words(error: BaseException) -> BaseException:
    """What a person can mend without the traceback that torch puts around it when a worker raises it."""
    kind = type(error)
    *around, words = str(error).split(f"{kind.__module__}.{kind.__qualname__}: ")
    return kind(words.strip()) if around and isinstance(error, AnimaticError) else error


def leave_signals_to_the_trainer(_worker: int = 0) -> None:
    """For a loader worker: a Ctrl-C reaches the whole group, and the step that is to be saved still needs batches."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
