"""What a run does when something goes wrong: a loss that is no number, no memory left, Ctrl-C."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

import torch

from labeling.errors import AnimaticError
from training.config import TrainConfig


class TrainingError(AnimaticError):
    """A run that cannot go on; its last good checkpoint is intact."""

    reason = "training"


class StopFlag:
    """Set by the first Ctrl-C (or SIGTERM); the run saves after its step and ends. A second one interrupts at once."""

    def __init__(self) -> None:
        self.set = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.set:
            raise KeyboardInterrupt
        self.set = True


@contextmanager
def stop_flag() -> Iterator[StopFlag]:
    """A flag that Ctrl-C sets while the block runs; handlers are put back after it."""
    flag = StopFlag()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    before = {number: signal.signal(number, flag._handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield flag
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def memory_advice(config: TrainConfig) -> Iterator[None]:
    """Turn running out of device memory into advice.

    Raises:
        TrainingError: the device is out of memory; the knobs are named in the order to turn them.
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not _is_memory(error):
            raise
        advice = memory_knobs(config)
        raise TrainingError(
            f"out of memory in the {config.stage} stage at micro_batch {config.optimiser.micro_batch}; "
            f"in this order: {'; '.join(advice)}"
        ) from error


def _is_memory(error: Exception) -> bool:
    """A GPU's own error, Python's, or the words of torch's CPU allocator and of cuBLAS."""
    known = isinstance(error, torch.OutOfMemoryError | MemoryError)
    return known or any(words in str(error) for words in ("can't allocate memory", "ALLOC_FAILED"))


def memory_knobs(config: TrainConfig) -> list[str]:
    """What to change, cheapest first; what is at its end already is left out."""
    knobs = []
    if config.optimiser.micro_batch > 1:
        knobs.append("set optimiser.micro_batch to 1 (the global batch stays, accumulation grows)")
    if not config.gradient_checkpointing:
        knobs.append("set gradient_checkpointing to true (a third more compute)")
    if config.backbone.dtype == "float32":
        knobs.append("set backbone.dtype to bfloat16")
    if config.adapter.rank > 64:
        knobs.append(f"lower adapter.rank from {config.adapter.rank} (each number trained costs 16 bytes)")
    picture = config.backbone.picture
    knobs.append(f"cache fewer frames or smaller pictures than {picture.rgb_width}x{picture.rgb_height}")
    if config.backbone.size == "13b":
        knobs.append("take the 2b backbone")
    return knobs
