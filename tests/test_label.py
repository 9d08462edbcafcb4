"""The main job on small videos: what is made, what is redone, and what a bad video does to the others."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from pipeline_fixtures import CLIP, HEIGHT, WIDTH, run_all, small_config, tree, write_detector, write_street
from video_fixtures import cut_off, write_audio_only

from dataset.contact_sheet import TILE, contact_sheet
from dataset.inspection import summarize
from dataset.loader import ShardDataset
from dataset.receipts import ReceiptLog, read_receipts
from dataset.selection import read_selection
from dataset.tables import read_keypoints
from labeling.camera import check_poses
from labeling.errors import ConfigError, StorageError
from labeling.model_cards import load_cards, write_card
from labeling.timeline import clip_key
from pipelines.job import Job, open_job, open_or_create
from pipelines.label import sweep_outdated
from pipelines.nothing_left import why_nothing_is_left
from pipelines.sources import Source, find_videos
from pipelines.stage import NotReadyError, Part, parse_part
from pipelines.stages_source import CutStage

KEEP_ALL = {"select": {"keep_share": 1.0}}


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("videos")
    for number, (name, level) in enumerate({"dim": 70, "day": 130, "glare": 180}.items()):
        write_street(folder / f"{name}.mp4", level=level, seed=number)
    return folder


@pytest.fixture(scope="module")
def short_video(tmp_path_factory):
    path = write_street(tmp_path_factory.mktemp("short") / "short.mp4", frames=24)
    return Source(video_id="short", path=path)


@pytest.fixture(scope="module")
def detector(tmp_path_factory):
    return write_detector(tmp_path_factory.mktemp("models"))


def make_job(root, folder, detector=None, **changes):
    sources = find_videos([folder])
    return Job(root, small_config(**changes), {s.video_id: s for s in sources}, models_dir=detector)


@pytest.fixture(scope="module")
def counted(tmp_path_factory, videos, detector):
    """A finished job of three videos, half of the clips kept."""
    job = make_job(tmp_path_factory.mktemp("jobs") / "J", videos, detector, pack={"shard_bytes": 60_000})
    run_all(job)
    return job


def test_the_clips_with_the_most_objects_are_kept_and_packed(counted):
    selection = read_selection(counted.root / "selection.parquet")
    objects = {
        video: {r.objects or 0.0 for r in selection.rows if r.video_id == video} for video in ("dim", "day", "glare")
    }
    assert max(objects["dim"]) < min(objects["day"]) < min(objects["glare"])
    assert {row.video_id for row in selection.rows if not row.kept} >= {"dim"}
    packed = [key for split in ("train", "val") for key in ShardDataset(counted.root, split).keys]
    assert sorted(packed) == sorted(row.key for row in selection.kept)


def test_a_sample_holds_what_the_contract_says(counted):
    sample = next(one for one in ShardDataset(counted.root, "train") if one.meta["start"] > 0)
    assert sample.frames("rgb.mp4").shape == (CLIP, HEIGHT, WIDTH, 3)
    for suffix in ("skeleton.mp4", "ego.mp4", "objects.mp4"):
        assert sample.frames(suffix).shape == (CLIP, HEIGHT, WIDTH, 3)
    poses = sample.cam_to_world
    check_poses(poses)
    assert poses.shape == (CLIP, 4, 4) and np.allclose(poses[0], np.eye(4))
    assert {label.frame for label in sample.keypoints()} == set(range(CLIP))
    assert sample.caption and sample.meta["key"] == sample.key
    assert sample.meta["end"] - sample.meta["start"] == CLIP


def test_a_clip_shows_the_frames_of_its_run_bit_for_bit(counted):
    from labeling.video import read_frames

    sample = next(iter(ShardDataset(counted.root, "train")))
    cut = read_receipts(counted.root, "cut")
    run = next(r for name, r in cut.items() if name.startswith(sample.meta["video_id"]))
    start = sample.meta["start"] - int(run.item.rsplit("_", 2)[1])
    whole = np.stack(list(read_frames(counted.root / run.output(".mp4").path, start=start, end=start + CLIP)))
    assert np.array_equal(sample.frames("rgb.mp4"), whole)


def test_a_finished_job_has_nothing_left_to_do(counted):
    made, reports = run_all(open_job(counted.root))
    assert made == []
    assert not [r for report in reports for r in report.failed]


def test_where_items_failed_that_is_why_nothing_is_packed(tmp_path, counted):
    """What the selection dropped is no reason while other clips were kept; want of storage is told before all else."""
    root = tmp_path / "J"
    shutil.copytree(counted.root, root)
    assert "no clip is left of" in why_nothing_is_left(root)
    first, second, *_ = read_receipts(root, "pack").values()
    for held, reason, message in ((first, "data", "is broken"), (second, "storage", "no space left on device")):
        failed = replace(held, state="failed", reason=reason, message=message, turn=held.turn + 1, outputs=())
        ReceiptLog(root, "pack").append(failed)
    told = f"no clip is packed: pack of {second.item} failed: no space left on device (2 items failed in all)"
    assert why_nothing_is_left(root) == told


def test_a_stage_that_could_write_nothing_ends_the_command(tmp_path, short_video, monkeypatch):
    def full(*_):
        raise StorageError("run.mp4: file too large; raise the file-size limit")

    monkeypatch.setattr(CutStage, "work", full)
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {"short": short_video})
    with pytest.raises(StorageError, match=r"file-size limit \(cut could write nothing\)"):
        run_all(job)
    assert not read_receipts(job.root, "pack")


def test_worker_processes_make_the_same_bytes(tmp_path, videos, detector, counted):
    job = make_job(tmp_path / "J", videos, detector, pack={"shard_bytes": 60_000})
    run_all(job, workers=2)
    assert tree(job.root) == tree(counted.root)
    for stage in ("index", "cut", "render", "pack"):
        mine, other = read_receipts(job.root, stage), read_receipts(counted.root, stage)
        assert [r.key for r in mine.values()] == [r.key for r in other.values()]
        assert [r.outputs for r in mine.values()] == [r.outputs for r in other.values()]


def test_two_parts_make_what_one_makes(tmp_path, videos, detector, counted):
    root = tmp_path / "J"
    jobs = [make_job(root, videos, detector, pack={"shard_bytes": 60_000}) for _ in range(2)]
    parts = [Part(index=1, count=2), Part(index=2, count=2)]
    assert {part.owns(name) for part in parts for name in jobs[0].sources} == {True, False}
    with pytest.raises(NotReadyError, match="of 3 videos are not counted yet"):
        run_all(jobs[0], part=parts[0])
    with pytest.raises(NotReadyError, match="are not labelled yet"):
        run_all(jobs[1], part=parts[1])
    with pytest.raises(NotReadyError, match="are not packed yet"):
        run_all(jobs[0], part=parts[0])
    run_all(jobs[1], part=parts[1])
    assert tree(root) == tree(counted.root)


@pytest.mark.parametrize(
    ("changes", "first", "later"),
    [
        ({"views": {"object_variant": 1}}, "render", set()),
        ({"ego": {"camera_height_m": 1.2}}, "camera", {"ego", "render"}),
        ({"ego": {"motion": {"smoothing_lag": 2}}}, "ego", {"camera", "render"}),
        ({"cameras": {"short": {"fx": 90.0}}}, "camera", {"ego", "render"}),
        ({"pack": {"videos": "rgb"}}, "render", set()),
        ({"views": {"skeleton_encoder": {"gop": 2}}}, "skeleton", set()),
        ({"encoder": {"crf": 30}}, "cut", {"keypoints", "corners", "camera", "ego", "skeleton", "render"}),
    ],
    ids=["object variant", "camera height", "smoothing", "one video's camera", "videos", "skeleton encoder", "encoder"],
)
def test_a_changed_setting_redoes_only_what_depends_on_it(tmp_path, short_video, changes, first, later):
    sources = {"short": short_video}
    run_all(Job(tmp_path / "J", small_config(**KEEP_ALL), sources))
    made, _ = run_all(Job(tmp_path / "J", small_config(**KEEP_ALL, **changes), sources))
    stages = {stage for stage, _ in made}
    # Where a stage gives the same bytes as before (no labels, no skeletons), nothing after it is redone.
    assert first in stages and stages <= {first, *later, "pack", "shards"}
    fresh = Job(tmp_path / "F", small_config(**KEEP_ALL, **changes), sources)
    run_all(fresh)
    views = ("skeleton.mp4", "ego.mp4", "objects.mp4")
    left = {name: data for name, data in tree(tmp_path / "J").items() if "shards/" in name or not name.endswith(views)}
    assert left == {name: data for name, data in tree(fresh.root).items() if name in left}


def test_a_changed_card_is_another_model(tmp_path, short_video):
    """Its thresholds make labels as its weights do; its notes do not."""
    models = write_detector(tmp_path / "models")
    sources = {"short": short_video}

    def made_with(**changes):
        card = load_cards(models)["counter"]
        write_card(card.model_copy(update=changes), models / "counter.toml")
        made, _ = run_all(Job(tmp_path / "J", small_config(), sources, models_dir=models))
        return {stage for stage, _ in made}

    assert {"count", "keypoints"} <= made_with()
    assert made_with(notes="measured anew") == set()
    assert {"count", "keypoints"} <= made_with(max_detections=1)
    labels = (tmp_path / "J" / "videos" / "short").glob("*.keypoints.parquet")
    assert all(len({label.track_id for label in read_keypoints(path)}) <= 1 for path in labels)


def test_a_video_added_to_a_finished_job_redoes_nothing_else(tmp_path, videos, detector):
    root = tmp_path / "J"
    sources = {s.video_id: s for s in find_videos([videos])}
    first = Job(
        root, small_config(pack={"shard_bytes": 60_000}), {k: sources[k] for k in ("day", "dim")}, models_dir=detector
    )
    run_all(first)
    before = tree(root)
    threshold = read_selection(root / "selection.parquet").threshold
    made, _ = run_all(open_or_create(root, videos=[sources["glare"]]))
    assert {item.split("/")[0].split("_")[0] for stage, item in made if stage not in ("select", "pack", "shards")} == {
        "glare"
    }
    after = tree(root)
    changed = {name for name in before if before[name] != after.get(name)}
    assert changed == {"selection.parquet", "shards/index.parquet"}
    assert read_selection(root / "selection.parquet").threshold == threshold


def test_a_changed_source_is_labelled_again_and_a_touched_one_is_not(tmp_path):
    path = write_street(tmp_path / "v" / "a.mp4", frames=24)
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {"a": Source(video_id="a", path=path)})
    run_all(job)
    path.touch()
    assert {stage for stage, _ in run_all(job)[0]} == {"source"}
    write_street(path, frames=32, seed=5)
    assert {"index", "select", "cut", "pack"} <= {stage for stage, _ in run_all(job)[0]}


def test_what_was_made_from_a_source_outlives_it(tmp_path):
    path = write_street(tmp_path / "v" / "a.mp4", frames=24)
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {"a": Source(video_id="a", path=path)})
    run_all(job)
    path.unlink()
    made, reports = run_all(job)
    assert made == [] and not [r for report in reports for r in report.failed]


def test_a_deleted_output_is_made_again(tmp_path, short_video):
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {"short": short_video})
    run_all(job)
    before = tree(job.root)
    run = next(name for name in before if name.endswith(".mp4") and "run_" in name)
    (job.root / run).unlink()
    assert {stage for stage, _ in run_all(job)[0]} <= {"cut", "skeleton"}
    assert tree(job.root) == before


def test_files_without_a_receipt_are_not_done(tmp_path, short_video):
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {"short": short_video})
    run_all(job)
    before = tree(job.root)
    for log in (job.root / "receipts" / "ego").iterdir():
        log.unlink()
    assert {stage for stage, _ in run_all(job)[0]} == {"ego"}
    assert tree(job.root) == before


def test_one_bad_video_never_stops_the_others(tmp_path, videos):
    folder = tmp_path / "v"
    folder.mkdir()
    good = folder / "good.mp4"
    good.write_bytes((videos / "day.mp4").read_bytes())
    (folder / "text.mp4").write_text("this is no video\n" * 50)
    (folder / "empty.mp4").write_bytes(b"")
    cut_off(good, folder / "truncated.mp4", share=0.4)
    write_audio_only(folder / "audio.mp4")
    write_street(folder / "short.mp4", frames=5)
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {s.video_id: s for s in find_videos([folder])})
    job.sources["gone"] = Source(video_id="gone", path=folder / "gone.mp4")
    _, reports = run_all(job)
    failed = {receipt.item: receipt for report in reports for receipt in report.failed}
    assert {"text", "empty", "audio", "gone"} <= set(failed) and "good" not in failed
    assert all(receipt.reason == "video" and str(folder / name) in receipt.message for name, receipt in failed.items())
    selection = read_selection(job.root / "selection.parquet")
    assert any(row.video_id == "good" and row.kept for row in selection.rows)
    assert [row.reason for row in selection.rows if row.video_id == "short"] == ["too_short: frames=5 < clip_frames=9"]
    assert {sample.meta["video_id"] for sample in ShardDataset(job.root)} >= {"good"}
    summary = summarize(job.root)
    assert summary.failed and summary.dropped["too_short"] == 1


def test_clips_with_a_hard_cut_are_dropped_with_that_reason(tmp_path):
    from labeling.encoding import EncoderSettings, VideoWriter
    from labeling.video import read_frames

    shots = [write_street(tmp_path / f"{n}.mp4", frames=24, seed=n, level=60 + 100 * n) for n in range(2)]
    path = tmp_path / "v" / "two.mp4"
    path.parent.mkdir()
    with VideoWriter(path, width=WIDTH, height=HEIGHT, settings=EncoderSettings(gop=12)) as writer:
        for shot in shots:
            for frame in read_frames(shot):
                writer.write(frame)
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {"two": Source(video_id="two", path=path)})
    run_all(job)
    rendered = read_receipts(job.root, "render")
    dropped = {key: receipt.reason for key, receipt in rendered.items() if receipt.state == "dropped"}
    assert dropped == {clip_key("two", 16): "cut=1 first at 1.000 s"}
    assert clip_key("two", 16) not in ShardDataset(job.root).keys
    assert summarize(job.root).dropped == {"cut": 1}


def test_files_of_clips_no_longer_kept_are_swept_once_all_is_settled(tmp_path, videos, detector):
    root = tmp_path / "J"
    everything = make_job(root, videos, detector, **KEEP_ALL)
    run_all(everything)
    kept_all = tree(root)
    half = make_job(root, videos, detector)
    run_all(half)
    removed = sweep_outdated(half)
    assert removed and all("dim" in path.parts for path in removed if path.name.startswith("run_"))
    run_all(make_job(root, videos, detector, **KEEP_ALL))
    assert {name: data for name, data in tree(root).items() if "counts" not in name and "selection" not in name} == {
        name: data for name, data in kept_all.items() if "selection" not in name
    }


def test_left_out_seconds_keep_clips_away_from_both_ends(tmp_path, videos):
    source = Source(video_id="day", path=videos / "day.mp4", leave_out_s=(0.5, 0.5))
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {"day": source})
    run_all(job)
    rows = read_selection(job.root / "selection.parquet").rows
    assert [row.start for row in rows if row.kept] == [16, 24]
    assert all((row.reason or "").startswith("left_out") for row in rows if not row.kept)


def test_without_a_detector_clips_cannot_be_ranked(tmp_path, videos, monkeypatch):
    monkeypatch.setenv("ANIMATIC_MODELS", str(tmp_path / "none"))
    job = make_job(tmp_path / "J", videos)
    with pytest.raises(ConfigError, match="keep-share 1` keeps every clip"):
        run_all(job)


def test_the_sheet_of_a_packed_clip_shows_its_four_videos(counted):
    sample = ShardDataset(counted.root)[0]
    sheet = contact_sheet(sample)
    width, height = TILE
    assert sheet.dtype == np.uint8 and sheet.shape[1] > 4 * width and sheet.shape[0] > 4 * height
    rgb = cv2.resize(sample.frames("rgb.mp4")[0], TILE, interpolation=cv2.INTER_NEAREST)
    top, left = sheet.shape[0] - 4 * (height + 6) - 6, sheet.shape[1] - 4 * (width + 6) - 6
    assert np.array_equal(sheet[top : top + height, left : left + width], rgb)


def test_parts_are_read_strictly():
    assert parse_part("2/3") == Part(index=2, count=3)
    for text in ("0/3", "4/3", "a/b", "3", "1/0", "1/2/3"):
        with pytest.raises(ConfigError, match="give i/n"):
            parse_part(text)


def test_receipts_are_one_json_object_a_line(counted):
    lines = [line for log in (counted.root / "receipts").glob("*/*.jsonl") for line in log.read_text().splitlines()]
    fields = {"stage", "item", "state", "inputs", "settings", "models", "outputs", "seconds"}
    assert lines and all(fields <= set(json.loads(line)) for line in lines)
