"""A job's sources and its selection across commands: what is kept, what is refused, and what is said of it."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from pipeline_fixtures import run_all, small_config, write_detector, write_street

from dataset.receipts import ReceiptLog, read_receipts
from dataset.selection import read_selection
from labeling.errors import ConfigError
from pipelines.commands import JobOptions, prepare_job, run_select
from pipelines.config import EFFORTS, Config, merged, with_effort
from pipelines.given_tables import read_leave_out
from pipelines.job import Job, open_job
from pipelines.sources import Source, find_videos
from pipelines.stage import NotReadyError

UP_TO_COUNT = ("source", "index", "count")
UP_TO_SELECT = (*UP_TO_COUNT, "select")


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("videos")
    for number, level in enumerate((60, 120, 230)):
        write_street(folder / f"v{number}.mp4", frames=24, level=level, seed=number)
    return folder


@pytest.fixture(scope="module")
def detector(tmp_path_factory):
    return write_detector(tmp_path_factory.mktemp("models"))


def ranked_job(root, videos, detector):
    """Three videos of which the brightest holds most."""
    sources = {path.stem: Source(video_id=path.stem, path=path) for path in sorted(videos.glob("*.mp4"))}
    config = small_config(select={"keep_share": 0.3}, keypoints={"extractors": []}, count={"detector": "counter"})
    return Job(root, config, sources, models_dir=detector)


def test_a_greater_effort_looks_more_often_in_counting_and_keypoints():
    efforts = [with_effort(Config(), effort) for effort in EFFORTS]
    fast, balanced, exact = (config.count.looks_per_clip for config in efforts)
    assert 1 <= fast < balanced < exact
    assert [config.keypoints.effort for config in efforts] == list(EFFORTS)
    assert with_effort(Config(), "balanced") == Config()


@pytest.mark.parametrize("before", ["another rule", "no selection"])
def test_a_refused_extension_leaves_nothing_behind(tmp_path, videos, detector, before):
    job = ranked_job(tmp_path / "J", videos, detector)
    run_all(job, stages=UP_TO_SELECT if before == "another rule" else UP_TO_COUNT)
    job.config = merged(job.config, {"select": {"keep_share": 0.9}})
    job.save()
    receipts = read_receipts(job.root, "select")
    with pytest.raises(ConfigError, match="no selection to extend"):
        run_select(job.root, extend=True)
    assert read_receipts(job.root, "select") == receipts
    assert run_select(job.root) == 0
    assert run_select(job.root, extend=True) == 0
    assert len({row.video_id for row in read_selection(job.root / "selection.parquet").kept}) == 3


@pytest.fixture(scope="module")
def counted_job(tmp_path_factory, videos, detector):
    job = ranked_job(tmp_path_factory.mktemp("jobs") / "J", videos, detector)
    run_all(job, stages=UP_TO_COUNT)
    return job


def fail_count(job, video_id, *, reason, retryable):
    """Another receipt for a video's count, as a failure of that kind leaves it."""
    receipt = read_receipts(job.root, "count")[video_id]
    failure = replace(
        receipt, state="failed", reason=reason, message=f"fails by {reason}", retryable=retryable,
        turn=receipt.turn + 1, outputs=(), facts={},
    )  # fmt: skip
    ReceiptLog(job.root, "count").append(failure)
    job.refresh()


@pytest.mark.parametrize("reason", ["storage", "memory", "died", "interrupted"])
def test_no_threshold_is_frozen_without_a_video_that_failed_for_the_moment(counted_job, reason):
    fail_count(counted_job, "v2", reason=reason, retryable=True)
    with pytest.raises(NotReadyError, match=f"v2 is not counted: fails by {reason}; run the command again"):
        counted_job.plan("select")


@pytest.mark.parametrize(("reason", "retryable"), [("video", False), ("fault", True)])
def test_a_video_that_would_fail_again_does_not_stop_the_selection(counted_job, reason, retryable):
    fail_count(counted_job, "v2", reason=reason, retryable=retryable)
    [selection] = counted_job.plan("select")
    assert set(selection.inputs["videos"]) == {"v0", "v1"}


@pytest.fixture
def two_files(tmp_path):
    """A folder with two files that are called videos."""
    folder = tmp_path / "v"
    folder.mkdir()
    for name in ("a", "b"):
        (folder / f"{name}.mp4").write_bytes(b"x")
    return folder


def left_out(root):
    return {name: source.leave_out_s for name, source in open_job(root).sources.items()}


