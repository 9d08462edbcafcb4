"""The command line. Commands import what they run when they are called, so that ``animatic --help`` answers at once."""

import errno
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli_errors import USAGE_ERRORS, print_usage_error, refuse_empty_paths
from pipelines.cli_options import (
    LABEL,
    LOOK,
    STAGES,
    STOPPED,
    AsJson,
    Cameras,
    ConfigFile,
    Effort,
    Extractors,
    JobFolder,
    KeepShare,
    LeaveOut,
    Models,
    MoreVideos,
    Out,
    PartOf,
    Videos,
    Wait,
    Workers,
)
from pipelines.cli_training import commands as training_commands

app = typer.Typer(
    name="animatic",
    help="Motion Appearance Decoupling for driving world models: raw driving videos in, two trained adapters out.",
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich",
)  # fmt: skip


def main() -> None:
    """Entry point: a person sees one line and exit code 2 for what they can mend, never a traceback."""
    from labeling.errors import AnimaticError

    try:
        refuse_empty_paths(app, sys.argv[1:])
        code = app(standalone_mode=False)
    except AnimaticError as error:
        from pipelines.console import print_error

        print_error(error)
        sys.exit(2)
    except USAGE_ERRORS as error:
        print_usage_error(error)
        sys.exit(2)
    except typer.Abort:
        sys.exit(1)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            from pipelines.console import print_error

            print_error(_too_long(error))
            sys.exit(2)
        if not isinstance(error, BrokenPipeError):
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    # typer makes this of Ctrl-C, without a word.
    if code == STOPPED:
        print("stopped; run the same command again to go on", file=sys.stderr)
    sys.exit(code if isinstance(code, int) else 0)


def _too_long(error: OSError) -> Exception:
    """What is no file's name was still asked for as one: an argument that is a recipe, a preset or a path."""
    from labeling.errors import ConfigError

    name = str(error.filename or "a name")
    return ConfigError(f"{name[:40]}... is no path: it has {len(name)} letters, more than a file's name may have")


@app.command(rich_help_panel=LABEL)
def plan(
    videos: Videos,
    config: ConfigFile = None,
    effort: Effort = None,
    keep_share: KeepShare = None,
    models: Models = None,
    extractors: Extractors = None,
    workers: Workers = None,
    parts: Annotated[int, typer.Option(min=1, help="Hosts that share the videos.")] = 1,
    leave_out: LeaveOut = None,
    cameras: Cameras = None,
    as_json: AsJson = False,
) -> None:
    """What labelling would take, before anything is spent: clips, disk and hours, from a minute of the footage."""
    from pipelines.commands import JobOptions
    from pipelines.plan_console import show_plan

    options = JobOptions(
        config=config, effort=effort, keep_share=keep_share, models=models, extractors=extractors, workers=workers,
        leave_out=leave_out, cameras=cameras,
    )  # fmt: skip
    raise typer.Exit(show_plan(videos, options, parts=parts, as_json=as_json))


@app.command(rich_help_panel=LABEL)
def label(
    out: Out,
    videos: MoreVideos = None,
    config: ConfigFile = None,
    effort: Effort = None,
    keep_share: KeepShare = None,
    models: Models = None,
    extractors: Extractors = None,
    workers: Workers = None,
    part: PartOf = None,
    leave_out: LeaveOut = None,
    cameras: Cameras = None,
    videos_kept: Annotated[str | None, typer.Option("--videos", help="all, or rgb to pack without the views.")] = None,
    captions: Annotated[Path | None, typer.Option(help="Table of key and text; other clips get the template.")] = None,
    split: Annotated[Path | None, typer.Option(help="CSV of video_id,split instead of the hash.")] = None,
    wait: Wait = 10.0,
) -> None:
    """Raw videos to packed, labelled clips: index, count, select, cut, keypoints, ego, render, pack."""
    from pipelines.commands import JobOptions, run_label

    options = JobOptions(
        config=config, effort=effort, keep_share=keep_share, models=models, extractors=extractors, videos=videos_kept,
        captions=captions, split=split, leave_out=leave_out, cameras=cameras, workers=workers, part=part,
        wait_minutes=wait,
    )  # fmt: skip
    raise typer.Exit(run_label(videos or [], out, options))


