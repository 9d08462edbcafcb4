"""Generating from the command line: what a person gives becomes conditions, and samples become files.

The sampling itself is ``clip_generator``'s. The same seed gives the same files.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dataset.receipts import atomic_write, make_folder, sha256_file, storage_errors
from labeling.camera import Intrinsics, Trajectory, write_tum
from labeling.encoding import VideoWriter, lossless_rgb
from labeling.errors import ConfigError
from training.adapter_notes import adapter_file, read_about
from training.backbone import Backbone, SamplingSettings
from training.backbones import load_backbone
from training.clip_generator import ClipConditions, ClipGenerator, GeneratedClip
from training.config import BackboneConfig, Convention, backbone_config
from training.sampling_inputs import (
    LabelledFrame,
    control_clip,
    ego_clip,
    ego_trajectory,
    first_skeleton,
    object_clip,
    read_image,
    skeleton_extractors,
)

__all__ = [
    "ClipConditions",
    "ClipGenerator",
    "GeneratedClip",
    "GeneratedFiles",
    "adapter_hashes",
    "generate",
    "open_generator",
    "prepare_conditions",
    "sampling_record",
    "write_clip",
    "write_samples",
]


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratedFiles:
    """Where one sample was written."""

    rgb: Path | None
    control: Path | None
    seed: int
    number: int


def generate(
    *,
    image: Path | np.ndarray,
    caption: str,
    out: Path,
    motion: Path | None = None,
    appearance: Path | None = None,
    end_to_end: Path | None = None,
    backbone: str | Path | BackboneConfig | Backbone | None = None,
    skeleton: Path | np.ndarray | LabelledFrame | None = None,
    skeleton_video: Path | None = None,
    ego: str | Path | Trajectory | None = None,
    objects: Path | None = None,
    intrinsics: Intrinsics | None = None,
    samples: int = 1,
    seed: int = 0,
    steps: int = 30,
    guidance: float = 3.0,
    coordinates: Convention = "consistent",
    frames: int | None = None,
    name: str | None = None,
    extractors: Sequence[str] | None = None,
    models_dir: Path | None = None,
    device: str | None = None,
    about: Mapping[str, Any] | None = None,
) -> list[GeneratedFiles]:
    """Generate clips and write them: ``<out>/<name>_<n>.mp4`` (RGB) and ``<out>/skeleton/<name>_<n>.mp4``.

    Args:
        image: the first frame, a file or (H, W, 3) uint8 RGB.
        caption: the text.
        out: folder to write to.
        motion: adapter file of the motion stage.
        appearance: adapter file of the appearance stage.
        end_to_end: adapter file of the baseline, instead of both.
        backbone: preset, YAML file, configuration, or one loaded; the adapters' own if None.
        skeleton: the first skeleton, as a picture or as labels; found by the extractors if None.
        skeleton_video: the whole skeleton video, instead of the motion stage.
        ego: a trajectory, its file, or a recipe such as ``straight 10m/s``.
        objects: object video (MP4) or labels (Parquet).
        intrinsics: of the camera, for the ego video.
        samples: how many.
        seed: with the sample's number it decides every draw.
        steps: denoising steps per stage.
        guidance: classifier-free guidance.
        coordinates: ``released`` with the released adapters.
        frames: video frames; what the adapters were trained on if None.
        name: of the files; the image's stem if None.
        extractors: model cards for the first skeleton.
        models_dir: where their weights lie.
        device: ``cuda`` if there is one, else ``cpu``.
        about: further entries of the record ``<name>.json``, beside the adapters' hashes.

    Raises:
        ConfigError: conditions that are missing or do not fit.
        ModelError: weights that are absent or do not fit.
        StorageError: no space left.
    """
    # Checked before anything is loaded.
    settings = SamplingSettings(steps=steps, guidance=guidance, coordinates=coordinates)
    if motion is not None and skeleton is None and skeleton_video is None:
        skeleton_extractors(extractors, models_dir=models_dir)
    generator = open_generator(
        backbone, motion=motion, appearance=appearance, end_to_end=end_to_end, frames=frames, device=device
    )
    conditions = prepare_conditions(
        generator, image=image, caption=caption, skeleton=skeleton, skeleton_video=skeleton_video, ego=ego,
        objects=objects, intrinsics=intrinsics, extractors=extractors, models_dir=models_dir,
    )  # fmt: skip
    return write_samples(
        generator, conditions, out=out, name=name or (image.stem if isinstance(image, Path) else "sample"),
        samples=samples, seed=seed, settings=settings, about={"adapters": adapter_hashes(generator), **(about or {})},
    )  # fmt: skip


def open_generator(
    backbone: str | Path | BackboneConfig | Backbone | None = None, *, motion: Path | None = None,
    appearance: Path | None = None, end_to_end: Path | None = None, frames: int | None = None,
    device: str | None = None,
) -> ClipGenerator:  # fmt: skip
    """A backbone with its adapters, loaded once for any number of clips; arguments as for ``generate``.

    Raises:
        ConfigError: no adapter, ones that exclude each other, or none that says which backbone it is for.
        ModelError: weights that are absent or do not fit.
    """
    adapters = [motion, appearance, end_to_end]
    if not any(adapters):
        raise ConfigError(
            "--motion and --appearance are missing; give the adapters that training wrote (either alone works too), or "
            "--end-to-end alone"
        )
    loaded = _loaded_backbone(backbone, adapters, device)
    return ClipGenerator(loaded, motion=motion, appearance=appearance, end_to_end=end_to_end, frames=frames)


def write_samples(
    generator: ClipGenerator, conditions: ClipConditions, *, out: Path, name: str, samples: int = 1, seed: int = 0,
    settings: SamplingSettings | None = None, about: Mapping[str, Any] | None = None,
) -> list[GeneratedFiles]:  # fmt: skip
    """Sample and write: ``conditions/<name>.tum``, ``<name>_<n>.mp4``, ``skeleton/<name>_<n>.mp4``, and a record.

    What an earlier record of that name says was written is taken away first. The record is there from the start, called
    ``unfinished`` until the last sample is: so no video is ever found beside a record of other settings, however a run
    ends.

    Args:
        generator: with its adapters.
        conditions: of the clip.
        out: folder.
        name: of the files.
        samples: how many.
        seed: with the sample's number it decides every draw.
        settings: of the sampler.
        about: further entries of the record ``<name>.json``.

    Raises:
        ConfigError: conditions that are missing or do not fit.
        StorageError: no space left, or ``out`` cannot be written to.
    """
    settings, rate = settings or SamplingSettings(), generator.picture(generator.first_stage).rate
    record = sampling_record(generator, conditions.caption, samples=samples, seed=seed, settings=settings)
    record |= about or {}
    make_folder(out)
    with storage_errors(out):
        _take_away(out, name)
        _write_record(out, name, {**record, "unfinished": True})
        if conditions.trajectory is not None:
            (out / "conditions").mkdir(parents=True, exist_ok=True)
            write_tum(conditions.trajectory, out / "conditions" / f"{name}.tum")
    written = []
    for number in range(samples):
        clip = generator.sample(conditions, seed=seed, number=number, settings=settings)
        written.append(write_clip(clip, out, f"{name}_{number}", fps=rate, seed=seed, number=number))
    _write_record(out, name, record)
    return written


def _write_record(out: Path, name: str, record: Mapping[str, Any]) -> None:
    atomic_write(out / f"{name}.json", f"{json.dumps(record, sort_keys=True, indent=1)}\n".encode())


def _take_away(out: Path, name: str) -> None:
    """What the record of an earlier run lists, and the record last: a kill in between leaves it to the next run."""
    record = out / f"{name}.json"
    if not record.is_file():
        return
    try:
        count = int(json.loads(record.read_text(encoding="utf-8"))["samples"])
    except (ValueError, KeyError, TypeError):
        count = 0
    for number in range(count):
        for folder in (out, out / "skeleton"):
            (folder / f"{name}_{number}.mp4").unlink(missing_ok=True)
    (out / "conditions" / f"{name}.tum").unlink(missing_ok=True)
    record.unlink()


def sampling_record(
    generator: ClipGenerator, caption: str, *, samples: int, seed: int, settings: SamplingSettings
) -> dict[str, Any]:
    """How a clip's samples are made, in plain values."""
    return {
        "caption": caption, "seed": seed, "samples": samples, "sampling": asdict(settings),
        "backbone": generator.backbone.config.model_dump(mode="json"), "frames": generator.frame_count,
        "frame_step": generator.picture(generator.first_stage).frame_step,
    }  # fmt: skip


