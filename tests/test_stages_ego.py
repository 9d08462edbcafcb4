"""The stages of ego-motion: one camera a video, where it came from, and input that shows nothing or cannot be."""

import json
import math
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from ego_fixtures import HEIGHT, WIDTH, driven, tracks_of
from pipeline_fixtures import HEIGHT as SMALL_HEIGHT
from pipeline_fixtures import WIDTH as SMALL_WIDTH
from pipeline_fixtures import run_all, small_config, write_street

from dataset.cameras import read_camera, write_camera
from dataset.loader import ShardDataset
from dataset.receipts import read_receipts
from dataset.tables import EGO_SCHEMA, VideoIndex, read_ego, read_table, write_index
from labeling.camera import Intrinsics, metadata_intrinsics, prior_intrinsics
from labeling.ego_calibration import KnownMounting, calibrate_camera, known_camera
from labeling.ego_tracks import RunTracks, StoredTracks
from labeling.encoding import EncoderSettings, VideoWriter
from labeling.errors import ConfigError, DataError, TrajectoryError
from labeling.video import probe
from pipelines.commands import JobOptions, configured
from pipelines.config import CameraSettings, Config, parse_config, video_camera
from pipelines.given_tables import CAMERA_COLUMNS, read_cameras, read_split
from pipelines.job import Job
from pipelines.sources import Source
from pipelines.stage import WorkItem
from pipelines.stages_ego import CameraStage, source_intrinsics

KEEP_ALL = {"select": {"keep_share": 1.0}}


def turning(focal_px: float = 640.0, *, pitch_deg: float = 0.0, seed: int = 0) -> RunTracks:
    """A run that drives around a corner."""
    rates = np.zeros(60)
    rates[12:50] = 30.0
    poses = driven(np.full(60, 6.0), rates, pitch_deg=pitch_deg)
    return tracks_of(poses, focal_px=focal_px, noise_px=0.15, seed=seed)


def index_of(width: int, height: int, **info: object) -> VideoIndex:
    times = np.arange(3) / 24
    return VideoIndex(
        times_s=times, is_keyframe=times == 0, info={"width": width, "height": height, **info}, sha256="ab"
    )


def found_camera(root: Path, runs: list[RunTracks], *, camera: dict[str, float], **info: object):
    """What the stage makes of a video's runs."""
    (root / "videos" / "v").mkdir(parents=True, exist_ok=True)
    write_index(root / "videos" / "v" / "index.parquet", index_of(WIDTH, HEIGHT, **info))
    names = [f"videos/v/run_{number}.corners.npz" for number in range(len(runs))]
    for name, run in zip(names, runs, strict=True):
        run.save(root / name)
    item = WorkItem(
        stage="camera", name="v", owner="v", version=1, inputs={}, payload={"corners": names},
        settings={
            "ego": Config().ego.model_dump(mode="json"), "camera": CameraSettings(**camera).model_dump(mode="json"),
            "picture": {"width": WIDTH, "height": HEIGHT},
        },
    )  # fmt: skip
    facts = CameraStage().work(root, item, root)
    return read_camera(root / "camera.json"), facts


def test_one_camera_is_estimated_from_all_runs(tmp_path):
    camera, facts = found_camera(tmp_path, [turning(820, seed=1), turning(820, seed=2)], camera={})
    assert camera.intrinsics.source == "estimated" and camera.pitch_source == "estimated"
    assert camera.intrinsics.fx == pytest.approx(820, rel=0.06)
    assert 0 < camera.intrinsics.focal_sigma < 0.15
    assert (camera.height_source, camera.road.height_m, camera.height_sigma) == ("prior", 1.5, 0.15)
    assert facts["turns"] == camera.turns > 3


def test_what_is_given_is_kept_and_the_rest_estimated(tmp_path):
    runs = [turning(pitch_deg=2.0)]
    camera, _ = found_camera(tmp_path, runs, camera={"fx": 700.0, "height_m": 1.2})
    assert (camera.intrinsics.source, camera.intrinsics.fx, camera.intrinsics.fy) == ("given", 700, 700)
    assert (camera.height_source, camera.road.height_m) == ("given", 1.2)
    assert camera.pitch_source == "estimated" and camera.turns == 0
    tilted, _ = found_camera(tmp_path, runs, camera={"fx": 640.0, "pitch_deg": 3.0})
    assert tilted.pitch_source == "given" and math.degrees(tilted.road.pitch_rad) == pytest.approx(3)


