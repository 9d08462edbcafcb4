"""The command line. Commands import what they run when they are called, so that ``animatic --help`` answers at once."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    name="animatic",
    help="Motion Appearance Decoupling for driving world models: raw driving videos in, two trained adapters out.",
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode="rich",
)  # fmt: skip

LABEL, STAGES, LOOK, TRAIN, MEASURE = "Label videos", "Single stages", "Look", "Train and sample", "Measure"

Videos = Annotated[list[Path], typer.Argument(help="Video files, folders of them, or text files of paths.")]
MoreVideos = Annotated[
    list[Path] | None,
    typer.Argument(help="Video files, folders of them, or text files of paths; a job that is there keeps its own."),
]
Out = Annotated[Path, typer.Option("--out", "-o", help="The job's folder.")]
JobFolder = Annotated[Path, typer.Argument(help="The job's folder.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="Settings in YAML.")]
Effort = Annotated[str | None, typer.Option("--effort", help="fast, balanced or exact.")]
KeepShare = Annotated[float | None, typer.Option(help="Share of the clips to keep, by objects; 1 keeps every clip.")]
Models = Annotated[Path | None, typer.Option("--models", help="Folder of ONNX weights.")]
Extractors = Annotated[
    str | None, typer.Option(help="Model cards by name, with commas; 'street' for the shipped ones.")
]
Workers = Annotated[int | None, typer.Option(min=0, help="Processes; by default one per core.")]
PartOf = Annotated[str | None, typer.Option("--part", help="i/n: this host's share of the videos.")]
LeaveOut = Annotated[Path | None, typer.Option(help="CSV of video_id,start_s,end_s: seconds to leave out at each end.")]
Wait = Annotated[float, typer.Option(help="Minutes to wait for other parts that make no progress.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def main() -> None:
    """Entry point: a person sees one line and exit code 2 for what they can mend, never a traceback."""
    from labeling.errors import AnimaticError

    try:
        app()
    except AnimaticError as error:
        from pipelines.console import print_error

        print_error(error)
        sys.exit(2)
    except KeyboardInterrupt:
        print("stopped; run the same command again to go on", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


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
    as_json: AsJson = False,
) -> None:
    """What labelling would take, before anything is spent: clips, disk and hours, from a minute of the footage."""
    from pipelines.commands import JobOptions
    from pipelines.plan_console import show_plan

    options = JobOptions(
        config=config, effort=effort, keep_share=keep_share, models=models, extractors=extractors, workers=workers,
        leave_out=leave_out,
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
    videos_kept: Annotated[str | None, typer.Option("--videos", help="all, or rgb to pack without the views.")] = None,
    captions: Annotated[Path | None, typer.Option(help="Table of key and text; other clips get the template.")] = None,
    split: Annotated[Path | None, typer.Option(help="CSV of video_id,split instead of the hash.")] = None,
    wait: Wait = 10.0,
) -> None:
    """Raw videos to packed, labelled clips: index, count, select, cut, keypoints, ego, render, pack."""
    from pipelines.commands import JobOptions, run_label

    options = JobOptions(
        config=config, effort=effort, keep_share=keep_share, models=models, extractors=extractors, videos=videos_kept,
        captions=captions, split=split, leave_out=leave_out, workers=workers, part=part, wait_minutes=wait,
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
    workers: Workers = None, part: PartOf = None,
) -> None:  # fmt: skip
    """Presentation times and keyframes of every video; packets only, nothing is decoded."""
    from pipelines.commands import JobOptions, run_index

    options = JobOptions(
        config=config, keep_share=keep_share, models=models, extractors=extractors, leave_out=leave_out,
        workers=workers, part=part,
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


for _name, _text in (
    ("cut", "The 24 fps runs around kept clips; each frame decoded and encoded once."),
    ("keypoints", "Keypoints and tracks of every run."),
    ("ego", "The camera's trajectory over every run."),
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
    as_json: AsJson = False,
) -> None:
    """The dataset in numbers, or one clip's record and contact sheet."""
    from pipelines.status import inspect as inspect_job

    raise typer.Exit(inspect_job(job, key, sheet=sheet, as_json=as_json))


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


export_app = typer.Typer(help="Write a packed job in other forms.", no_args_is_help=True)
app.add_typer(export_app, name="export", rich_help_panel=LOOK)


@export_app.callback()
def _export() -> None:
    """Write a packed job in other forms."""


@export_app.command("released")
def export_released(
    job: JobFolder,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the manifest and its loose files.")],
    split: Annotated[str, typer.Option(help="train or val.")] = "train",
) -> None:
    """The released trainer's JSONL (id, caption, rgb_path, pose_path) with loose files."""
    from pipelines.export import export_released as export

    raise typer.Exit(export(job, out, split=split))


