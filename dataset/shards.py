"""Shards: plain tar files in WebDataset's naming, the same bytes for the same samples, and their index.

A sample is a set of members ``<key>.<suffix>``; an index row says where each member's bytes lie, so that any member can
be read alone by one seek.
"""

import hashlib
import io
import os
import re
import tarfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from dataset.layout import INDEX_NAME, SHARD_INDEX, SHARDS
from dataset.receipts import storage_errors
from dataset.tables import SHARD_INDEX_SCHEMA, read_table, table_of, write_table
from labeling.errors import DataError

Split = Literal["train", "val"]

_BLOCK = 512
_KEY = re.compile(r"[A-Za-z0-9_-]+")
_FILE_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]*")


@dataclass(frozen=True, slots=True, kw_only=True)
class Member:
    """A row of the shard index."""

    key: str
    split: str
    shard: str
    """File name of the tar."""
    member: str
    """Suffix, as ``rgb.mp4``."""
    offset: int
    """Where the member's bytes start in the tar."""
    size: int
    """Bytes."""
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipSize:
    """What the plan of the shards needs to know of a clip."""

    key: str
    split: str
    round: int
    """The selection's round that took it in; a round starts new shards."""
    size: int
    """Bytes, estimated from the runs it is cut from."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShardPlan:
    """One shard to be written."""

    name: str
    """``train-000000.tar``."""
    split: str
    keys: tuple[str, ...]


def plan_shards(clips: Sequence[ClipSize], *, target_bytes: int) -> list[ShardPlan]:
    """Which clip goes to which shard: filled in order of round and key up to ``target_bytes``.

    A clip added by a later round never moves a clip of an earlier one.
    """
    plans: list[ShardPlan] = []
    for split in sorted({clip.split for clip in clips}):
        group: list[str] = []
        filled, number, current_round = 0, 0, None
        for clip in sorted((c for c in clips if c.split == split), key=lambda c: (c.round, c.key)):
            if group and (filled + clip.size > target_bytes or clip.round != current_round):
                plans.append(ShardPlan(name=f"{split}-{number:06d}.tar", split=split, keys=tuple(group)))
                group, filled, number = [], 0, number + 1
            group.append(clip.key)
            filled, current_round = filled + clip.size, clip.round
        if group:
            plans.append(ShardPlan(name=f"{split}-{number:06d}.tar", split=split, keys=tuple(group)))
    return plans


SampleMembers = Mapping[str, Callable[[], bytes]]
"""Suffix to a function that yields the member's bytes when its turn comes: one member in memory at a time."""


def write_shard(path: Path, plan: ShardPlan, samples: Iterable[tuple[str, SampleMembers]]) -> list[Member]:
    """Write one tar and return its index rows; times, owners and modes are constant.

    Raises:
        StorageError: no space left, or ``path`` cannot be written.
    """
    rows: list[Member] = []
    with storage_errors(path), tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for key, members in samples:
            for suffix, load in members.items():
                data = load()
                offset = tar.offset + _BLOCK
                tar.addfile(_header(f"{key}.{suffix}", len(data)), io.BytesIO(data))
                rows.append(
                    Member(
                        key=key, split=plan.split, shard=plan.name, member=suffix, offset=offset, size=len(data),
                        sha256=hashlib.sha256(data).hexdigest(),
                    )
                )  # fmt: skip
    return rows


def _header(name: str, size: int) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.size, info.mtime, info.mode = size, 0, 0o644
    return info


def check_shard(path: Path, rows: Sequence[Member]) -> None:
    """Read a shard back against its rows.

    Raises:
        DataError: a member is not where its row says, or has other bytes.
    """
    with path.open("rb") as stream:
        for row in rows:
            stream.seek(row.offset)
            if hashlib.sha256(stream.read(row.size)).hexdigest() != row.sha256:
                raise DataError(f"{path}: {row.key}.{row.member} is not as it was written; run pack again")


def write_shard_index(path: Path, rows: Sequence[Member]) -> None:
    """Write ``index.parquet``, sorted by split, shard and offset."""
    ordered = sorted(rows, key=lambda row: (row.shard, row.offset))
    write_table(path, table_of(SHARD_INDEX_SCHEMA, [asdict(row) for row in ordered]))


def read_shard_index(path: Path) -> list[Member]:
    """The rows of ``index.parquet``, in order.

    Raises:
        DataError: the file is missing, has other columns or empty fields, or names that lead out of a folder.
    """
    table, _ = read_table(path, SHARD_INDEX_SCHEMA)
    if any(column.null_count for column in table.columns):
        raise DataError(f"{path}: has rows with empty fields; remove it and run pack again, or copy it again")
    rows = [Member(**row) for row in table.to_pylist()]
    for row in rows:
        # Shards come from others too: a shard is opened by its name, and an export calls files by their keys.
        if not _KEY.fullmatch(row.key) or not _FILE_NAME.fullmatch(row.shard):
            raise DataError(
                f"{path}: names clip {row.key!r} in shard {row.shard!r}; keys hold only letters, digits, _ and -, and "
                "shards lie beside their index: pack the job again, or take its shards from somebody you trust"
            )
    return rows


def find_shards(job_or_shards: Path) -> Path:
    """The folder that holds ``index.parquet``: the one given, or its ``shards``.

    Raises:
        DataError: neither holds one.
    """
    for folder in (job_or_shards, job_or_shards / SHARDS):
        if (folder / INDEX_NAME).is_file():
            return folder
    raise DataError(f"{job_or_shards}: holds no {SHARD_INDEX}; run `animatic label` or `animatic pack` first")


def read_member(folder: Path, row: Member) -> bytes:
    """A member's bytes, by one seek.

    They are hashed at each reading, a gigabyte a second or so: what decodes them would crash on damage, or not see it.

    Raises:
        DataError: the shard is missing or too short, or the member has other bytes than were packed.
    """
    path, name = folder / row.shard, f"{row.key}.{row.member}"
    again = "copy it again, or remove it and run pack again"
    try:
        with path.open("rb") as stream:
            # Of a size that a damaged index claims, no buffer is made.
            whole = row.offset + row.size <= os.fstat(stream.fileno()).st_size
            data = os.pread(stream.fileno(), row.size, row.offset) if whole else b""
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error}); {again}") from error
    if len(data) != row.size:
        raise DataError(f"{path}: ends inside {name} (bytes {row.offset} to {row.offset + row.size}); {again}")
    found = hashlib.sha256(data).hexdigest()
    if found != row.sha256:
        raise DataError(
            f"{path}: {name} is not as it was packed (its sha256 is {found[:12]}..., the index says "
            f"{row.sha256[:12]}...); {again}"
        )
    return data


def iterate_keys(rows: Sequence[Member], split: str) -> Iterator[str]:
    """Keys of a split, in the order of their bytes."""
    seen: dict[str, None] = {}
    for row in rows:
        if row.split == split:
            seen.setdefault(row.key)
    return iter(seen)
