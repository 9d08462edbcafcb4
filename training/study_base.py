"""The study's general video model: a small LTX transformer and a VAE, both taught on moving shapes and on no street.

The transformer is diffusers' class in the project's own ``LtxBackbone``, so that the study's arms go through the same
conditioning, trainer and sampler as real ones. The text encoder is the random tiny T5.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from diffusers.models.transformers.transformer_ltx import LTXVideoTransformer3DModel

from training.backbone import TextEmbedding
from training.config import BackboneConfig, PictureConfig
from training.ltx import LtxBackbone
from training.stages import stack_inputs, stage_inputs
from training.street_fitting import FitSettings, fit
from training.study_shapes import shape_video
from training.study_vae import fit_vae, load_linear, save_linear
from training.tiny import TEXT_CHANNELS, seeded, tiny_text
from training.weights import load_pretrained, load_text_encoder

TRANSFORMER: dict[str, Any] = {
    "in_channels": 128, "out_channels": 128, "num_attention_heads": 4, "attention_head_dim": 48,
    "cross_attention_dim": 192, "num_layers": 3, "caption_channels": TEXT_CHANNELS,
}  # fmt: skip
"""2.2 million parameters, patch 1."""
TEXT_TOKENS = 16
VAE_FILE = "vae.safetensors"
_SHAPE_BATCH = 8
_UNSEEN = 1 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class BasePlan:
    """How much the general video model learns."""

    vae_videos: int
    """Shape videos whose components are the VAE."""
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


def open_backbone(config: BackboneConfig, *, denoiser: LTXVideoTransformer3DModel | None = None) -> LtxBackbone:
    """The backbone of ``study_backbone``, with the transformer that its folder holds or with another."""
    folder = Path(config.weights or "")
    return LtxBackbone(
        config, device="cpu",
        makers={
            "denoiser": lambda: denoiser or _saved_transformer(folder), "vae": lambda: load_linear(folder / VAE_FILE),
            "text": lambda: load_text_encoder(str(folder), dtype=torch.float32),
        },
    )  # fmt: skip


def _saved_transformer(folder: Path) -> LTXVideoTransformer3DModel:
    return load_pretrained(LTXVideoTransformer3DModel, str(folder), "transformer", dtype=torch.float32)


def save_vae(folder: Path, plan: BasePlan, *, picture: PictureConfig) -> None:
    """Fit the VAE and save it beside the text encoder, unless ``folder`` has them."""
    if not (folder / "tokenizer").is_dir():
        tokenizer, encoder = tiny_text(plan.seed)
        _save(encoder, folder / "text_encoder")
        _save(tokenizer, folder / "tokenizer")
    if not (folder / VAE_FILE).is_file():
        size = {"width": picture.rgb_width, "height": picture.rgb_height}
        save_linear(fit_vae(videos=plan.vae_videos, seed=plan.seed, **size), folder / VAE_FILE)


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


def train_denoiser(folder: Path, plan: BasePlan, *, picture: PictureConfig) -> LTXVideoTransformer3DModel:
    """A transformer that goes on from a first frame, trained whole on the latents of shape videos."""
    network = seeded(lambda: LTXVideoTransformer3DModel(**TRANSFORMER), seed=plan.seed)
    backbone = open_backbone(study_backbone(folder, picture=picture, name="shapes"), denoiser=network)
    latents, text = _shape_latents(backbone, plan), backbone.encode_text([""])[0]
    backbone.denoiser.requires_grad_(True)

    def batch_of(rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        chosen = latents[torch.from_numpy(rng.integers(0, len(latents), _SHAPE_BATCH))]
        noise = torch.from_numpy(rng.standard_normal(tuple(chosen.shape), np.float32))
        return chosen, noise, torch.from_numpy(rng.standard_normal(len(chosen), np.float32))

    def loss_of(_: torch.nn.Module, batch: tuple[torch.Tensor, torch.Tensor, torch.Tensor]) -> torch.Tensor:
        return _shape_loss(backbone, batch, text)

    fitting = FitSettings(
        seed=plan.seed, steps=plan.denoiser_steps, learning_rate=1e-3, average_decay=0.99, channels_last=False,
        name="denoiser",
    )  # fmt: skip
    fitted: Any = fit(network, batch_of, loss_of, fitting)
    return fitted


def _shape_latents(backbone: LtxBackbone, plan: BasePlan) -> torch.Tensor:
    """(videos, C, F, H, W) of videos that the VAE was not trained on."""
    picture = backbone.config.picture
    size = {"frames": picture.frames or 1, "width": picture.rgb_width, "height": picture.rgb_height}
    return torch.stack(
        [backbone.encode_video(shape_video(plan.seed, _UNSEEN + one, **size)) for one in range(plan.videos)]
    )


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
