"""The Stable Video Diffusion backbone, one recipe: 25 frames at 12 fps, every second one of a clip's first two seconds.

Conditions are channels: the network's own image slot holds the target's first frame, and ``conv_in`` is widened by
four channels for each reference, starting at zero. Text stays in control through a zero-initialised projection: the
cross-attention sees [image, image + P(t_1), ..., image + P(t_L)], so at the start all tokens are equal and attention
over them gives exactly what attention over the image alone does.

Preconditioning and loss weight are EDM's for v-prediction (Karras et al. 2022, table 1; Salimans and Ho 2022):
c_skip = 1 / (s^2 + 1), c_out = -s / sqrt(s^2 + 1), c_in = 1 / sqrt(s^2 + 1), weight (s^2 + 1) / s^2, and
log s ~ N(0.7, 1.6).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers.models.autoencoders.autoencoder_kl_temporal_decoder import AutoencoderKLTemporalDecoder
from diffusers.models.unets.unet_spatio_temporal_condition import UNetSpatioTemporalConditionModel

from labeling.errors import ModelError
from training.adapters import AdapterFile, Switchable, attach_adapter, load_adapter, read_adapter
from training.backbone import LatentGeometry, SamplingSettings, StageInputs, TextEmbedding, with_empty_text
from training.config import AdapterConfig, BackboneConfig, TrainConfig
from training.parts import LazyParts
from training.stages import IMAGE, reference_names
from training.text import embed_captions
from training.weights import TEXT_PARTS, digest_module, load_image_encoder, load_pretrained, load_text_encoder

SVD_GEOMETRY = LatentGeometry(channels=4, spatial=8, temporal=1, multiple=64)
LATENT_SCALE = 0.18215
"""Of the VAE's latents; the image slot takes them unscaled, as diffusers' pipeline feeds it."""
SIGMA_MEAN, SIGMA_STD = 0.7, 1.6
SIGMA_MIN, SIGMA_MAX, RHO = 0.002, 700.0, 7.0
MOTION_BUCKET, NOISE_AUGMENTATION = 127.0, 0.0
_BASE_CHANNELS = 8
_TEXT_KEY, _WIDE_KEY = "text_projection.per_adapter.weight", "conv_in.per_adapter.weight"
_CLIP_MEAN, _CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)


class WideConvIn(torch.nn.Module, Switchable):
    """The network's first convolution, and one for the extra channels of each adapter."""

    def __init__(self, base: torch.nn.Conv2d) -> None:
        super().__init__()
        self.base = base
        self.per_adapter = torch.nn.ModuleDict()

    def add(self, name: str, channels: int) -> None:
        """Room for an adapter's conditions, starting at zero."""
        wide = torch.nn.Conv2d(channels, self.base.out_channels, 3, padding=1, bias=False)
        torch.nn.init.zeros_(wide.weight)
        self.per_adapter[name] = wide.to(self.base.weight.device)

    def forward(self, sample: torch.Tensor) -> torch.Tensor:
        """(B*T, 8 + extra, H, W) to the first feature map."""
        features = self.base(sample[:, :_BASE_CHANNELS])
        if self.active is None or sample.shape[1] == _BASE_CHANNELS:
            return features
        return features + self.per_adapter[self.active](sample[:, _BASE_CHANNELS:].float()).to(features.dtype)


class TextProjection(torch.nn.Module, Switchable):
    """Text tokens as offsets of the image embedding, one zero-initialised linear map per adapter."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width
        self.per_adapter = torch.nn.ModuleDict()

    def add(self, name: str, text_width: int, device: torch.device) -> None:
        """Room for an adapter's map."""
        linear = torch.nn.Linear(text_width, self.width, bias=False)
        torch.nn.init.zeros_(linear.weight)
        self.per_adapter[name] = linear.to(device)

    def forward(self, image_B1D: torch.Tensor, text_BLD: torch.Tensor) -> torch.Tensor:
        """(B, 1 + L, D); padded tokens are zeros, so they repeat the image."""
        if self.active is None:
            return image_B1D
        offsets_BLD = self.per_adapter[self.active](text_BLD.float()).to(image_B1D)
        return torch.cat([image_B1D, image_B1D + offsets_BLD], dim=1)


