"""Trajectories from elsewhere: their clocks, what cannot be, and what becomes of the clips that they do not cover."""

import sys
from pathlib import Path

import numpy as np
import pytest
from ego_fixtures import driven, write_kitti
from pipeline_fixtures import CLIP, run_all, small_config, write_street

from dataset.loader import ShardDataset
from dataset.receipts import read_receipts
from dataset.tables import read_ego
from labeling.camera import Trajectory, prior_intrinsics, write_tum
from labeling.ego_import import MISSING, FileClock, covered, motion_at, motion_modes, read_drive, trajectory_format
from labeling.ego_motion import RoadView
from labeling.errors import ConfigError, TrajectoryError
from pipelines.cli import main
from pipelines.imports import import_trajectories, match_files
from pipelines.job import Job, open_job, open_or_create
from pipelines.sources import Source
from pipelines.stage import STAGES
from pipelines.status import job_status

KEEP_ALL = {"select": {"keep_share": 1.0}}
VIDEO_S = np.arange(48) / 24


@pytest.fixture
def drive() -> Trajectory:
    return Trajectory(timestamps_s=VIDEO_S, cam_to_world=driven(np.full(48, 6.0), 10.0))


def at(trajectory: Trajectory, times_s: np.ndarray):
    road = RoadView(height_m=1.5, pitch_rad=0.0, pitch_sigma_rad=np.inf)
    return motion_at(trajectory, times_s, intrinsics=prior_intrinsics(96, 64), road=road)


def test_a_tum_file_comes_back_at_the_frames_times(tmp_path, drive):
    write_tum(drive, tmp_path / "drive.tum")
    found = read_drive(tmp_path / "drive.tum", video_times_s=VIDEO_S)
    motion = at(found, 0.5 + np.arange(24) / 24)
    assert np.allclose(motion.trajectory.cam_to_world, drive.slice(12, 36).cam_to_world, atol=1e-6)
    assert (motion.mode == "moving").all() and (motion.scale_source == "given").all()
    assert (motion.confidence == 1).all() and (motion.scale_sigma == 0).all()


def test_another_clock_is_told_by_its_offset(tmp_path, drive):
    unix = Trajectory(timestamps_s=drive.timestamps_s + 1.7e9, cam_to_world=drive.cam_to_world)
    write_tum(unix, tmp_path / "drive.tum")
    found = read_drive(tmp_path / "drive.tum", video_times_s=VIDEO_S, clock=FileClock(offset_s=1.7e9))
    assert np.allclose(at(found, VIDEO_S).trajectory.cam_to_world, drive.cam_to_world, atol=1e-5)
    with pytest.raises(TrajectoryError, match=r"covers 1.7e\+09 .* so none of it; .* offset"):
        read_drive(tmp_path / "drive.tum", video_times_s=VIDEO_S)


def test_a_kitti_file_has_a_row_for_each_frame_or_a_rate(tmp_path, drive):
    path = tmp_path / "drive.txt"
    write_kitti(drive, path)
    assert (trajectory_format(path), trajectory_format(tum_of(drive, tmp_path))) == ("kitti", "tum")
    found = read_drive(path, video_times_s=VIDEO_S)
    assert np.allclose(found.cam_to_world, drive.cam_to_world, atol=1e-6)
    with pytest.raises(TrajectoryError, match="48 rows for a video of 47 frames"):
        read_drive(path, video_times_s=VIDEO_S[:-1])
    at_12 = read_drive(path, video_times_s=VIDEO_S, clock=FileClock(fps=12))
    assert at_12.timestamps_s[-1] == pytest.approx(47 / 12)
    later = read_drive(path, video_times_s=VIDEO_S, clock=FileClock(fps=12, offset_s=0.5))
    assert later.timestamps_s == pytest.approx(np.arange(48) / 12 - 0.5)
    with pytest.raises(TrajectoryError, match="carries no times"):
        read_drive(path, video_times_s=None)


def tum_of(drive: Trajectory, folder: Path) -> Path:
    write_tum(drive, folder / "drive.tum")
    return folder / "drive.tum"


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (lambda rows: rows[::-1], "does not increase"),
        (lambda rows: np.concatenate([rows, rows[:3]]), "does not increase"),
        (lambda rows: rows * np.array([1, 1, 1, 1, 2, 2, 2, 2]), "quaternion of length"),
        (lambda rows: rows * np.array([1, 1, 1, 1, 0, 0, 0, 0]), "quaternion of length"),
        (lambda rows: rows[:, :7], "7 numbers in its first row"),
        (lambda rows: np.where(np.arange(8) == 2, np.nan, rows), "not finite"),
        (lambda rows: np.where(np.arange(8) == 5, np.nan, rows), r"drive\.tum"),
        (lambda rows: np.where(np.arange(8) == 0, np.inf, rows), "finite"),
        (lambda rows: rows[:0], "0 numbers"),
    ],
    ids=["backwards", "again", "no rotation", "no quaternion", "columns", "NaN place", "NaN turn", "infinite", "empty"],
)
def test_a_tum_file_that_cannot_be_is_refused(tmp_path, drive, harm, message):
    path = tum_of(drive, tmp_path)
    np.savetxt(path, harm(np.loadtxt(path)))
    with pytest.raises(TrajectoryError, match=message) as error:
        read_drive(path, video_times_s=VIDEO_S)
    assert str(path) in str(error.value)


