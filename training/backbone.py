"""What the trainer, the cache and the generator ask of a backbone, and the records that pass between them.

Shape suffixes: B batch, C latent channels, F latent frames, H and W latent rows and columns, N tokens, L text tokens,
D text channels, T video frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, get_args

import numpy as np
import torch

from labeling.errors import ConfigError
from training.adapters import AdapterFile
from training.config import AdapterConfig, BackboneConfig, Convention


@dataclass(frozen=True, slots=True, kw_only=True)
class LatentGeometry:
    """How pixels become latent cells."""

    channels: int
    spatial: int
    """Pixels per latent cell, each way."""
    temporal: int
    """Frames per latent frame after the first; 1 where every frame is its own."""
    multiple: int = 0
    """Pixels that sizes must be a multiple of, where the network halves its latents further; 0 means ``spatial``."""

    def latent_shape(self, *, frames: int, height: int, width: int) -> tuple[int, int, int, int]:
        """(C, F, H, W) of a video.

        Raises:
            ConfigError: a frame count that is not ``temporal * k + 1``, a size that ``spatial`` does not divide.
        """
        if frames < 1 or (frames - 1) % self.temporal:
            lower = max(0, frames - 1) // self.temporal * self.temporal + 1
            raise ConfigError(
                f"{frames} frames do not fit the backbone: it takes {self.temporal}k+1, such as {lower} or "
                f"{lower + self.temporal} (others would silently lose frames); set picture.frames or the clip length"
            )
        step = self.multiple or self.spatial
        if height % step or width % step or min(height, width) < step:
            raise ConfigError(
                f"a picture of {width}x{height} does not fit the backbone: both must be multiples of {step}; try "
                f"{max(1, round(width / step)) * step}x{max(1, round(height / step)) * step}"
            )
        latent_frames = (frames - 1) // self.temporal + 1
        return self.channels, latent_frames, height // self.spatial, width // self.spatial

    def frame_groups(self, frames: int) -> list[tuple[int, int]]:
        """Half-open spans of video frames behind each latent frame: the first alone, then ``temporal`` each."""
        starts = [0, *range(1, frames, self.temporal)]
        return [(start, 1 if start == 0 else start + self.temporal) for start in starts]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TextEmbedding:
    """One caption after the text encoder, without padding."""

    tokens_LD: torch.Tensor
    """(L, D), L at least 1."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reference:
    """A condition that the network sees clean, at timestep 0."""

    name: str
    """``ego``, ``objects``, ``image`` (RGB frame 0), or the control video's name."""
    latents_BCFHW: torch.Tensor
    first_latent_frame: int = 0
    """Where its first latent frame lies on the target's time axis; the RGB image lies at 1000."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StageInputs:
    """All that one stage is given besides the noisy target; the same record in training and in sampling."""

    target_shape: tuple[int, int, int, int]
    """(C, F, H, W) of the target's latents."""
    first_frame_BCFHW: torch.Tensor
    """(B, C, 1, H, W): the target's first latent frame, clean."""
    references: tuple[Reference, ...]
    slots: tuple[str, ...]
    """Names of all references that the stage may be given, present or not."""
    text_BLD: torch.Tensor
    """Padded with zeros."""
    text_mask_BL: torch.Tensor
    """Bool, True where a token is."""
    fps: float
    """Video frames per second."""
    image_B1D: torch.Tensor | None = None
    """The first RGB frame's embedding, where the backbone has an image encoder."""

    @property
    def layout(self) -> tuple:
        """What must agree for samples to share a batch."""
        shapes = [(r.name, tuple(r.latents_BCFHW.shape[1:]), r.first_latent_frame) for r in self.references]
        return self.target_shape, tuple(shapes), tuple(self.text_BLD.shape[1:]), self.fps

    def to(self, device: torch.device) -> "StageInputs":
        """The same inputs on a device."""
        return StageInputs(
            target_shape=self.target_shape, first_frame_BCFHW=self.first_frame_BCFHW.to(device), slots=self.slots,
            references=tuple(
                Reference(
                    name=r.name, latents_BCFHW=r.latents_BCFHW.to(device), first_latent_frame=r.first_latent_frame
                )
                for r in self.references
            ),
            text_BLD=self.text_BLD.to(device), text_mask_BL=self.text_mask_BL.to(device), fps=self.fps,
            image_B1D=None if self.image_B1D is None else self.image_B1D.to(device),
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class SamplingSettings:
    """How a sample is drawn.

    Raises:
        ConfigError: coordinates of an unknown name.
    """

    steps: int = 30
    guidance: float = 3.0
    """Classifier-free guidance (Ho and Salimans 2022); 1 switches it off."""
    coordinates: Convention = "consistent"
    """``released`` for the released adapters."""

    def __post_init__(self) -> None:
        if self.coordinates not in get_args(Convention):
            raise ConfigError(
                f"coordinates {self.coordinates!r} are not known; choose one of {', '.join(get_args(Convention))}"
            )


class Backbone(Protocol):
    """A video diffusion model as the rest of the framework sees it."""

    config: BackboneConfig
    device: torch.device
    adapter_prefix: str
    """Of the adapter files' keys: ``transformer`` or ``unet``."""

    @property
    def geometry(self) -> LatentGeometry:
        """How pixels become latent cells."""
        ...

    @property
    def denoiser(self) -> torch.nn.Module:
        """The network that carries the adapters."""
        ...

    def attach(self, name: str, config: AdapterConfig) -> list[torch.nn.Parameter]:
        """A fresh trainable adapter, active; its parameters."""
        ...

    def load_adapter(self, path: Path, name: str) -> AdapterFile:
        """An adapter file, not active."""
        ...

    def release(self, parts: Sequence[str]) -> None:
        """Forget parts (``vae``, ``text``); they load again when used."""
        ...

    def fingerprint_vae(self) -> str:
        """The fingerprint's part ``vae``."""
        ...

    def encode_video(self, frames_THWC: np.ndarray) -> torch.Tensor:
        """(T, H, W, 3) uint8 RGB to (C, F, H, W) normalised latents, on the CPU; no randomness."""
        ...

    def decode_video(self, latents_CFHW: torch.Tensor, *, seed: int = 0) -> np.ndarray:
        """Latents to (T, H, W, 3) uint8 RGB; ``seed`` feeds decoders that add noise."""
        ...

    def encode_text(self, captions: Sequence[str]) -> list[TextEmbedding]:
        """One embedding per caption, on the CPU."""
        ...

    def encode_image(self, frame_HWC: np.ndarray) -> torch.Tensor | None:
        """(1, D) embedding of a (H, W, 3) uint8 RGB picture, on the CPU; None without an image encoder."""
        ...

    def fingerprint(self) -> dict[str, str]:
        """sha256 of the weights and settings that latents and text embeddings depend on, by part."""
        ...

    def sigma_from_normal(self, normal_B: torch.Tensor, *, target_shape: tuple[int, int, int, int]) -> torch.Tensor:
        """Training noise levels (B,) from standard normal draws."""
        ...

    def sigma_from_share(self, share: float) -> float:
        """The noise level that lies ``share`` (0 to 1) of the way to pure noise."""
        ...

    def losses(
        self, inputs: StageInputs, target_BCFHW: torch.Tensor, *, noise_BCFHW: torch.Tensor, sigma_B: torch.Tensor
    ) -> torch.Tensor:
        """The training loss of each sample, (B,) float32."""
        ...

    def sample(
        self, inputs: StageInputs, *, noise_BCFHW: torch.Tensor, empty_text: TextEmbedding, settings: SamplingSettings
    ) -> torch.Tensor:
        """Target latents (B, C, F, H, W) float32, from noise."""
        ...


def pad_text(embeddings: Sequence[TextEmbedding], *, length: int) -> tuple[torch.Tensor, torch.Tensor]:
    """(B, length, D) padded with zeros, and its mask (B, length) bool."""
    dimension = embeddings[0].tokens_LD.shape[1]
    text_BLD = torch.zeros(len(embeddings), length, dimension, dtype=embeddings[0].tokens_LD.dtype)
    mask_BL = torch.zeros(len(embeddings), length, dtype=torch.bool)
    for row, embedding in enumerate(embeddings):
        count = min(length, len(embedding.tokens_LD))
        text_BLD[row, :count] = embedding.tokens_LD[:count]
        mask_BL[row, :count] = True
    return text_BLD, mask_BL


def with_empty_text(inputs: StageInputs, empty_text: TextEmbedding) -> StageInputs:
    """The batch twice, for guidance: first with the empty caption, then with its own."""
    batch, length = inputs.text_mask_BL.shape
    empty_BLD, empty_mask = pad_text([empty_text] * batch, length=length)
    references = tuple(
        Reference(
            name=r.name, latents_BCFHW=r.latents_BCFHW.repeat(2, 1, 1, 1, 1), first_latent_frame=r.first_latent_frame
        )
        for r in inputs.references
    )
    return StageInputs(
        target_shape=inputs.target_shape, first_frame_BCFHW=inputs.first_frame_BCFHW.repeat(2, 1, 1, 1, 1),
        references=references, slots=inputs.slots, text_BLD=torch.cat([empty_BLD.to(inputs.text_BLD), inputs.text_BLD]),
        text_mask_BL=torch.cat([empty_mask.to(inputs.text_mask_BL.device), inputs.text_mask_BL]), fps=inputs.fps,
        image_B1D=None if inputs.image_B1D is None else inputs.image_B1D.repeat(2, 1, 1),
    )  # fmt: skip