def test_metadata_go_before_an_estimate_and_after_what_is_given(tmp_path):
    film = 24.0
    camera, _ = found_camera(tmp_path, [turning()], camera={}, focal_35mm=film)
    assert camera.intrinsics.source == "metadata"
    assert camera.intrinsics.fx == pytest.approx(film / math.hypot(36, 24) * math.hypot(WIDTH, HEIGHT))
    camera, _ = found_camera(tmp_path, [turning()], camera={"fx": 640.0}, focal_35mm=film)
    assert camera.intrinsics.source == "given"


def test_a_video_without_a_look_keeps_the_prior():
    camera = known_camera(prior_intrinsics(WIDTH, HEIGHT))
    assert (camera.intrinsics.source, camera.pitch_source, camera.pitch_rad) == ("prior", "prior", None)


def test_a_camera_comes_back(tmp_path):
    for camera in (
        calibrate_camera([turning()], intrinsics=prior_intrinsics(WIDTH, HEIGHT)),
        known_camera(prior_intrinsics(WIDTH, HEIGHT), KnownMounting(height_m=1.4, pitch_rad=0.02)),
        known_camera(prior_intrinsics(WIDTH, HEIGHT)),
    ):
        write_camera(tmp_path / "camera.json", camera)
        assert read_camera(tmp_path / "camera.json") == camera
        assert "NaN" not in (text := (tmp_path / "camera.json").read_text()) and "Infinity" not in text
    (tmp_path / "camera.json").write_text("{}")
    with pytest.raises(DataError, match="animatic ego"):
        read_camera(tmp_path / "camera.json")


def test_runs_are_read_one_at_a_time_and_windows_are_the_middle(tmp_path):
    run = turning()
    for name in "ab":
        run.save(tmp_path / f"{name}.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    stored = StoredTracks([tmp_path / "a.npz", tmp_path / "b.npz"])
    assert len(stored) == 2 and len(stored[1].frames) == len(run.frames) and len(stored[1:]) == 1
    middle = stored[0].middle(20)
    assert np.array_equal(middle.times_s, run.times_s[20:40])
    assert len(run.middle(1000).frames) == 60


def test_a_video_s_own_camera_goes_before_that_of_all_videos():
    config = parse_config(
        {"camera": {"fx": 800, "fy": 810, "height_m": 1.4}, "cameras": {"a": {"fx": 500}, "b": {"pitch_deg": 2}}}, "c"
    )
    a, b = video_camera(config, "a"), video_camera(config, "b")
    assert (a.fx, a.fy, a.height_m) == (500, None, 1.4)
    assert (b.fx, b.fy, b.pitch_deg, video_camera(config, "c").fx) == (800, 810, 2, 800)


def test_a_table_of_cameras(tmp_path):
    path = tmp_path / "cameras.csv"
    path.write_text("video_id,fx,height_m\na,700,\nb,,1.3\n")
    assert read_cameras(path) == {"a": {"fx": 700}, "b": {"height_m": 1.3}}
    with pytest.raises(ConfigError, match=r"^--cameras \S+none.csv: no such file; check the path$"):
        read_cameras(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("video_id,fx\na,1\nb,wide\n", r"line 3 \(video b\): fx is 'wide', but must be a number"),
        ("video,fx\na,1\n", "has no column video_id; its columns are video, fx; add it"),
        ("", "has no column video_id; its columns are none"),
        ("video_id,fx\na,1\nb,2\na,3\n", "line 4 names video a again; keep one of its lines"),
        ("video_id,fx\na,1,2\n", "line 2 does not fit the columns video_id, fx; mend the table"),
        ("fx,video_id\n1\n", "line 2 does not fit the columns fx, video_id; mend the table"),
        ("video_id,focal\na,1\n", "column 'focal' is not known; did you mean focal_sigma[?] choose from fx, fy, cx"),
        ('video_id,fx\n"a,1\nb,2\n', "cannot be read as a CSV table .*; mend the table"),
    ],
)
def test_a_faulty_table_of_cameras_says_where_and_what(tmp_path, text, message):
    path = tmp_path / "cameras.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_cameras(path)


def test_a_table_of_cameras_holds_what_settings_do():
    assert set(CAMERA_COLUMNS) == set(CameraSettings.model_fields)


