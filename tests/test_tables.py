import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset.tables import (
    EGO_SCHEMA,
    FRAMES_SCHEMA,
    KEYPOINTS_SCHEMA,
    SHARD_INDEX_SCHEMA,
    VideoIndex,
    keypoints_from_table,
    keypoints_table,
    read_ego,
    read_frames_table,
    read_index,
    read_keypoints,
    read_table,
    table_of,
    write_ego,
    write_frames,
    write_index,
    write_keypoints,
    write_table,
)
from labeling.camera import Trajectory, prior_intrinsics
from labeling.ego_motion import EgoMotion, RoadView
from labeling.errors import DataError
from labeling.labels import Keypoints
from labeling.schemas import keypoint_schema
from labeling.timeline import RunFrames

SCHEMAS = ("car66", "car24", "lane24", "wholebody133", "coco17")


def some_labels(seed, count):
    rng = np.random.default_rng(seed)
    labels = []
    for _ in range(count):
        schema = keypoint_schema(SCHEMAS[int(rng.integers(len(SCHEMAS)))])
        points = rng.normal(300, 200, (schema.point_count, 3)).astype(np.float32)
        points[:, 2] = rng.random(schema.point_count) * (rng.random(schema.point_count) > 0.3)
        labels.append(
            Keypoints(
                frame=int(rng.integers(0, 500)), track_id=int(rng.integers(-1, 9)), category=schema.category,
                schema=schema.name, score=float(np.float32(rng.random())),
                box_xyxy=rng.normal(300, 200, 4).astype(np.float32), points=points,
                point_source=rng.integers(0, 4, schema.point_count).astype(np.int8),
            )
        )  # fmt: skip
    return labels


def same(first, second):
    plain = ("frame", "track_id", "category", "schema", "score")
    arrays = ("box_xyxy", "points", "point_source")
    return all(getattr(first, name) == getattr(second, name) for name in plain) and all(
        np.array_equal(getattr(first, name), getattr(second, name))
        and getattr(first, name).dtype == getattr(second, name).dtype
        for name in arrays
    )


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 40))
def test_labels_come_back_as_they_went(tmp_path_factory, seed, count):
    path = tmp_path_factory.mktemp("t") / "k.parquet"
    labels = some_labels(seed, count)
    write_keypoints(path, labels)
    assert all(same(a, b) for a, b in zip(labels, read_keypoints(path), strict=True))


def test_labels_are_stored_in_the_design_s_columns(tmp_path):
    write_keypoints(tmp_path / "k.parquet", some_labels(0, 5))
    schema = pq.read_schema(tmp_path / "k.parquet")
    assert schema.names == [
        "frame", "track_id", "category", "schema", "score", "box_xyxy", "keypoints", "point_source"
    ]  # fmt: skip
    assert schema.field("box_xyxy").type == pa.list_(pa.float32(), 4)
    assert schema.field("keypoints").type == pa.list_(pa.float32())


def test_a_slice_of_a_table_and_a_shift_of_frames(tmp_path):
    labels = some_labels(3, 20)
    table = keypoints_table(labels).slice(7, 6)
    found = keypoints_from_table(table, frame_offset=-4)
    assert [label.frame + 4 for label in found] == [label.frame for label in labels[7:13]]
    assert all(np.array_equal(a.points, b.points) for a, b in zip(found, labels[7:13], strict=True))
    joined = pa.concat_tables([keypoints_table(labels[:9]), keypoints_table(labels[9:])])
    assert all(same(a, b) for a, b in zip(labels, keypoints_from_table(joined), strict=True))


def test_the_same_rows_give_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        write_keypoints(tmp_path / name, some_labels(1, 30), metadata={"models": {"b": "2", "a": "1"}})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_video_index_comes_back(tmp_path):
    index = VideoIndex(
        times_s=np.array([0.0, 0.04, 0.08]), is_keyframe=np.array([True, False, False]), info={"width": 7}, sha256="ab"
    )
    write_index(tmp_path / "i.parquet", index)
    found = read_index(tmp_path / "i.parquet")
    assert np.array_equal(found.times_s, index.times_s) and np.array_equal(found.is_keyframe, index.is_keyframe)
    assert (found.info, found.sha256) == ({"width": 7}, "ab")


