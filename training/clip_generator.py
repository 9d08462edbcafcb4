"""One backbone with both adapters, sampling clip after clip: the motion stage, then the appearance stage.

Latents pass from the motion to the appearance stage without a decode in between where both were trained at the same
control size; else they are decoded, resized and encoded. ``(seed, number)`` decides a sample.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from labeling.camera import Trajectory
from labeling.errors import ConfigError, ModelError
from training.adapter_notes import read_about
from training.adapters import AdapterFile, activate_adapter
from training.backbone import Backbone, SamplingSettings, TextEmbedding
from training.config import PictureConfig, Stage
from training.draws import keyed_normal, keyed_seed
from training.sampling_inputs import covered, fitted
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
    trajectory: Trajectory | None = None
    """What ``ego`` shows; written beside the samples, so that control can be judged."""
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
        ConfigError: no adapter, ones that exclude each other, or one of another stage, control video or frame rate; no
            frame.
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
        if self.frames is not None and self.frames < 1:
            raise ConfigError(f"--frames {self.frames} leaves nothing to generate; give at least 1")
        for stage, path in chosen.items():
            _check_stage(path, stage)
        for stage, path in chosen.items():
            self.files[stage] = self.backbone.load_adapter(path, stage)
        if len(chosen) > 1:
            self._check_pair()
        if self.frames is None:
            self.frames = next((f.about["frames"] for f in self.files.values() if f.about.get("frames")), None)
        self._empty = self.backbone.encode_text([""])[0]
        self._texts: dict[str, TextEmbedding] = {}

    def _check_pair(self) -> None:
        drafted, painted = self.control_name("motion"), self.control_name("appearance")
        if drafted != painted:
            raise ConfigError(
                f"the motion adapter drafts {drafted} videos, the appearance adapter paints over {painted} videos; "
                "give two that were trained with the same conditions.control"
            )
        rates = [self.picture(stage).rate for stage in ("motion", "appearance")]
        if rates[0] != rates[1]:
            raise ConfigError(
                f"the motion adapter works at {rates[0]} fps, the appearance adapter at {rates[1]} fps; give two that "
                "were trained with the same picture.frame_step"
            )

    @property
    def frame_count(self) -> int:
        """Video frames of a sample."""
        return self.frames or self.backbone.config.picture.frames or _DEFAULT_FRAMES

    @property
    def first_stage(self) -> Stage:
        """The stage that is given the clip's conditions."""
        return next(stage for stage in ("motion", "appearance", "end_to_end") if stage in self.files)

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
            ModelError: the network draws numbers that are not finite.
        """
        settings = settings or SamplingSettings()
        if "end_to_end" in self.files:
            latents = self._rgb(conditions, "end_to_end", None, keyed=(seed, number), settings=settings)
            return GeneratedClip(rgb=self._decoded(latents, seed, number), control=None)
        control = self.draft(conditions, seed=seed, number=number, settings=settings)
        return self.paint(conditions, control, seed=seed, number=number, settings=settings)

    def paint(
        self, conditions: ClipConditions, control_CFHW: torch.Tensor, *, seed: int = 0, number: int = 0,
        settings: SamplingSettings | None = None,
    ) -> GeneratedClip:  # fmt: skip
        """A drafted control video with its RGB, where there is an appearance adapter.

        Raises:
            ConfigError: sizes do not fit.
        """
        shown = self._decoded(control_CFHW, seed, number) if conditions.control is None else conditions.control
        if "appearance" not in self.files:
            return GeneratedClip(rgb=None, control=shown)
        rgb = self._rgb(
            conditions, "appearance", self._handed_over(control_CFHW, shown), keyed=(seed, number),
            settings=settings or SamplingSettings(),
        )  # fmt: skip
        return GeneratedClip(rgb=self._decoded(rgb, seed, number), control=shown)

    def draft(
        self, conditions: ClipConditions, *, seed: int = 0, number: int = 0, settings: SamplingSettings | None = None
    ) -> torch.Tensor:
        """Latents (C, F, H, W) of the control video: encoded where it is given, else sampled.

        Raises:
            ConfigError: a condition is missing, or sizes do not fit.
        """
        settings = settings or SamplingSettings()
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
        return self._drawn("motion", first, references, conditions, picture, keyed=(seed, number), settings=settings)

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
        self._check_finite(stage, latents, settings)
        return latents[0].cpu()

    def _check_finite(self, stage: Stage, latents: torch.Tensor, settings: SamplingSettings) -> None:
        """Refuse what would decode to black frames."""
        share = 1 - float(latents.isfinite().float().mean())
        if share:
            config = self.backbone.config
            raise ModelError(
                f"the {stage} stage drew latents of which {share:.1%} are not finite, with guidance "
                f"{settings.guidance:g} on {config.name} in {config.dtype}; lower --guidance, set backbone.dtype to "
                "float32, or take an earlier checkpoint of the adapter"
            )

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


def _check_stage(path: Path, stage: Stage) -> None:
    told = read_about(path).get("stage", stage)
    if told != stage:
        raise ConfigError(
            f"{path} is an adapter of the {told} stage, not of the {stage} stage; give it with "
            f"--{told.replace('_', '-')}"
        )
