"""Two-stage sampling: image and text -> skeleton video -> RGB video, both adapters on one backbone.

Latents pass from the motion to the appearance stage without a decode in between where both were trained at the same
control size; else they are decoded, resized and encoded. The same seed gives the same files.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dataset.receipts import storage_errors
from labeling.camera import Intrinsics, Trajectory
from labeling.encoding import VideoWriter, lossless_rgb
from labeling.errors import ConfigError
from training.adapters import AdapterFile, activate_adapter, read_adapter
from training.backbone import Backbone, SamplingSettings, TextEmbedding
from training.backbones import load_backbone
from training.config import BackboneConfig, PictureConfig, Stage, backbone_config
from training.draws import keyed_normal, keyed_seed
from training.sampling_inputs import (
    LabelledFrame,
    control_clip,
    covered,
    ego_clip,
    ego_trajectory,
    first_skeleton,
    fitted,
    object_clip,
    read_image,
)
from training.stages import EGO, IMAGE, OBJECTS, stage_inputs

_DEFAULT_FRAMES = 121


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClipConditions:
    """What one clip is generated from, as pictures; sizes are brought to the backbone's by the generator."""

    image: np.ndarray
    """(H, W, 3) uint8 RGB: the first frame."""
    caption: str
    first_control: np.ndarray | None = None
    """(H, W, 3): the first skeleton; needed by the motion stage."""
    ego: np.ndarray | None = None
    """(T, H, W, 3) ego video."""
    objects: np.ndarray | None = None
    """(T, H, W, 3) object video."""
    control: np.ndarray | None = None
    """(T, H, W, 3) skeleton video; given, the motion stage is left out (the truth, for stage attribution)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GeneratedClip:
    """One sample."""

    rgb: np.ndarray | None
    """(T, H, W, 3) uint8; None without an appearance adapter."""
    control: np.ndarray | None
    """(T, H, W, 3) uint8 skeleton video; None where RGB was made end to end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratedFiles:
    """Where one sample was written."""

    rgb: Path | None
    control: Path | None
    seed: int
    number: int