def test_a_run_s_frames_come_back(tmp_path):
    frames = RunFrames(
        frame=np.arange(48, 52, dtype=np.int32), source_time_s=np.array([2.0, 2.04, 2.04, 2.12]),
        duplicate=np.array([False, False, True, False]), hole=np.zeros(4, bool), cut=np.array([False] * 3 + [True]),
    )  # fmt: skip
    write_frames(tmp_path / "f.parquet", frames)
    found = read_frames_table(tmp_path / "f.parquet")
    for name in FRAMES_SCHEMA.names:
        assert np.array_equal(getattr(found, name), getattr(frames, name))
        assert getattr(found, name).dtype == getattr(frames, name).dtype


def test_a_trajectory_comes_back(tmp_path):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = [0, 0.5, 1.25]
    motion = EgoMotion(
        trajectory=Trajectory(timestamps_s=np.array([0.0, 0.04, 0.08]), cam_to_world=poses),
        mode=np.array(["moving", "moving", "held"]), confidence=np.array([1, 0.5, 0], np.float32),
        scale_source=np.array(["road", "held", "default"]), scale_sigma=np.array([0.1, 0.3, 1], np.float32),
        intrinsics=prior_intrinsics(96, 64), road=RoadView(height_m=1.5, pitch_rad=0.01, pitch_sigma_rad=np.inf),
    )  # fmt: skip
    write_ego(tmp_path / "e.parquet", motion, first_frame=48)
    found = read_ego(tmp_path / "e.parquet")
    assert found.frame.tolist() == [48, 49, 50]
    assert np.array_equal(found.trajectory.cam_to_world, poses)
    assert (found.mode, found.scale_source) == (["moving", "moving", "held"], ["road", "held", "default"])
    assert found.intrinsics == motion.intrinsics
    assert found.road["pitch_sigma_rad"] is None and found.road["height_m"] == 1.5


@pytest.mark.parametrize("broken", ["missing", "text", "columns"])
def test_a_broken_table_is_named(tmp_path, broken):
    path = tmp_path / "k.parquet"
    if broken == "text":
        path.write_text("no table")
    if broken == "columns":
        pq.write_table(pa.table({"frame": [1]}), path)
    with pytest.raises(DataError, match=r"k\.parquet"):
        read_table(path, KEYPOINTS_SCHEMA)


def rewritten(path, metadata):
    """As another tool writes it again: the same columns, other metadata."""
    pq.write_table(pq.read_table(path).replace_schema_metadata(metadata), path)


@pytest.mark.parametrize(
    ("metadata", "complaint"),
    [
        (None, "no info, sha256 in its metadata"),
        ({"info": "{}"}, "no sha256 in its metadata"),
        ({"info": "{}", "sha256": '"ab"', "tool": "spark"}, "metadata that is no JSON"),
        ({"info": "[" * 100_000, "sha256": '"ab"'}, "metadata that is no JSON"),
    ],
    ids=["none", "one lost", "foreign", "nested"],
)
def test_a_table_that_another_tool_rewrote_is_an_error(tmp_path, metadata, complaint):
    path = tmp_path / "i.parquet"
    write_index(path, VideoIndex(times_s=np.zeros(1), is_keyframe=np.ones(1, bool), info={}, sha256="ab"))
    rewritten(path, metadata)
    with pytest.raises(DataError, match=f"i.parquet: has {complaint}.*; remove it and run again"):
        read_index(path)


def test_a_trajectory_without_its_camera_is_an_error(tmp_path):
    path = tmp_path / "e.parquet"
    pq.write_table(EGO_SCHEMA.empty_table(), path)
    for metadata, complaint in (
        (None, "no intrinsics, road"),
        ({"intrinsics": "{}", "road": "{}"}, "other intrinsics"),
    ):
        rewritten(path, metadata)
        with pytest.raises(DataError, match=f"has {complaint}"):
            read_ego(path)


def test_texts_that_are_no_texts_any_more_are_found_when_they_are_read(tmp_path):
    path = tmp_path / "s.parquet"
    write_table(path, table_of(SHARD_INDEX_SCHEMA, [{"key": "vvvvvvvv_0"}]))
    path.write_bytes(path.read_bytes().replace(b"vvvvvvvv_0", b"\xff\xfe\xfdvvvvv_0"))
    with pytest.raises(DataError, match="s.parquet: cannot be read as a table.*; remove it and run again"):
        read_table(path, SHARD_INDEX_SCHEMA)
