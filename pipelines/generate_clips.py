"""``animatic generate --clips``: samples of many clips of a job, named as ``animatic evaluate`` looks for them.

The backbone and its adapters are loaded once. A clip whose record says that the same was made of the same is left
alone, so that a killed run goes on where it was.
"""

import json
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dataset.loader import Sample, ShardDataset
from labeling.errors import ConfigError, DataError
from labeling.object_video import object_frames
from labeling.skeleton_video import draw_skeletons
from labeling.timeline import Span
from pipelines.console import counted, counting_bar, make_console
from pipelines.train import GenerateOptions, check_start, clip_conditions, sample_facts, tell_unfinished
from training.backbone import SamplingSettings
from training.config import PictureConfig
from training.generation import (
    ClipGenerator,
    adapter_hashes,
    open_generator,
    prepare_conditions,
    sampling_record,
    write_samples,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipsRequest:
    """Which clips, and what is other than the clip's own."""

    clips: str = "val"
    """``val``, ``train``, ``all``, or keys with commas."""
    ego: str | None = None
    """Trajectory file or words for every clip, instead of its own trajectory."""
    caption: str | None = None
    """Text for every clip, instead of its own."""
    true_skeletons: bool = False
    """Paint over the clip's own skeleton video, for stage attribution."""
    object_variant: int | None = None
    """Condition on this object video of the clip too."""


def chosen_clips(job: Path, clips: str) -> list[Sample]:
    """The clips that ``--clips`` names: ``val``, ``train``, ``all``, or keys with commas.

    Raises:
        DataError: no such clip, or none in that split.
    """
    datasets = {split: ShardDataset(job, split) for split in ("val", "train")}
    if clips in (*datasets, "all"):
        found = [sample for split, dataset in datasets.items() if clips in (split, "all") for sample in dataset]
        if not found:
            raise DataError(_empty_split(job, clips, {split: len(dataset) for split, dataset in datasets.items()}))
        return found
    by_key = {sample.key: sample for dataset in datasets.values() for sample in dataset}
    wanted = dict.fromkeys(key.strip() for key in clips.split(","))
    unknown = [key for key in wanted if key not in by_key]
    if unknown:
        near = ", ".join(list(by_key)[:3]) or "none"
        raise DataError(f"{job}: has no clip {unknown[0]!r}; give val, train, all, or keys such as {near}")
    return [by_key[key] for key in wanted]


def _empty_split(job: Path, clips: str, counts: Mapping[str, int]) -> str:
    """Why ``--clips`` names nothing: whole source videos go to a split, and few of them may leave one empty."""
    there = [f"{split} has {count}" for split, count in counts.items() if count]
    if not there:
        return f"{job}: has no clip at all; `animatic status {job}` says what was dropped and why"
    return (
        f"{job}: has no clip in {clips} ({there[0]}): the split is by source video, and the job has too few of them "
        f"for {clips}; give --clips all, or label the videos again with --split FILE that names some for {clips}"
    )


def show_clips(
    job: Path | None, request: ClipsRequest, *, out: Path, motion: Path | None, appearance: Path | None,
    end_to_end: Path | None = None, image: Path | None = None, skeleton: Path | None = None,
    options: GenerateOptions | None = None,
) -> None:  # fmt: skip
    """As ``generate_clips``, with a bar, and a line about what came of it.

    Raises:
        AnimaticError: as ``generate_clips``.
    """
    if job is None:
        raise ConfigError("--clips, --true-skeletons and --object-variant are of a job's clips; give --data JOB too")
    check_start(data=job, image=image, skeleton=skeleton)
    tell_unfinished(motion, appearance, end_to_end)
    given = {"motion": motion, "appearance": appearance, "end_to_end": end_to_end}
    with counting_bar() as progress:
        task = progress.add_task("generate", total=None)
        made, there = generate_clips(
            job, request, out=out, adapters={stage: path for stage, path in given.items() if path is not None},
            options=options, on_clip=lambda done, total: progress.update(task, completed=done, total=total),
        )  # fmt: skip
    make_console().print(f"{counted(made, 'clip')} generated, {there} there before; {out}")


def generate_clips(
    job: Path, request: ClipsRequest, *, out: Path, adapters: Mapping[str, Path],
    options: GenerateOptions | None = None, on_clip: Callable[[int, int], None] | None = None,
) -> tuple[int, int]:  # fmt: skip
    """Generate samples of many clips, each from its own first frame, caption, first skeletons and trajectory.

    Args:
        job: whose clips.
        request: which clips, and what is other than the clip's own.
        out: folder of ``<key>_<n>.mp4``.
        adapters: files by stage: motion and appearance, either alone, or end_to_end.
        options: as for ``animatic generate``.
        on_clip: called with the number of clips done and of all.

    Returns:
        How many clips were made, and how many were there.

    Raises:
        ConfigError: options that a single clip only can have, adapters that exclude each other, or samples that are
            longer than a clip whose own skeletons or objects they show.
        DataError: no such clip.
        ModelError: weights that are absent or do not fit.
    """
    options = options or GenerateOptions()
    _check(request, options, adapters)
    settings = SamplingSettings(steps=options.steps, guidance=options.guidance, coordinates=options.coordinates)
    samples = chosen_clips(job, request.clips)
    generator = open_generator(options.backbone, **adapters, frames=options.frames, device=options.device)
    hashes = adapter_hashes(generator)
    made = 0
    for number, sample in enumerate(samples):
        made += _make(generator, sample, request, out=out, options=options, settings=settings, adapters=hashes)
        if on_clip is not None:
            on_clip(number + 1, len(samples))
    return made, len(samples) - made


def _check(request: ClipsRequest, options: GenerateOptions, adapters: Mapping[str, Path]) -> None:
    if options.skeleton_video is not None or options.objects is not None:
        raise ConfigError("--skeleton-video and --objects are of one clip; give --true-skeletons or --object-variant")
    if request.true_skeletons and "appearance" not in adapters:
        raise ConfigError("--true-skeletons are painted over by the appearance stage; give --appearance")


def _make(
    generator: ClipGenerator, sample: Sample, request: ClipsRequest, *, out: Path, options: GenerateOptions,
    settings: SamplingSettings, adapters: Mapping[str, str],
) -> bool:  # fmt: skip
    """Make one clip's samples; False where they were there."""
    caption = sample.caption if request.caption is None else request.caption
    about = {"adapters": dict(adapters)} | sample_facts(
        sample, ego=request.ego, true_skeletons=request.true_skeletons, object_variant=request.object_variant
    )
    record = sampling_record(generator, caption, samples=options.samples, seed=options.seed, settings=settings)
    if _is_there(out, sample.key, {**record, **about}, options.samples, stages=set(adapters)):
        return False
    own = clip_conditions(sample, with_ego=request.ego is None)
    prepared = prepare_conditions(
        generator, image=own["image"], caption=caption, skeleton=own["skeleton"], intrinsics=own["intrinsics"],
        ego=request.ego or own["ego"], **_views(generator, sample, request),
    )  # fmt: skip
    write_samples(
        generator, prepared, out=out, name=sample.key, samples=options.samples, seed=options.seed, settings=settings,
        about=about,
    )  # fmt: skip
    return True


def _views(generator: ClipGenerator, sample: Sample, request: ClipsRequest) -> dict[str, Any]:
    """The clip's own skeleton and object videos at the controls' size, where they are asked for.

    Raises:
        ConfigError: the samples are longer than the clip.
    """
    views, count = {}, generator.frame_count
    needed, there = (count - 1) * generator.picture(generator.first_stage).frame_step + 1, len(sample.cam_to_world)
    if (request.true_skeletons or request.object_variant is not None) and needed > there:
        raise ConfigError(
            f"{sample.key} has {there} frames, but its own skeletons or objects are wanted in {needed}; give fewer "
            "with --frames, or leave out --true-skeletons and --object-variant"
        )
    if request.true_skeletons:
        views["skeleton_video"] = _skeletons(sample, generator.picture("appearance"), count)
    if request.object_variant is not None:
        picture = generator.picture(generator.first_stage)
        views["objects"] = _objects(sample, picture, count, request.object_variant)
    return views


def _skeletons(sample: Sample, picture: PictureConfig, count: int) -> np.ndarray:
    labels, size = sample.keypoints(), sample.meta["picture"]
    return np.stack([
        draw_skeletons(
            [one for one in labels if one.frame == frame * picture.frame_step], width=picture.control_width,
            height=picture.control_height, label_width=size["width"], label_height=size["height"],
        )
        for frame in range(count)
    ])  # fmt: skip


def _objects(sample: Sample, picture: PictureConfig, count: int, variant: int) -> np.ndarray:
    size = sample.meta["picture"]
    frames = object_frames(
        sample.keypoints(), clip=Span(start=0, end=(count - 1) * picture.frame_step + 1), key=sample.key,
        variant=variant, width=picture.control_width, height=picture.control_height, label_width=size["width"],
        label_height=size["height"],
    )  # fmt: skip
    return np.stack(list(frames)[:: picture.frame_step])


def _is_there(out: Path, key: str, record: dict[str, Any], samples: int, *, stages: Set[str]) -> bool:
    """Whether the clip's record says that the same was made, and its files are still there."""
    folders = [out] * (stages != {"motion"}) + [out / "skeleton"] * ("end_to_end" not in stages)
    videos = [folder / f"{key}_{number}.mp4" for folder in folders for number in range(samples)]
    file = out / f"{key}.json"
    if not all(path.is_file() for path in (file, out / "conditions" / f"{key}.tum", *videos)):
        return False
    try:
        return json.loads(file.read_text(encoding="utf-8")) == json.loads(json.dumps(record))
    except ValueError:
        return False
