"""Keypoints as COCO JSON: against the tables that they come from, and against a case counted by hand."""

import json

import cv2
import numpy as np
import pytest
from pipeline_fixtures import HEIGHT, WIDTH, run_all, small_config, write_detector, write_street
from skeleton_fixtures import busy_street, car, label

from dataset.layout import run_path
from dataset.receipts import atomic_write
from dataset.tables import read_keypoints, write_keypoints
from labeling.errors import ConfigError, DataError
from labeling.schemas import keypoint_schema
from labeling.timeline import Span
from pipelines.export_coco import COCO_IDS, CocoRun, coco_annotation, coco_category, coco_chunks, export_coco
from pipelines.job import Job
from pipelines.sources import find_videos


def a_run(number, *, start=0, frames=(), first_image=1):
    return CocoRun(
        number=number, video_id=f"v{number}", run=Span(start=start, end=start + 48), frames=frames,
        first_image=first_image,
    )  # fmt: skip


def written(runs, labels):
    chunks = coco_chunks(runs, lambda run: labels[run.number], width=1056, height=704, split="train")
    return json.loads(b"".join(chunks))


def test_a_person_counted_by_hand():
    points = np.zeros((17, 3))
    points[0], points[5], points[16] = (100.126, 40.5, 0.9), (90, 60, 0.29), (101, 160, 0.3)
    found = coco_annotation(label("person", "coco17", points, track_id=7), number=3, image=12)
    assert (found["id"], found["image_id"], found["category_id"], found["track_id"]) == (3, 12, 1, 7)
    assert found["bbox"] == [90.0, 40.5, 11.0, 119.5] and found["area"] == 1314.5
    assert found["keypoints"][:3] == [100.13, 40.5, 2], "seen"
    assert found["keypoints"][15:18] == [90.0, 60.0, 1], "labelled, and hidden"
    assert found["keypoints"][3:6] == [0, 0, 0], "absent"
    assert found["keypoints"][48:] == [101.0, 160.0, 2]
    assert found["num_keypoints"] == 3 and found["score"] == 0.9 and found["iscrowd"] == 0
    assert found["keypoint_scores"][5] == 0.29 and found["keypoint_sources"][:2] == [1, 0]


@pytest.mark.parametrize("schema", COCO_IDS)
def test_a_category_names_its_points_and_edges_from_one(schema):
    found, table = coco_category(schema), keypoint_schema(schema)
    assert found["name"] == table.category and found["keypoints"] == list(table.point_names)
    edges = np.array(found["skeleton"])
    assert edges.min() >= 1 and edges.max() <= table.point_count
    assert np.array_equal(edges - 1, table.edges)


def test_ids_are_unique_and_every_schema_has_one():
    from labeling.schemas import _CATEGORY_OF

    assert set(COCO_IDS) == set(_CATEGORY_OF) and len(set(COCO_IDS.values())) == len(COCO_IDS)


def test_annotations_say_what_the_tables_say(tmp_path):
    labels = [*busy_street(cars=3, people=2), car(frame=4, schema="car24", track_id=50)]
    write_keypoints(tmp_path / "k.parquet", labels)
    tables = {1: read_keypoints(tmp_path / "k.parquet"), 2: [car(frame=1000, track_id=1)]}
    runs = [a_run(1, frames=(0, 2, 4)), a_run(2, start=990, frames=(1000,), first_image=4)]
    found = written(runs, tables)
    categories = {category["id"]: category for category in found["categories"]}
    images = {image["id"]: image for image in found["images"]}
    assert list(images) == [1, 2, 3, 4] and images[4]["file_name"].startswith("images/v2/run_")
    assert (images[4]["video_id"], images[4]["frame_id"], images[4]["source_frame"]) == (2, 10, 1000)
    assert [one["id"] for one in found["annotations"]] == list(range(1, len(labels) + 2))
    for given, one in zip([*tables[1], *tables[2]], found["annotations"], strict=True):
        category = categories[one["category_id"]]
        assert (category["name"], category["schema"]) == (given.category, given.schema)
        assert images[one["image_id"]]["source_frame"] == given.frame and one["track_id"] == given.track_id
        points = np.array(one["keypoints"], np.float64).reshape(-1, 3)
        seen = given.points[:, 2] > 0
        assert np.abs(points[seen, :2] - given.points[seen, :2]).max() <= 0.0051
        assert np.array_equal(points[:, 2] > 0, seen) and one["num_keypoints"] == seen.sum()
        assert np.allclose(one["keypoint_scores"], given.points[:, 2], atol=5.1e-5)
        left, top, width, height = one["bbox"]
        assert np.allclose([left, top, left + width, top + height], given.box_xyxy, atol=0.011)
        assert one["keypoint_sources"] == given.point_source.tolist()