@app.command(name="slice", rich_help_panel=LABEL)
def slice_videos(
    videos: Videos,
    out: Out,
    config: ConfigFile = None,
    workers: Workers = None,
    part: PartOf = None,
    leave_out: LeaveOut = None,
    wait: Wait = 10.0,
) -> None:
    """Index and cut, with every clip kept: the 24 fps runs alone."""
    from pipelines.commands import JobOptions, run_slice

    options = JobOptions(
        config=config, keep_share=1.0, workers=workers, part=part, leave_out=leave_out, wait_minutes=wait
    )
    raise typer.Exit(run_slice(videos, out, options))


@app.command(rich_help_panel=LABEL)
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for videos, job, adapters and report.")] = Path(
        "demo"
    ),
    workers: Workers = None,
) -> None:
    """The whole of it on a synthetic street, in minutes: videos, labels, two adapters, a sample, a report."""
    from pipelines.demo import run_demo

    raise typer.Exit(run_demo(out, workers=workers))


def _stage_command(name: str, text: str) -> None:
    def command(out: Out, workers: Workers = None, part: PartOf = None) -> None:
        from pipelines.commands import run_single

        raise typer.Exit(run_single(name, out, workers=workers, part=part))

    command.__doc__ = text
    app.command(name=name, rich_help_panel=STAGES)(command)


@app.command(rich_help_panel=STAGES)
def index(
    out: Out, videos: MoreVideos = None, config: ConfigFile = None,
    models: Models = None, keep_share: KeepShare = None, extractors: Extractors = None, leave_out: LeaveOut = None,
    cameras: Cameras = None, workers: Workers = None, part: PartOf = None,
) -> None:  # fmt: skip
    """Presentation times and keyframes of every video; packets only, nothing is decoded."""
    from pipelines.commands import JobOptions, run_index

    options = JobOptions(
        config=config, keep_share=keep_share, models=models, extractors=extractors, leave_out=leave_out,
        cameras=cameras, workers=workers, part=part,
    )  # fmt: skip
    raise typer.Exit(run_index(videos or [], out, options))


_stage_command("count", "Objects per clip, on the videos' own keyframes.")


@app.command(rich_help_panel=STAGES)
def select(
    out: Out,
    extend: Annotated[bool, typer.Option("--extend", help="Judge added videos by the frozen threshold.")] = False,
    refreeze: Annotated[bool, typer.Option("--refreeze", help="Compute threshold, sample and split anew.")] = False,
    workers: Workers = None,
) -> None:
    """Keep the clips with the most objects; split and sample. The one barrier: every part must have counted."""
    from pipelines.commands import run_select

    raise typer.Exit(run_select(out, extend=extend, refreeze=refreeze, workers=workers))


