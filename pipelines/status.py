"""``animatic status`` and ``animatic inspect``: what is done, dropped and failed, and what to type next."""

import json
import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from dataset.contact_sheet import contact_sheet
from dataset.inspection import Spread, Summary, clip_record, drop_reasons, find_sample, packed_keys, summarize
from dataset.layout import JOB_FILE, SELECTION, SHARD_INDEX
from dataset.pictures import write_picture
from dataset.receipts import read_receipts, reason_counts
from dataset.selection import read_selection
from labeling.errors import AnimaticError, ConfigError, DataError
from pipelines.black_skeletons import black_skeletons, print_black_skeletons
from pipelines.console import counted, dropped_words, file_size, make_console, print_damaged, shortened
from pipelines.damage import damaged_videos
from pipelines.job import Job, open_job
from pipelines.next_training import next_training
from pipelines.nothing_left import clips_packed, why_nothing_is_left
from pipelines.stage import COMMAND_STAGES, item_state
from pipelines.stale_shards import print_stale_shards


@dataclass(frozen=True, slots=True, kw_only=True)
class StageStatus:
    """How far one stage has come."""

    stage: str
    items: int | None
    """How many there should be; None where an earlier stage must end first."""
    done: int = 0
    pending: int = 0
    """Never made, or out of date."""
    dropped: Mapping[str, int] = field(default_factory=dict)
    """By reason."""
    failed: Mapping[str, int] = field(default_factory=dict)
    """By reason, for good."""
    retryable: Mapping[str, int] = field(default_factory=dict)
    """By reason, to be tried again."""
    waits_for: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class JobStatus:
    """How far a job has come, and what to type next."""

    root: str
    videos: int
    stages: tuple[StageStatus, ...]
    clips: Mapping[str, int]
    """Clips that are still kept, and those dropped, by the selection or when they were to be drawn, by reason."""
    damaged: tuple[str, ...]
    """Videos that are less than they claim, with what they lack."""
    nothing_left: str
    """Why a job that is through holds no clip; empty where it holds some, and before."""
    next_command: str
    next_reason: str


def job_status(root: Path) -> JobStatus:
    """The status of a job, from its receipts alone.

    Raises:
        ConfigError: no job there.
    """
    job = open_job(root)
    stages = tuple(stage_status(job, name) for names in COMMAND_STAGES.values() for name in names)
    empty = why_nothing_is_left(root) if _is_through(stages) and clips_packed(job) == 0 else ""
    command, reason = _next(job, stages, empty=bool(empty))
    return JobStatus(
        root=str(root), videos=len(job.sources), stages=stages, clips=_selected(root),
        damaged=tuple(damaged_videos(job)), nothing_left=empty, next_command=command, next_reason=reason,
    )  # fmt: skip


def stage_status(job: Job, name: str) -> StageStatus:
    """One stage's counts; its plan says what there should be, its receipts what there is."""
    known = job.receipts(name)
    try:
        items = job.plan(name)
    except AnimaticError as error:
        return StageStatus(stage=name, items=None, waits_for=str(error))
    states = {item.name: item_state(item, known.get(item.name), job.root) for item in items}
    settled = [known[name] for name, state in states.items() if state in ("current", "retry")]
    failed = [receipt for receipt in settled if receipt.state == "failed"]
    return StageStatus(
        stage=name, items=len(items), done=sum(receipt.state == "done" for receipt in settled),
        pending=sum(state in ("missing", "stale") for state in states.values()),
        dropped=reason_counts(receipt.reason for receipt in settled if receipt.state == "dropped"),
        failed=reason_counts(receipt.reason for receipt in failed if not receipt.retryable),
        retryable=reason_counts(receipt.reason for receipt in failed if receipt.retryable),
    )  # fmt: skip


def _selected(root: Path) -> dict[str, int]:
    try:
        rows, reasons = read_selection(root / SELECTION).rows, drop_reasons(root)
    except DataError:
        return {}
    return {"kept": len(rows) - len(reasons), **reason_counts(reasons.values())}


def _is_through(stages: tuple[StageStatus, ...]) -> bool:
    return not any(stage.items is None or stage.pending or stage.retryable for stage in stages)


