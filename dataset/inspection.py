"""Looking at a dataset: its summary in numbers, and a clip's record."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dataset.layout import RECEIPTS, SELECTION, SHARD_INDEX
from dataset.loader import Sample, ShardDataset
from dataset.receipts import Receipt, read_receipts, reason_counts
from dataset.selection import ClipRow, Selection, read_selection
from dataset.shards import read_shard_index
from labeling.errors import DataError
from labeling.labels import Keypoints
from labeling.timeline import FPS


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """Least, middle and greatest of some numbers."""

    count: int
    least: float
    median: float
    greatest: float
    total: float


def spread(values: Sequence[float]) -> Spread | None:
    """The spread of numbers; None of none."""
    if not values:
        return None
    return Spread(
        count=len(values), least=float(min(values)), median=float(np.median(values)), greatest=float(max(values)),
        total=float(sum(values)),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """A job in numbers."""

    videos: int
    """Indexed source videos."""
    source_hours: float
    clip_hours: float
    """Of packed clips, overlaps counted as often as they occur."""
    clips: int
    """Of all indexed videos."""
    kept: int
    """Selected and not dropped since: with those dropped, all."""
    packed: Mapping[str, int]
    """By split."""
    dropped: Mapping[str, int]
    """By reason."""
    threshold: float | None
    """Least number of objects of a kept clip."""
    objects_per_clip: Spread | None
    """Counted on keyframes, of all clips."""
    tracks_per_clip: Spread | None
    """Tracked objects in rendered clips."""
    path_length_m: Spread | None
    bytes_by_kind: Mapping[str, int]
    """Of the shards' members."""
    failed: Mapping[str, int] = field(default_factory=dict)
    """By stage."""


def summarize(job: Path) -> Summary:
    """A job's summary, as far as it has come.

    Raises:
        DataError: the folder holds no selection yet.
    """
    if not (job / SELECTION).is_file():
        raise DataError(f"{job}: holds no selection; make one with `animatic label VIDEO... --out {job}`")
    selection = read_selection(job / SELECTION)
    # By the stages that there are receipts of: which there may be is for the pipeline to know.
    logged = {folder.name for folder in (job / RECEIPTS).glob("*") if folder.is_dir()}
    receipts = {stage: read_receipts(job, stage) for stage in sorted(logged | {"index", "render"})}
    index_file = job / SHARD_INDEX
    rows = read_shard_index(index_file) if index_file.is_file() else []
    lengths = {row.key: row.end - row.start for row in selection.rows}
    splits = {row.key: row.split for row in rows}
    kept = {row.key for row in selection.kept}
    dropped = _drop_reasons(selection, receipts["render"])
    rendered = [r for key, r in receipts["render"].items() if r.state == "done" and key in kept]
    return Summary(
        videos=sum(r.state == "done" for r in receipts["index"].values()),
        source_hours=sum(r.facts.get("seconds", 0.0) for r in receipts["index"].values()) / 3600,
        clip_hours=sum(lengths.get(key, 0) for key in splits) / FPS / 3600,
        clips=len(selection.rows), kept=len(selection.rows) - len(dropped),
        packed={split: _count(splits, split) for split in ("train", "val")},
        dropped=reason_counts(dropped.values()), threshold=selection.threshold,
        objects_per_clip=spread([row.objects for row in selection.rows if row.objects is not None]),
        tracks_per_clip=spread([r.facts["objects"] for r in rendered]),
        path_length_m=spread([r.facts["metres"] for r in rendered]),
        bytes_by_kind=_bytes_by_kind(rows),
        failed={stage: count for stage, found in receipts.items() if (count := _failures(found))},
    )  # fmt: skip


def drop_reasons(job: Path) -> dict[str, str]:
    """By key: why each clip is dropped, by the selection or when it was to be drawn.

    Raises:
        DataError: the folder holds no selection.
    """
    return _drop_reasons(read_selection(job / SELECTION), read_receipts(job, "render"))


def _drop_reasons(selection: Selection, rendered: Mapping[str, Receipt]) -> dict[str, str]:
    late = {key: receipt.reason for key, receipt in rendered.items() if receipt.state == "dropped"}
    reasons = {row.key: late.get(row.key) if row.kept else row.reason or "" for row in selection.rows}
    return {key: reason for key, reason in reasons.items() if reason is not None}


def _count(splits: Mapping[str, str], split: str) -> int:
    return sum(found == split for found in splits.values())


def _failures(receipts: Mapping[str, Receipt]) -> int:
    return sum(receipt.state == "failed" for receipt in receipts.values())


def _bytes_by_kind(rows: Sequence[Any]) -> dict[str, int]:
    sizes: Counter[str] = Counter()
    for row in rows:
        sizes[row.member] += row.size
    return dict(sorted(sizes.items()))


def clip_verdict(job: Path, key: str) -> ClipRow:
    """What the selection says of a clip.

    Raises:
        DataError: no clip has that key.
    """
    rows = read_selection(job / SELECTION).rows
    for row in rows:
        if row.key == key:
            return row
    # Those that can be shown: what was dropped is as little to be looked at as what is not there.
    packed = [key for keys in packed_keys(job).values() for key in keys] if _has_shards(job) else []
    likely = packed or [row.key for row in rows if row.kept] or [row.key for row in rows]
    near = ", ".join(likely[:3]) or "none"
    raise DataError(f"{job}: has no clip {key!r}; keys are <video_id>_<start_frame>, such as {near}")


def packed_keys(job: Path) -> dict[str, list[str]]:
    """The keys of the clips in a job's shards, by split.

    Raises:
        DataError: there are no shards.
    """
    return {split: ShardDataset(job, split).keys for split in ("train", "val")}


def _has_shards(job: Path) -> bool:
    return (job / SHARD_INDEX).is_file()


def find_sample(job: Path, key: str | None = None) -> Sample:
    """A packed clip, of either split; the first one if no key is given.

    Raises:
        DataError: no such clip, or none at all; the message says what became of it.
    """
    datasets = [ShardDataset(job, split) for split in ("train", "val")]
    for dataset in datasets:
        if key in dataset.keys or (key is None and len(dataset)):
            return dataset.sample(key or dataset.keys[0])
    if key is not None and (job / SELECTION).is_file():
        row, rendered = clip_verdict(job, key), read_receipts(job, "render").get(key)
        reason = row.reason or (rendered and (rendered.reason or rendered.message)) or "it is not packed yet"
        raise DataError(f"{key}: is not in the shards: {reason}; `animatic status {job}` says more")
    raise DataError(f"{job}: has no clip {key or ''!r}; `animatic inspect {job}` says what there is")


def clip_record(sample: Sample) -> dict[str, Any]:
    """A clip's record, its caption and the sizes of its members."""
    return {
        **sample.meta,
        "caption": sample.caption,
        "members": {suffix: member.size for suffix, member in sample.members.items()},
        "labels": _label_counts(sample.keypoints()),
    }


def _label_counts(labels: Sequence[Keypoints]) -> dict[str, int]:
    return dict(sorted(Counter(label.category for label in labels).items()))
