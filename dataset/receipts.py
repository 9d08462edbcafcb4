"""What is done, dropped and failed: append-only receipts, one log per worker, no lock and no server.

An item is done when a receipt says so, never because a file exists. A receipt is written after the item's outputs were
staged, checked, synced and renamed; so a job that is killed anywhere and started again ends as one left alone.
"""

import contextlib
import errno
import functools
import hashlib
import json
import os
import re
import socket
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from dataset.layout import RECEIPTS
from labeling.errors import DataError, StorageError

State = Literal["done", "dropped", "failed"]

_STORAGE_ERRNOS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.ENOTDIR, errno.EACCES, errno.EPERM,
                   errno.EIO, errno.ESTALE, errno.ENAMETOOLONG, errno.EEXIST, errno.EISDIR}  # fmt: skip


class AlteredError(DataError):
    """A file that is not as its receipt says. Once it is removed it is made again, and then what failed by it."""

    reason: ClassVar[str] = "altered"
    retryable: ClassVar[bool] = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Output:
    """One file that an item made."""

    path: str
    """Relative to the job's folder, with forward slashes."""
    size: int
    """Bytes."""
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Receipt:
    """What became of one item."""

    stage: str
    item: str
    """``<video_id>``, ``<video_id>/run_<start>_<end>``, a clip's key, or a shard's name."""
    state: State
    reason: str = ""
    """Why it was dropped or failed: a slug, then its numbers."""
    message: str = ""
    """The error's own words."""
    retryable: bool = False
    turn: int = 1
    """Counts an item's receipts: the one with the highest turn holds."""
    key: str
    """Digest of stage, settings, inputs and models: a receipt with another key is out of date."""
    inputs: str = ""
    """Digest of the input's content."""
    settings: str = ""
    """Digest of the stage's settings."""
    models: str = ""
    """Digest of the models used."""
    outputs: tuple[Output, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)
    """Small numbers for summaries and plans (frames, objects); they follow from the inputs."""
    seconds: float = 0.0
    """Time spent; the only field in which two jobs may differ."""

    def output(self, suffix: str) -> Output:
        """The one output whose path ends in ``suffix``.

        Raises:
            DataError: there is none.
        """
        for output in self.outputs:
            if output.path.endswith(suffix):
                return output
        raise DataError(f"{self.stage} of {self.item} has no output that ends in {suffix}; run the stage again")


def digest(value: Any) -> str:
    """sha256 of a value's canonical JSON."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def sha256_file(path: Path) -> str:
    """sha256 of a file's content."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def hashed_share(*parts: object) -> float:
    """A number in [0, 1) that depends on ``parts`` alone, for draws that adding an item must not disturb."""
    text = "\x1f".join(str(part) for part in parts)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") / 2**64


def storage_error(error: OSError, path: Path) -> Exception:
    """``error`` as a ``StorageError`` if it is about the place and not about the program, else itself."""
    return _as_storage_error(error, path) if error.errno in _STORAGE_ERRNOS else error


def _as_storage_error(error: OSError, path: Path) -> StorageError:
    what = error.strerror or str(error)
    advice = {
        errno.ENOSPC: "free some space and run the command again",
        errno.EDQUOT: "raise the quota or free some space, and run the command again",
        errno.EFBIG: "raise the file-size limit (ulimit -f) and run the command again",
    }.get(error.errno or 0, "give a folder that can be written to")
    return StorageError(f"{path}: {what.lower()}; {advice}")


@contextlib.contextmanager
def storage_errors(path: Path) -> Any:
    """Turn operating-system errors about ``path``'s place into ``StorageError``."""
    try:
        yield
    except OSError as error:
        mapped = storage_error(error, path)
        if mapped is error:
            raise
        raise mapped from error


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, where they are not there.

    Raises:
        StorageError: it cannot be made, whatever the operating system calls the reason: in /proc or on a lost mount
            it says that there is no such file.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _as_storage_error(error, folder) from error


def try_folder(folder: Path) -> None:
    """Make a folder, and write to it: what takes minutes should know before them.

    Raises:
        StorageError: it cannot be made, or not be written to.
    """
    make_folder(folder)
    with storage_errors(folder), tempfile.TemporaryFile(dir=folder):
        pass


def host_name() -> str:
    """This host, in letters that a file name may have."""
    return re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())


def worker_name() -> str:
    """A log name that no other process has: host, process, start."""
    return f"{host_name()}-{os.getpid()}-{time.time_ns():x}"


class ReceiptLog:
    """One worker's own log of one stage."""

    def __init__(self, job: Path, stage: str, *, worker: str | None = None) -> None:
        self._path = job / RECEIPTS / stage / f"{worker or worker_name()}.jsonl"

    def append(self, receipt: Receipt) -> None:
        """Append one line and sync it; a line that cannot be written whole is taken back.

        Raises:
            StorageError: no space, or the folder cannot be written to.
        """
        line = json.dumps(asdict(receipt), sort_keys=True, separators=(",", ":")) + "\n"
        with storage_errors(self._path):
            fresh = not self._path.exists()
            make_folder(self._path.parent)
            with self._path.open("ab", buffering=0) as stream:
                start = stream.seek(0, os.SEEK_END)
                try:
                    _write_all(stream.fileno(), line.encode())
                    os.fsync(stream.fileno())
                except OSError:
                    with contextlib.suppress(OSError):
                        stream.truncate(start)
                    raise
            if fresh:
                sync_folder(self._path.parent)


