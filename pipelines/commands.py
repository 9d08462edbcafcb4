"""What the labelling commands do: settings from options, a job, its stages, and an exit code."""

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.markup import escape

from dataset.layout import JOB_FILE, SELECTION
from dataset.receipts import Receipt, make_folder
from dataset.selection import check_split, read_selection, twin_holders
from labeling.captions import read_caption_table
from labeling.ego_import import FileClock
from labeling.errors import ConfigError
from labeling.extractors import ExtractorChoice, Extractors, choose_extractors
from labeling.onnx_model import resolve_providers
from labeling.settings_files import read_yaml
from pipelines.cli_options import listed
from pipelines.config import EFFORTS, Config, merged, parse_config, with_effort
from pipelines.console import ConsoleReporter, counted, print_damaged, print_failures, print_twins
from pipelines.damage import damaged_videos
from pipelines.engine import Engine
from pipelines.given_tables import read_cameras, read_split
from pipelines.imports import import_trajectories
from pipelines.job import Job, open_job, open_or_create
from pipelines.job_changes import job_changes
from pipelines.label import ALL_STAGES, SLICE_STAGES, StageReport, run_stages, sweep_outdated
from pipelines.models import check_models_folder
from pipelines.nothing_left import clips_packed, why_nothing_is_left
from pipelines.sources import absolute, find_videos
from pipelines.stage import COMMAND_STAGES, Part, parse_part
from pipelines.stages_select import NO_DETECTOR, job_extractors, refuse_extend


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOptions:
    """Options as a person gave them; what is None stays as the job has it."""

    config: Path | None = None
    effort: str | None = None
    keep_share: float | None = None
    models: Path | None = None
    extractors: str | None = None
    videos: str | None = None
    captions: Path | None = None
    split: Path | None = None
    leave_out: Path | None = None
    cameras: Path | None = None
    workers: int | None = None
    part: str | None = None
    wait_minutes: float = 0.0


def run_label(videos: Sequence[Path], out: Path, options: JobOptions) -> int:
    """The main job; 0, or 1 where something failed or no clip is left.

    Raises:
        AnimaticError: something a person can mend before anything is spent.
    """
    reporter = ConsoleReporter()
    job = prepare_job(videos, out, options, check=lambda job: check_extractors(job, reporter), reporter=reporter)
    reports = run_job(job, ALL_STAGES, options, reporter)
    sweep_outdated(job)
    return _finish(job, reports, reporter)


def run_slice(videos: Sequence[Path], out: Path, options: JobOptions) -> int:
    """Index and cut with every clip kept; 0, or 1 where something failed."""
    reporter = ConsoleReporter()
    job = prepare_job(videos, out, options, reporter=reporter)
    return _finish(job, run_job(job, SLICE_STAGES, options, reporter), reporter)


def run_index(videos: Sequence[Path], out: Path, options: JobOptions) -> int:
    """Index, on a new job or one that is there; 0, or 1 where something failed."""
    reporter = ConsoleReporter()
    job = prepare_job(videos, out, options, check=chosen_cards, reporter=reporter)
    return _finish(job, run_job(job, COMMAND_STAGES["index"], options, reporter), reporter)


def run_single(stage: str, out: Path, *, workers: int | None = None, part: str | None = None) -> int:
    """One stage of a job that is there; 0, or 1 where something failed."""
    reporter = ConsoleReporter()
    options = JobOptions(workers=workers, part=part)
    job = open_job(out)
    return _finish(job, run_job(job, COMMAND_STAGES[stage], options, reporter), reporter)


def run_ego(
    out: Path, *, imported: Path | None = None, clock: FileClock | None = None, workers: int | None = None,
    part: str | None = None,
) -> int:  # fmt: skip
    """The ego stage of a job that is there, after taking trajectories from elsewhere where there are some; 0, or 1
    where something failed."""
    if imported is None:
        return run_single("ego", out, workers=workers, part=part)
    reporter = ConsoleReporter()
    job = open_job(out)
    taken = import_trajectories(job, imported, clock=clock)
    others = len(job.sources) - len(taken)
    reporter.console.print(
        f"[bold]{'import':>10}[/] trajectories of {counted(len(taken), 'video')} ({', '.join(taken[:3])}"
        f"{', ...' * (len(taken) > 3)}); {others} of the job's others stay as they are"
    )
    options = JobOptions(workers=workers, part=part)
    code = _finish(job, run_job(job, COMMAND_STAGES["ego"], options, reporter), reporter)
    reporter.console.print(f"{'':>10} `animatic label --out {out}` draws and packs what has changed")
    return code