@app.command(rich_help_panel=STAGES)
def ego(
    job: Annotated[Path | None, typer.Argument(help="The job's folder (or --out).")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The job's folder.")] = None,
    imported: Annotated[
        Path | None,
        typer.Option(
            "--import", help="Trajectories from elsewhere: a TUM or KITTI file, or a folder of <video_id>.tum."
        ),
    ] = None,
    offset: Annotated[float, typer.Option(help="The file's time, seconds, at the video's first frame.")] = 0.0,
    fps: Annotated[
        float | None, typer.Option(min=0.1, help="Rows a second of a KITTI file; by default a row for each frame.")
    ] = None,
    workers: Workers = None,
    part: PartOf = None,
) -> None:
    """The camera's trajectory over every run: corners, one camera per video, motion; or from a file."""
    from labeling.ego_import import FileClock
    from labeling.errors import ConfigError
    from pipelines.commands import run_ego

    folder = job or out
    if folder is None:
        raise ConfigError("no job is named; give its folder, as `animatic ego JOB`")
    clock = FileClock(offset_s=offset, fps=fps)
    raise typer.Exit(run_ego(folder, imported=imported, clock=clock, workers=workers, part=part))


for _name, _text in (
    ("cut", "The 24 fps runs around kept clips; each frame decoded and encoded once."),
    ("keypoints", "Keypoints and tracks of every run."),
    ("render", "Skeleton, ego and object videos, and captions."),
    ("pack", "Shards and their index."),
):
    _stage_command(_name, _text)


@app.command(rich_help_panel=LOOK)
def status(job: JobFolder, as_json: AsJson = False) -> None:
    """What is done, dropped and failed, stage by stage, and what to type next."""
    from pipelines.status import print_status

    raise typer.Exit(print_status(job, as_json=as_json))


@app.command(rich_help_panel=LOOK)
def inspect(
    job: JobFolder,
    key: Annotated[str | None, typer.Argument(help="A clip; without one, the whole dataset in numbers.")] = None,
    sheet: Annotated[Path | None, typer.Option(help="Write the clip's contact sheet here.")] = None,
    trajectory: Annotated[
        Path | None, typer.Option(help="Write the clip's way from above, its speed and yaw rate here (.png).")
    ] = None,
    keys: Annotated[bool, typer.Option("--keys", help="List the packed clips, each with its split.")] = False,
    as_json: AsJson = False,
) -> None:
    """The dataset in numbers, or one clip's record, contact sheet and trajectory."""
    from pipelines.status import inspect as inspect_job

    raise typer.Exit(inspect_job(job, key, sheet=sheet, trajectory=trajectory, as_json=as_json, keys=keys))


@app.command(rich_help_panel=LOOK)
def report(
    job: JobFolder, out: Annotated[Path | None, typer.Option("--out", "-o", help="By default JOB/report.html.")] = None
) -> None:  # fmt: skip
    """One self-contained page: a clip in its videos, selection, trajectories, stages, failures."""
    from pipelines.report import write_report

    print(write_report(job, out=out))


models_app = typer.Typer()
app.add_typer(models_app, name="models", rich_help_panel=LOOK)


@models_app.callback(invoke_without_command=True)
def list_models(context: typer.Context, models: Models = None, as_json: AsJson = False) -> None:
    """The model cards, which weights are present, and how to get the others; `check` tries one."""
    if context.invoked_subcommand is None:
        from pipelines.models import print_models

        raise typer.Exit(print_models(models, as_json=as_json))


@models_app.command("check")
def check_model(
    card: Annotated[str, typer.Argument(help="Name of a model card.")],
    image: Annotated[
        list[Path] | None,
        typer.Option(help="A picture, or a video, that shows what the network looks for; repeatable."),
    ] = None,
    models: Models = None,
    as_json: AsJson = False,
) -> None:
    """Run a model as its card says, and as the card's likely mistakes would: which fits?"""
    from pipelines.model_check import print_check

    raise typer.Exit(print_check(card, image or [], models_dir=models, as_json=as_json))


export_app = typer.Typer(help="Write a job in other forms.", no_args_is_help=True)
app.add_typer(export_app, name="export", rich_help_panel=LOOK)


@export_app.callback()
def _export() -> None:
    """Write a job in other forms."""


@export_app.command("released")
def export_released(
    job: JobFolder,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the manifest and its loose files.")],
    split: Annotated[str, typer.Option(help="train or val.")] = "train",
) -> None:
    """The released trainer's JSONL (id, caption, rgb_path, pose_path) with loose files."""
    from pipelines.export import export_released as export

    raise typer.Exit(export(job, out, split=split))


@export_app.command("coco")
def export_coco(
    job: JobFolder,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for the JSON file, and with --images for its pictures.")
    ],
    split: Annotated[str | None, typer.Option(help="train or val; by default both.")] = None,
    images: Annotated[
        bool, typer.Option("--images", help="Write the frames that the file names as JPEG files too.")
    ] = False,
) -> None:
    """Keypoints, boxes and tracks as COCO JSON; the pictures that it names are written with --images alone."""
    from pipelines.export_coco import export_coco as export

    raise typer.Exit(export(job, out, split=split, images=images))


app.add_typer(training_commands)

if __name__ == "__main__":
    main()
