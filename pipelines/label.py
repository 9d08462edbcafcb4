"""The main job: stages in order over a job's items, skipping what receipts say is done."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from dataset.layout import RECEIPTS
from dataset.receipts import Receipt, check_unaltered
from labeling.errors import StorageError
from pipelines.engine import Engine
from pipelines.items import Task
from pipelines.job import Job
from pipelines.stage import STAGES, NotReadyError, Part, item_state

ALL_STAGES: tuple[str, ...] = tuple(STAGES)
SLICE_STAGES: tuple[str, ...] = ("source", "index", "count", "select", "cut")

_POLL_S = 2.0


class Reporter(Protocol):
    """What a person sees while stages run."""

    def stage_started(self, stage: str, *, items: int, weight: float, current: int) -> None:
        """``items`` are to be made, ``current`` were made before."""
        ...

    def item_finished(self, receipt: Receipt, *, weight: float) -> None:
        """One item has its receipt."""
        ...

    def stage_finished(self, report: "StageReport") -> None:
        """All items have theirs."""
        ...

    def waiting(self, message: str) -> None:
        """Another part of the job has not come as far."""
        ...


@dataclass(slots=True, kw_only=True)
class StageReport:
    """What one stage did in this call."""

    stage: str
    current: int = 0
    """Items that were up to date before."""
    made: list[Receipt] = field(default_factory=list)
    """Receipts of this call, in the order of items."""
    failed: list[Receipt] = field(default_factory=list)
    """Every item that failed, now or before."""
    seconds: float = 0.0

    def count(self, state: str) -> int:
        """How many items got that state in this call."""
        return sum(receipt.state == state for receipt in self.made)


def run_stage(
    job: Job, stage: str, engine: Engine, reporter: Reporter, *, part: Part | None = None, force: bool = False
) -> StageReport:
    """Run one stage of one part.

    Args:
        job: the job; it is refreshed afterwards.
        stage: which.
        engine: where items are worked on.
        reporter: told of every step.
        part: this host's share of the videos.
        force: make even what is up to date.

    Raises:
        NotReadyError: the stage waits for another part.
        StorageError: the disk is full, or nothing of the stage could be written; what was made so far is kept.
        AlteredError: the selection, or the shards' index, is not as it was written.
    """
    started = time.perf_counter()
    known = job.receipts(stage)
    items = [item for item in job.plan(stage) if part is None or not item.owner or part.owns(item.owner)]
    todo = [item for item in items if force or item_state(item, known.get(item.name), job.root) != "current"]
    names = {item.name: item for item in todo}
    for item in items:
        # Tables of the whole job are read by later plans and by other commands, where no item compares them.
        if not item.owner and item.name not in names:
            for output in known[item.name].outputs:
                check_unaltered(job.root / output.path, output.sha256)
    report = StageReport(stage=stage, current=len(items) - len(todo))
    report.failed = [
        known[item.name] for item in items if item.name not in names and known[item.name].state == "failed"
    ]
    reporter.stage_started(stage, items=len(todo), weight=sum(item.weight for item in todo), current=report.current)
    for receipt in engine.run([Task(item=item, previous=known.get(item.name)) for item in todo]):
        report.made.append(receipt)
        reporter.item_finished(receipt, weight=names[receipt.item].weight)
    order = {name: number for number, name in enumerate(names)}
    report.made.sort(key=lambda receipt: order[receipt.item])
    report.failed += [receipt for receipt in report.made if receipt.state == "failed"]
    report.seconds = time.perf_counter() - started
    job.refresh()
    reporter.stage_finished(report)
    lacking = _unwritten(report)
    if len(report.made) < len(todo):
        raise StorageError(f"{lacking[0].message} ({stage} stopped with {len(todo) - len(report.made)} items to go)")
    if lacking and len(lacking) == len(items):
        # What comes after would pack nothing, and give another reason for it.
        raise StorageError(f"{lacking[0].message} ({stage} could write nothing)")
    return report


def _unwritten(*reports: StageReport) -> list[Receipt]:
    """What failed in this call because it could not be written."""
    made = (receipt for report in reports for receipt in report.made)
    return [receipt for receipt in made if receipt.state == "failed" and receipt.reason == StorageError.reason]


def run_stages(
    job: Job,
    stages: Sequence[str],
    engine: Engine,
    reporter: Reporter,
    *,
    part: Part | None = None,
    refreeze: bool = False,
    patience_s: float = 0.0,
) -> list[StageReport]:
    """Run stages in order; at a barrier wait for the other parts as long as they make progress.

    Args:
        job: the job.
        stages: names of ``STAGES``.
        engine: where items are worked on.
        reporter: told of every step.
        part: this host's share.
        refreeze: make the selection anew.
        patience_s: how long to wait at a barrier without a sign of the other parts.

    Raises:
        NotReadyError: the other parts made no progress for ``patience_s``.
        StorageError: the disk is full, or a stage waits for what could not be written.
    """
    reports: list[StageReport] = []
    for stage in stages:
        lacking = _unwritten(*reports)
        patient = part is not None and part.count > 1 and not lacking
        try:
            _wait_for_parts(job, stage, reporter, patience_s if patient else 0.0)
        except NotReadyError as error:
            if not lacking:
                raise
            # Not even the receipts of these may have been written: no other part is to blame.
            raise StorageError(f"{lacking[0].message} ({stage} waits for {len(lacking)} that failed)") from error
        reports.append(run_stage(job, stage, engine, reporter, part=part, force=refreeze and stage == "select"))
    return reports


def _wait_for_parts(job: Job, stage: str, reporter: Reporter, patience_s: float) -> None:
    sign, since = _progress(job.root), time.monotonic()
    while True:
        try:
            job.plan(stage)
        except NotReadyError as error:
            if time.monotonic() - since >= patience_s:
                raise
            reporter.waiting(str(error))
            time.sleep(min(_POLL_S, patience_s))
            job.refresh()
            now = _progress(job.root)
            if now != sign:
                sign, since = now, time.monotonic()
        else:
            return


def _progress(root: Path) -> tuple[tuple[str, int], ...]:
    """Sizes of all receipt logs: they grow while any part lives."""
    logs = sorted((root / RECEIPTS).glob("*/*.jsonl"))
    return tuple((str(log.relative_to(root)), log.stat().st_size) for log in logs)


def sweep_outdated(job: Job) -> list[Path]:
    """Remove runs' and clips' files that no plan names any more; what was removed.

    A selection that keeps less leaves runs behind. Nothing is removed while anything is unsettled or has failed. The
    receipts stay: a file that is missing is made again when it is wanted again.
    """
    if any(job.pending(stage) or _failures(job, stage) for stage in STAGES):
        return []
    wanted = {job.root / output for stage in STAGES for item in job.plan(stage) for output in item.outputs}
    folders = [path for path in (job.root / "videos").glob("*") if path.is_dir()]
    found = [path for folder in folders for path in (*folder.glob("run_*"), *folder.glob("clips/*")) if path.is_file()]
    outdated = [path for path in sorted(found) if path not in wanted]
    for path in outdated:
        path.unlink(missing_ok=True)
    return outdated


def _failures(job: Job, stage: str) -> list[Receipt]:
    return [receipt for receipt in job.settled(stage).values() if receipt.state == "failed"]
