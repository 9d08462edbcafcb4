"""Looking at a dataset: its summary in numbers, a clip's record, and a clip as a contact sheet."""

import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dataset.loader import Sample, ShardDataset
from dataset.receipts import Receipt, read_receipts, reason_counts
from dataset.selection import ClipRow, Selection, read_selection
from dataset.shards import read_shard_index
from labeling.errors import DataError
from labeling.labels import Keypoints
from labeling.object_video import MOST_TRACKS, tracks_of

SHEET_ROWS = {"rgb.mp4": "RGB", "skeleton.mp4": "skeleton", "ego.mp4": "ego", "objects.mp4": "objects"}
"""The videos of a sheet from the top, and what they are called."""

_FPS = 24
_MOMENTS = 8
_TILE = (264, 176)
_GAP, _GUTTER, _TIMES = 6, 92, 26
_GROUND, _INK, _FAINT = "#14171c", "#f2f4f7", "#9aa4b2"


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
    if not (job / "selection.parquet").is_file():
        raise DataError(f"{job}: holds no selection; make one with `animatic label VIDEO... --out {job}`")
    selection = read_selection(job / "selection.parquet")
    # By the stages that there are receipts of: which there may be is for the pipeline to know.
    logged = {folder.name for folder in (job / "receipts").glob("*") if folder.is_dir()}
    receipts = {stage: read_receipts(job, stage) for stage in sorted(logged | {"index", "render"})}
    index_file = job / "shards" / "index.parquet"
    rows = read_shard_index(index_file) if index_file.is_file() else []
    lengths = {row.key: row.end - row.start for row in selection.rows}
    splits = {row.key: row.split for row in rows}
    kept = {row.key for row in selection.kept}
    dropped = _drop_reasons(selection, receipts["render"])
    rendered = [r for key, r in receipts["render"].items() if r.state == "done" and key in kept]
    return Summary(
        videos=sum(r.state == "done" for r in receipts["index"].values()),
        source_hours=sum(r.facts.get("seconds", 0.0) for r in receipts["index"].values()) / 3600,
        clip_hours=sum(lengths.get(key, 0) for key in splits) / _FPS / 3600,
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
    return _drop_reasons(read_selection(job / "selection.parquet"), read_receipts(job, "render"))


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
    rows = read_selection(job / "selection.parquet").rows
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
    return (job / "shards" / "index.parquet").is_file()


def find_sample(job: Path, key: str | None = None) -> Sample:
    """A packed clip, of either split; the first one if no key is given.

    Raises:
        DataError: no such clip, or none at all; the message says what became of it.
    """
    datasets = [ShardDataset(job, split) for split in ("train", "val")]
    for dataset in datasets:
        if key in dataset.keys or (key is None and len(dataset)):
            return dataset.sample(key or dataset.keys[0])
    if key is not None and (job / "selection.parquet").is_file():
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


def contact_sheet(sample: Sample, *, moments: int = _MOMENTS) -> np.ndarray:
    """A clip at a glance: moments across, its videos below one another, the caption on top.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    suffixes = [suffix for suffix in SHEET_ROWS if suffix in sample.members]
    rows = [moment_frames(sample, suffix, moments) for suffix in suffixes]
    tiles = [[_tile(frame) for _, frame in row] for row in rows]
    times = [index / _FPS for index, _ in rows[0]]
    caption = textwrap.wrap(sample.caption, width=150)
    width = _GUTTER + moments * (_TILE[0] + _GAP) + _GAP
    head = 44 + 22 * len(caption)
    height = head + _TIMES + len(rows) * (_TILE[1] + _GAP) + _GAP
    canvas = np.full((height, width, 3), tuple(int(_GROUND[i : i + 2], 16) for i in (1, 3, 5)), np.uint8)
    for number, row in enumerate(tiles):
        top = head + _TIMES + number * (_TILE[1] + _GAP)
        for column, tile in enumerate(row):
            left = _GUTTER + column * (_TILE[0] + _GAP)
            canvas[top : top + _TILE[1], left : left + _TILE[0]] = tile
    texts = [(_GAP * 2, 30.0, sample.key, 15.0, _INK, "left")]
    texts += [(_GAP * 2, 56.0 + 22 * n, line, 11.0, _INK, "left") for n, line in enumerate(caption)]
    centre = _TILE[0] / 2
    texts += [
        (_GUTTER + n * (_TILE[0] + _GAP) + centre, head + _TIMES - 8.0, f"{time:.2f} s", 9.0, _FAINT, "center")
        for n, time in enumerate(times)
    ]
    for n, suffix in enumerate(suffixes):
        middle = head + _TIMES + n * (_TILE[1] + _GAP) + _TILE[1] / 2
        texts.append((_GUTTER - 10.0, middle + 4, SHEET_ROWS[suffix], 10.5, _FAINT, "right"))
        if suffix == "objects.mp4" and (tracks := len(tracks_of(sample.keypoints()))) > MOST_TRACKS:
            # Rare traffic and a random choice of dense traffic look the same.
            texts.append((_GUTTER - 10.0, middle + 20, f"{MOST_TRACKS} of {tracks}", 8.5, _FAINT, "right"))
    if "skeleton.mp4" in suffixes and not any(label.present.any() for label in sample.keypoints()):
        middle = head + _TIMES + (suffixes.index("skeleton.mp4") + 0.5) * (_TILE[1] + _GAP)
        note = "no keypoints: no keypoint network's weights were there, so there is nothing to draw"
        texts.append((_GUTTER + (width - _GUTTER) / 2, middle, note, 11.0, _FAINT, "center"))
    return _with_texts(canvas, texts)


def moment_frames(sample: Sample, suffix: str, moments: int) -> list[tuple[int, np.ndarray]]:
    """Frames spread evenly over a clip's video, its first and last among them, with their indices."""
    count = len(sample.cam_to_world)
    wanted = [round(index) for index in np.linspace(0, count - 1, moments)]
    found = {index: frame for index, frame in enumerate(sample.iterate_frames(suffix)) if index in set(wanted)}
    return [(index, found[index]) for index in wanted]


def _tile(frame: np.ndarray) -> np.ndarray:
    """A frame shrunk to fit a tile, on black."""
    scale = min(_TILE[0] / frame.shape[1], _TILE[1] / frame.shape[0])
    size = (max(1, round(frame.shape[1] * scale)), max(1, round(frame.shape[0] * scale)))
    shrunk = cv2.resize(frame, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
    tile = np.zeros((_TILE[1], _TILE[0], 3), np.uint8)
    top, left = (_TILE[1] - size[1]) // 2, (_TILE[0] - size[0]) // 2
    tile[top : top + size[1], left : left + size[0]] = shrunk
    return tile


def _with_texts(canvas: np.ndarray, texts: Sequence[tuple[float, float, str, float, str, str]]) -> np.ndarray:
    """Texts (x, y of the baseline, text, points, colour, side) on a picture, pixel for pixel."""
    height, width = canvas.shape[:2]
    dpi = 100
    figure = Figure(figsize=(width / dpi, height / dpi), dpi=dpi)
    painter = FigureCanvasAgg(figure)
    figure.figimage(canvas)
    for x, y, text, points, colour, side in texts:
        figure.text(
            x / width, 1 - y / height, text.replace("$", r"\$"), fontsize=points, color=colour, ha=side, va="baseline"
        )
    painter.draw()
    return np.asarray(painter.buffer_rgba())[..., :3].copy()
