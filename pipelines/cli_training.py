"""The command line's second half: training, sampling and measuring. As light to import as the first."""

import os
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from pipelines.cli_options import MEASURE, STOPPED, TRAIN, Effort, Extractors, JobFolder, Models, Workers, listed

commands = typer.Typer()

# generate has many options, which its help shows by what they are for. They stay parameters, one each: typer reads a
# command's options off its signature alone, and what they are passed on in are records.
_adapters = partial(typer.Option, rich_help_panel="Adapters")
_picture = partial(typer.Option, rich_help_panel="Start from a picture")
_clips = partial(typer.Option, rich_help_panel="Start from a job's clips")
_conditions = partial(typer.Option, rich_help_panel="Given beside the start")
_sampler = partial(typer.Option, rich_help_panel="Sampling")


@commands.command(rich_help_panel=TRAIN)
def cache(
    job: JobFolder,
    backbone: Annotated[str, typer.Option(help="A preset (tiny, ltx-2b, ltx-13b, svd ...) or a YAML file.")],
    part: Annotated[str | None, typer.Option(help="i/n: this host's share of the clips.")] = None,
    object_variants: Annotated[int, typer.Option(min=1, help="Object videos per clip.")] = 1,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    refresh: Annotated[bool, typer.Option("--refresh", help="Throw away what was made with other settings.")] = False,
    controls: Annotated[
        str | None, typer.Option(help="Further control videos of the shards, by name: hdmap,...")
    ] = None,
) -> None:
    """Latents of every clip, once per backbone."""
    from pipelines.train import run_cache

    _tell_stale(job)
    run_cache(
        job, backbone=backbone, part=part, object_variants=object_variants, device=device, refresh=refresh,
        controls=listed(controls or ""),
    )  # fmt: skip


@commands.command(rich_help_panel=TRAIN)
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

    _tell_stale(data)
    result = run_train(
        stage, data=data, config=config, out=out, resume=resume, dry_run=dry_run, steps_per_second=steps_per_second
    )
    raise typer.Exit(STOPPED if getattr(result, "interrupted", False) else 0)


def _tell_stale(job: Path) -> None:
    """A line, where the job's shards are out of date; of several processes one speaks."""
    from pipelines.console import make_console
    from pipelines.stale_shards import print_stale_shards

    if os.environ.get("RANK", "0") == "0":
        print_stale_shards(job, make_console())


@commands.command(rich_help_panel=TRAIN)
def generate(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the videos.")],
    motion: Annotated[Path | None, _adapters(help="Adapter of the motion stage.")] = None,
    appearance: Annotated[Path | None, _adapters(help="Adapter of the appearance stage.")] = None,
    end_to_end: Annotated[Path | None, _adapters(help="Adapter of the baseline, instead of both.")] = None,
    backbone: Annotated[str | None, _adapters(help="By default the adapters' own.")] = None,
    image: Annotated[Path | None, _picture(help="The first frame.")] = None,
    skeleton: Annotated[Path | None, _picture(help="The first skeleton; by default extracted.")] = None,
    data: Annotated[Path | None, _clips(help="A job: start from one of its clips instead.")] = None,
    clip: Annotated[str | None, _clips(help="Which clip of the job; by default the first.")] = None,
    clips: Annotated[str | None, _clips(help="Many clips of the job: val, train, all, or keys with commas.")] = None,
    true_skeletons: Annotated[
        bool, _clips("--true-skeletons", help="With --clips: paint over the clips' own skeletons.")
    ] = False,
    object_variant: Annotated[
        int | None, _clips(help="With --clips: condition on this object video of each clip too.")
    ] = None,
    caption: Annotated[str | None, _conditions(help="What the clip shows.")] = None,
    skeleton_video: Annotated[Path | None, _conditions(help="All skeletons, instead of the motion stage.")] = None,
    ego: Annotated[str | None, _conditions(help="Trajectory file, or words such as 'straight 10m/s'.")] = None,
    objects: Annotated[Path | None, _conditions(help="Object video, or labels in Parquet.")] = None,
    samples: Annotated[int, _sampler(min=1)] = 1,
    seed: Annotated[int, _sampler()] = 0,
    steps: Annotated[int, _sampler(min=1, help="Denoising steps per stage.")] = 30,
    guidance: Annotated[float, _sampler(help="Classifier-free guidance.")] = 3.0,
    coordinates: Annotated[
        Literal["consistent", "released"], _sampler(help="consistent, or released with the released adapters.")
    ] = "consistent",
    frames: Annotated[int | None, _sampler(help="By default what the adapters were trained on.")] = None,
    extractors: Extractors = None,
    models: Models = None,
    device: Annotated[str | None, typer.Option(help="cpu or cuda.")] = None,
) -> None:
    """A skeleton video, then an RGB video painted over it."""
    from pipelines.train import GenerateOptions, run_generate

    options = GenerateOptions(
        backbone=backbone, skeleton_video=skeleton_video, objects=objects, samples=samples, seed=seed, steps=steps,
        guidance=guidance, coordinates=coordinates, frames=frames,
        extractors=listed(extractors) if extractors else None, models_dir=models, device=device,
    )  # fmt: skip
    if clips is not None or true_skeletons or object_variant is not None:
        from pipelines.generate_clips import ClipsRequest, show_clips

        request = ClipsRequest(
            clips=clips if clips is not None else clip or "val",
            ego=ego,
            caption=caption,
            true_skeletons=true_skeletons,
            object_variant=object_variant,
        )
        show_clips(
            data, request, out=out, motion=motion, appearance=appearance, end_to_end=end_to_end, image=image,
            skeleton=skeleton, options=options,
        )  # fmt: skip
        return
    run_generate(
        out=out, motion=motion, appearance=appearance, end_to_end=end_to_end, image=image, caption=caption,
        skeleton=skeleton, ego=ego, data=data, clip=clip, options=options,
    )  # fmt: skip