def run_select(out: Path, *, extend: bool = False, refreeze: bool = False, workers: int | None = None) -> int:
    """Select, extend or select anew; 0, or 1 where something failed."""
    if extend and refreeze:
        raise ConfigError("--extend keeps the threshold and --refreeze computes it anew; give one of them")
    reporter = ConsoleReporter()
    job = open_job(out)
    job.selection_mode = "extend" if extend else "refreeze" if refreeze else "auto"
    if extend:
        refuse_extend(job)
    with Engine(job.root, workers=0 if workers is None else workers) as engine:
        reports = run_stages(job, ("select",), engine, reporter, refreeze=refreeze or extend)
    if reports[-1].failed and reports[-1].failed[0].reason == ConfigError.reason:
        raise ConfigError(reports[-1].failed[0].message)
    return _finish(job, reports, reporter)


def prepare_job(
    videos: Sequence[Path], out: Path, options: JobOptions, *, check: Callable[[Job], object] | None = None,
    reporter: ConsoleReporter | None = None,
) -> Job:  # fmt: skip
    """The job with its settings and videos, written to ``job.yaml``.

    Args:
        videos: to add to the job.
        out: its folder.
        options: on top of the job's settings.
        check: raises for what the command could not use; what cannot be used leaves no ``job.yaml`` behind.
        reporter: told, before anything is spent, of what changes in a job that is there.

    Raises:
        AnimaticError: settings, tables, videos, a part or a folder that cannot be used.
    """
    if options.part is not None:
        parse_part(options.part)
    _refuse_file(out)
    sources = find_videos(videos, out=out) if videos else []
    if sources:
        _refuse_other_folder(out)
    job = open_or_create(out, videos=sources, models_dir=options.models, leave_out=options.leave_out)
    config = configured(job.config, options)
    _check_tables(config, list(job.sources))
    job = Job(absolute(job.root), config, job.sources, models_dir=job.models_dir)
    check_models_folder(options.models)
    if check is not None:
        check(job)
    if reporter is not None and (out / JOB_FILE).is_file() and (words := job_changes(open_job(out), job)):
        reporter.console.print(f"[bold]{'job':>10}[/] {escape(f'{out}: {words}')}")
    make_folder(out)
    job.save()
    return job


def _refuse_file(out: Path) -> None:
    """Before networks are opened: a folder cannot be made where, or below where, a file lies."""
    there = next((place for place in (out, *out.parents) if place.exists()), None)
    if there is not None and not there.is_dir():
        raise ConfigError(f"--out {out}: {there} is a file; give a folder that can be written to")


def _refuse_other_folder(out: Path) -> None:
    """A folder of other things (the videos, as a rule) is not to be filled with a job's."""
    if out.is_dir() and not (out / JOB_FILE).is_file():
        # What another part is just writing begins with a dot.
        others = sorted(path.name for path in out.iterdir() if not path.name.startswith("."))
        if others:
            raise ConfigError(f"--out {out}: is no job and not empty (holds {others[0]}); give a job or a new folder")


def _check_tables(config: Config, video_ids: Sequence[str]) -> None:
    unknown = sorted(set(config.cameras) - set(video_ids))
    if unknown:
        raise ConfigError(f"cameras: {unknown[0]!r} is none of the videos; use ids, as {', '.join(video_ids[:3])}")
    if config.select.split is not None:
        check_split(config.select.split, video_ids)


def configured(config: Config, options: JobOptions) -> Config:
    """Settings with a person's options on top.

    Raises:
        ConfigError: an option that no setting allows, or a table that cannot be read.
        DataError: captions that cannot be read.
    """
    if options.config is not None:
        config = parse_config(read_yaml(options.config), str(options.config))
    if options.effort is not None:
        if options.effort not in EFFORTS:
            raise ConfigError(f"--effort {options.effort!r} is not known; choose one of {', '.join(EFFORTS)}")
        config = with_effort(config, next(effort for effort in EFFORTS if effort == options.effort))
    for option, changes in _option_changes(options):
        try:
            config = merged(config, changes)
        except ConfigError as error:
            raise ConfigError(f"{option}: {str(error).removeprefix('settings: ')}") from error
    if config.views.captions is not None:
        read_caption_table(Path(config.views.captions))
    return config