def _write_all(descriptor: int, data: bytes) -> None:
    while data:
        data = data[os.write(descriptor, data) :]


def sync_folder(folder: Path) -> None:
    """Make a folder's names durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_receipts(job: Path, stage: str) -> dict[str, Receipt]:
    """The receipt that holds for each item of a stage; a torn last line of a log is ignored.

    Raises:
        DataError: a whole line is no receipt.
    """
    latest: dict[str, Receipt] = {}
    for path in sorted((job / RECEIPTS / stage).glob("*.jsonl")):
        for receipt in _read_log(path):
            known = latest.get(receipt.item)
            if known is None or (receipt.turn, receipt.state == "done") >= (known.turn, known.state == "done"):
                latest[receipt.item] = receipt
    return dict(sorted(latest.items()))


def _read_log(path: Path) -> Iterable[Receipt]:
    *whole, _torn = path.read_bytes().split(b"\n")
    for number, line in enumerate(whole, start=1):
        try:
            yield _receipt(line)
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise DataError(f"{path}:{number}: is no receipt ({error}); move the line away and run again") from error


_KINDS: dict[str, type | tuple[type, ...]] = {
    "turn": int, "size": int, "retryable": bool, "seconds": (int, float), "outputs": tuple, "facts": dict
}  # fmt: skip
"""Types of a record's fields; the others are texts."""


def _receipt(line: bytes) -> Receipt:
    values = json.loads(line)
    receipt = Receipt(**{**values, "outputs": tuple(Output(**output) for output in values["outputs"])})
    for record in (receipt, *receipt.outputs):
        for name in (one.name for one in fields(record)):
            value = getattr(record, name)
            if not isinstance(value, _KINDS.get(name, str)):
                raise TypeError(f"{name} is {value!r}")
    if receipt.state not in get_args(State):
        raise ValueError(f"state is {receipt.state!r}")
    return receipt


def publish(staging: Path, job: Path, names: Sequence[str]) -> tuple[Output, ...]:
    """Move staged files to their places, synced and each by one rename.

    Args:
        staging: folder that holds the files under their final base names.
        job: the job's folder.
        names: where they go, relative to ``job``.

    Raises:
        StorageError: no space, or a folder that cannot be written to.
        DataError: a file was not made, or is empty.
    """
    outputs = []
    for name in names:
        staged = staging / Path(name).name
        if not staged.is_file() or staged.stat().st_size == 0:
            raise DataError(f"{name}: was not made; this is a fault of the stage, please report it")
        with storage_errors(job / name), staged.open("rb") as stream:
            os.fsync(stream.fileno())
        outputs.append(Output(path=name, size=staged.stat().st_size, sha256=sha256_file(staged)))
    for folder in {(job / name).parent for name in names}:
        make_folder(folder)
    for name in names:
        with storage_errors(job / name):
            (staging / Path(name).name).replace(job / name)
    for folder in sorted({(job / name).parent for name in names}):
        sync_folder(folder)
    return tuple(outputs)


def outputs_present(job: Path, receipt: Receipt) -> bool:
    """Whether every output of a receipt is where it says, with its size (a person may have deleted some)."""
    for output in receipt.outputs:
        try:
            if (job / output.path).stat().st_size != output.size:
                return False
        except OSError:
            return False
    return True


def check_unaltered(path: Path, sha256: str) -> None:
    """That a file still has the content that its receipt names: sizes alone do not tell what a bad disk did to it.

    It costs one reading of the file in each process that uses it, which will read it anyway: a gigabyte a second or so.

    Raises:
        AlteredError: it has another content.
        OSError: it cannot be read.
    """
    status = path.stat()
    found = _sha256_of(path, status.st_size, status.st_mtime_ns)
    if found != sha256:
        raise AlteredError(
            f"{path}: was altered or damaged after it was made (its sha256 is {found[:12]}..., its receipt says "
            f"{sha256[:12]}...); remove it and run again"
        )


@functools.lru_cache(maxsize=4096)
def _sha256_of(path: Path, size: int, modified_ns: int) -> str:
    return sha256_file(path)


def atomic_write(path: Path, data: bytes | Iterable[bytes]) -> None:
    """Write a file whole or not at all, from its bytes or from their pieces in order.

    Raises:
        StorageError: no space, or the folder cannot be written to.
    """
    with storage_errors(path):
        make_folder(path.parent)
        temporary = path.with_name(f".{path.name}.{host_name()}-{os.getpid()}.tmp")
        try:
            with temporary.open("wb") as stream:
                for piece in (data,) if isinstance(data, bytes) else data:
                    stream.write(piece)
                stream.flush()
                os.fsync(stream.fileno())
            temporary.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
        sync_folder(path.parent)


def reason_counts(reasons: Iterable[str]) -> Mapping[str, int]:
    """How often each kind of reason occurs: the slug before its numbers."""
    counts: dict[str, int] = {}
    for reason in reasons:
        slug = re.split(r"[ =:(]", reason, maxsplit=1)[0] or "unknown"
        counts[slug] = counts.get(slug, 0) + 1
    return dict(sorted(counts.items()))
