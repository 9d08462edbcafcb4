"""The Parquet tables of a job: their schemas, and typed readers and writers.

The same rows always give the same bytes: one row group, no threads, fixed compression, no time stamps.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from labeling.camera import Intrinsics, Trajectory
from labeling.errors import DataError
from labeling.labels import Keypoints
from labeling.schemas import Category
from labeling.timeline import RunFrames

if TYPE_CHECKING:
    from labeling.ego_motion import EgoMotion

_F32, _F64, _I64, _TEXT, _BOOL = pa.float32(), pa.float64(), pa.int64(), pa.string(), pa.bool_()

INDEX_SCHEMA = pa.schema([("time_s", _F64), ("is_keyframe", _BOOL)])
"""A source's packets in presentation order; the metadata holds what its container says and its content's sha256."""

COUNTS_SCHEMA = pa.schema([("time_s", _F64), ("classes", pa.list_(_TEXT)), ("scores", pa.list_(_F32))])
"""What the detector saw in each frame that was looked at, all classes and scores: selecting needs no second look."""

FRAMES_SCHEMA = pa.schema(
    [("frame", pa.int32()), ("source_time_s", _F64), ("duplicate", _BOOL), ("hole", _BOOL), ("cut", _BOOL)]
)
"""One row per frame of a run, on the video's 24 fps grid."""

KEYPOINTS_SCHEMA = pa.schema(
    [
        ("frame", pa.int32()),
        ("track_id", pa.int32()),
        ("category", _TEXT),
        ("schema", _TEXT),
        ("score", _F32),
        ("box_xyxy", pa.list_(_F32, 4)),
        ("keypoints", pa.list_(_F32)),
        ("point_source", pa.list_(pa.int8())),
    ]
)
"""One row per object and frame; ``keypoints`` is K x (x, y, score), flattened."""

EGO_SCHEMA = pa.schema(
    [
        ("frame", pa.int32()),
        ("time_s", _F64),
        ("cam_to_world", pa.list_(_F64, 16)),
        ("mode", _TEXT),
        ("confidence", _F32),
        ("scale_source", _TEXT),
        ("scale_sigma", _F32),
    ]
)
"""One row per frame of a run: the pose in the run's first camera, row-major."""

SELECTION_SCHEMA = pa.schema(
    [
        ("key", _TEXT),
        ("video_id", _TEXT),
        ("start", _I64),
        ("end", _I64),
        ("objects", _F32),
        ("kept", _BOOL),
        ("split", _TEXT),
        ("reason", _TEXT),
        ("round", pa.int32()),
    ]
)
"""One row per clip of every indexed video. ``objects`` is null where nothing was counted, ``reason`` where it is kept;
``round`` counts the times that the selection was extended, so that shards already packed stay as they are."""

SHARD_INDEX_SCHEMA = pa.schema(
    [
        ("key", _TEXT),
        ("split", _TEXT),
        ("shard", _TEXT),
        ("member", _TEXT),
        ("offset", _I64),
        ("size", _I64),
        ("sha256", _TEXT),
    ]
)
"""One row per member of a shard; ``offset`` is where its bytes start in the tar."""


def write_table(path: Path, table: pa.Table, *, metadata: Mapping[str, Any] | None = None) -> None:
    """Write a table; ``metadata`` (JSON values) goes into the file's schema."""
    if metadata is not None:
        encoded = {key: json.dumps(value, sort_keys=True) for key, value in sorted(metadata.items())}
        table = table.replace_schema_metadata(encoded)
    pq.write_table(table, path, compression="zstd", row_group_size=max(1, table.num_rows))


def read_table(path: Path, schema: pa.Schema, *, needs: Sequence[str] = ()) -> tuple[pa.Table, dict[str, Any]]:
    """The table at ``path`` and its metadata, which must have the keys ``needs``.

    Raises:
        DataError: the file is missing, no Parquet, has other columns than ``schema``, or metadata that is not ours.
    """
    if not path.is_file():
        raise DataError(f"{path}: is not there; name the job's folder, or run the stage that writes this table")
    try:
        table = pq.read_table(path, use_threads=False)
        table.validate(full=True)
    except (OSError, pa.ArrowException) as error:
        raise DataError(f"{path}: cannot be read as a table ({error}); remove it and run again") from error
    found = {field.name: field.type for field in table.schema}
    wanted = {field.name: field.type for field in schema}
    if found != wanted:
        raise DataError(f"{path}: needs columns {_columns(wanted)}, has {_columns(found)}; remove it and run again")
    raw = table.schema.metadata or {}
    try:
        metadata = {k.decode(): json.loads(v) for k, v in raw.items() if not k.startswith((b"ARROW", b"pandas"))}
    except (ValueError, RecursionError) as error:
        raise _foreign(path, f"metadata that is no JSON ({error})") from error
    missing = [key for key in needs if key not in metadata]
    if missing:
        raise _foreign(path, f"no {', '.join(missing)} in its metadata")
    return table, metadata