def test_a_byte_order_mark_is_no_number(tmp_path, drive):
    path = tum_of(drive, tmp_path)
    np.savetxt(path, np.loadtxt(path))
    before = read_drive(path, video_times_s=VIDEO_S)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert np.array_equal(read_drive(path, video_times_s=VIDEO_S).cam_to_world, before.cam_to_world)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"a b c d e f g h\n", b"", b"1 2 3\n"], ids=str)
def test_what_is_no_trajectory_is_refused(tmp_path, content):
    (tmp_path / "drive.tum").write_bytes(content)
    with pytest.raises(TrajectoryError, match=r"drive\.tum"):
        read_drive(tmp_path / "drive.tum", video_times_s=VIDEO_S)


def test_a_kitti_file_without_rotations_is_refused(tmp_path, drive):
    write_kitti(drive, tmp_path / "drive.txt")
    rows = np.loadtxt(tmp_path / "drive.txt")
    rows[5, 0] = 2.0
    np.savetxt(tmp_path / "drive.txt", rows)
    with pytest.raises(TrajectoryError, match="not a rigid motion"):
        read_drive(tmp_path / "drive.txt", video_times_s=VIDEO_S)


def test_a_gap_and_both_ends_are_known_to_be_missing(drive):
    kept = np.r_[6:18, 30:44]
    holed = Trajectory(
        timestamps_s=drive.timestamps_s[kept], cam_to_world=drive.slice(6, 48).cam_to_world[kept - 6]
    )  # fmt: skip
    motion = at(holed, VIDEO_S)
    seen = np.isin(np.arange(48), kept)
    assert np.array_equal(motion.mode != MISSING, seen)
    assert np.array_equal(motion.confidence > 0, seen) and set(motion.scale_source[~seen]) == {"held"}
    assert np.isfinite(motion.trajectory.cam_to_world).all()


def test_a_slow_file_is_filled_in_up_to_a_quarter_second():
    every = np.arange(0, 2, 0.2)
    assert covered(every, VIDEO_S[VIDEO_S <= 1.8]).all()
    sparse = np.arange(0, 2, 0.3)
    assert covered(sparse, sparse).all() and not covered(sparse, sparse[:-1] + 0.15).any()
    assert covered(np.array([0.5]), np.array([0.4, 0.5])).tolist() == [False, True]


def test_modes_of_an_imported_drive():
    speeds = np.concatenate([np.zeros(10), np.zeros(10), np.full(10, 5.0)])
    rates = np.concatenate([np.zeros(10), np.full(10, 20.0), np.zeros(10)])
    mode = motion_modes(Trajectory(timestamps_s=np.arange(30) / 24, cam_to_world=driven(speeds, rates)))
    assert list(dict.fromkeys(mode)) == ["still", "turning", "moving"]


def test_files_belong_to_videos_by_their_names(tmp_path):
    for name in ("a.tum", "b.txt", "notes.txt", "c.md"):
        (tmp_path / name).write_text("")
    assert match_files(tmp_path, ("a", "b", "c")) == {"a": tmp_path / "a.tum", "b": tmp_path / "b.txt"}
    assert match_files(tmp_path / "a.tum", ("a", "b")) == {"a": tmp_path / "a.tum"}
    assert match_files(tmp_path / "notes.txt", ("b",)) == {"b": tmp_path / "notes.txt"}
    with pytest.raises(ConfigError, match="'notes' is none of the job's 2 videos"):
        match_files(tmp_path / "notes.txt", ("a", "b"))
    with pytest.raises(ConfigError, match="holds no trajectory"):
        match_files(tmp_path, ("x", "y"))
    with pytest.raises(ConfigError, match="no such file"):
        match_files(tmp_path / "gone.tum", ("a",))
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(ConfigError, match=r"two trajectories of a, a\.tum and a\.txt"):
        match_files(tmp_path, ("a", "b"))
    assert match_files(tmp_path, ("b",)) == {"b": tmp_path / "b.txt"}


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    folder = tmp_path_factory.mktemp("videos")
    return {
        name: Source(video_id=name, path=write_street(folder / f"{name}.mp4", frames=48, seed=seed))
        for seed, name in enumerate(("mine", "other"))
    }