@app.command(rich_help_panel=TRAIN)
def cache(
    job: JobFolder,
    backbone: Annotated[str, typer.Option(help="A preset (tiny, ltx-2b, ltx-13b, svd ...) or a YAML file.")],
    part: Annotated[str | None, typer.Option(help="i/n: this host's share of the clips.")] = None,
    object_variants: Annotated[int, typer.Option(min=1, help="Object videos per clip.")] = 1,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    refresh: Annotated[bool, typer.Option("--refresh", help="Throw away what was made with other settings.")] = False,
) -> None:
    """Latents of every clip, once per backbone."""
    from pipelines.train import run_cache

    run_cache(job, backbone=backbone, part=part, object_variants=object_variants, device=device, refresh=refresh)


@app.command(rich_help_panel=TRAIN)
def train(
    stage: Annotated[str, typer.Argument(help="motion, appearance or end_to_end.")],
    data: Annotated[Path, typer.Option(help="A job whose latents are cached.")],
    config: Annotated[str, typer.Option(help="A recipe by name (tiny, motion_ltx_2b ...) or a YAML file.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="By default JOB/adapters/<recipe>_<stage>.")] = None,
    resume: Annotated[str, typer.Option(help="auto, never, or a checkpoint.")] = "auto",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what it would take; load nothing.")] = False,
    steps_per_second: Annotated[float | None, typer.Option(help="For the dry run's hours.")] = None,
) -> None:
    """One LoRA adapter on the frozen backbone."""
    from pipelines.train import run_train

    result = run_train(
        stage, data=data, config=config, out=out, resume=resume, dry_run=dry_run, steps_per_second=steps_per_second
    )
    raise typer.Exit(1 if getattr(result, "interrupted", False) else 0)


@app.command(rich_help_panel=TRAIN)
def generate(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the videos.")],
    motion: Annotated[Path | None, typer.Option(help="Adapter of the motion stage.")] = None,
    appearance: Annotated[Path | None, typer.Option(help="Adapter of the appearance stage.")] = None,
    end_to_end: Annotated[Path | None, typer.Option(help="Adapter of the baseline, instead of both.")] = None,
    image: Annotated[Path | None, typer.Option(help="The first frame.")] = None,
    caption: Annotated[str | None, typer.Option(help="What the clip shows.")] = None,
    data: Annotated[Path | None, typer.Option(help="A job: start from one of its clips instead.")] = None,
    clip: Annotated[str | None, typer.Option(help="Which clip of the job; by default the first.")] = None,
    skeleton: Annotated[Path | None, typer.Option(help="The first skeleton; by default extracted.")] = None,
    skeleton_video: Annotated[Path | None, typer.Option(help="All skeletons, instead of the motion stage.")] = None,
    ego: Annotated[str | None, typer.Option(help="Trajectory file, or words such as 'straight 10m/s'.")] = None,
    objects: Annotated[Path | None, typer.Option(help="Object video, or labels in Parquet.")] = None,
    backbone: Annotated[str | None, typer.Option(help="By default the adapters' own.")] = None,
    samples: Annotated[int, typer.Option(min=1)] = 1,
    seed: Annotated[int, typer.Option()] = 0,
    steps: Annotated[int, typer.Option(min=1, help="Denoising steps per stage.")] = 30,
    guidance: Annotated[float, typer.Option(help="Classifier-free guidance.")] = 3.0,
    coordinates: Annotated[
        str, typer.Option(help="consistent, or released with the released adapters.")
    ] = "consistent",
    frames: Annotated[int | None, typer.Option(help="By default what the adapters were trained on.")] = None,
    extractors: Extractors = None,
    models: Models = None,
    device: Annotated[str | None, typer.Option(help="cpu or cuda.")] = None,
) -> None:
    """A skeleton video, then an RGB video painted over it."""
    from pipelines.train import GenerateOptions, run_generate

    options = GenerateOptions(
        backbone=backbone, skeleton_video=skeleton_video, objects=objects, samples=samples, seed=seed, steps=steps,
        guidance=guidance, coordinates=coordinates, frames=frames,
        extractors=tuple(extractors.split(",")) if extractors else None, models_dir=models, device=device,
    )  # fmt: skip
    run_generate(
        out=out, motion=motion, appearance=appearance, end_to_end=end_to_end, image=image, caption=caption,
        skeleton=skeleton, ego=ego, data=data, clip=clip, options=options,
    )  # fmt: skip


@app.command(rich_help_panel=MEASURE)
def chart(
    stage: Annotated[str, typer.Argument(help="Which chart; an unknown name lists them.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for chart-<stage>.json and .png.")] = Path("charts"),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer runs on less data.")] = False,
) -> None:
    """Speed against accuracy: a stage's methods side by side, with the Pareto front."""
    from pipelines.measure import show_chart

    raise typer.Exit(show_chart(stage, out=out, quick=quick))


@app.command(rich_help_panel=MEASURE)
def stability(
    stage: Annotated[str, typer.Argument(help="Which stage; an unknown name lists them.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the table.")] = Path("charts"),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer runs on less data.")] = False,
) -> None:
    """Where methods fail: named scenarios, a bound each, held or not."""
    from pipelines.measure import show_stability

    raise typer.Exit(show_stability(stage, out=out, quick=quick))
