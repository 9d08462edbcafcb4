"""An iterator that works in the background, a few items ahead of whoever takes them."""

import queue
import threading
from collections.abc import Generator, Iterator
from typing import TypeVar, cast

Item = TypeVar("Item")

_END = object()
_PATIENCE_S = 0.1


def read_ahead(items: Iterator[Item], *, depth: int) -> Generator[Item, None, None]:
    """The same items in the same order, made by a thread that is at most ``depth`` items ahead.

    Pays where both sides spend their time outside the interpreter (decoding here, encoding there). What the thread
    raises is raised here; when the taker stops early, so does the thread.
    """
    waiting: queue.Queue[object] = queue.Queue(maxsize=depth)
    stopped = threading.Event()
    failure: list[BaseException] = []

    def put(item: object) -> bool:
        while not stopped.is_set():
            try:
                waiting.put(item, timeout=_PATIENCE_S)
                return True
            except queue.Full:
                continue
        return False

    def work() -> None:
        try:
            for item in items:
                if not put(item):
                    break
        except BaseException as error:
            failure.append(error)
        finally:
            try:
                getattr(items, "close", bool)()
            finally:
                put(_END)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while (item := waiting.get()) is not _END:
            yield cast(Item, item)
        if failure:
            raise failure[0]
    finally:
        stopped.set()
        thread.join()
