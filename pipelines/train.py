"""What ``animatic cache``, ``train`` and ``generate`` do: options to the training package, and a few lines back."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from rich.table import Table

from dataset.inspection import find_sample
from dataset.loader import Sample
from dataset.receipts import sha256_file
from labeling.camera import Intrinsics, rebased_trajectory
from labeling.errors import ConfigError
from pipelines.black_skeletons import print_black_skeletons
from pipelines.console import counted, counting_bar, file_size, make_console
from pipelines.stage import parse_part
from training.adapter_notes import read_progress
from training.config import STAGES, Convention, Stage, load_config
from training.dry_run import RunPlan
from training.generation import GeneratedFiles, generate
from training.latents import CacheSummary, cache_latents
from training.sampling_inputs import LabelledFrame
from training.trainer import TrainSummary, train


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerateOptions:
    """Options of ``animatic generate`` that pass through as they are."""

    backbone: str | None = None
    skeleton_video: Path | None = None
    objects: Path | None = None
    samples: int = 1
    seed: int = 0
    steps: int = 30
    guidance: float = 3.0
    coordinates: Convention = "consistent"
    frames: int | None = None
    extractors: tuple[str, ...] | None = None
    models_dir: Path | None = None
    device: str | None = None


def run_cache(
    job: Path, *, backbone: str, part: str | None = None, object_variants: int = 1, device: str = "cpu",
    refresh: bool = False, picture: Mapping[str, Any] | None = None, controls: Sequence[str] = (),
) -> CacheSummary:  # fmt: skip
    """Cache a job's latents, with a bar.

    Raises:
        AnimaticError: as ``cache_latents``.
    """
    share = parse_part(part) if part else None
    with counting_bar() as progress:
        task = progress.add_task("cache", total=None)

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total)

        summary = cache_latents(
            job, backbone_name=backbone, part=(share.index - 1, share.count) if share else (0, 1), progress=show,
            object_variants=object_variants, device=device, refresh=refresh, picture=picture, controls=controls,
        )  # fmt: skip
    gone = f"{summary.retired} are in the shards no longer, " if summary.retired else ""
    make_console().print(
        f"{counted(summary.made, 'clip')} encoded, {summary.kept} there before, {gone}"
        f"{counted(summary.captions, 'caption')}, {file_size(summary.bytes)} in {summary.folder}"
    )
    return summary


def run_train(
    stage: str, *, data: Path, config: str, out: Path | None = None, resume: str = "auto", dry_run: bool = False,
    steps_per_second: float | None = None, overrides: Mapping[str, Any] | None = None,
    on_step: Callable[[int, float], None] | None = None,
) -> TrainSummary | RunPlan:  # fmt: skip
    """Train one adapter, or print what would be trained.

    Raises:
        ConfigError: a stage or a recipe that is not known.
        AnimaticError: as ``train``.
    """
    if stage not in STAGES:
        raise ConfigError(f"stage {stage!r} is not known; choose one of {', '.join(STAGES)}")
    recipe = load_config(config, stage=cast(Stage, stage), overrides=overrides)
    out = out or data / "adapters" / f"{recipe.name}_{stage}"
    if stage != "end_to_end" and _is_first_process():
        print_black_skeletons(data, make_console())
    result = train(
        recipe, data=data, out=out, resume=_resume(resume), dry_run=dry_run, steps_per_second=steps_per_second,
        on_step=on_step, quiet=on_step is not None,
    )  # fmt: skip
    if isinstance(result, RunPlan):
        table = Table(show_header=False, box=None, pad_edge=False)
        for name, value in result.rows():
            table.add_row(f"[bold]{name}[/]", value)
        make_console().print(table)
    else:
        _show_run(stage, result)
    return result


def _is_first_process() -> bool:
    """torchrun and accelerate launch start this command once a process; one of them speaks."""
    return os.environ.get("RANK", "0") == "0"


def _show_run(stage: str, summary: TrainSummary) -> None:
    if not _is_first_process():
        return
    losses, console = summary.losses, make_console()
    course = f", loss {losses[0]:.4f} to {losses[-1]:.4f}" if losses else ""
    console.print(f"{stage}: {summary.steps} steps{course}; {summary.adapter}")
    if summary.interrupted:
        console.print("interrupted, and saved first")


def _resume(text: str) -> Any:
    return text if text in ("auto", "never") else Path(text)


def run_generate(
    *, out: Path, motion: Path | None, appearance: Path | None, end_to_end: Path | None = None,
    image: Path | None = None, caption: str | None = None, skeleton: Path | None = None, ego: str | None = None,
    data: Path | None = None, clip: str | None = None, options: GenerateOptions | None = None,
) -> list[GeneratedFiles]:  # fmt: skip
    """Generate from a picture and a text, or from a clip of a job: its first frame, caption, skeletons and trajectory.

    Raises:
        ConfigError: neither a picture nor a clip, both, or no adapter.
        AnimaticError: as ``generate``.
    """
    options = options or GenerateOptions()
    check_start(data=data, clip=clip, image=image, skeleton=skeleton)
    if data is None:
        check_given(image, caption)
    tell_unfinished(motion, appearance, end_to_end)
    sample = None if data is None else find_sample(data, clip)
    if sample is not None:
        conditions = clip_conditions(sample, with_ego=ego is None)
    else:
        conditions = {"image": image, "caption": caption, "skeleton": skeleton, "name": image.stem if image else None}
    if caption is not None:
        conditions["caption"] = caption
    if ego is not None:
        conditions["ego"] = ego
    given = {
        "image": image, "skeleton": skeleton, "skeleton_video": options.skeleton_video, "objects": options.objects,
    }  # fmt: skip
    files = generate(
        **conditions, about=sample_facts(sample, ego=ego, files=given),
        out=out, motion=motion, appearance=appearance, end_to_end=end_to_end,
        backbone=options.backbone, skeleton_video=options.skeleton_video, objects=options.objects,
        samples=options.samples, seed=options.seed, steps=options.steps, guidance=options.guidance,
        coordinates=options.coordinates, frames=options.frames, extractors=options.extractors,
        models_dir=options.models_dir, device=options.device,
    )  # fmt: skip
    console = make_console()
    for made in files:
        console.print(" ".join(str(path) for path in (made.control, made.rgb) if path is not None))
    return files


def tell_unfinished(*adapters: Path | None) -> None:
    """Say which of the adapters are of trainings that have not ended."""
    for path in filter(None, adapters):
        if (progress := read_progress(path)) and not progress.finished:
            make_console().print(
                f"[yellow]note[/] {path} has done {progress.step} of {progress.steps} steps; `animatic train` goes on"
            )


def sample_facts(
    clip: Sample | None, *, ego: str | None, true_skeletons: bool = False, object_variant: int | None = None,
    files: Mapping[str, Path | None] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """What samples are made of, as their record tells it beside the adapters and the sampler's settings.

    Args:
        clip: of the job, or None where a picture is the start.
        ego: as it was given.
        true_skeletons: whether the clip's own skeletons are painted over.
        object_variant: the clip's object video that is given.
        files: given in place of the clip's own views.
    """
    facts: dict[str, Any] = {
        "ego": _told(ego) if ego is not None or clip is None else "the clip's own", "true_skeletons": true_skeletons,
        "object_variant": object_variant,
        "clip": {name: row.sha256 for name, row in clip.members.items()} if clip is not None else None,
    }  # fmt: skip
    told = {name: _told(path) for name, path in (files or {}).items() if path is not None}
    return facts | ({"files": told} if told else {})


def _told(given: str | Path | None) -> str | dict[str, str] | None:
    """Words as they are, a file by its content, which may change."""
    if given is not None and Path(given).is_file():
        return {"file": Path(given).name, "sha256": sha256_file(Path(given))}
    return None if given is None else str(given)


def check_start(
    *, data: Path | None, clip: str | None = None, image: Path | None = None, skeleton: Path | None = None
) -> None:
    """Refuse two things to start from, of which one would be left out without a word.

    Raises:
        ConfigError: a picture beside a job's clip, or a clip of no job.
    """
    own = [name for name, given in (("--image", image), ("--skeleton", skeleton)) if given is not None]
    if data is not None and own:
        raise ConfigError(
            f"--data starts from a clip's own first frame and skeletons, so {' and '.join(own)} would not be used; "
            "give one or the other"
        )
    if data is None and clip is not None:
        raise ConfigError(f"--clip {clip} is of a job; give --data JOB too")


def check_given(image: Path | None, caption: str | None) -> None:
    """Refuse a start from a picture without the picture, or without its text.

    Raises:
        ConfigError: one is not given, or there is no such file.
    """
    if image is not None and not image.is_file():
        raise ConfigError(f"--image {image} does not exist; check the path")
    absent = [name for name, given in (("--image FILE", image), ("--caption TEXT", caption)) if given is None]
    if len(absent) == 1:
        raise ConfigError(f"{absent[0].split()[0]} is missing; give {absent[0]} too")
    if absent:
        raise ConfigError("nothing to start from; give --image FILE and --caption TEXT, or --data JOB [--clip KEY]")


def clip_conditions(sample: Sample, *, with_ego: bool = True) -> dict[str, Any]:
    """What a clip of a job is generated from: its first frame, caption, first skeletons, trajectory and camera."""
    meta = sample.meta
    picture = meta["picture"]
    first = [label for label in sample.keypoints() if label.frame == 0]
    intrinsics = Intrinsics(**meta["intrinsics"])
    conditions: dict[str, Any] = {
        "image": next(sample.iterate_frames("rgb.mp4")), "caption": sample.caption, "name": sample.key,
        "intrinsics": intrinsics,
        "skeleton": LabelledFrame(labels=first, width=picture["width"], height=picture["height"]),
    }  # fmt: skip
    if with_ego:
        poses = sample.cam_to_world
        conditions["ego"] = rebased_trajectory(np.arange(len(poses)) / meta["fps"], poses)
    return conditions