def test_labels_of_frames_that_no_clip_shows_are_left_out():
    found = written([a_run(1, frames=(2, 3))], {1: [car(frame=frame) for frame in (1, 2, 9)]})
    assert [one["image_id"] for one in found["annotations"]] == [1] and len(found["images"]) == 2


def test_frames_without_objects_stay_images():
    found = written([a_run(1, frames=(5, 6))], {1: []})
    assert len(found["images"]) == 2 and found["annotations"] == [] and found["categories"] == []


def test_one_run_is_read_at_a_time():
    asked = []
    runs = [a_run(number, frames=(0,), first_image=number) for number in (1, 2, 3)]
    chunks = coco_chunks(
        runs, lambda run: asked.append(run.number) or [car(), car(track_id=1)], width=64, height=64, split="val"
    )
    seen = []
    for chunk in chunks:
        if b'"bbox"' in chunk:
            seen.append(len(asked))
    assert seen == [1, 1, 2, 2, 3, 3]


def test_a_file_that_breaks_half_way_is_not_left_behind(tmp_path):
    def pieces():
        yield b"half"
        raise DataError("a table that cannot be read")

    with pytest.raises(DataError):
        atomic_write(tmp_path / "train.coco.json", pieces())
    assert list(tmp_path.iterdir()) == []


def test_a_job_is_exported_with_its_frames(tmp_path):
    write_street(tmp_path / "street.mp4", frames=24, level=130)
    models = write_detector(tmp_path / "models")
    write_street(tmp_path / "other.mp4", frames=9, level=130, seed=1)
    sources = find_videos([tmp_path / "street.mp4", tmp_path / "other.mp4"])
    config = small_config(select={"keep_share": 1.0, "split": {"street": "train", "other": "val"}})
    job = Job(tmp_path / "J", config, {source.video_id: source for source in sources}, models_dir=models)
    run_all(job)
    assert export_coco(job.root, tmp_path / "out", images=True, split="train") == 0
    assert not (tmp_path / "out" / "val.coco.json").exists()
    found = json.loads((tmp_path / "out" / "train.coco.json").read_text())
    # Clips of 9 frames, one each 8, share frames: each is one image.
    assert [image["source_frame"] for image in found["images"]] == list(range(17))
    table = read_keypoints(job.root / run_path("street", Span(start=0, end=17), ".keypoints.parquet"))
    assert [one["track_id"] for one in found["annotations"]] == [one.track_id for one in table]
    assert found["annotations"] and {one["num_keypoints"] for one in found["annotations"]} == {0}, "boxes alone"
    for image in found["images"]:
        picture = cv2.imread(str(tmp_path / "out" / image["file_name"]))
        assert picture is not None and picture.shape == (image["height"], image["width"], 3) == (HEIGHT, WIDTH, 3)
    before = (tmp_path / "out" / "train.coco.json").read_bytes()
    export_coco(job.root, tmp_path / "again")
    assert (tmp_path / "again" / "train.coco.json").read_bytes() == before
    assert not (tmp_path / "again" / "images").exists()
    val = json.loads((tmp_path / "again" / "val.coco.json").read_text())
    assert [video["name"] for video in val["videos"]] == ["other/run_0_9"], "without a word both splits are written"
    with pytest.raises(ConfigError, match="choose train or val"):
        export_coco(job.root, tmp_path / "out", split="test")
    with pytest.raises(ConfigError, match=r"holds no job\.yaml"):
        export_coco(tmp_path, tmp_path / "out")