@pytest.mark.parametrize("again", ["with the videos", "without the videos"])
def test_what_is_left_out_stays_until_a_table_says_otherwise(tmp_path, two_files, again):
    table, root = tmp_path / "leave_out.csv", tmp_path / "J"
    videos = [two_files] if again == "with the videos" else []
    table.write_text("video_id,start_s,end_s\na,1,0.5\nb,2,0\n")
    prepare_job([two_files], root, JobOptions(leave_out=table))
    prepare_job(videos, root, JobOptions())
    assert left_out(root) == {"a": (1.0, 0.5), "b": (2.0, 0.0)}
    table.write_text("video_id,start_s,end_s\na,0,0\n")
    prepare_job(videos, root, JobOptions(leave_out=table))
    assert left_out(root) == {"a": (0.0, 0.0), "b": (2.0, 0.0)}


@pytest.mark.parametrize("again", ["with the videos", "without the videos"])
def test_a_table_that_names_no_video_of_the_job_is_refused(tmp_path, two_files, again):
    table, root = tmp_path / "leave_out.csv", tmp_path / "J"
    prepare_job([two_files], root, JobOptions())
    table.write_text("video_id,start_s,end_s\nc,1,0\n")
    with pytest.raises(ConfigError, match="names 'c', which is none of the videos; use ids, as 'a', 'b'"):
        prepare_job([two_files] if again == "with the videos" else [], root, JobOptions(leave_out=table))


def test_a_job_inside_the_videos_folder_takes_nothing_of_a_job_for_a_source(tmp_path, two_files):
    root, other = two_files / "J", two_files / "deep" / "other"
    for made in (root / "videos" / "a" / "run_0_9.mp4", other / "videos" / "c" / "run_0_9.mp4"):
        made.parent.mkdir(parents=True)
        made.write_bytes(b"x")
    (two_files / "deep" / "d.mp4").write_bytes(b"x")
    for made in (root, other):
        (made / "job.yaml").touch()
    for _ in range(2):
        job = prepare_job([two_files], root, JobOptions())
        assert list(job.sources) == ["a", "b", "d"]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("a,-1,0", r"line 2 \(video a\): \(-1.0, 0.0\) are no two lengths of time"),
        ("a,1,nan", "no two lengths of time"),
        ("a,1,soon", r"line 2 \(video a\): end_s is 'soon', but must be a number"),
        ("a,1,1\na,2,2", "line 3 names video a again"),
    ],
)
def test_a_table_of_what_to_leave_out_holds_lengths(tmp_path, rows, message):
    (tmp_path / "t.csv").write_text(f"video_id,start_s,end_s\n{rows}\n")
    with pytest.raises(ConfigError, match=message):
        read_leave_out(tmp_path / "t.csv")


def test_a_link_to_a_video_that_is_gone_is_told_of(tmp_path, two_files):
    """Half of a linked data set on a disk that is not mounted must not vanish in silence."""
    (two_files / "gone.mp4").symlink_to(tmp_path / "nowhere.mp4")
    sources = {source.video_id: source for source in find_videos([two_files])}
    job = Job(tmp_path / "J", small_config(), {"gone": sources["gone"]})
    run_all(job, stages=("source",))
    (receipt,) = read_receipts(job.root, "source").values()
    assert receipt.state == "failed" and "no such file" in receipt.message


def test_a_job_s_own_folder_is_no_folder_of_videos(tmp_path, two_files):
    with pytest.raises(ConfigError, match="is a job's own folder"):
        prepare_job([two_files], two_files, JobOptions())
    prepare_job([two_files], tmp_path / "J", JobOptions())
    with pytest.raises(ConfigError, match="is a job's own folder"):
        prepare_job([tmp_path / "J"], tmp_path / "another", JobOptions())


@pytest.mark.parametrize("named", ["list", "file", "folder above", "link"])
def test_a_video_below_the_job_s_folder_is_no_source_of_it(tmp_path, two_files, named):
    (two_files / "job.yaml").touch()
    (tmp_path / "list.txt").write_text("v/a.mp4\n")
    (tmp_path / "link").symlink_to(two_files)
    given = {"list": tmp_path / "list.txt", "file": two_files / "a.mp4", "folder above": tmp_path / "link" / "a.mp4"}
    with pytest.raises(ConfigError, match="lies in the job's own folder .*; give the folder of the videos"):
        prepare_job([given.get(named, two_files / "a.mp4")], given_out(tmp_path, two_files, named), JobOptions())


