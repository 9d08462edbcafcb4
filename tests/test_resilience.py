"""What goes wrong from outside: kill -9 at every point of every stage, no space left, a folder that cannot be written.

Each disturbance happens in a forked child, which shares this process's imports; what it leaves behind is then finished
by an undisturbed run, and must come out byte for byte as a job that was left alone.
"""

import functools
import json
import multiprocessing
import os
import resource
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from pipeline_fixtures import SilentReporter, run_all, small_config, tree, write_detector, write_street

from dataset import receipts
from dataset.receipts import AlteredError, ReceiptLog, read_receipts, sha256_file
from labeling.errors import StorageError
from pipelines import engine, items
from pipelines.items import files_read
from pipelines.job import Job
from pipelines.label import StageReport, run_stages
from pipelines.sources import find_videos
from pipelines.stage import STAGES

MOMENTS = ("outputs made, none published", "outputs published, no receipt", "receipt torn")


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("videos")
    write_street(folder / "dim.mp4", level=70, frames=32, seed=1)
    write_street(folder / "day.mp4", level=150, frames=32, seed=2)
    return folder


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_detector(tmp_path_factory.mktemp("models"))


def make_job(root: Path, videos: Path, detector: Path) -> Job:
    sources = {source.video_id: source for source in find_videos([videos])}
    return Job(root, small_config(pack={"shard_bytes": 60_000}), sources, models_dir=detector)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, videos: Path, detector: Path) -> Job:
    job = make_job(tmp_path_factory.mktemp("left_alone") / "J", videos, detector)
    run_all(job)
    return job


def in_child(work: Callable[[], object]) -> int | None:
    """Run ``work`` in a forked child; how it ended (negative: the signal that killed it)."""
    child = multiprocessing.get_context("fork").Process(target=work)
    child.start()
    child.join(timeout=120)
    assert not child.is_alive(), "the child hangs"
    return child.exitcode


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def run_and_die(job: Job, stage: str, moment: str) -> None:
    """Run the job, and be killed at that moment of the stage's first item."""
    publish, append = items.publish, ReceiptLog.append
    if moment == MOMENTS[0]:

        def publish_nothing(staging: Path, *args: object) -> object:
            if staging.name.startswith(f"{stage}."):
                die()
            return publish(staging, *args)  # type: ignore[arg-type]

        items.publish = publish_nothing  # type: ignore[assignment]
    elif moment == MOMENTS[1]:

        def append_nothing(log: ReceiptLog, receipt: receipts.Receipt) -> None:
            if receipt.stage == stage:
                die()
            append(log, receipt)

        ReceiptLog.append = append_nothing  # type: ignore[method-assign]
    else:

        def append_half(log: ReceiptLog, receipt: receipts.Receipt) -> None:
            append(log, receipt)
            if receipt.stage == stage:
                (path,) = (
                    log_file for log_file in job.root.glob(f"receipts/{stage}/*.jsonl") if log_file.stat().st_size
                )
                os.truncate(path, path.stat().st_size - 20)
                die()

        ReceiptLog.append = append_half  # type: ignore[method-assign]
    run_all(job)


def without_seconds(root: Path) -> dict[tuple[str, str], str]:
    """The receipts that hold, without what may differ: the time taken, and how often an item had to be made."""
    held = {}
    for stage in STAGES:
        for name, receipt in read_receipts(root, stage).items():
            held[stage, name] = json.dumps(
                {field: str(getattr(receipt, field)) for field in ("state", "reason", "key", "outputs", "facts")}
            )
    return held


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_job_killed_in_every_stage_ends_as_one_left_alone(
    tmp_path: Path, videos: Path, detector: Path, undisturbed: Job, moment: str
) -> None:
    """One job, killed in its first stage, started again, killed in the second, and so on to the last."""
    root = tmp_path / "J"
    for stage in STAGES:
        code = in_child(functools.partial(run_and_die, make_job(root, videos, detector), stage, moment))
        assert code == -signal.SIGKILL, f"the child that should have died in {stage} ended with {code}"
    run_all(make_job(root, videos, detector))
    assert tree(root) == tree(undisturbed.root)
    assert without_seconds(root) == without_seconds(undisturbed.root)
    assert not (root / ".staging").exists()


def run_with_small_files(job: Job, limit: int) -> None:
    """Run where no file may grow beyond ``limit`` bytes; exit code 3 where that is told as it should be."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    try:
        _, reports = run_all(job)
    except StorageError:
        os._exit(3)
    failures = [receipt for report in reports for receipt in report.failed]
    os._exit(3 if failures and all(f.reason == "storage" and f.retryable for f in failures) else 4)


@pytest.mark.parametrize("limit", [600, 3_000, 12_000, 50_000], ids=lambda limit: f"{limit} bytes")
def test_no_space_left_loses_nothing(
    tmp_path: Path, videos: Path, detector: Path, undisturbed: Job, limit: int
) -> None:
    root = tmp_path / "J"
    make_job(root, videos, detector).root.mkdir()
    make_job(root, videos, detector).save()
    assert in_child(functools.partial(run_with_small_files, make_job(root, videos, detector), limit)) == 3
    run_all(make_job(root, videos, detector))
    assert tree(root) == tree(undisturbed.root)


def test_an_unwritable_place_is_told_and_mended(tmp_path: Path, videos: Path, detector: Path, undisturbed: Job) -> None:
    """A file where a video's folder should be: that video waits, the other is done, and a second start mends all."""
    job = make_job(tmp_path / "J", videos, detector)
    (job.root / "videos").mkdir(parents=True)
    (job.root / "videos" / "day").write_text("in the way")
    _, reports = run_all(job, stages=("source", "index"))
    failed = [receipt for report in reports for receipt in report.failed]
    assert failed and {receipt.item for receipt in failed} == {"day"}
    assert {receipt.reason for receipt in failed} == {"storage"}
    (job.root / "videos" / "day").unlink()
    run_all(make_job(tmp_path / "J", videos, detector))
    assert tree(job.root) == tree(undisturbed.root)