def _option_changes(options: JobOptions) -> Iterator[tuple[str, dict[str, Any]]]:
    """Each option that stands for a setting, as it was typed, with what it changes."""
    if options.keep_share is not None:
        yield f"--keep-share {options.keep_share:g}", {"select": {"keep_share": options.keep_share}}
    if options.split is not None:
        yield f"--split {options.split}", {"select": {"split": read_split(options.split)}}
    if options.cameras is not None:
        yield f"--cameras {options.cameras}", {"cameras": read_cameras(options.cameras)}
    if options.extractors is not None:
        names = list(listed(options.extractors))
        yield f"--extractors {options.extractors}", {"keypoints": {"extractors": names}}
    if options.videos is not None:
        yield f"--videos {options.videos}", {"pack": {"videos": options.videos}}
    if options.captions is not None:
        yield f"--captions {options.captions}", {"views": {"captions": str(absolute(options.captions))}}


def check_extractors(job: Job, reporter: ConsoleReporter) -> None:
    """Open every network once before anything is spent, and say what is left out.

    Raises:
        ConfigError: no detector, though clips are to be ranked by what they show.
        ModelError: weights that break their card's contract, or a provider that is not there.
    """
    choice, counting = chosen_cards(job)
    if counting.detector is None and job.config.select.keep_share < 1:
        raise ConfigError(NO_DETECTOR)
    resolve_providers(job.config.count.providers)
    settings = job.config.keypoints
    opened = Extractors(choice, models_dir=job.models_dir, providers=settings.providers, threads=settings.threads)
    used = ", ".join(card.name for card in opened.choice.cards) or "none"
    reporter.console.print(f"[bold]{'models':>10}[/] {used}; providers {', '.join(settings.providers)}")
    if choice.missing_categories:
        reporter.console.print(
            f"{'':>10} no keypoints of {', '.join(choice.missing_categories)}: no weights for "
            f"{', '.join(choice.absent) or 'them'} (`animatic models` says how to get them)"
        )


def chosen_cards(job: Job) -> tuple[ExtractorChoice, ExtractorChoice]:
    """The cards that label a job, and those that its objects are counted by.

    Raises:
        ConfigError: a name that no card has, or ``count.detector`` is that of no detector.
        ModelError: a card that is named has no weights.
    """
    choice, name = job_extractors(job), job.config.count.detector
    if name is None:
        return choice, choice
    counting = choose_extractors((name,), models_dir=job.models_dir)
    if counting.detector is None:
        raise ConfigError(f"count.detector: {name!r} is no detector; choose a card of boxes from `animatic models`")
    return choice, counting


def run_job(job: Job, stages: Sequence[str], options: JobOptions, reporter: ConsoleReporter) -> list[StageReport]:
    """Run stages on the local pool."""
    part = parse_part(options.part) if options.part else Part()
    workers = options.workers if options.workers is not None else max(1, os.cpu_count() or 1)
    with Engine(job.root, workers=workers) as engine:
        return run_stages(job, stages, engine, reporter, part=part, patience_s=options.wait_minutes * 60)


def _finish(job: Job, reports: Sequence[StageReport], reporter: ConsoleReporter) -> int:
    failed: list[Receipt] = [receipt for report in reports for receipt in report.failed]
    print_failures(failed, reporter.console)
    stages = {report.stage for report in reports}
    if stages & {"index", "cut"}:
        print_damaged(damaged_videos(job), reporter.console)
    if "select" in stages and (job.root / SELECTION).is_file():
        print_twins(twin_holders(read_selection(job.root / SELECTION)), reporter.console)
    if _is_empty(job, stages):
        reporter.console.print(f"[red]{escape(why_nothing_is_left(job.root))}[/]")
        return 1
    if "shards" in stages and not failed:
        reporter.console.print(f"{'':>10} look at it with `animatic inspect {job.root}`")
    return 1 if failed else 0


def _is_empty(job: Job, stages: Collection[str]) -> bool:
    """Whether stages that were run have left no clip: none is packed, or none selected."""
    if "select" in stages and (job.root / SELECTION).is_file() and not read_selection(job.root / SELECTION).kept:
        return True
    return "shards" in stages and clips_packed(job) == 0
