"""The plan against the truth of the job that then runs: clips and bytes here, hours in a benchmark."""

import json
import shutil
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from pipeline_fixtures import SMALL, run_all, small_config, write_detector, write_street
from video_fixtures import write_source

from dataset.receipts import Receipt
from dataset.selection import read_selection, twin_holders
from labeling.ego_calibration import ROAD_FRAMES
from labeling.errors import ConfigError
from labeling.timeline import ClipSettings, plan_clips, plan_timeline
from pipelines.commands import JobOptions
from pipelines.job import Job
from pipelines.plan import _Measured, _scaled, count_candidates, plan_job
from pipelines.plan_console import hours, show_plan, size
from pipelines.sources import Source, find_videos, likely_twins
from pipelines.trial_windows import SourceClips, plan_windows


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("videos")
    for seed in range(3):
        write_street(folder / f"v{seed}.mp4", frames=96, level=80 + 40 * seed, seed=seed)
    return folder


@pytest.fixture(scope="module")
def options(tmp_path_factory: pytest.TempPathFactory) -> JobOptions:
    folder = tmp_path_factory.mktemp("settings")
    (folder / "small.yaml").write_text(yaml.safe_dump(SMALL))
    return JobOptions(config=folder / "small.yaml", models=write_detector(folder / "models"), keep_share=0.3)


def test_clips_and_bytes_are_within_thirty_percent(tmp_path: Path, videos: Path, options: JobOptions) -> None:
    plan = plan_job([videos], options, workers=1, calibration_s=6.0)
    sources = {source.video_id: source for source in find_videos([videos])}
    job = Job(tmp_path / "J", small_config(select={"keep_share": 0.3}), sources, models_dir=options.models)
    run_all(job)
    chosen = read_selection(job.root / "selection.parquet")
    assert plan.clips == len(chosen.rows)
    assert plan.kept_clips == pytest.approx(len(chosen.kept), rel=0.3)
    made = sum(path.stat().st_size for path in job.root.rglob("*") if path.is_file() and "receipts" not in path.parts)
    assert plan.disk_bytes == pytest.approx(made, rel=0.3)
    assert plan.core_hours > 0 and plan.hours_per_host == pytest.approx(plan.core_hours)


def test_twins_count_once_as_in_the_job(
    tmp_path: Path, videos: Path, options: JobOptions, capsys: pytest.CaptureFixture[str]
) -> None:
    once = plan_job([videos], options, workers=1, calibration_s=6.0)
    shutil.copytree(videos, tmp_path / "videos")
    shutil.copy(videos / "v1.mp4", tmp_path / "videos" / "v3.mp4")
    twice = plan_job([tmp_path / "videos"], options, workers=1, calibration_s=6.0)
    assert twice.twins == {"v3": "v1"} and (twice.videos, once.videos) == (4, 3)
    assert (twice.clips, twice.kept_clips) == (once.clips, once.kept_clips)
    job = Job(
        tmp_path / "J", small_config(select={"keep_share": 0.3}),
        {source.video_id: source for source in find_videos([tmp_path / "videos"])}, models_dir=options.models,
    )  # fmt: skip
    run_all(job, stages=("source", "index", "count", "select"))
    chosen = read_selection(job.root / "selection.parquet")
    assert twin_holders(chosen) == twice.twins
    assert twice.clips == len([row for row in chosen.rows if row.video_id not in twice.twins])
    assert show_plan([tmp_path / "videos"], options, parts=1, as_json=False) == 0
    assert "v3 is v1 again, byte for byte" in " ".join(capsys.readouterr().out.split())