class SvdBackbone(LazyParts):
    """See ``training.backbone.Backbone``."""

    adapter_prefix = "unet"

    @property
    def geometry(self) -> LatentGeometry:
        """Pixels and frames per latent cell."""
        return svd_geometry(self.config)

    @property
    def denoiser(self) -> UNetSpatioTemporalConditionModel:
        """The network, its first convolution wrapped and the text projection added."""
        unet = self.part("denoiser")
        if not isinstance(unet.conv_in, WideConvIn):
            unet.conv_in = WideConvIn(unet.conv_in)
            unet.text_projection = TextProjection(unet.config.cross_attention_dim)
        return unet

    @property
    def vae(self) -> AutoencoderKLTemporalDecoder:
        """The VAE."""
        return self.part("vae")

    def attach(self, name: str, config: AdapterConfig) -> list[torch.nn.Parameter]:
        """A fresh trainable adapter with its widened ``conv_in`` and text projection, active; its parameters."""
        stage: Any = name
        self._add_extras(name, channels=4 * len(reference_names(stage)), text_width=self.config.text_width)
        return attach_adapter(self.denoiser, name, config)

    def load_adapter(self, path: Path, name: str) -> AdapterFile:
        """An adapter file, not active.

        Raises:
            ModelError: the file lacks the widened convolution or the text projection, or does not fit.
        """
        extra = read_adapter(path).extra
        if _WIDE_KEY not in extra or _TEXT_KEY not in extra:
            raise ModelError(f"{path} holds no {_WIDE_KEY} and {_TEXT_KEY}; it is not an adapter for SVD")
        self._add_extras(name, channels=extra[_WIDE_KEY].shape[1], text_width=extra[_TEXT_KEY].shape[1])
        return load_adapter(self.denoiser, path, name)

    def _add_extras(self, name: str, *, channels: int, text_width: int) -> None:
        unet: Any = self.denoiser
        unet.conv_in.add(name, channels)
        unet.text_projection.add(name, text_width, self.device)

    @torch.no_grad()
    def encode_video(self, frames_THWC: np.ndarray) -> torch.Tensor:
        """(T, H, W, 3) uint8 RGB to (4, T, H/8, W/8) float32 scaled latents: the posterior's mode.

        Raises:
            ConfigError: sizes that do not fit.
        """
        frames, height, width, _ = frames_THWC.shape
        self.geometry.latent_shape(frames=frames, height=height, width=width)
        latents = []
        for frame in frames_THWC:
            pixels = torch.from_numpy(np.ascontiguousarray(frame)).permute(2, 0, 1)[None]
            pixels = pixels.to(self.device).to(self.dtype) / 127.5 - 1
            latents.append(self.vae.encode(pixels).latent_dist.mode().float())  # type: ignore[union-attr]
        return torch.stack(latents, dim=2)[0].cpu() * LATENT_SCALE

    @torch.no_grad()
    def decode_video(self, latents_CFHW: torch.Tensor, *, seed: int = 0) -> np.ndarray:
        """Latents to (T, H, W, 3) uint8 RGB; this decoder draws nothing."""
        latents = latents_CFHW.transpose(0, 1).to(self.device).float() / LATENT_SCALE
        pixels = self.vae.decode(latents.to(self.dtype), num_frames=len(latents)).sample.float()  # type: ignore[union-attr]
        return ((pixels + 1) * 127.5).round().clamp(0, 255).to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()

    @torch.no_grad()
    def encode_image(self, frame_HWC: np.ndarray) -> torch.Tensor:
        """(1, D) CLIP embedding, on the CPU."""
        encoder = self.part("image")
        size = encoder.config.image_size
        pixels = torch.from_numpy(np.ascontiguousarray(frame_HWC)).permute(2, 0, 1)[None].float() / 255
        pixels = torch.nn.functional.interpolate(pixels, (size, size), mode="bicubic", antialias=True)
        mean, std = (torch.tensor(values).view(1, 3, 1, 1) for values in (_CLIP_MEAN, _CLIP_STD))
        pixels = ((pixels - mean) / std).to(self.device).to(self.dtype)
        return encoder(pixels).image_embeds.float().cpu()

    def encode_text(self, captions: Sequence[str]) -> list[TextEmbedding]:
        """One unpadded T5 embedding per caption."""
        tokenizer, encoder = self.part("text")
        return embed_captions(tokenizer, encoder, captions, length=self.config.text_tokens)

    def fingerprint(self) -> dict[str, str]:
        """sha256 of VAE, text encoder and image encoder."""
        text, image = digest_module(self.part("text")[1]), digest_module(self.part("image"))
        return {"vae": self.fingerprint_vae(), "text": text, "image": image}

    def fingerprint_vae(self) -> str:
        """sha256 of the VAE alone."""
        return digest_module(self.vae, extra={"dtype": self.config.dtype})

    def sigma_from_normal(self, normal_B: torch.Tensor, *, target_shape: tuple[int, int, int, int]) -> torch.Tensor:
        """Log-normal noise levels."""
        return torch.exp(SIGMA_MEAN + SIGMA_STD * normal_B.float())

    def sigma_from_share(self, share: float) -> float:
        """sigma / (1 + sigma) = share."""
        return share / (1 - share)

    def denoised(self, inputs: StageInputs, noisy_BCFHW: torch.Tensor, *, sigma_B: torch.Tensor) -> torch.Tensor:
        """The network's estimate of the clean latents, (B, C, F, H, W) float32."""
        sample_BTCHW = assemble_channels(inputs, noisy_BCFHW, sigma_B=sigma_B)
        unet: Any = self.denoiser
        assert inputs.image_B1D is not None
        with self.autocast():
            context = unet.text_projection(inputs.image_B1D.to(self.dtype), inputs.text_BLD)
            # diffusers' pipeline tells SVD one frame a second less than it shows.
            told = torch.tensor([[inputs.fps - 1, MOTION_BUCKET, NOISE_AUGMENTATION]], device=self.device)
            predicted = unet(
                sample_BTCHW.to(self.dtype), 0.25 * sigma_B.float().log(), encoder_hidden_states=context,
                added_time_ids=told.to(self.dtype).repeat(len(sample_BTCHW), 1), return_dict=False,
            )[0]  # fmt: skip
        sigma = _wide(sigma_B.float())
        skip, out = 1 / (sigma**2 + 1), -sigma / (sigma**2 + 1).sqrt()
        return skip * noisy_BCFHW.float() + out * predicted.float().transpose(1, 2)

    def losses(
        self, inputs: StageInputs, target_BCFHW: torch.Tensor, *, noise_BCFHW: torch.Tensor, sigma_B: torch.Tensor
    ) -> torch.Tensor:
        """EDM's weighted squared error of each sample over all frames, (B,) float32."""
        target_BCFHW, sigma = target_BCFHW.float(), _wide(sigma_B.float())
        estimate = self.denoised(inputs, target_BCFHW + sigma * noise_BCFHW, sigma_B=sigma_B)
        weighted = (estimate - target_BCFHW).square() * (sigma**2 + 1) / sigma**2
        return weighted.flatten(1).mean(dim=1)

    @torch.no_grad()
    def sample(
        self, inputs: StageInputs, *, noise_BCFHW: torch.Tensor, empty_text: TextEmbedding, settings: SamplingSettings
    ) -> torch.Tensor:
        """Euler steps (Karras et al. 2022, algorithm 1, no churn) to (B, C, F, H, W) float32."""
        sigmas = karras_sigmas(settings.steps)
        latents = noise_BCFHW.to(self.device).float() * sigmas[0]
        for sigma, following in zip(sigmas[:-1].tolist(), sigmas[1:].tolist(), strict=True):
            estimate = self._guided(inputs, latents, sigma, empty_text, settings.guidance)
            latents = latents + (latents - estimate) / sigma * (following - sigma)
        return latents

    def _guided(
        self, inputs: StageInputs, latents: torch.Tensor, sigma: float, empty_text: TextEmbedding, guidance: float
    ) -> torch.Tensor:
        sigma_B = torch.full((len(latents),), sigma, device=self.device)
        if guidance == 1:
            return self.denoised(inputs, latents, sigma_B=sigma_B)
        both = with_empty_text(inputs, empty_text)
        without, with_text = self.denoised(
            both, latents.repeat(2, 1, 1, 1, 1), sigma_B=sigma_B.repeat(2)
        ).chunk(2)  # fmt: skip
        return without + guidance * (with_text - without)


