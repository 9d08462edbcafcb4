"""The study's general video model: a small LTX transformer and VAE, both trained on moving shapes and on no street.

They are saved as a diffusers folder, so that the study's arms load them as they would load released weights: the same
loading code, the same trainer, the same sampler. The text encoder is the random tiny T5.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers.models.autoencoders.autoencoder_kl_ltx import AutoencoderKLLTXVideo
from diffusers.models.transformers.transformer_ltx import LTXVideoTransformer3DModel

from training.backbone import TextEmbedding
from training.config import BackboneConfig, PictureConfig
from training.ltx import LtxBackbone
from training.stages import stack_inputs, stage_inputs
from training.street_fitting import FitSettings, fit
from training.study_shapes import shape_video
from training.tiny import TEXT_CHANNELS, TINY_VAE, seeded, tiny_text
from training.weights import load_pretrained, load_text_encoder

VAE: dict[str, Any] = TINY_VAE | {
    "block_out_channels": (16, 32, 64, 128), "decoder_block_out_channels": (32, 64, 128),
    "layers_per_block": (1,) * 4, "decoder_layers_per_block": (1,) * 4, "spatio_temporal_scaling": (True,) * 3,
    "decoder_spatio_temporal_scaling": (True,) * 3, "decoder_inject_noise": (False,) * 4,
    "down_block_types": ("LTXVideo095DownBlock3D",) * 3, "downsample_type": ("spatiotemporal",) * 3,
    "upsample_residual": (True,) * 3, "upsample_factor": (2,) * 3,
}  # fmt: skip
"""LTX-Video 0.9.5's VAE made small, at the true ratios (32 pixels, 8 frames, 128 channels); its residual samplers learn
in a tenth of the steps that the plain ones need."""
TRANSFORMER: dict[str, Any] = {
    "in_channels": 128, "out_channels": 128, "num_attention_heads": 4, "attention_head_dim": 48,
    "cross_attention_dim": 192, "num_layers": 3, "caption_channels": TEXT_CHANNELS,
}  # fmt: skip
"""2.2 million parameters, patch 1."""
TEXT_TOKENS = 16
_VAE_MIX = (0.55, 0.3, 0.15)
"""How often the VAE sees six clips of 32x32x9, three of 64x64x9, two of 64x64x17: the small ones are cheap."""
_LATENT_NOISE = 0.05
"""Of the latents' spread, added while the VAE learns: what is sampled later is never quite what was encoded."""
_LEAST_STD = 0.05
_SHAPE_BATCH = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class BasePlan:
    """How much the general video model learns."""

    vae_steps: int
    """Steps of the VAE, each over two to six small clips."""
    denoiser_steps: int
    """Steps of the transformer, each over eight clips."""
    videos: int
    """Different shape videos that the transformer sees."""
    seed: int = 0


def study_backbone(folder: Path, *, picture: PictureConfig, name: str) -> BackboneConfig:
    """The backbone in ``folder`` at given sizes; ``name`` is that of its latents."""
    return BackboneConfig(
        name=name, kind="ltx", weights=str(folder), text_width=TEXT_CHANNELS, text_tokens=TEXT_TOKENS, picture=picture
    )


def save_vae(folder: Path, plan: BasePlan) -> None:
    """Train the VAE and save it beside the text encoder, unless ``folder`` has them."""
    if not (folder / "tokenizer").is_dir():
        tokenizer, encoder = tiny_text(plan.seed)
        _save(encoder, folder / "text_encoder")
        _save(tokenizer, folder / "tokenizer")
    if not (folder / "vae").is_dir():
        _save(train_vae(plan), folder / "vae")


def save_denoiser(folder: Path, plan: BasePlan, *, picture: PictureConfig) -> None:
    """Train the transformer on the latents of the VAE that ``folder`` holds, unless it is there."""
    if not (folder / "transformer").is_dir():
        _save(train_denoiser(folder, plan, picture=picture), folder / "transformer")


def _save(module: Any, folder: Path) -> None:
    """Under a temporary name first: a folder that is there is whole."""
    temporary = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(temporary, ignore_errors=True)
    module.save_pretrained(str(temporary))
    temporary.rename(folder)


def train_vae(plan: BasePlan) -> AutoencoderKLLTXVideo:
    """A VAE that gives moving shapes back; its latents' mean and spread are stored in it."""
    vae = seeded(lambda: AutoencoderKLLTXVideo(**VAE), seed=plan.seed)
    fitting = FitSettings(
        seed=plan.seed, steps=plan.vae_steps, learning_rate=4e-4, average_decay=0.99, channels_last=False, name="VAE"
    )
    fitted: Any = fit(vae, lambda rng: _vae_batch(plan, rng), _vae_loss, fitting)
    _store_statistics(fitted, plan)
    return fitted


