"""Captions: what the template says of a clip, and the tables that texts are imported from."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation
from skeleton_fixtures import car, lane, person

from labeling.camera import Trajectory, rebased_trajectory, rigid
from labeling.captions import camera_motion, read_caption_table, template_caption
from labeling.errors import DataError

FRAMES = 121


def _drive(*, speed: float = 0.0, yaw_deg: float = 0.0, frames: int = FRAMES, jitter_m: float = 0.0) -> Trajectory:
    """An arc at a steady speed that turns by ``yaw_deg`` in all, to the right if positive."""
    times = np.arange(frames) / 24
    yaw = np.radians(np.linspace(0, yaw_deg, frames))
    steps = speed / 24 * np.column_stack([np.sin(yaw), np.zeros(frames), np.cos(yaw)])
    positions = np.concatenate([np.zeros((1, 3)), np.cumsum(steps[:-1], axis=0)])
    positions = positions + np.random.default_rng(0).normal(0, jitter_m, positions.shape)
    return rebased_trajectory(times, rigid(Rotation.from_euler("y", yaw[:, None]).as_matrix(), positions))


def _clip(*, cars: int = 0, people: int = 0, frames: range = range(FRAMES)) -> list:
    labels = [car(frame=f, track_id=i) for f in frames for i in range(cars)]
    return labels + [person(frame=f, track_id=50 + i, schema="coco17") for f in frames for i in range(people)]


def test_the_designs_example():
    caption = template_caption(_clip(cars=3, people=1), _drive(speed=13))
    assert caption == "A road with 3 cars and 1 person ahead; the camera drives forward at 13 m/s."


@pytest.mark.parametrize(
    "cars,people,scene",
    [
        (0, 0, "An empty road"),
        (1, 0, "A road with 1 car ahead"),
        (0, 2, "A road with 2 people ahead"),
        (2, 3, "A road with 2 cars and 3 people ahead"),
    ],
    ids=str,
)
def test_objects_are_counted(cars, people, scene):
    assert template_caption(_clip(cars=cars, people=people), _drive(speed=5)).startswith(scene + ";")


def test_an_object_counts_when_in_view_for_a_quarter_of_the_clip():
    brief, long = _clip(cars=1, frames=range(30)), _clip(cars=1, frames=range(31))
    assert template_caption(brief, _drive()).startswith("An empty road")
    assert template_caption(long, _drive()).startswith("A road with 1 car ")


def test_an_id_switch_adds_no_car_and_lanes_are_no_objects():
    labels = [car(frame=f, track_id=f) for f in range(FRAMES)] + [lane(frame=f) for f in range(FRAMES)]
    assert template_caption(labels, _drive()).startswith("A road with 1 car ahead")


@pytest.mark.parametrize(
    "drive,words",
    [
        ({"speed": 13}, "drives forward at 13 m/s"),
        ({"speed": 1.2}, "drives forward at 1.2 m/s"),
        ({"speed": 8, "yaw_deg": 60}, "drives forward at 8 m/s, turning right"),
        ({"speed": 8, "yaw_deg": -60}, "drives forward at 8 m/s, turning left"),
        ({"speed": 8, "yaw_deg": 4}, "drives forward at 8 m/s"),
        ({"speed": -3}, "reverses at 3 m/s"),
        ({}, "stands still"),
        ({"jitter_m": 0.02}, "stands still"),
        ({"yaw_deg": -90}, "turns left on the spot"),
        ({"speed": 6, "yaw_deg": 300}, "drives forward at 6 m/s, turning right"),
        ({"frames": 1}, ""),
    ],
    ids=str,
)
def test_the_cameras_motion_in_words(drive, words):
    assert camera_motion(_drive(**drive)) == words


@pytest.mark.parametrize(
    ("frames", "yaw_deg", "turns"), [(25, 4, False), (25, 6, True), (121, 14, False), (121, 16, True)]
)
def test_a_turn_is_5_degrees_and_3_degrees_a_second(frames, yaw_deg, turns):
    for sign, side in ((1, "right"), (-1, "left")):
        words = camera_motion(_drive(speed=8, yaw_deg=sign * yaw_deg, frames=frames))
        assert words == "drives forward at 8 m/s" + (f", turning {side}" if turns else "")


def test_without_a_trajectory_the_caption_is_silent_about_the_camera():
    assert template_caption(_clip(cars=2)) == "A road with 2 cars ahead."
    assert template_caption([]) == "An empty road."


# Tables

ROWS = [{"key": "a_0", "text": "A wet road, two lanes."}, {"key": "b_48", "text": 'A "quoted" sign;\nänd a newline'}]


def _write(path, rows=ROWS):
    if path.suffix == ".parquet":
        pq.write_table(pa.Table.from_pylist(rows), path)
    elif path.suffix == ".jsonl":
        path.write_text("\n".join(json.dumps(row) for row in rows) + "\n\n", encoding="utf-8")
    else:
        names = list(rows[0]) if rows else ["key", "text"]
        quoted = [",".join('"' + str(row[name]).replace('"', '""') + '"' for name in names) for row in rows]
        path.write_text("\n".join([",".join(names), *quoted]) + "\n", encoding="utf-8")
    return path


KINDS = ["captions.csv", "captions.parquet", "captions.jsonl", "CAPTIONS.CSV"]


@pytest.mark.parametrize("name", KINDS)
def test_tables_of_every_kind_give_the_same_texts(tmp_path, name):
    assert read_caption_table(_write(tmp_path / name)) == {row["key"]: row["text"] for row in ROWS}


@pytest.mark.parametrize("name", KINDS[:3])
@pytest.mark.parametrize(
    "rows,message",
    [
        ([{"key": "a_0", "caption": "x"}], "row 1 has no column 'text'"),
        ([ROWS[0], {"key": "", "text": "x"}], "row 2 has key '' and text 'x'"),
        ([ROWS[0], {"key": "c_0", "text": "  "}], "row 2 has key 'c_0'"),
        ([ROWS[0], ROWS[0]], "row 2 repeats the key 'a_0'"),
        ([ROWS[0], ROWS[0] | {"key": " a_0 "}], "row 2 repeats the key 'a_0'"),
        ([], "holds no captions"),
    ],
    ids=["column", "key", "text", "repeated", "repeated with spaces", "empty"],
)
def test_a_table_that_cannot_be_used_says_where(tmp_path, name, rows, message):
    with pytest.raises(DataError, match="captions") as caught:
        read_caption_table(_write(tmp_path / name, rows))
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "name,content",
    [
        ("c.parquet", b"not parquet"),
        ("c.jsonl", b'{"key": '),
        ("c.csv", b"\xff\xfe\x00"),
        ("c.xlsx", b""),
        ("d.csv", b""),
    ],
    ids=["parquet", "jsonl", "encoding", "kind", "zero bytes"],
)
def test_a_file_that_is_no_table_is_a_clear_error(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(DataError, match=name):
        read_caption_table(path)


def test_a_missing_table_is_a_clear_error(tmp_path):
    for name in ("none.csv", "none.parquet", "none.jsonl"):
        with pytest.raises(DataError, match="check the path"):
            read_caption_table(tmp_path / name)


def test_json_lines_may_hold_any_text_and_begin_with_a_mark(tmp_path):
    """U+2028 and U+0085 end a line for Unicode, but not for JSON; editors on Windows put a mark before the first."""
    text = "a road\u2028with cars\u0085and people"
    row = json.dumps({"key": "a_0", "text": text}, ensure_ascii=False)
    (tmp_path / "c.jsonl").write_text(f"\ufeff{row}\r\n\r\n", encoding="utf-8", newline="")
    assert read_caption_table(tmp_path / "c.jsonl") == {"a_0": text}


@pytest.mark.parametrize("line", ['["a_0", "text"]', '{"key": 5, "text": "x"}', "3"])
def test_lines_that_are_no_key_and_text_are_refused(tmp_path, line):
    path = tmp_path / "c.jsonl"
    path.write_text(line, encoding="utf-8")
    with pytest.raises(DataError, match="row 1"):
        read_caption_table(path)


def test_lists_in_lists_without_end_are_refused(tmp_path):
    path = tmp_path / "c.jsonl"
    path.write_text('{"key": "a_0", "text": ' + "[" * 100_000, encoding="utf-8")
    with pytest.raises(DataError, match="cannot be read as a caption table"):
        read_caption_table(path)


@pytest.mark.parametrize(
    ("name", "character"),
    [*((name, character) for name in KINDS[:3] for character in "\x1b\0\x9b"), ("captions.jsonl", "\ud800")],
    ids=ascii,
)
def test_what_a_terminal_obeys_and_what_is_no_character_is_refused(tmp_path, name, character):
    path = _write(tmp_path / name, [ROWS[0], {"key": "b_48", "text": f"A {character}[31mred car"}])
    with pytest.raises(DataError, match="row 2 holds the control character .*; take it out"):
        read_caption_table(path)
    path = _write(tmp_path / name, [{"key": f"a{character}_0", "text": "A red car\twith\nlines"}])
    with pytest.raises(DataError, match="row 1 holds the control character"):
        read_caption_table(path)