@pytest.mark.parametrize("values", [{"camera": {"foc": 1}}, {"cameras": {"a": {"foc": 1}}}], ids=["all", "one"])
def test_a_setting_of_cameras_that_is_not_known_is_told_of_those_that_are(values):
    with pytest.raises(ConfigError, match="foc is not a setting; .*choose one of fx, fy, cx"):
        parse_config(values, "settings")


@pytest.mark.parametrize(
    ("option", "values", "message"),
    [
        ("keep_share", 2.0, "^--keep-share 2: select.keep_share is 2.0, but must be 1 or less"),
        ("videos", "some", "^--videos some: pack.videos is 'some', but must be 'all' or 'rgb'"),
        ("split", "video_id,split\na,test\n", "^--split .*t.csv: select.split.a is 'test', but must be 'train' or"),
        ("cameras", "video_id,fx\na,1e300\n", "^--cameras .*t.csv: cameras.a.fx is 1e[+]300, but must be 1e[+]06 or"),
        ("split", None, "^--split .*t.csv: no such file; check the path$"),
        ("cameras", None, "^--cameras .*t.csv: no such file; check the path$"),
    ],
)
def test_an_option_that_no_setting_allows_is_named_as_it_was_typed(tmp_path, option, values, message):
    path = tmp_path / "t.csv"
    if values is not None and option in ("split", "cameras"):
        path.write_text(values)
    value = path if option in ("split", "cameras") else values
    with pytest.raises(ConfigError, match=message):
        configured(small_config(), replace(JobOptions(), **{option: value}))


def test_a_table_of_splits_needs_its_column(tmp_path):
    path = tmp_path / "split.csv"
    path.write_text("video_id,part\na,val\n")
    with pytest.raises(ConfigError, match="has no column split; its columns are video_id, part"):
        read_split(path)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"fx": 0}, "camera.fx"),
        ({"fx": float("nan")}, "camera.fx"),
        ({"fx": float("inf")}, "camera.fx"),
        ({"fx": 700, "cx": 3}, "cx and cy go together"),
        ({"fy": 700}, "fy is given without fx"),
        ({"height_m": 0}, "camera.height_m"),
        ({"fx": 1e300}, "camera.fx"),
        ({"fx": 1e-300}, "camera.fx"),
        ({"fx": 700, "cx": 1e300, "cy": 3}, "camera.cx"),
        ({"height_m": 1e-300}, "camera.height_m"),
        ({"height_m": 1e300}, "camera.height_m"),
    ],
    ids=[
        "zero",
        "NaN",
        "infinite",
        "half a centre",
        "fy alone",
        "on the ground",
        "far off",
        "tiny",
        "centre far off",
        "in the ground",
        "in space",
    ],
)
def test_a_camera_that_cannot_be_is_refused(camera, message):
    with pytest.raises(ConfigError, match=message):
        parse_config({"camera": camera}, "settings")


@pytest.mark.parametrize("factor", [0.1, 10.0], ids=str)
@pytest.mark.parametrize("focal_px", [721.5, 1242.0, 900.0], ids=str)
def test_a_focal_length_off_by_ten_is_refused(focal_px, factor):
    with pytest.raises(TrajectoryError, match="0.2 to 5 times"):
        source_intrinsics(index_of(1242, 375), CameraSettings(fx=factor * focal_px))


def test_a_focal_length_off_by_ten_fails_that_video_alone(tmp_path):
    sources = {
        name: Source(video_id=name, path=write_street(tmp_path / f"{name}.mp4", frames=24, seed=seed))
        for seed, name in enumerate(("good", "wrong"))
    }
    job = Job(tmp_path / "J", small_config(**KEEP_ALL, cameras={"wrong": {"fx": 960.0}}), sources)
    _, reports = run_all(job)
    failed = [receipt for report in reports for receipt in report.failed]
    assert [(receipt.stage, receipt.item, receipt.reason) for receipt in failed] == [("camera", "wrong", "trajectory")]
    assert "fx=960" in failed[0].message and "give focal lengths in pixels" in failed[0].message
    assert {key.split("_")[0] for key in ShardDataset(job.root, "train").keys} == {"good"}