def test_a_worker_that_dies_does_not_take_the_job_along(
    tmp_path: Path, videos: Path, detector: Path, undisturbed: Job
) -> None:
    """One of two workers is killed between stages; the other and a new one go on."""
    job = make_job(tmp_path / "J", videos, detector)
    job.root.mkdir()
    job.save()

    def kill_one(report: StageReport) -> None:
        if report.stage not in ("index", "cut"):
            return
        for process in multiprocessing.active_children():
            if process.pid is not None:
                os.kill(process.pid, signal.SIGKILL)
                return

    reporter = SilentReporter()
    reporter.stage_finished = kill_one  # type: ignore[method-assign]
    with engine.Engine(job.root, workers=2) as pool:
        reports = run_stages(job, tuple(STAGES), pool, reporter)
    assert [receipt.message for report in reports for receipt in report.failed] == []
    assert tree(job.root) == tree(undisturbed.root)


@pytest.mark.parametrize(
    "stage", ["count", "cut", "keypoints", "corners", "camera", "ego", "skeleton", "render", "shards"]
)
def test_it_is_known_what_an_item_reads(undisturbed: Job, stage: str) -> None:
    for item in undisturbed.plan(stage):
        read = files_read(item)
        assert read, f"{item.name} reads nothing"
        assert {path: sha256_file(undisturbed.root / path) for path in read} == read


def alter(path: Path) -> None:
    """Other bytes in the middle of a file, which keeps its size."""
    data = bytearray(path.read_bytes())
    middle = slice(len(data) // 2, len(data) // 2 + 20)
    data[middle] = bytes(byte ^ 0x55 for byte in data[middle])
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("altered", "gone", "stage"),
    [
        ("videos/day/index.parquet", "selection.parquet", "select"),
        ("videos/day/counts.parquet", "selection.parquet", "select"),
        ("videos/day/index.parquet", "videos/day/run_*[0-9].mp4", "cut"),
        ("videos/day/run_*[0-9].mp4", "shards/*.tar", "pack"),
        ("shards/rows/*.parquet", "shards/index.parquet", "shards"),
    ],
)
def test_what_is_made_from_an_altered_file_fails_until_that_file_is_removed(
    tmp_path: Path, videos: Path, detector: Path, undisturbed: Job, altered: str, gone: str, stage: str
) -> None:
    """A bad disk, or a person, changes what an item reads and not its size: the receipt's sha256 tells."""
    root = tmp_path / "J"
    shutil.copytree(undisturbed.root, root)
    damaged = min(root.glob(altered))
    alter(damaged)
    for path in root.glob(gone):
        path.unlink()
    _, reports = run_all(make_job(root, videos, detector), stages=tuple(STAGES)[: tuple(STAGES).index(stage) + 1])
    assert [receipt for report in reports[:-1] for receipt in report.failed] == []
    assert reports[-1].failed
    for receipt in reports[-1].failed:
        assert (receipt.reason, receipt.retryable) == ("altered", True)
        assert str(damaged) in receipt.message and "remove it and run again" in receipt.message
    damaged.unlink()
    run_all(make_job(root, videos, detector))
    assert tree(root) == tree(undisturbed.root)


def test_an_altered_selection_is_not_extended(tmp_path: Path, videos: Path, detector: Path, undisturbed: Job) -> None:
    """Its threshold and split would hold for the videos that come."""
    root = tmp_path / "J"
    shutil.copytree(undisturbed.root, root)
    alter(root / "selection.parquet")
    write_street(tmp_path / "more" / "dawn.mp4", frames=24, level=60, seed=9)
    job = make_job(root, videos, detector)
    job.sources |= {source.video_id: source for source in find_videos([tmp_path / "more"])}
    job.selection_mode = "extend"
    _, reports = run_all(job, stages=("source", "index", "count", "select"))
    (receipt,) = reports[-1].failed
    assert (receipt.reason, receipt.retryable) == ("altered", True) and "selection.parquet" in receipt.message


@pytest.mark.parametrize("table", ["selection.parquet", "shards/index.parquet"])
def test_an_altered_table_of_the_whole_job_stops_it_until_it_is_removed(
    tmp_path: Path, videos: Path, detector: Path, undisturbed: Job, table: str
) -> None:
    root = tmp_path / "J"
    shutil.copytree(undisturbed.root, root)
    alter(root / table)
    with pytest.raises(AlteredError, match=f"{table}: was altered or damaged .*; remove it and run again"):
        run_all(make_job(root, videos, detector))
    (root / table).unlink()
    run_all(make_job(root, videos, detector))
    assert tree(root) == tree(undisturbed.root)