def _next(job: Job, stages: tuple[StageStatus, ...], *, empty: bool) -> tuple[str, str]:
    """What to type next, and why."""
    root = job.root
    again = f"animatic label --out {shlex.quote(str(root))}"
    for stage in stages:
        if stage.retryable:
            count = sum(stage.retryable.values())
            return again, f"{count} of {stage.stage} failed for a reason that may pass"
        if stage.items is None or stage.pending:
            left = f"{stage.pending} of {stage.stage} are to be made" if stage.pending else stage.waits_for
            return again, left
    if empty:
        return again, "with other settings or videos: no clip is left"
    if stages[-1].done and (root / SHARD_INDEX).is_file():
        # A person who has cached latents all the same may have other control videos.
        if black_skeletons(job) and not any((root / "latents").glob("*/cache.json")):
            return "animatic models", f"to get a keypoint network: without one skeletons are black; then `{again}`"
        return next_training(root)
    return again, "nothing is packed yet"


def print_status(root: Path, *, as_json: bool = False) -> int:
    """Print a job's status; 1 where something failed or no clip is left."""
    status = job_status(root)
    failed = bool(status.nothing_left) or any(stage.failed or stage.retryable for stage in status.stages)
    console = make_console()
    if as_json:
        print(json.dumps(asdict(status), indent=1))
        return int(failed)
    table = Table(
        title=escape(f"{root}: {counted(status.videos, 'video')}"),
        title_justify="left",
        box=None,
        pad_edge=False,
    )
    table.add_column("stage", style="bold")
    for column in ("items", "done", "to do"):
        table.add_column(column, justify="right")
    table.add_column("dropped")
    table.add_column("failed")
    for stage in status.stages:
        if stage.items is None:
            table.add_row(stage.stage, "?", "", "", "", "[dim]waits for an earlier stage[/]")
            continue
        lost = _words(stage.failed, "") + _words(stage.retryable, ", to be tried again")
        table.add_row(
            stage.stage, str(stage.items), str(stage.done), str(stage.pending or ""), "; ".join(_words(stage.dropped)),
            f"[red]{escape('; '.join(lost))}[/]" if lost else "",
        )  # fmt: skip
    console.print(table)
    if status.clips:
        dropped = {name: count for name, count in status.clips.items() if name != "kept"}
        console.print("clips: " + ", ".join([f"{status.clips['kept']} kept", *dropped_words(dropped)]))
    for line in failure_lines(root):
        console.print(f"[red]{escape(line)}[/]")
    print_damaged(status.damaged, console, most=20)
    print_black_skeletons(root, console)
    if status.nothing_left:
        console.print(f"[red]{escape(status.nothing_left)}[/]")
    console.print(f"next: [bold]{escape(status.next_command)}[/]  [dim]({escape(status.next_reason)})[/]")
    return int(failed)


def _words(counts: Mapping[str, int], ending: str = "") -> list[str]:
    return [f"{count} {reason}{ending}" for reason, count in counts.items()]


def failure_lines(root: Path, *, most: int = 20) -> list[str]:
    """What failed and why, one line each."""
    lines = [
        f"{stage}: {receipt.item}: {receipt.message}"
        for names in COMMAND_STAGES.values()
        for stage in names
        for receipt in read_receipts(root, stage).values()
        if receipt.state == "failed"
    ]
    return shortened(lines, most)