def _vae_batch(plan: BasePlan, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Clips of one latent cell or of two by two, of two latent frames or three, and noise for their latents."""
    count, side, frames = ((6, 32, 9), (3, 64, 9), (2, 64, 17))[int(rng.choice(3, p=_VAE_MIX))]
    clips = []
    for _ in range(count):
        clip = shape_video(plan.seed, int(rng.integers(1 << 20, 1 << 40)), frames=frames, width=128, height=64)
        left, top = int(rng.integers(0, 129 - side)), int(rng.integers(0, 65 - side))
        clips.append(clip[:, top : top + side, left : left + side])
    noise = rng.standard_normal((count, 128, (frames - 1) // 8 + 1, side // 32, side // 32), np.float32)
    return _pixels(np.stack(clips)), torch.from_numpy(noise)


def _vae_loss(vae: Any, batch: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """What is given back from latents that are a little off, since sampled latents always are."""
    clips, noise = batch
    latents = vae.encode(clips).latent_dist.mode()
    noisy = latents + _LATENT_NOISE * latents.detach().std() * noise
    error = vae.decode(noisy, return_dict=False)[0].float() - clips
    return error.square().mean() + 0.1 * error.abs().mean() + 1e-4 * latents.float().square().mean()


def _pixels(clips: np.ndarray) -> torch.Tensor:
    """(B, T, H, W, 3) uint8 to (B, 3, T, H, W) float32 from -1 to 1."""
    return torch.from_numpy(np.ascontiguousarray(clips)).permute(0, 4, 1, 2, 3).float() / 127.5 - 1


@torch.no_grad()
def _store_statistics(vae: AutoencoderKLLTXVideo, plan: BasePlan) -> None:
    """Mean and spread of each latent channel, as the released VAE carries its own."""
    clips = [shape_video(plan.seed, one, frames=17, width=128, height=64) for one in range(min(32, plan.videos))]
    encoded: list[Any] = [vae.encode(_pixels(clip[None])) for clip in clips]
    latents = torch.cat([one.latent_dist.mode() for one in encoded])
    vae.latents_mean.copy_(latents.mean(dim=(0, 2, 3, 4)))
    vae.latents_std.copy_(latents.std(dim=(0, 2, 3, 4)).clamp(min=_LEAST_STD))


def train_denoiser(folder: Path, plan: BasePlan, *, picture: PictureConfig) -> LTXVideoTransformer3DModel:
    """A transformer that goes on from a first frame, trained whole on the latents of shape videos."""
    network = seeded(lambda: LTXVideoTransformer3DModel(**TRANSFORMER), seed=plan.seed)
    backbone = LtxBackbone(
        study_backbone(folder, picture=picture, name="shapes"), device="cpu",
        makers={
            "denoiser": lambda: network,
            "vae": lambda: load_pretrained(AutoencoderKLLTXVideo, str(folder), "vae", dtype=torch.float32),
            "text": lambda: load_text_encoder(str(folder), dtype=torch.float32),
        },
    )  # fmt: skip
    latents, text = _shape_latents(backbone, plan), backbone.encode_text([""])[0]
    backbone.denoiser.requires_grad_(True)

    def batch_of(rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        chosen = latents[torch.from_numpy(rng.integers(0, len(latents), _SHAPE_BATCH))]
        noise = torch.from_numpy(rng.standard_normal(tuple(chosen.shape), np.float32))
        return chosen, noise, torch.from_numpy(rng.standard_normal(len(chosen), np.float32))

    def loss_of(_: torch.nn.Module, batch: tuple[torch.Tensor, torch.Tensor, torch.Tensor]) -> torch.Tensor:
        return _shape_loss(backbone, batch, text)

    fitting = FitSettings(
        seed=plan.seed, steps=plan.denoiser_steps, learning_rate=6e-4, average_decay=0.99, channels_last=False,
        name="denoiser",
    )  # fmt: skip
    fitted: Any = fit(network, batch_of, loss_of, fitting)
    return fitted


def _shape_latents(backbone: LtxBackbone, plan: BasePlan) -> torch.Tensor:
    """(videos, C, F, H, W) of videos that the VAE was not trained on."""
    picture = backbone.config.picture
    size = {"frames": picture.frames or 1, "width": picture.rgb_width, "height": picture.rgb_height}
    return torch.stack([backbone.encode_video(shape_video(plan.seed, one, **size)) for one in range(plan.videos)])


def _shape_loss(
    backbone: LtxBackbone, batch: tuple[torch.Tensor, torch.Tensor, torch.Tensor], text: TextEmbedding
) -> torch.Tensor:
    """Flow matching from a clean first frame and an empty caption, as an image-to-video model is trained."""
    latents, noise, normal_B = batch
    shape = (latents.shape[1], latents.shape[2], latents.shape[3], latents.shape[4])
    inputs = stack_inputs(
        [
            stage_inputs(
                "end_to_end", first_frame_CFHW=one, target_shape=shape, references={}, text=text,
                text_tokens=TEXT_TOKENS, fps=backbone.config.picture.fps,
            )
            for one in latents
        ]
    )  # fmt: skip
    sigma_B = backbone.sigma_from_normal(normal_B, target_shape=shape)
    return backbone.losses(inputs, latents, noise_BCFHW=noise, sigma_B=sigma_B).mean()