def adapter_hashes(generator: ClipGenerator) -> dict[str, str]:
    """sha256 of each stage's adapter file."""
    given = {"appearance": generator.appearance, "end_to_end": generator.end_to_end, "motion": generator.motion}
    return {stage: sha256_file(adapter_file(path)) for stage, path in given.items() if path is not None}


def prepare_conditions(
    generator: ClipGenerator, *, image: Path | np.ndarray, caption: str,
    skeleton: Path | np.ndarray | LabelledFrame | None = None,
    skeleton_video: Path | np.ndarray | None = None, ego: str | Path | Trajectory | None = None,
    objects: Path | np.ndarray | None = None, intrinsics: Intrinsics | None = None,
    extractors: Sequence[str] | None = None, models_dir: Path | None = None,
) -> ClipConditions:  # fmt: skip
    """What ``generate`` is given, as pictures. See there."""
    pixels = read_image(image) if isinstance(image, Path) else image
    stage = generator.first_stage
    picture, count = generator.picture(stage), generator.frame_count
    if isinstance(skeleton, LabelledFrame):
        first = skeleton.drawn(picture)
    else:
        first = read_image(skeleton) if isinstance(skeleton, Path) else skeleton
    if first is None and stage == "motion" and skeleton_video is None:
        if generator.control_name("motion") != "skeleton":
            raise ConfigError(f"give the first {generator.control_name('motion')} frame with --skeleton FILE")
        first = first_skeleton(pixels, picture=picture, extractors=extractors, models_dir=models_dir)
    track = None if ego is None else ego_trajectory(ego, frames=count, fps=picture.fps)
    return ClipConditions(
        image=pixels, caption=caption, first_control=first,
        ego=None if track is None else ego_clip(track, picture=picture, intrinsics=intrinsics),
        trajectory=track,
        objects=object_clip(objects, frames=count, picture=picture) if isinstance(objects, Path) else objects,
        control=control_clip(skeleton_video, frames=count, picture=picture)
        if isinstance(skeleton_video, Path) else skeleton_video,
    )  # fmt: skip