def karras_sigmas(steps: int) -> torch.Tensor:
    """(steps + 1,) noise levels from 700 to 0 (Karras et al. 2022, eq. 5)."""
    ramp = torch.linspace(0, 1, steps, dtype=torch.float64)
    top, bottom = SIGMA_MAX ** (1 / RHO), SIGMA_MIN ** (1 / RHO)
    return torch.cat([(top + ramp * (bottom - top)) ** RHO, torch.zeros(1, dtype=torch.float64)]).float()


def assemble_channels(inputs: StageInputs, noisy_BCFHW: torch.Tensor, *, sigma_B: torch.Tensor) -> torch.Tensor:
    """(B, T, 8 + 4 n, H, W): scaled noisy target, first frame, then each reference of the stage; absent ones are zeros.

    One function for training and for sampling.
    """
    batch, channels, frames, height, width = noisy_BCFHW.shape
    slots = [noisy_BCFHW.float() / (_wide(sigma_B.float()) ** 2 + 1).sqrt()]
    slots.append((inputs.first_frame_BCFHW.float() / LATENT_SCALE).expand(-1, -1, frames, -1, -1))
    given = {reference.name: reference.latents_BCFHW.float() for reference in inputs.references}
    absent = torch.zeros(batch, channels, frames, height, width, device=noisy_BCFHW.device)
    for name in inputs.slots:
        latents = given.get(name, absent)
        if latents.shape[3:] != (height, width):
            latents = torch.nn.functional.interpolate(latents, (latents.shape[2], height, width), mode="nearest")
        slots.append(latents.expand(-1, -1, frames, -1, -1) if name == IMAGE else latents)
    return torch.cat(slots, dim=1).transpose(1, 2)