def test_files_of_one_size_are_twins_where_they_agree(tmp_path: Path) -> None:
    data = np.random.default_rng(0).integers(0, 256, 20 << 20, np.uint8)
    others = {"a": data, "b": data, "c": data.copy(), "d": data[:-1]}
    others["c"][len(data) // 2 :] ^= 1
    sources = [Source(video_id=name, path=tmp_path / f"{name}.mp4") for name in reversed(others)]
    for name, content in others.items():
        (tmp_path / f"{name}.mp4").write_bytes(content.tobytes())
    assert likely_twins(sources) == {"b": "a"}


def test_parts_share_the_footage(videos: Path, options: JobOptions, capsys: pytest.CaptureFixture[str]) -> None:
    assert show_plan([videos], options, parts=2, as_json=True) == 0
    plan = json.loads(capsys.readouterr().out)
    assert 1 / 3 < plan["largest_part"] <= 1
    assert plan["hours_per_host"] == pytest.approx(plan["core_hours"] * plan["largest_part"] / plan["workers"])


def clips_of(length_s: float, source: Source) -> SourceClips:
    """A video without holes."""
    clip = ClipSettings()
    timeline = plan_timeline(np.arange(round(length_s * 24)) / 24)
    plan = plan_clips(timeline, clip_frames=clip.clip_frames, leave_out_s=source.leave_out_s)
    return SourceClips(frames=len(timeline), clips=plan.kept)


def windows_of(sources: list[Source], length_s: float, seconds: float) -> list[Source]:
    return plan_windows(sources, partial(clips_of, length_s), clip_frames=121, seconds=seconds)


def test_windows_lie_in_the_middle_and_add_up() -> None:
    sources = [Source(video_id=f"v{i}", path=Path(f"v{i}.mp4"), leave_out_s=(10.0, 0.0)) for i in range(5)]
    windows = windows_of(sources, 610.0, 60)
    assert len(windows) == 3
    for window in windows:
        start, end = window.leave_out_s
        assert abs((start - 10) - end) <= 2 * 48 / 24
    kept = [clips_of(610.0, window).clips for window in windows]
    assert [len(clips) for clips in kept] == [8, 8, 9]
    assert 60 - 48 / 24 < sum(clips[-1].end - clips[0].start for clips in kept) / 24 <= 60


def test_short_videos_give_all_they_have() -> None:
    sources = [Source(video_id=f"v{i}", path=Path(f"v{i}.mp4")) for i in range(20)]
    windows = windows_of(sources, 6.0, 60)
    assert len(windows) == 11 and all(len(clips_of(6.0, window).clips) == 1 for window in windows)


@pytest.mark.parametrize("seconds", [0, 1, 5.1, 8, 20, 1000])
@pytest.mark.parametrize("length_s", [5.1, 6.0, 8.3, 61.7])
def test_no_window_falls_between_the_clips(length_s: float, seconds: float) -> None:
    (window,) = windows_of([Source(video_id="v", path=Path("v.mp4"))], length_s, seconds)
    kept = clips_of(length_s, window).clips
    assert kept and (len(kept) == 1 or kept[-1].end - kept[0].start <= 24 * seconds)


@pytest.mark.parametrize(("frames", "left"), [(25, 25), (121, 121), (500, 121)])
def test_the_warm_up_is_the_beginning_of_a_clip(frames: int, left: int) -> None:
    source = Source(video_id="v", path=Path("v.mp4"))
    found = clips_of(61.7, source)
    (window,) = plan_windows([source], lambda _: found.cut_to(frames), clip_frames=left, seconds=0)
    timeline = plan_timeline(np.arange(found.frames) / 24)
    (kept,) = plan_clips(timeline, clip_frames=left, leave_out_s=window.leave_out_s).kept
    assert len(kept) == left and kept.start in {clip.start for clip in found.clips}


def test_videos_whose_middle_is_a_hole_are_measured_beside_it(
    tmp_path: Path, options: JobOptions, capsys: pytest.CaptureFixture[str]
) -> None:
    times = [Fraction(frame, 24) + (3 if frame >= 24 else 0) for frame in range(48)]
    write_source(tmp_path / "v.mp4", times)
    plan = plan_job([tmp_path], replace(options, keep_share=1.0), workers=1, calibration_s=0.5)
    assert (plan.clips, plan.calibration_clips, plan.calibration_videos) == (4, 1, 1)
    assert plan.disk_bytes > 0 and plan.calibration_s == pytest.approx(9 / 24)
    assert show_plan([tmp_path], replace(options, keep_share=1.0), parts=1, as_json=False) == 0
    assert "(4 clips of 1 video)" in capsys.readouterr().out


def test_videos_of_which_no_clip_is_whole_are_an_error(tmp_path: Path, options: JobOptions) -> None:
    write_source(tmp_path / "v.mp4", [Fraction(frame, 24) + frame // 6 for frame in range(48)])
    with pytest.raises(ConfigError, match="none of 1 videos holds a clip of 0.375 s without a hole"):
        plan_job([tmp_path], replace(options, keep_share=1.0), workers=1)


@pytest.mark.parametrize(("seconds", "clips"), [(4.9, 0), (5.0, 1), (6.9, 1), (7.0, 2), (3600, 1798)])
def test_candidates_fit_on_the_timeline(seconds: float, clips: int) -> None:
    assert count_candidates(seconds, ClipSettings()) == clips


def test_videos_too_short_for_a_clip_are_an_error(tmp_path: Path, options: JobOptions) -> None:
    write_street(tmp_path / "blink.mp4", frames=4)
    with pytest.raises(ConfigError, match="long enough"):
        plan_job([tmp_path / "blink.mp4"], options, workers=1)


def test_videos_shorter_than_a_clip_are_counted(
    tmp_path: Path, options: JobOptions, capsys: pytest.CaptureFixture[str]
) -> None:
    write_street(tmp_path / "long.mp4", frames=24)
    for number in range(2):
        write_street(tmp_path / f"blink{number}.mp4", frames=4, seed=number)
    assert show_plan([tmp_path], replace(options, keep_share=1.0), parts=1, as_json=False) == 0
    assert "2 of 3 videos are shorter than a clip (9 frames)" in capsys.readouterr().out


def test_a_card_that_is_not_there_is_named(tmp_path: Path, videos: Path) -> None:
    (tmp_path / "settings.yaml").write_text("count: {detector: nope}")
    with pytest.raises(ConfigError, match="no model card is called 'nope'"):
        plan_job([videos], JobOptions(config=tmp_path / "settings.yaml"), workers=1)


def test_readable_units() -> None:
    assert [hours(2.5), hours(0.5), hours(0.002)] == ["2.5 h", "30.0 min", "7.2 s"]
    assert [size(12), size(1.5e6), size(2.5e12)] == ["12 B", "1.5 MB", "2.5 TB"]


def test_a_camera_costs_no_more_than_the_frames_that_it_is_read_from() -> None:
    """Two hours of one video: everything made of runs grows with them, its camera only up to what is looked at."""

    def receipt(stage: str, **facts: object) -> dict[str, Receipt]:
        return {"v": Receipt(stage=stage, item="v", state="done", key="k", facts=dict(facts), seconds=10.0)}

    receipts = {
        "index": receipt("index", seconds=60.0), "count": receipt("count", clips=30),
        "select": receipt("select", kept=15), "cut": receipt("cut", frames=720), "ego": receipt("ego"),
        "camera": receipt("camera"),
    }  # fmt: skip
    measured = _Measured.of(receipts)
    assert (measured.camera_frames, measured.frames_per_clip) == (720, 48)
    costs = _scaled(receipts, measured, {"v": 7200.0}, candidates={"v": 3600}, counted=3600, sampled=1800)
    seconds = {cost.stage: cost.core_hours * 3600 for cost in costs}
    assert seconds["ego"] == pytest.approx(10 * 1800 / 15)
    assert seconds["camera"] == pytest.approx(10 * ROAD_FRAMES / 720)