def write_clip(
    clip: GeneratedClip, out: Path, stem: str, *, fps: int | Fraction, seed: int, number: int
) -> GeneratedFiles:
    """Write one sample: RGB at the folder's root, the skeleton video under ``skeleton/``, lossless."""
    rgb = out / f"{stem}.mp4" if clip.rgb is not None else None
    control = out / "skeleton" / f"{stem}.mp4" if clip.control is not None else None
    with storage_errors(out):
        for path, frames, settings in ((rgb, clip.rgb, None), (control, clip.control, lossless_rgb())):
            if path is None or frames is None:
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            height, width = frames.shape[1:3]
            with VideoWriter(path, width=width, height=height, fps=fps, settings=settings) as writer:
                for frame in frames:
                    writer.write(frame)
    return GeneratedFiles(rgb=rgb, control=control, seed=seed, number=number)


def _loaded_backbone(
    backbone: str | Path | BackboneConfig | Backbone | None, adapters: Sequence[Path | None], device: str | None
) -> Backbone:
    if backbone is not None and not isinstance(backbone, str | Path | BackboneConfig):
        return backbone
    config = backbone_config(backbone) if isinstance(backbone, str | Path) else backbone or _told_config(adapters)
    return load_backbone(config, device=device or ("cuda" if torch.cuda.is_available() else "cpu"))


def _told_config(adapters: Sequence[Path | None]) -> BackboneConfig:
    """The backbone that the adapters say they were trained on."""
    for path in adapters:
        told: dict[str, Any] = read_about(Path(path)).get("config", {}) if path is not None else {}
        if told:
            try:
                return BackboneConfig.model_validate(told["backbone"])
            except (KeyError, ValueError) as error:
                raise ConfigError(
                    f"{path}: tells of a backbone that this version does not know; give --backbone"
                ) from error
    raise ConfigError("the adapters do not say which backbone they are for; give --backbone")