def _wide(sigma_B: torch.Tensor) -> torch.Tensor:
    return sigma_B.view(-1, 1, 1, 1, 1)


def svd_geometry(config: BackboneConfig) -> LatentGeometry:
    """The tiny network halves its latents once, the real one three times."""
    return replace(SVD_GEOMETRY, multiple=16) if config.kind == "tiny_svd" else SVD_GEOMETRY


def extra_parameters(unet: torch.nn.Module, config: TrainConfig) -> int:
    """Numbers that are trained beside the LoRA: the widened convolution and the text projection."""
    settings: Any = unet.config
    slots = len(reference_names(config.stage, control=config.conditions.control))
    return 9 * 4 * slots * settings.block_out_channels[0] + config.backbone.text_width * settings.cross_attention_dim


def meta_unet(config: BackboneConfig) -> UNetSpatioTemporalConditionModel:
    """The network without weights, for a dry run."""
    from training.tiny import TINY_UNET

    with torch.device("meta"):
        return UNetSpatioTemporalConditionModel(**(TINY_UNET if config.kind == "tiny_svd" else {}))


def load_svd(config: BackboneConfig, *, device: str | torch.device = "cpu", parts: Sequence[str] = ()) -> SvdBackbone:
    """The SVD backbone of ``config``; the tiny kind without weights is random.

    Raises:
        ModelError: weights that are absent or do not fit.
    """
    if config.weights is not None:
        makers = _makers(config, config.weights)
    elif config.kind == "tiny_svd":
        from training.tiny import tiny_svd_makers

        makers = tiny_svd_makers(config)
    else:
        raise ModelError(f"backbone {config.name} has no weights; set backbone.weights to a folder or hub id")
    backbone = SvdBackbone(config, device=device, makers=makers)
    backbone.preload(parts)
    return backbone


def _makers(config: BackboneConfig, source: str) -> dict[str, Callable[[], Any]]:
    dtype, text = getattr(torch, config.dtype), config.text_weights or source
    needed = ("vae", "unet", "image_encoder", *(TEXT_PARTS if text == source else ()))
    return {
        "denoiser": lambda: load_pretrained(
            UNetSpatioTemporalConditionModel, source, "unet", dtype=dtype, needed=needed
        ),
        "vae": lambda: load_pretrained(AutoencoderKLTemporalDecoder, source, "vae", dtype=dtype, needed=needed),
        "text": lambda: load_text_encoder(text, dtype=dtype, needed=needed if text == source else ()),
        "image": lambda: load_image_encoder(source, dtype=dtype, needed=needed),
    }