def test_what_was_used_is_stored_with_the_labels_and_the_sample(tmp_path):
    video = Source(video_id="v", path=write_street(tmp_path / "v.mp4", frames=24))
    config = small_config(**KEEP_ALL, cameras={"v": {"fx": 90.0, "height_m": 1.3, "focal_sigma": 0.02}})
    job = Job(tmp_path / "J", config, {"v": video})
    run_all(job)
    (table,) = (job.root / "videos" / "v").glob("run_*.ego.parquet")
    ego = read_ego(table)
    assert (ego.intrinsics.source, ego.intrinsics.fx, ego.intrinsics.focal_sigma) == ("given", 90, 0.02)
    assert (ego.road["height_m"], ego.road["height_source"], ego.road["height_sigma"]) == (1.3, "given", 0.01)
    assert (ego.scale_sigma >= 0.01).all()
    meta = ShardDataset(job.root, "train").sample("v_0").meta
    assert meta["intrinsics"]["source"] == "given"
    assert meta["ego"]["road"]["height_source"] == "given" and "pitch_source" in meta["ego"]["road"]


def write_black(path: Path, *, frames: int) -> Path:
    settings = EncoderSettings(gop=12, preset="ultrafast")
    with VideoWriter(path, width=SMALL_WIDTH, height=SMALL_HEIGHT, fps=24, settings=settings) as writer:
        for _ in range(frames):
            writer.write(np.zeros((SMALL_HEIGHT, SMALL_WIDTH, 3), np.uint8))
    return path


@pytest.mark.parametrize("clip_frames", [1, 2, 9], ids=lambda n: f"{n} frames")
@pytest.mark.parametrize("black", [True, False], ids=["black", "seen"])
def test_clips_of_nothing_have_numbers_all_the_same(tmp_path, clip_frames, black):
    make = write_black if black else write_street
    video = Source(video_id="v", path=make(tmp_path / "v.mp4", frames=clip_frames))
    job = Job(tmp_path / "J", small_config(**KEEP_ALL, clip={"clip_frames": clip_frames}), {"v": video})
    _, reports = run_all(job)
    assert not [receipt.message for report in reports for receipt in report.failed]
    (path,) = (job.root / "videos" / "v").glob("run_*.ego.parquet")
    table, _ = read_table(path, EGO_SCHEMA)
    assert table.num_rows == clip_frames
    for name in ("cam_to_world", "confidence", "scale_sigma", "time_s"):
        column = table[name].combine_chunks()
        values = np.asarray(column.flatten() if name == "cam_to_world" else column)
        assert np.isfinite(values).all(), name
    if black:
        assert np.asarray(table["confidence"]).max() == 0


def test_a_phone_s_focal_length_is_read_from_its_file(tmp_path):
    path = tmp_path / "phone.mp4"
    with av.open(str(path), "w", options={"movflags": "use_metadata_tags"}) as container:
        container.metadata["com.apple.quicktime.camera.focal_length.35mm_equivalent"] = "26"
        stream = container.add_stream("libx264", rate=24)
        stream.width, stream.height = 64, 48
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8))))
        container.mux(stream.encode())
    assert probe(path).focal_35mm == 26.0
    assert probe(write_street(tmp_path / "plain.mp4", frames=3)).focal_35mm is None
    camera = metadata_intrinsics(1920, 1080, focal_35mm=26.0)
    assert isinstance(camera, Intrinsics) and camera.fx == pytest.approx(1324, abs=2)


def test_a_video_is_calibrated_once_all_its_runs_are_there(tmp_path):
    video = Source(video_id="v", path=write_street(tmp_path / "v.mp4", frames=120))
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {"v": video})
    run_all(job)
    runs = read_receipts(job.root, "corners")
    assert len(runs) > 1
    (receipt,) = read_receipts(job.root, "camera").values()
    assert receipt.outputs[0].path == "videos/v/camera.json"
    for log in (job.root / "receipts" / "corners").iterdir():
        lines = log.read_text().splitlines(keepends=True)
        log.write_text("".join(lines[:-1]))
    job.refresh()
    assert job.plan("camera") == [] and job.plan("ego") == []
    before = json.loads((job.root / "videos" / "v" / "camera.json").read_text())
    # The corners come out as before, so nothing that rests on them is made again.
    assert {stage for stage, _ in run_all(job)[0]} == {"corners"}
    assert json.loads((job.root / "videos" / "v" / "camera.json").read_text()) == before