@dataclass
class ClipGenerator:
    """A backbone with its adapters, ready to sample clip after clip.

    Args:
        backbone: with or without adapters of other names.
        motion: adapter file of the motion stage, or None.
        appearance: adapter file of the appearance stage, or None.
        end_to_end: adapter file of the baseline; excludes the other two.
        frames: video frames; what the adapters were trained on if None.

    Raises:
        ConfigError: no adapter, or ones that exclude each other.
        ModelError: adapters that do not fit the backbone.
    """

    backbone: Backbone
    motion: Path | None = None
    appearance: Path | None = None
    end_to_end: Path | None = None
    frames: int | None = None
    files: dict[Stage, AdapterFile] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        given: dict[Stage, Path | None] = {
            "motion": self.motion, "appearance": self.appearance, "end_to_end": self.end_to_end,
        }  # fmt: skip
        chosen: dict[Stage, Path] = {stage: Path(path) for stage, path in given.items() if path is not None}
        if not chosen or ("end_to_end" in chosen and len(chosen) > 1):
            raise ConfigError("give --motion and --appearance (either alone works too), or --end-to-end alone")
        for stage, path in chosen.items():
            self.files[stage] = self.backbone.load_adapter(path, stage)
        if self.frames is None:
            self.frames = next((f.about["frames"] for f in self.files.values() if f.about.get("frames")), None)
        self._empty = self.backbone.encode_text([""])[0]
        self._texts: dict[str, TextEmbedding] = {}

    @property
    def frame_count(self) -> int:
        """Video frames of a sample."""
        return self.frames or self.backbone.config.picture.frames or _DEFAULT_FRAMES

    def picture(self, stage: Stage) -> PictureConfig:
        """The sizes that a stage's adapter was trained at; the backbone's for foreign files."""
        about = self.files[stage].about if stage in self.files else {}
        told = about.get("config", {}).get("backbone", {}).get("picture")
        return PictureConfig.model_validate(told) if told else self.backbone.config.picture

    def control_name(self, stage: Stage) -> str:
        """The intermediate representation that a stage's adapter knows."""
        about = self.files[stage].about if stage in self.files else {}
        return about.get("config", {}).get("conditions", {}).get("control", "skeleton")

    def sample(
        self, conditions: ClipConditions, *, seed: int = 0, number: int = 0, settings: SamplingSettings | None = None
    ) -> GeneratedClip:
        """One sample; ``(seed, number)`` decides it.

        Raises:
            ConfigError: a condition is missing, or sizes do not fit.
        """
        settings = settings or SamplingSettings()
        if "end_to_end" in self.files:
            latents = self._rgb(conditions, "end_to_end", None, keyed=(seed, number), settings=settings)
            return GeneratedClip(rgb=self._decoded(latents, seed, number), control=None)
        control = self._control(conditions, keyed=(seed, number), settings=settings)
        shown = self._decoded(control, seed, number) if conditions.control is None else conditions.control
        if "appearance" not in self.files:
            return GeneratedClip(rgb=None, control=shown)
        rgb = self._rgb(
            conditions, "appearance", self._handed_over(control, shown), keyed=(seed, number), settings=settings
        )
        return GeneratedClip(rgb=self._decoded(rgb, seed, number), control=shown)

    def _control(
        self, conditions: ClipConditions, *, keyed: tuple[int, int], settings: SamplingSettings
    ) -> torch.Tensor:
        """Latents (C, F, H, W) of the control video: encoded where it is given, else sampled."""
        picture = self.picture("motion" if "motion" in self.files else "appearance")
        size = {"width": picture.control_width, "height": picture.control_height}
        if conditions.control is not None:
            return self.backbone.encode_video(fitted(conditions.control[: self.frame_count], **size))
        if "motion" not in self.files or conditions.first_control is None:
            raise ConfigError(
                "the appearance stage needs a skeleton video: give --motion and a first skeleton, or --skeleton-video"
            )
        references = self._motion_references(conditions, picture)
        references[IMAGE] = self.backbone.encode_video(covered(conditions.image, **size)[None])
        first = self.backbone.encode_video(fitted(conditions.first_control[None], **size))
        return self._drawn("motion", first, references, conditions, picture, keyed=keyed, settings=settings)

    def _motion_references(self, conditions: ClipConditions, picture: PictureConfig) -> dict[str, torch.Tensor]:
        given = {EGO: conditions.ego, OBJECTS: conditions.objects}
        size = {"width": picture.control_width, "height": picture.control_height}
        return {
            name: self.backbone.encode_video(fitted(frames[: self.frame_count], **size))
            for name, frames in given.items()
            if frames is not None
        }

    def _rgb(
        self, conditions: ClipConditions, stage: Stage, control: torch.Tensor | None, *, keyed: tuple[int, int],
        settings: SamplingSettings,
    ) -> torch.Tensor:  # fmt: skip
        picture = self.picture(stage)
        if control is not None:
            references = {self.control_name(stage): control}
        else:
            references = self._motion_references(conditions, picture)
        first = covered(conditions.image, width=picture.rgb_width, height=picture.rgb_height)[None]
        first_latents = self.backbone.encode_video(first)
        return self._drawn(stage, first_latents, references, conditions, picture, keyed=keyed, settings=settings)

    def _drawn(
        self, stage: Stage, first: torch.Tensor, references: dict[str, torch.Tensor], conditions: ClipConditions,
        picture: PictureConfig, *, keyed: tuple[int, int], settings: SamplingSettings,
    ) -> torch.Tensor:  # fmt: skip
        shape = self.backbone.geometry.latent_shape(
            frames=self.frame_count, height=first.shape[2] * self.backbone.geometry.spatial,
            width=first.shape[3] * self.backbone.geometry.spatial,
        )  # fmt: skip
        caption = conditions.caption
        image = covered(conditions.image, width=picture.rgb_width, height=picture.rgb_height)
        if caption not in self._texts:
            self._texts[caption] = self.backbone.encode_text([caption])[0]
        inputs = stage_inputs(
            stage, first_frame_CFHW=first, target_shape=shape, references=references, text=self._texts[caption],
            text_tokens=self.backbone.config.text_tokens, fps=picture.fps, control=self.control_name(stage),
            image_1D=self.backbone.encode_image(image),
        )  # fmt: skip
        activate_adapter(self.backbone.denoiser, stage)
        noise = keyed_normal((1, *shape), *keyed, stage)
        latents = self.backbone.sample(
            inputs.to(self.backbone.device), noise_BCFHW=noise, empty_text=self._empty, settings=settings
        )
        return latents[0].cpu()

    def _handed_over(self, control: torch.Tensor, shown: np.ndarray) -> torch.Tensor:
        """The control's latents at the size that the appearance stage was trained with."""
        picture = self.picture("appearance")
        shape = self.backbone.geometry.latent_shape(
            frames=self.frame_count, height=picture.control_height, width=picture.control_width
        )
        if tuple(control.shape) == shape:
            return control
        return self.backbone.encode_video(fitted(shown, width=picture.control_width, height=picture.control_height))

    def _decoded(self, latents: torch.Tensor, seed: int, number: int) -> np.ndarray:
        return self.backbone.decode_video(latents, seed=keyed_seed(seed, number, "decode") % 2**31)


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
    coordinates: str = "consistent",
    frames: int | None = None,
    name: str | None = None,
    extractors: Sequence[str] | None = None,
    models_dir: Path | None = None,
    device: str | None = None,
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

    Raises:
        ConfigError: conditions that are missing or do not fit.
        ModelError: weights that are absent or do not fit.
        StorageError: no space left.
    """
    loaded = _loaded_backbone(backbone, [motion, appearance, end_to_end], device)
    generator = ClipGenerator(loaded, motion=motion, appearance=appearance, end_to_end=end_to_end, frames=frames)
    name = name or (image.stem if isinstance(image, Path) else "sample")
    conditions = prepare_conditions(
        generator, image=image, caption=caption, skeleton=skeleton, skeleton_video=skeleton_video, ego=ego,
        objects=objects, intrinsics=intrinsics, extractors=extractors, models_dir=models_dir,
    )  # fmt: skip
    settings = SamplingSettings(steps=steps, guidance=guidance, coordinates=coordinates)
    written = []
    for number in range(samples):
        clip = generator.sample(conditions, seed=seed, number=number, settings=settings)
        written.append(
            write_clip(clip, out, f"{name}_{number}", fps=loaded.config.picture.fps, seed=seed, number=number)
        )
    record = {
        "caption": caption, "seed": seed, "samples": samples, "sampling": asdict(settings), "ego": str(ego or ""),
        "backbone": loaded.config.model_dump(mode="json"), "frames": generator.frame_count,
    }  # fmt: skip
    with storage_errors(out):
        (out / f"{name}.json").write_text(json.dumps(record, sort_keys=True, indent=1) + "\n", encoding="utf-8")
    return written


def prepare_conditions(
    generator: ClipGenerator, *, image: Path | np.ndarray, caption: str,
    skeleton: Path | np.ndarray | LabelledFrame | None = None,
    skeleton_video: Path | None = None, ego: str | Path | Trajectory | None = None, objects: Path | None = None,
    intrinsics: Intrinsics | None = None, extractors: Sequence[str] | None = None, models_dir: Path | None = None,
) -> ClipConditions:  # fmt: skip
    """What ``generate`` is given, as pictures. See there."""
    pixels = read_image(image) if isinstance(image, Path) else image
    stage: Stage = "motion" if "motion" in generator.files else next(iter(generator.files))
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
        objects=None if objects is None else object_clip(objects, frames=count, picture=picture),
        control=None if skeleton_video is None else control_clip(skeleton_video, frames=count, picture=picture),
    )  # fmt: skip


def write_clip(clip: GeneratedClip, out: Path, stem: str, *, fps: float, seed: int, number: int) -> GeneratedFiles:
    """Write one sample: RGB at the folder's root, the skeleton video under ``skeleton/``, lossless."""
    rgb = out / f"{stem}.mp4" if clip.rgb is not None else None
    control = out / "skeleton" / f"{stem}.mp4" if clip.control is not None else None
    with storage_errors(out):
        for path, frames, settings in ((rgb, clip.rgb, None), (control, clip.control, lossless_rgb())):
            if path is None or frames is None:
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            height, width = frames.shape[1:3]
            with VideoWriter(path, width=width, height=height, fps=round(fps), settings=settings) as writer:
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
        told: dict[str, Any] = read_adapter(Path(path)).about.get("config", {}) if path is not None else {}
        if told:
            return BackboneConfig.model_validate(told["backbone"])
    raise ConfigError("the adapters do not say which backbone they are for; give --backbone")
