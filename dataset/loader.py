"""Reading shards back: a map-style dataset over the index.

Every read is one seek, so nothing is unpacked, workers share no state, and any sample can be had at any time.
"""

import hashlib
import io
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dataset.layout import INDEX_NAME
from dataset.shards import Member, find_shards, iterate_keys, read_member, read_shard_index
from dataset.tables import keypoints_from_table
from labeling.errors import DataError
from labeling.labels import Keypoints
from labeling.video import read_frames


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """One clip of a shard. Members are read when asked for; frames count from the clip's first."""

    key: str
    members: dict[str, Member] = field(repr=False)
    """By suffix."""
    folder: Path
    """The shards' folder."""

    def member(self, suffix: str) -> bytes:
        """A member's bytes.

        Raises:
            DataError: the clip has no such member (views are left out by ``--videos rgb``), or the shard is broken.
        """
        if suffix not in self.members:
            raise DataError(
                f"{self.key} has no {suffix}, only {', '.join(self.members)}; pack the job again with that member"
            )
        return read_member(self.folder, self.members[suffix])

    @property
    def caption(self) -> str:
        """What the clip shows, in words."""
        return self.member("txt").decode()

    @property
    def meta(self) -> dict[str, Any]:
        """The record: video id, span, fps, picture sizes, intrinsics, models ..."""
        return json.loads(self.member("json"))

    @property
    def cam_to_world(self) -> np.ndarray:
        """(T, 4, 4) float64 poses, metres, relative to the clip's first camera."""
        return np.load(io.BytesIO(self.member("cam_to_world.npy")), allow_pickle=False)

    def keypoints(self) -> list[Keypoints]:
        """The clip's labels; ``frame`` runs from 0 to T - 1."""
        return keypoints_from_table(pq.read_table(pa.BufferReader(self.member("labels.parquet"))))

    def frames(self, suffix: str) -> np.ndarray:
        """(T, H, W, 3) uint8 RGB frames of a video member, as ``rgb.mp4``."""
        return np.stack(list(self.iterate_frames(suffix)))

    def iterate_frames(self, suffix: str) -> Iterator[np.ndarray]:
        """(H, W, 3) uint8 RGB frames of a video member, one at a time."""
        with tempfile.NamedTemporaryFile(suffix=".mp4") as file:
            file.write(self.member(suffix))
            file.flush()
            yield from read_frames(Path(file.name))


class ShardDataset:
    """Samples of one split, by index.

    Args:
        job_or_shards: a job's folder, or a folder of shards with their ``index.parquet``.
        split: ``train`` or ``val``.

    Raises:
        DataError: there is no index.
    """

    def __init__(self, job_or_shards: Path | str, split: str = "train") -> None:
        self.folder = find_shards(Path(job_or_shards))
        self.split = split
        rows = read_shard_index(self.folder / INDEX_NAME)
        self.keys: list[str] = list(iterate_keys(rows, split))
        self._members: dict[str, dict[str, Member]] = {key: {} for key in self.keys}
        for row in rows:
            if row.split == split:
                self._members[row.key][row.member] = row

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: int) -> Sample:
        return self.sample(self.keys[index])

    def __iter__(self) -> Iterator[Sample]:
        return (self.sample(key) for key in self.keys)

    def sample(self, key: str) -> Sample:
        """The sample called ``key``.

        Raises:
            DataError: the split has none of that name.
        """
        if key not in self._members:
            raise DataError(f"{self.folder}: {self.split} has no clip {key!r}; `animatic inspect` lists what there is")
        return Sample(key=key, members=self._members[key], folder=self.folder)

    @property
    def fingerprint(self) -> str:
        """sha256 over keys and members: what a cache of this split depends on."""
        lines = [f"{row.key}.{row.member} {row.sha256}" for key in self.keys for row in self._members[key].values()]
        return hashlib.sha256("\n".join(sorted(lines)).encode()).hexdigest()