def inspect(
    root: Path, key: str | None, *, sheet: Path | None = None, trajectory: Path | None = None, as_json: bool = False,
    keys: bool = False,
) -> int:  # fmt: skip
    """The dataset's summary, a clip's record, contact sheet and trajectory, or the packed clips' keys.

    Raises:
        AnimaticError: no job, no such clip, a clip that was dropped, or a picture that cannot be written.
    """
    if keys:
        if key is not None or sheet is not None or trajectory is not None:
            raise ConfigError("--keys lists all packed clips; give it without a clip and without pictures")
        by_split = packed_keys(root)
        if as_json:
            print_json(by_split)
            return 0
        for split, packed in by_split.items():
            for one in packed:
                print(f"{one}\t{split}")
        return 0
    if key is None:
        if sheet is not None or trajectory is not None:
            option = "--sheet" if sheet is not None else "--trajectory"
            raise ConfigError(f"{option} shows one clip; name it, such as {_some_key(root)}")
        summary = summarize(root)
        print_json(asdict(summary)) if as_json else _print_summary(root, summary)
        return 0
    sample = find_sample(root, key)
    if sheet is not None:
        write_picture(sheet, contact_sheet(sample))
    if trajectory is not None:
        from dataset.trajectory_picture import write_trajectory_picture

        write_trajectory_picture(root, key, trajectory)
    record = clip_record(sample)
    if as_json:
        print_json(record)
    else:
        _print_record(record)
        if sheet is not None:
            make_console().print(f"contact sheet: {sheet}")
        if trajectory is not None:
            make_console().print(f"trajectory: {trajectory}")
    return 0


def _some_key(root: Path) -> str:
    keys = [key for packed in packed_keys(root).values() for key in packed]
    return keys[0] if keys else "<video_id>_<start_frame>"


def print_json(value: Any) -> None:
    """Print JSON, a key to a line."""
    print(json.dumps(value, indent=1))


def _print_summary(root: Path, summary: Summary) -> None:
    console = make_console()
    table = Table(title=escape(str(root)), title_justify="left", show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold")
    table.add_column()
    rule = f"at least {summary.threshold:.3g} objects" if summary.threshold is not None else "no threshold"
    kept = f"kept {summary.kept} ({rule})" if summary.kept else "none kept"
    rows = {
        "source": f"{videos_words(root, summary)}, {summary.source_hours:.3g} h",
        "clips": f"{summary.clips}, {kept}, packed {sum(summary.packed.values())} "
        f"({', '.join(f'{count} {split}' for split, count in summary.packed.items())}), {summary.clip_hours:.3g} h",
        "dropped": ", ".join(f"{count} {reason}" for reason, count in summary.dropped.items()) or "none",
        "objects per clip": _spread_text(summary.objects_per_clip, "counted"),
        "tracks per clip": _spread_text(summary.tracks_per_clip, ""),
        "path length": _spread_text(summary.path_length_m, "m"),
        "bytes": ", ".join(f"{kind} {file_size(size)}" for kind, size in summary.bytes_by_kind.items()) or "none",
        "failed": ", ".join(f"{count} in {stage}" for stage, count in summary.failed.items()) or "none",
    }
    for name, text in rows.items():
        table.add_row(name, escape(text))
    console.print(table)
    if (root / JOB_FILE).is_file():
        print_damaged(damaged_videos(open_job(root)), console)
    print_black_skeletons(root, console)
    print_stale_shards(root, console)
    if sum(summary.packed.values()):
        command = f"animatic inspect {shlex.quote(str(root))} {_some_key(root)} --sheet sheet.png"
        console.print(f"one clip: [bold]{escape(command)}[/]")
    elif not summary.kept or (root / SHARD_INDEX).is_file():
        console.print(f"[red]{escape(why_nothing_is_left(root))}[/]")


def videos_words(root: Path, summary: Summary) -> str:
    """How many videos a job has, and of how many of them the summary is."""
    videos = len(open_job(root).sources) if (root / JOB_FILE).is_file() else summary.videos
    if videos <= summary.videos:
        return counted(summary.videos, "video")
    return f"{counted(videos, 'video')}, {summary.videos} of them indexed"


def _spread_text(found: Spread | None, unit: str) -> str:
    if found is None:
        return "not counted"
    return f"{found.least:.3g} to {found.greatest:.3g}, median {found.median:.3g} {unit}".rstrip()


def _print_record(record: Mapping[str, Any]) -> None:
    table = Table(title=record["key"], title_justify="left", show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold")
    table.add_column()
    for name, value in record.items():
        if isinstance(value, Mapping):
            value = ", ".join(f"{key} {_short(item)}" for key, item in value.items())
        table.add_row(name, escape(str(_short(value))))
    make_console().print(table)


def _short(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value