def test_an_import_changes_its_video_alone_and_lasts(tmp_path, drive, sources):
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), sources)
    run_all(job)
    write_tum(drive, tmp_path / "mine.tum")
    assert import_trajectories(job, tmp_path / "mine.tum") == ("mine",)
    made, reports = run_all(job)
    assert not [receipt.message for report in reports for receipt in report.failed]
    assert {item.split("/")[0].split("_")[0] for stage, item in made if stage in ("ego", "render")} == {"mine"}
    assert {stage for stage, _ in made} == {"camera", "ego", "render", "pack", "shards"}
    sample = ShardDataset(job.root, "train").sample("mine_8")
    assert np.allclose(sample.cam_to_world, drive.slice(8, 8 + CLIP).cam_to_world, atol=1e-5)
    assert np.array_equal(sample.cam_to_world[0], np.eye(4))
    assert sample.meta["ego"]["scale_sources"] == {"given": CLIP}
    # The job keeps its copy, and what it was told, whatever becomes of the file.
    (tmp_path / "mine.tum").unlink()
    assert run_all(open_job(job.root))[0] == []
    assert run_all(open_or_create(job.root, videos=list(sources.values())))[0] == []
    fresh = Job(tmp_path / "F", small_config(**KEEP_ALL), sources)
    write_tum(drive, tmp_path / "mine.tum")
    import_trajectories(fresh, tmp_path / "mine.tum")
    run_all(fresh)
    for name in read_receipts(job.root, "ego"):
        path = f"videos/{name}.ego.parquet"
        assert (job.root / path).read_bytes() == (fresh.root / path).read_bytes()


def test_an_imported_drive_without_labels_waits_for_them(tmp_path, drive, sources):
    """The trajectory needs none, the clips do: nothing is rendered, and nothing fails."""
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {"mine": sources["mine"]})
    import_trajectories(job, tum_of(drive, tmp_path))
    _, reports = run_all(job, stages=tuple(stage for stage in STAGES if stage not in ("keypoints", "pack", "shards")))
    assert job.done("ego") and not job.done("render")
    assert not [receipt.message for report in reports for receipt in report.failed]
    assert job_status(job.root).stages
    run_all(job)
    assert set(ShardDataset(job.root, "train").keys) == {"mine_0", "mine_8", "mine_16", "mine_24", "mine_32"}


def test_clips_that_the_file_does_not_cover_are_dropped_with_their_reason(tmp_path, drive, sources):
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {"mine": sources["mine"]})
    path = tum_of(drive, tmp_path)
    np.savetxt(path, np.delete(np.loadtxt(path), np.arange(20, 32), axis=0))
    import_trajectories(job, path)
    _, reports = run_all(job)
    assert not [receipt.message for report in reports for receipt in report.failed]
    rendered = read_receipts(job.root, "render")
    dropped = {key: receipt.reason for key, receipt in rendered.items() if receipt.state == "dropped"}
    assert dropped["mine_16"] == "no_trajectory=5 of 9 frames from 0.833 s"
    assert set(dropped) == {"mine_16", "mine_24"}
    assert set(ShardDataset(job.root, "train").keys) == {"mine_0", "mine_8", "mine_32"}
    for table in (job.root / "videos" / "mine").glob("*.ego.parquet"):
        ego = read_ego(table)
        assert np.isfinite(ego.trajectory.cam_to_world).all() and np.isfinite(ego.scale_sigma).all()


def test_a_copy_that_was_changed_is_not_used(tmp_path, drive, sources):
    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {"mine": sources["mine"]})
    import_trajectories(job, tum_of(drive, tmp_path))
    (job.root / "trajectories" / "mine.txt").write_text("0 0 0 0 0 0 0 1\n")
    _, reports = run_all(job)
    failed = [receipt for report in reports for receipt in report.failed]
    assert failed and {receipt.stage for receipt in failed} == {"ego"} and "import it again" in failed[0].message


def test_the_command_line(tmp_path, drive, sources, monkeypatch, capsys):
    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["animatic", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        out = capsys.readouterr()
        return int(end.value.code or 0), out.out, out.err

    job = Job(tmp_path / "J", small_config(**KEEP_ALL), {"mine": sources["mine"]})
    run_all(job, stages=("source", "index", "count", "select", "cut", "keypoints"))
    path = tum_of(drive, tmp_path)
    code, out, _ = run("ego", job.root, "--import", path, "--workers", "0")
    assert code == 0 and "trajectories of 1 video (mine)" in out and "animatic label" in out
    np.savetxt(path, np.loadtxt(path)[::-1])
    code, out, err = run("ego", "--out", job.root, "--import", path, "--workers", "0")
    assert code == 2 and "does not increase" in err and err.count("\n") == 1
    assert run("ego", job.root, "--import", tmp_path / "gone.tum")[0] == 2
    assert run("ego")[0] == 2
    assert run("ego", "--out", job.root, "--workers", "0")[0] == 0
