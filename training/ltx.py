"""The LTX-Video backbone: diffusers' transformer, video VAE and T5 encoder, from a folder, one file or a hub id."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers.models.autoencoders.autoencoder_kl_ltx import AutoencoderKLLTXVideo
from diffusers.models.transformers.transformer_ltx import LTXVideoTransformer3DModel

from labeling.errors import ModelError
from training.adapters import AdapterFile, attach_adapter, load_adapter
from training.backbone import LatentGeometry, SamplingSettings, StageInputs, TextEmbedding, with_empty_text
from training.conditioning import TokenSequence, assemble_tokens, pack, sequence_tokens, unpack
from training.config import AdapterConfig, BackboneConfig, Convention
from training.flow import (
    interpolate,
    masked_mse,
    sampling_sigmas,
    sigma_from_normal,
    velocity_target,
)
from training.parts import LazyParts
from training.text import embed_captions
from training.weights import TEXT_PARTS, digest_module, load_pretrained, load_text_encoder

TRANSFORMERS: dict[str, dict[str, Any]] = {
    "2b": {},
    "13b": {"num_attention_heads": 32, "attention_head_dim": 128, "cross_attention_dim": 4096, "num_layers": 48},
}
"""What differs from diffusers' defaults (which are the 2B model's) in each released transformer."""

LTX_GEOMETRY = LatentGeometry(channels=128, spatial=32, temporal=8)
DECODE_TIMESTEP, DECODE_NOISE = 0.05, 0.025
"""For decoders with timestep conditioning, as LTX-Video's own examples set them."""


