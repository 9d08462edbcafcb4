"""Making one item: staged, checked, synced, renamed, and only then written into a receipt."""

import contextlib
import os
import re
import shutil
import time
import traceback
from dataclasses import dataclass, replace
from pathlib import Path

from dataset.receipts import (
    Output,
    Receipt,
    ReceiptLog,
    check_unaltered,
    digest,
    host_name,
    make_folder,
    publish,
    storage_error,
)
from labeling.errors import AnimaticError, StorageError
from pipelines.stage import DroppedError, WorkItem, load_stage

_PROCESS = re.compile(r"[0-9]{1,9}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """An item to be made, and the receipt that it supersedes."""

    item: WorkItem
    previous: Receipt | None = None

    @property
    def turn(self) -> int:
        """The number of the receipt to come."""
        return 1 if self.previous is None else self.previous.turn + 1


def perform(root: Path, task: Task, log: ReceiptLog) -> Receipt:
    """Make one item: stage, check, sync, rename, and only then write its receipt. Never raises for the item's faults.

    A receipt that cannot itself be written comes back as a retryable failure.
    """
    item, started = task.item, time.perf_counter()
    staging = root / ".staging" / f"{item.stage}.{item.name.replace('/', '.')}.{host_name()}-{os.getpid()}"
    base = base_receipt(task)
    try:
        base = _make(root, task, staging, log)
    except DroppedError as verdict:
        base = replace(base, state="dropped", reason=str(verdict))
    except Exception as error:
        base = _failed(base, error, root)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    receipt = replace(base, seconds=round(time.perf_counter() - started, 3))
    try:
        log.append(receipt)
    except StorageError as error:
        return _failed(receipt, error, root)
    return receipt


def _make(root: Path, task: Task, staging: Path, log: ReceiptLog) -> Receipt:
    item = task.item
    shutil.rmtree(staging, ignore_errors=True)
    make_folder(staging)
    for name, sha256 in files_read(item).items():
        # One that is not there is for the stage to tell.
        if (root / name).is_file():
            check_unaltered(root / name, sha256)
    facts = load_stage(item.stage).work(root, item, staging)
    base = base_receipt(task)
    if task.previous is not None and task.previous.outputs and task.previous.key != item.key:
        # The old receipt must not vouch for a mixture of old and new files if we are killed between two renames.
        void = replace(
            base, state="failed", reason="interrupted", message="outputs were being replaced", retryable=True
        )
        log.append(void)
        base = replace(base, turn=base.turn + 1)
    outputs: tuple[Output, ...] = publish(staging, root, item.outputs)
    return replace(base, outputs=outputs, facts=dict(facts))


def files_read(item: WorkItem) -> dict[str, str]:
    """The job's files among an item's inputs, path to sha256: inputs are called by their paths, or by a name whose path
    the payload holds."""
    placed = {item.payload.get(name, name): value for name, value in item.inputs.items() if isinstance(value, str)}
    return {path: value for path, value in placed.items() if "/" in path and _SHA256.fullmatch(value)}


def sweep_staging(root: Path) -> None:
    """Remove what dead processes of this host left half-made; other hosts' process numbers may live, so theirs stay."""
    for folder in (root / ".staging").glob("*"):
        host, _, process = folder.name.rpartition(".")[2].rpartition("-")
        # A folder that somebody else called otherwise is not ours to remove.
        if host == host_name() and _PROCESS.fullmatch(process) and not _alive(int(process)):
            shutil.rmtree(folder, ignore_errors=True)
    with contextlib.suppress(OSError):
        (root / ".staging").rmdir()


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:  # a zombie answers signals, but works no more
        state = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state != "Z"


def base_receipt(task: Task) -> Receipt:
    """The receipt of a task that is done, without what only the work can tell."""
    item = task.item
    return Receipt(
        stage=item.stage, item=item.name, state="done", turn=task.turn, key=item.key, inputs=digest(item.inputs),
        settings=digest([item.version, item.settings]), models=digest(item.models),
    )  # fmt: skip


def _failed(base: Receipt, error: Exception, root: Path) -> Receipt:
    if isinstance(error, OSError):
        error = storage_error(error, Path(error.filename) if error.filename else root)
    if isinstance(error, AnimaticError):
        reason, retryable, message = error.reason, error.retryable, str(error)
    elif isinstance(error, MemoryError):
        reason, retryable, message = "memory", True, "out of memory; give fewer --workers"
    else:
        where = traceback.extract_tb(error.__traceback__)[-1]
        reason, retryable = "fault", True
        message = f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno}); please report it"
    message = " ".join(message.split())
    return replace(base, state="failed", reason=reason, message=message, retryable=retryable, outputs=(), facts={})
