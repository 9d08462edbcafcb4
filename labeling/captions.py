"""Captions: a template filled from labels and trajectory, or a table of texts made elsewhere."""

import csv
import json
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from labeling.camera import Trajectory
from labeling.errors import DataError
from labeling.labels import Keypoints

_NOUNS = {"car": ("car", "cars"), "person": ("person", "people")}
_SEEN_SHARE = 0.25
_STILL_SPEED_M_S = 0.3
_TURN_DEG_PER_S = 3.0
_TURN_LEAST_DEG = 5.0
_CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f\x7f-\x84\x86-\x9f\ud800-\udfff]")
"""What a terminal obeys (line ends and tabs apart), and halves of characters, which UTF-8 cannot write."""


def template_caption(labels: Sequence[Keypoints], trajectory: Trajectory | None = None) -> str:
    """One sentence from what is known: ``A road with 3 cars and 1 person ahead; the camera drives forward at 13 m/s.``

    An object counts when it is in view for a quarter of the clip: n cars means that at least n are seen at once in a
    quarter of the frames, which neither an id switch nor a flicker inflates.

    Args:
        labels: all labels of the clip.
        trajectory: the clip's; without one the sentence is silent about the camera, and frames are counted from labels.
    """
    frames = len(trajectory) if trajectory is not None else len({one.frame for one in labels})
    counts = {category: _typical_count(labels, category, frames) for category in _NOUNS}
    seen = [f"{n} {_NOUNS[category][n != 1]}" for category, n in counts.items() if n]
    scene = f"A road with {' and '.join(seen)} ahead" if seen else "An empty road"
    motion = camera_motion(trajectory) if trajectory is not None else ""
    return f"{scene}; the camera {motion}." if motion else f"{scene}."


def camera_motion(trajectory: Trajectory) -> str:
    """What the camera does, as a verb phrase: ``drives forward at 13 m/s, turning left``; empty for a single frame."""
    if len(trajectory) < 2:
        return ""
    seconds = float(trajectory.timestamps_s[-1] - trajectory.timestamps_s[0])
    speed = trajectory.path_length_m / seconds
    turn = _turn(trajectory, seconds)
    # Jitter adds up along a path but not in a displacement, so a still camera is told by both.
    farthest = float(np.linalg.norm(trajectory.positions, axis=1).max())
    if speed < _STILL_SPEED_M_S or farthest < _STILL_SPEED_M_S * min(seconds, 1.0):
        return f"turns {turn} on the spot" if turn else "stands still"
    ahead = trajectory.cam_to_world[:-1, :3, 2]
    forward_m = float((np.diff(trajectory.positions, axis=0) * ahead).sum())
    verb = "drives forward" if forward_m >= 0 else "reverses"
    pace = f"{speed:.0f}" if speed >= 1.5 else f"{speed:.1f}"
    return f"{verb} at {pace} m/s{f', turning {turn}' if turn else ''}"


def read_caption_table(path: Path) -> dict[str, str]:
    """Texts by clip key, from a table with the columns ``key`` and ``text``.

    Args:
        path: ``.csv`` (with a header), ``.parquet``, or ``.jsonl`` (one object a line).

    Raises:
        DataError: the file is missing or unreadable, of another kind, lacks a column, or has an empty or repeated key,
            an empty text, or control characters.
    """
    readers = {".csv": _csv_rows, ".parquet": _parquet_rows, ".jsonl": _jsonl_rows}
    read = readers.get(path.suffix.lower())
    if read is None:
        raise DataError(f"{path}: captions are read from {', '.join(readers)}; convert the table to one of them")
    try:
        return _checked(path, read(path))
    except (OSError, ValueError, RecursionError, csv.Error, pa.ArrowException) as error:
        raise DataError(
            f"{path}: cannot be read as a caption table ({error}); check the path and the format"
        ) from error


def _typical_count(labels: Sequence[Keypoints], category: str, frames: int) -> int:
    """The largest n such that at least n are in view in a quarter of the frames."""
    per_frame: dict[int, int] = {}
    for one in labels:
        if one.category == category:
            per_frame[one.frame] = per_frame.get(one.frame, 0) + 1
    counts = sorted(per_frame.values(), reverse=True)
    needed = max(1, math.ceil(_SEEN_SHARE * frames))
    return counts[needed - 1] if len(counts) >= needed else 0


def _turn(trajectory: Trajectory, seconds: float) -> str:
    """left, right, or empty: the net change of heading, unwrapped, about the vertical of the first camera."""
    ahead = trajectory.cam_to_world[:, :3, 2]
    heading_deg = np.degrees(np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 2])))
    change = float(heading_deg[-1] - heading_deg[0])
    if abs(change) < max(_TURN_LEAST_DEG, _TURN_DEG_PER_S * seconds):
        return ""
    return "right" if change > 0 else "left"


def _checked(path: Path, rows: Iterable[tuple[int, dict]]) -> dict[str, str]:
    texts: dict[str, str] = {}
    for number, row in rows:
        missing = [name for name in ("key", "text") if name not in row]
        if missing:
            raise DataError(f"{path}: row {number} has no column {missing[0]!r}; give the columns key and text")
        key, text = row["key"], row["text"]
        if not isinstance(key, str) or not isinstance(text, str) or not key.strip() or not text.strip():
            raise DataError(f"{path}: row {number} has key {key!r} and text {text!r}; give two texts, neither empty")
        if found := _CONTROL.search(key + text):
            raise DataError(f"{path}: row {number} holds the control character {found[0]!r}; take it out")
        key = key.strip()
        if key in texts:
            raise DataError(f"{path}: row {number} repeats the key {key!r}; give each clip one text")
        texts[key] = text.strip()
    if not texts:
        raise DataError(f"{path}: holds no captions; give rows of key and text")
    return texts


def _csv_rows(path: Path) -> Iterable[tuple[int, dict]]:
    with path.open(newline="", encoding="utf-8-sig") as file:
        yield from enumerate(csv.DictReader(file, strict=True), start=1)


def _parquet_rows(path: Path) -> Iterable[tuple[int, dict]]:
    yield from enumerate(pq.read_table(path).to_pylist(), start=1)


def _jsonl_rows(path: Path) -> Iterable[tuple[int, dict]]:
    # Lines end at line feeds alone: JSON texts may hold what Unicode calls line separators.
    with path.open(encoding="utf-8-sig", newline="\n") as file:
        for number, line in enumerate(file, start=1):
            if line.strip():
                row = json.loads(line)
                yield number, row if isinstance(row, dict) else {}