class LtxBackbone(LazyParts):
    """See ``training.backbone.Backbone``."""

    adapter_prefix = "transformer"

    @property
    def geometry(self) -> LatentGeometry:
        """32 pixels and 8 frames a cell, 128 channels."""
        return LTX_GEOMETRY

    def attach(self, name: str, config: AdapterConfig) -> list[torch.nn.Parameter]:
        """A fresh trainable adapter, active; its parameters."""
        return attach_adapter(self.denoiser, name, config)

    def load_adapter(self, path: Path, name: str) -> AdapterFile:
        """An adapter file, not active."""
        return load_adapter(self.denoiser, path, name)

    @property
    def denoiser(self) -> LTXVideoTransformer3DModel:
        """The transformer."""
        return self.part("denoiser")

    @property
    def vae(self) -> AutoencoderKLLTXVideo:
        """The video VAE."""
        vae = self.part("vae")
        if self.config.vae_tiling:
            vae.enable_tiling()
        return vae

    @property
    def text(self) -> tuple[Any, torch.nn.Module]:
        """(tokenizer, encoder)."""
        return self.part("text")

    @torch.no_grad()
    def encode_video(self, frames_THWC: np.ndarray) -> torch.Tensor:
        """(T, H, W, 3) uint8 RGB to (C, F, H, W) float32 normalised latents: the posterior's mode, no randomness.

        Raises:
            ConfigError: sizes that do not fit (see ``LatentGeometry.latent_shape``).
        """
        frames, height, width, _ = frames_THWC.shape
        self.geometry.latent_shape(frames=frames, height=height, width=width)
        pixels = torch.from_numpy(np.ascontiguousarray(frames_THWC)).permute(3, 0, 1, 2)[None]
        pixels = pixels.to(self.device).to(self.dtype) / 127.5 - 1
        encoded: Any = self.vae.encode(pixels)
        latents = encoded.latent_dist.mode().float()
        mean, std, scale = self._statistics()
        return ((latents - mean) * scale / std)[0].cpu()

    @torch.no_grad()
    def decode_video(self, latents_CFHW: torch.Tensor, *, seed: int = 0) -> np.ndarray:
        """Latents to (T, H, W, 3) uint8 RGB; ``seed`` feeds decoders that add noise."""
        mean, std, scale = self._statistics()
        latents = latents_CFHW[None].to(self.device).float() * std / scale + mean
        timestep = None
        with torch.random.fork_rng(devices=[self.device] if self.device.type == "cuda" else []):
            torch.manual_seed(seed)
            if self.vae.config["timestep_conditioning"]:
                noise = torch.randn(latents.shape).to(latents)
                latents = (1 - DECODE_NOISE) * latents + DECODE_NOISE * noise
                timestep = torch.full((1,), DECODE_TIMESTEP, device=self.device, dtype=self.dtype)
            pixels = self.vae.decode(latents.to(self.dtype), timestep, return_dict=False)[0]
        pixels = ((pixels[0].float() + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
        return pixels.permute(1, 2, 3, 0).cpu().numpy()

    def _statistics(self) -> tuple[torch.Tensor, torch.Tensor, float]:
        mean, std = (
            getattr(self.vae, name).to(self.device).float().view(1, -1, 1, 1, 1)
            for name in ("latents_mean", "latents_std")
        )
        return mean, std, float(self.vae.config["scaling_factor"])

    def encode_image(self, frame_HWC: np.ndarray) -> None:
        """LTX sees images through its VAE only."""

    @torch.no_grad()
    def encode_text(self, captions: Sequence[str]) -> list[TextEmbedding]:
        """One unpadded T5 embedding per caption, cut at ``text_tokens``, float32 on the CPU."""
        return embed_captions(*self.text, captions, length=self.config.text_tokens)

    def fingerprint(self) -> dict[str, str]:
        """sha256 of the VAE's and of the text encoder's weights and settings."""
        return {"vae": self.fingerprint_vae(), "text": digest_module(self.text[1])}

    def fingerprint_vae(self) -> str:
        """sha256 of the VAE alone: what a trainer can check without the text encoder."""
        return digest_module(self.vae, extra={"dtype": self.config.dtype, "tiling": self.config.vae_tiling})

    def sigma_from_normal(self, normal_B: torch.Tensor, *, target_shape: tuple[int, int, int, int]) -> torch.Tensor:
        """Shifted logit-normal; the shift follows the target's tokens and is bounded."""
        return sigma_from_normal(normal_B, tokens=target_shape[1] * target_shape[2] * target_shape[3])

    def sigma_from_share(self, share: float) -> float:
        """sigma itself is the share."""
        return share

    def velocity(
        self, inputs: StageInputs, noisy_BCFHW: torch.Tensor, *, sigma_B: torch.Tensor, convention: Convention
    ) -> tuple[torch.Tensor, TokenSequence]:
        """The network's v over the target's tokens, (B, N_target, C), and the sequence it was fed."""
        sequence = assemble_tokens(inputs, noisy_BCFHW, sigma_B=sigma_B, geometry=self.geometry, convention=convention)
        with self.autocast():
            predicted = self.denoiser(
                hidden_states=sequence.hidden_BNC.to(self.dtype),
                encoder_hidden_states=inputs.text_BLD.to(self.dtype),
                timestep=sequence.timestep_BN,
                encoder_attention_mask=inputs.text_mask_BL.to(self.dtype),
                video_coords=sequence.coordinates_B3N,
                return_dict=False,
            )[0]
        return predicted[:, sequence.target_start :], sequence

    def losses(
        self, inputs: StageInputs, target_BCFHW: torch.Tensor, *, noise_BCFHW: torch.Tensor, sigma_B: torch.Tensor
    ) -> torch.Tensor:
        """Flow-matching loss of each sample over the noisy target tokens, (B,) float32."""
        # Latents travel in the type they are stored in; the sums are float32.
        target_BCFHW = target_BCFHW.float()
        noisy = interpolate(target_BCFHW, noise_BCFHW, sigma_B)
        predicted, sequence = self.velocity(inputs, noisy, sigma_B=sigma_B, convention="consistent")
        return masked_mse(predicted, pack(velocity_target(target_BCFHW, noise_BCFHW)), sequence.loss_mask_BN)

    @torch.no_grad()
    def sample(
        self, inputs: StageInputs, *, noise_BCFHW: torch.Tensor, empty_text: TextEmbedding, settings: SamplingSettings
    ) -> torch.Tensor:
        """Euler steps from noise to (B, C, F, H, W) float32; the first latent frame stays clean throughout."""
        convention = settings.coordinates
        sigmas = sampling_sigmas(settings.steps, tokens=sequence_tokens(inputs)[0], convention=convention)
        latents = noise_BCFHW.to(self.device).float()
        for sigma, following in zip(sigmas[:-1].tolist(), sigmas[1:].tolist(), strict=True):
            sigma_B = torch.full((len(latents),), sigma, device=self.device)
            velocity = self._guided(inputs, latents, sigma_B, empty_text, settings.guidance, convention)
            latents = latents + (following - sigma) * unpack(velocity.float(), inputs.target_shape)
        return torch.cat([inputs.first_frame_BCFHW.to(latents), latents[:, :, 1:]], dim=2)

    def _guided(
        self, inputs: StageInputs, latents: torch.Tensor, sigma_B: torch.Tensor, empty_text: TextEmbedding,
        guidance: float, convention: Convention,
    ) -> torch.Tensor:  # fmt: skip
        if guidance == 1:
            return self.velocity(inputs, latents, sigma_B=sigma_B, convention=convention)[0]
        both = with_empty_text(inputs, empty_text)
        doubled, _ = self.velocity(
            both, latents.repeat(2, 1, 1, 1, 1), sigma_B=sigma_B.repeat(2), convention=convention
        )
        without, with_text = doubled.chunk(2)
        return without + guidance * (with_text - without)


def load_ltx(config: BackboneConfig, *, device: str | torch.device = "cpu", parts: Sequence[str] = ()) -> LtxBackbone:
    """The LTX backbone of ``config``; the tiny kind without weights is random.

    Raises:
        ModelError: weights that are absent or do not fit.
    """
    if config.weights is not None:
        makers = _makers(config, config.weights)
    elif config.kind == "tiny":
        from training.tiny import tiny_ltx_makers

        makers = tiny_ltx_makers(config)
    else:
        raise ModelError(f"backbone {config.name} has no weights; set backbone.weights to a folder, file or hub id")
    backbone = LtxBackbone(config, device=device, makers=makers)
    backbone.preload(parts)
    return backbone


def _makers(config: BackboneConfig, source: str) -> dict[str, Callable[[], Any]]:
    dtype, text_source, told = getattr(torch, config.dtype), config.text_weights or source, config.weights_config
    needed = ("vae", "transformer", *(TEXT_PARTS if text_source == source else ()))
    return {
        "denoiser": lambda: load_pretrained(
            LTXVideoTransformer3DModel, source, "transformer", dtype=dtype, file_config=told, needed=needed
        ),
        "vae": lambda: load_pretrained(
            AutoencoderKLLTXVideo, source, "vae", dtype=dtype, file_config=told, needed=needed
        ),
        "text": lambda: load_text_encoder(
            text_source, dtype=dtype, single_file=Path(source).is_file(), needed=needed if text_source == source else ()
        ),
    }