def given_out(tmp_path, two_files, named):
    """The videos' folder by the name that the videos have, or by that of a link."""
    return tmp_path / "link" if named in ("link", "folder above") else two_files


def test_a_folder_of_other_things_is_filled_with_no_job(tmp_path, two_files):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "notes.txt").touch()
    with pytest.raises(ConfigError, match=r"thesis: is no job and not empty \(holds notes.txt\); give a job or a new"):
        prepare_job([two_files], tmp_path / "thesis", JobOptions())
    assert [path.name for path in (tmp_path / "thesis").iterdir()] == ["notes.txt"]
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / ".job.yaml.host-1.tmp").touch()
    assert list(prepare_job([two_files], tmp_path / "empty", JobOptions()).sources) == ["a", "b"]


def test_all_ids_that_cannot_be_are_named_at_once(tmp_path):
    for name in ("a.b.mp4", "c d.mp4", "e.mp4"):
        (tmp_path / name).touch()
    with pytest.raises(ConfigError, match="a.b.mp4: 'a.b' is no video id .*, nor are .*c d.mp4: 'c d'; rename the fil"):
        find_videos([tmp_path])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("x y\ta.mp4", "line 3: .*a.mp4: 'x y' is no video id"),
        (".", "line 3: .*: is no file's path"),
        ("gone.mp4", "line 3: .*gone.mp4: no such file"),
    ],
)
def test_a_line_that_cannot_be_used_is_named(tmp_path, line, message):
    (tmp_path / "list.txt").write_text(f"# a comment\n\n{line}\n")
    with pytest.raises(ConfigError, match=f"list.txt: {message}"):
        find_videos([tmp_path / "list.txt"])


def test_a_video_by_another_route_is_the_same_video(tmp_path, two_files, monkeypatch):
    (tmp_path / "sub").mkdir()
    monkeypatch.chdir(tmp_path / "sub")
    paths = tmp_path / "sub" / "paths.txt"
    paths.write_text("../v/a.mp4\n")
    root, routes = tmp_path / "J", [two_files, Path("../v"), Path("../v/a.mp4"), paths]
    for videos in (*([route] for route in routes), routes):
        job = prepare_job(videos, root, JobOptions())
        assert {name: source.path for name, source in job.sources.items()} == {
            name: two_files / f"{name}.mp4" for name in ("a", "b")
        }


def test_a_job_that_holds_a_path_with_dots_knows_its_video_again(tmp_path, two_files):
    root = tmp_path / "J"
    sources = {name: Source(video_id=name, path=root / ".." / "v" / f"{name}.mp4") for name in ("a", "b")}
    root.mkdir()
    Job(root, small_config(), sources).save()
    assert prepare_job([two_files], root, JobOptions()).sources["a"].path == two_files / "a.mp4"


def test_a_link_keeps_its_name(tmp_path, two_files):
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "day.mp4").symlink_to(two_files / "a.mp4")
    job = prepare_job([tmp_path / "links"], tmp_path / "J", JobOptions())
    assert job.sources["day"].path == tmp_path / "links" / "day.mp4"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("videos: {v0: null}", "'v0' cannot be None"),
        ("videos: {v0: {leave_out_s: [1, 2]}}", "'v0' cannot be"),
        ("videos: {v0: {path: null}}", "'v0' cannot be"),
        ("videos: {v0: {path: a.mp4, leave_out_s: 3}}", "'v0' cannot be"),
        ("videos: {v0: {path: a.mp4, leave_out_s: [1, -2]}}", "no two lengths of time"),
        ("videos: {v0: {path: a.mp4, trajectory: a.tum}}", "'v0' cannot be"),
        ("videos: {v0: {path: a.mp4, trajectory: {flie: a.tum}}}", "flie"),
        ("videos: {../v0: {path: a.mp4}}", "'../v0' cannot be"),
        ("videos: {1: {path: a.mp4}}", "1 cannot be"),
        ("videos: [a.mp4]", "videos needs a mapping"),
        ("config: 3", "config needs a mapping"),
        ("models: 3", "models needs a folder's path"),
    ],
)
def test_a_job_file_that_cannot_be_used_is_an_error_that_names_it(tmp_path, text, message):
    (tmp_path / "job.yaml").write_text(text)
    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        open_job(tmp_path)
    assert str(tmp_path / "job.yaml") in str(caught.value)