def _foreign(path: Path, what: str) -> DataError:
    return DataError(f"{path}: has {what}, as if another tool had rewritten it; remove it and run again")


def table_of(schema: pa.Schema, rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """A table from dictionaries, one per row."""
    return pa.Table.from_pylist([dict(row) for row in rows], schema=schema)


def _columns(types: Mapping[str, pa.DataType]) -> str:
    return ", ".join(f"{name}:{kind}" for name, kind in types.items())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VideoIndex:
    """What is known of a source video without decoding a frame."""

    times_s: np.ndarray
    """(N,) float64, sorted presentation times."""
    is_keyframe: np.ndarray
    """(N,) bool."""
    info: dict[str, Any]
    """Container facts: width, height, codec, frame rate ..."""
    sha256: str
    """Of the source file's content."""


def write_index(path: Path, index: VideoIndex) -> None:
    """Write a video's packet times."""
    columns = [pa.array(index.times_s, _F64), pa.array(index.is_keyframe, _BOOL)]
    table = pa.Table.from_arrays(columns, schema=INDEX_SCHEMA)
    write_table(path, table, metadata={"info": index.info, "sha256": index.sha256})


def read_index(path: Path) -> VideoIndex:
    """A video's packet times."""
    table, metadata = read_table(path, INDEX_SCHEMA, needs=("info", "sha256"))
    return VideoIndex(
        times_s=_column(table, "time_s"), is_keyframe=_column(table, "is_keyframe"),
        info=metadata["info"], sha256=metadata["sha256"],
    )  # fmt: skip


def write_frames(path: Path, frames: RunFrames) -> None:
    """Write a run's frame table."""
    arrays = [pa.array(getattr(frames, field.name), field.type) for field in FRAMES_SCHEMA]
    write_table(path, pa.Table.from_arrays(arrays, schema=FRAMES_SCHEMA))


def read_frames_table(path: Path) -> RunFrames:
    """A run's frame table."""
    table, _ = read_table(path, FRAMES_SCHEMA)
    return RunFrames(**{name: _column(table, name) for name in FRAMES_SCHEMA.names})


def write_keypoints(path: Path, labels: Sequence[Keypoints], *, metadata: Mapping[str, Any] | None = None) -> None:
    """Write labels, in the order given."""
    write_table(path, keypoints_table(labels), metadata=metadata)


def keypoints_table(labels: Sequence[Keypoints]) -> pa.Table:
    """Labels as rows of ``KEYPOINTS_SCHEMA``."""
    counts = [len(label.points) for label in labels]
    ends = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    points = np.concatenate([label.points.reshape(-1) for label in labels]) if labels else np.zeros(0)
    sources = np.concatenate([label.point_source for label in labels]) if labels else np.zeros(0)
    boxes = np.concatenate([label.box_xyxy for label in labels]) if labels else np.zeros(0)
    columns = [
        pa.array([label.frame for label in labels], pa.int32()),
        pa.array([label.track_id for label in labels], pa.int32()),
        pa.array([label.category for label in labels], _TEXT),
        pa.array([label.schema for label in labels], _TEXT),
        pa.array([label.score for label in labels], _F32),
        pa.FixedSizeListArray.from_arrays(pa.array(boxes.astype(np.float32)), 4),
        pa.ListArray.from_arrays(pa.array(ends * 3), pa.array(points.astype(np.float32))),
        pa.ListArray.from_arrays(pa.array(ends), pa.array(sources.astype(np.int8))),
    ]
    return pa.Table.from_arrays(columns, schema=KEYPOINTS_SCHEMA)


def read_keypoints(path: Path, *, start: int | None = None, end: int | None = None) -> list[Keypoints]:
    """A run's labels, in the order they were written; only those of frames ``[start, end)`` where given."""
    table, _ = read_table(path, KEYPOINTS_SCHEMA)
    if start is not None or end is not None:
        frames = _column(table, "frame")
        inside = (frames >= (-np.inf if start is None else start)) & (frames < (np.inf if end is None else end))
        table = table.filter(pa.array(inside))
    return keypoints_from_table(table)


def keypoints_from_table(table: pa.Table, *, frame_offset: int = 0) -> list[Keypoints]:
    """Rows of ``KEYPOINTS_SCHEMA`` as labels, with ``frame_offset`` added to their frames."""
    table = table.combine_chunks()
    points, point_ends = _lists(table, "keypoints")
    sources, source_ends = _lists(table, "point_source")
    boxes = np.asarray(table["box_xyxy"].combine_chunks().flatten(), dtype=np.float32).reshape(-1, 4)
    frames, tracks = _column(table, "frame"), _column(table, "track_id")
    categories, schemas = table["category"].to_pylist(), table["schema"].to_pylist()
    scores = _column(table, "score")
    return [
        Keypoints(
            frame=int(frames[row]) + frame_offset,
            track_id=int(tracks[row]),
            category=cast(Category, categories[row]),
            schema=schemas[row],
            score=float(scores[row]),
            box_xyxy=boxes[row].copy(),
            points=points[point_ends[row] : point_ends[row + 1]].reshape(-1, 3).copy(),
            point_source=sources[source_ends[row] : source_ends[row + 1]].copy(),
        )
        for row in range(table.num_rows)
    ]


def _lists(table: pa.Table, name: str) -> tuple[np.ndarray, np.ndarray]:
    """The flat values of a list column and where each row's start, one more offset than rows."""
    column = table[name].combine_chunks()
    if isinstance(column, pa.ChunkedArray):
        column = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    offsets = np.asarray(column.offsets)
    return np.asarray(column.values), offsets


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EgoTable:
    """A run's camera motion, as stored."""

    frame: np.ndarray
    """(T,) int32, on the video's grid."""
    trajectory: Trajectory
    """In the run's first camera; seconds from the video's first frame."""
    mode: list[str]
    """T times still, turning, moving, held, cut or missing (an imported trajectory says nothing of the frame)."""
    confidence: np.ndarray
    """(T,) float32, 0 to 1."""
    scale_source: list[str]
    """T times road, held, default or given (imported): what metres rest on."""
    scale_sigma: np.ndarray
    """(T,) float32: one sigma of the scale, relative to it."""
    intrinsics: Intrinsics
    """Of the working picture."""
    road: dict[str, float | str | None]
    """Height over the road and pitch against it, with the pitch's sigma (null where no road was seen), and where the
    two came from."""


def write_ego(
    path: Path, motion: "EgoMotion", *, first_frame: int, mounting: Mapping[str, float | str | None] | None = None
) -> None:
    """Write a run's camera motion; ``first_frame`` is its first grid frame, ``mounting`` what more is known of how the
    camera looks at the road.

    Raises:
        DataError: confidence or sigma that are no numbers.
    """
    poses = motion.trajectory.cam_to_world
    if not (np.isfinite(motion.confidence).all() and np.isfinite(motion.scale_sigma).all()):
        raise DataError(f"{path.name}: confidence or scale sigma are not finite; please report it")
    columns = [
        pa.array(np.arange(first_frame, first_frame + len(poses)), pa.int32()),
        pa.array(motion.trajectory.timestamps_s, _F64),
        pa.FixedSizeListArray.from_arrays(pa.array(poses.reshape(-1)), 16),
        pa.array([str(mode) for mode in motion.mode], _TEXT),
        pa.array(np.asarray(motion.confidence, dtype=np.float32), _F32),
        pa.array([str(source) for source in motion.scale_source], _TEXT),
        pa.array(np.asarray(motion.scale_sigma, dtype=np.float32), _F32),
    ]
    road = {name: float(value) if np.isfinite(value) else None for name, value in asdict(motion.road).items()}
    metadata = {"intrinsics": asdict(motion.intrinsics), "road": {**road, **(mounting or {})}}
    write_table(path, pa.Table.from_arrays(columns, schema=EGO_SCHEMA), metadata=metadata)


def read_ego(path: Path) -> EgoTable:
    """A run's camera motion."""
    table, metadata = read_table(path, EGO_SCHEMA, needs=("intrinsics", "road"))
    try:
        intrinsics = Intrinsics(**metadata["intrinsics"])
    except TypeError as error:
        raise _foreign(path, f"other intrinsics in its metadata than ours ({error})") from error
    poses = np.asarray(table["cam_to_world"].combine_chunks().flatten(), dtype=np.float64).reshape(-1, 4, 4)
    return EgoTable(
        frame=_column(table, "frame"),
        trajectory=Trajectory(timestamps_s=_column(table, "time_s"), cam_to_world=poses),
        mode=table["mode"].to_pylist(),
        confidence=_column(table, "confidence"),
        scale_source=table["scale_source"].to_pylist(),
        scale_sigma=_column(table, "scale_sigma"),
        intrinsics=intrinsics,
        road=metadata["road"],
    )


def _column(table: pa.Table, name: str) -> np.ndarray:
    return table[name].to_numpy(zero_copy_only=False)
