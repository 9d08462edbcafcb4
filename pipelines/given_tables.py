"""CSV tables that a person gives, a row for each video: splits, cameras, and what to leave out."""

import csv
import math
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path

from labeling.errors import ConfigError

CAMERA_COLUMNS = ("fx", "fy", "cx", "cy", "focal_sigma", "height_m", "pitch_deg")
"""What a table of cameras may hold besides ``video_id``: the fields of ``CameraSettings``."""


def read_split(path: Path) -> dict[str, str]:
    """Split by video id, from a CSV table with the columns ``video_id, split``.

    Raises:
        ConfigError: it cannot be read, or lacks a column.
    """
    return {row["video_id"]: row["split"] for _, row in _table_rows(path, "--split", needs=("video_id", "split"))}


def read_cameras(path: Path) -> dict[str, dict[str, float]]:
    """What is known of each video's camera, from a CSV table with the column ``video_id`` and any of those of
    ``CameraSettings`` (fx, fy, cx, cy, focal_sigma, height_m, pitch_deg); empty cells are not known.

    Raises:
        ConfigError: it cannot be read, lacks ``video_id``, or holds something that is no number.
    """
    cameras: dict[str, dict[str, float]] = {}
    for place, row in _table_rows(path, "--cameras", needs=("video_id",), known=CAMERA_COLUMNS):
        cells = {name: cell for name, cell in row.items() if name != "video_id" and cell}
        cameras[row["video_id"]] = {name: _number(cell, f"{place}: {name}") for name, cell in cells.items()}
    return cameras


def read_leave_out(path: Path) -> dict[str, tuple[float, float]]:
    """Seconds to leave out at each video's start and end, from a CSV table with the columns ``video_id``, ``start_s``
    and ``end_s``.

    Raises:
        ConfigError: it cannot be read, lacks a column, or holds something that is no length.
    """
    spans: dict[str, tuple[float, float]] = {}
    for place, row in _table_rows(path, "--leave-out", needs=("video_id", "start_s", "end_s")):
        start, end = (_number(row[name] or "0", f"{place}: {name}") for name in ("start_s", "end_s"))
        try:
            spans[row["video_id"]] = two_lengths(start, end)
        except ValueError as error:
            raise ConfigError(f"{place}: {error}; give seconds from 0 on") from error
    return spans


def two_lengths(start_s: float, end_s: float) -> tuple[float, float]:
    """Two lengths of time.

    Raises:
        ValueError: one is none.
    """
    lengths = float(start_s), float(end_s)
    if not all(0 <= length < math.inf for length in lengths):
        raise ValueError(f"{lengths} are no two lengths of time")
    return lengths


def _table_rows(
    path: Path, option: str, *, needs: Sequence[str], known: Sequence[str] | None = None
) -> list[tuple[str, dict[str, str]]]:
    """The rows of a CSV table, each with the words that say where it stands.

    Args:
        path: the table.
        option: that named it.
        needs: columns that it must have.
        known: columns that it may have besides; None allows any.

    Raises:
        ConfigError: it cannot be read, lacks a column or has one that is not known, has a row whose cells do not fit,
            or two rows of a video.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            # Not strict, a quote that is not closed would swallow all rows after it.
            reader = csv.DictReader(stream, strict=True)
            rows, columns = [(reader.line_num, row) for row in reader], reader.fieldnames or ()
    except FileNotFoundError as error:
        raise ConfigError(f"{option} {path}: no such file; check the path") from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"{option} {path}: cannot be read as a CSV table ({why}); mend the table") from error
    for name in needs:
        if name not in columns:
            raise ConfigError(f"{path}: has no column {name}; its columns are {', '.join(columns) or 'none'}; add it")
    for name in columns:
        if known is not None and name not in (*needs, *known):
            meant = "".join(f"did you mean {near}? " for near in get_close_matches(name, known, n=1))
            raise ConfigError(f"{path}: column {name!r} is not known; {meant}choose from {', '.join(known)}")
    seen: set[str] = set()
    for line, row in rows:
        if None in row or None in (row[name] for name in needs):
            raise ConfigError(f"{path}: line {line} does not fit the columns {', '.join(columns)}; mend the table")
        if row["video_id"] in seen:
            raise ConfigError(f"{path}: line {line} names video {row['video_id']} again; keep one of its lines")
        seen.add(row["video_id"])
    return [(f"{path}: line {line} (video {row['video_id']})", row) for line, row in rows]


def _number(cell: str, place: str) -> float:
    try:
        return float(cell)
    except ValueError as error:
        raise ConfigError(f"{place} is {cell!r}, but must be a number; leave it empty if it is not known") from error