@commands.command(rich_help_panel=MEASURE)
def evaluate(
    job: JobFolder,
    samples: Annotated[Path, typer.Option(help="Folder of generated videos, <key>[_n].mp4, whoever made them.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="By default SAMPLES/evaluation.")] = None,
    true_skeletons: Annotated[
        Path | None, typer.Option(help="Samples painted over the true skeletons: what the motion stage costs.")
    ] = None,
    trajectories: Annotated[
        Path | None, typer.Option(help="Folder of <key>[_n].tum, instead of the project's own ego-motion.")
    ] = None,
    skeletons: Annotated[Path | None, typer.Option(help="Skeleton videos; by default SAMPLES/skeleton.")] = None,
    samples_per_clip: Annotated[int, typer.Option(min=1, help="Samples of a clip that count: 6 for minADE6.")] = 6,
    seconds: Annotated[float | None, typer.Option(help="Compare no more than this of each clip.")] = None,
    object_variant: Annotated[int | None, typer.Option(help="The object video that was given.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Compare pictures and read skeletons every so many frames.")] = 8,
    extractors: Extractors = None,
    models: Models = None,
    effort: Effort = None,
    workers: Workers = None,
) -> None:
    """Generated videos against the job's clips, beside a noise floor and baselines."""
    from pipelines.evaluate import EvaluateOptions
    from pipelines.evaluate_console import show_evaluation

    options = EvaluateOptions(
        out=out, true_skeletons=true_skeletons, trajectories=trajectories, skeletons=skeletons,
        samples_per_clip=samples_per_clip, seconds=seconds, object_variant=object_variant, every=every,
        extractors=listed(extractors) if extractors else None, models_dir=models, effort=effort,
        workers=(os.cpu_count() or 1) if workers is None else workers,
    )  # fmt: skip
    raise typer.Exit(show_evaluation(job, samples, options))


@commands.command(rich_help_panel=MEASURE)
def chart(
    stage: Annotated[str, typer.Argument(help="Which chart; an unknown name lists them.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for chart-<stage>.json and .png.")] = Path("charts"),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer runs on less data.")] = False,
) -> None:
    """Speed against accuracy: a stage's methods side by side, with the Pareto front."""
    from pipelines.measure import show_chart

    raise typer.Exit(show_chart(stage, out=out, quick=quick))


@commands.command(rich_help_panel=MEASURE)
def stability(
    stage: Annotated[str, typer.Argument(help="Which stage; an unknown name lists them.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the table.")] = Path("charts"),
    quick: Annotated[bool, typer.Option("--quick", help="Fewer runs on less data.")] = False,
) -> None:
    """Where methods fail: named scenarios, a bound each, held or not; exit code 1 where ours holds one not."""
    from pipelines.measure import show_stability

    raise typer.Exit(show_stability(stage, out=out, quick=quick))


@commands.command(rich_help_panel=MEASURE)
def study(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of everything; a study in it goes on.")] = Path(
        "study"
    ),
    budget: Annotated[
        float | None, typer.Option(help="Processor minutes in all, nominal; by default 360, 3 h of 2 cores.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A smoke run of seconds that shows nothing.")] = False,
    report: Annotated[bool, typer.Option("--report", help="Conclude from the seeds that are done.")] = False,
) -> None:
    """Does the method work? Small arms on the street at equal compute, judged by exact truth."""
    from pipelines.study import show_study

    raise typer.Exit(show_study(out, minutes=budget, quick=quick, report=report))
