"""Random tiny networks of the very classes that the real backbones are, so that everything runs on a CPU in seconds.

Nothing is learnt in them: they stand in for weights that cannot be shipped. The same seed gives the same weights. The
text encoder is a two-layer random T5 over bytes (``ByT5Tokenizer`` needs no vocabulary file), so that captions still
have different, deterministic embeddings.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from diffusers.models.autoencoders.autoencoder_kl_ltx import AutoencoderKLLTXVideo
from diffusers.models.autoencoders.autoencoder_kl_temporal_decoder import AutoencoderKLTemporalDecoder
from diffusers.models.transformers.transformer_ltx import LTXVideoTransformer3DModel
from diffusers.models.unets.unet_spatio_temporal_condition import UNetSpatioTemporalConditionModel

from training.config import BackboneConfig

Made = TypeVar("Made")
TEXT_CHANNELS = 32
TINY_TRANSFORMER: dict[str, Any] = {
    "in_channels": 128, "out_channels": 128, "num_attention_heads": 4, "attention_head_dim": 16,
    "cross_attention_dim": 64, "num_layers": 2, "caption_channels": TEXT_CHANNELS,
}  # fmt: skip
"""203 thousand parameters; patch 1, as the real one."""
TINY_VAE: dict[str, Any] = {
    "latent_channels": 128, "block_out_channels": (8, 8, 8, 8), "decoder_block_out_channels": (8, 8, 8, 8),
    "layers_per_block": (1,) * 5, "decoder_layers_per_block": (1,) * 5,
    "spatio_temporal_scaling": (True, True, True, False),
    "decoder_spatio_temporal_scaling": (True, True, True, False), "decoder_inject_noise": (False,) * 5,
    "upsample_residual": (False,) * 4, "upsample_factor": (1,) * 4, "timestep_conditioning": False,
    "patch_size": 4, "patch_size_t": 1, "encoder_causal": True, "decoder_causal": False,
}  # fmt: skip
"""158 thousand parameters with the true ratios: 32 pixels, 8 frames, 128 channels."""

TINY_UNET: dict[str, Any] = {
    "sample_size": 8, "in_channels": 8, "out_channels": 4, "num_frames": 5, "layers_per_block": 1,
    "down_block_types": ("CrossAttnDownBlockSpatioTemporal", "DownBlockSpatioTemporal"),
    "up_block_types": ("UpBlockSpatioTemporal", "CrossAttnUpBlockSpatioTemporal"), "block_out_channels": (32, 64),
    "cross_attention_dim": TEXT_CHANNELS, "num_attention_heads": (2, 4), "addition_time_embed_dim": 32,
    "projection_class_embeddings_input_dim": 96,
}  # fmt: skip


def seeded(make: Callable[[], Made], *, seed: int) -> Made:
    """``make()`` under its own random state; the caller's is left alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make()


def tiny_transformer(seed: int = 0) -> LTXVideoTransformer3DModel:
    """The tiny transformer."""
    return seeded(lambda: LTXVideoTransformer3DModel(**TINY_TRANSFORMER), seed=seed)


def tiny_vae(seed: int = 0, *, timestep_conditioning: bool = False) -> AutoencoderKLLTXVideo:
    """The tiny VAE; ``timestep_conditioning`` as the released 2B model has it."""
    settings: dict[str, Any] = TINY_VAE | {"timestep_conditioning": timestep_conditioning}
    return seeded(lambda: AutoencoderKLLTXVideo(**settings), seed=seed)


def tiny_text(seed: int = 0) -> tuple[Any, torch.nn.Module]:
    """(byte tokenizer, two-layer T5 encoder)."""
    from transformers import ByT5Tokenizer, T5Config, T5EncoderModel

    config = T5Config(
        vocab_size=384, d_model=TEXT_CHANNELS, d_kv=8, d_ff=64, num_layers=2, num_heads=4, dropout_rate=0.0
    )
    return ByT5Tokenizer(), seeded(lambda: T5EncoderModel(config), seed=seed)


def tiny_ltx_makers(config: BackboneConfig) -> dict[str, Callable[[], Any]]:
    """The makers of an LTX backbone's parts."""
    return {
        "denoiser": lambda: tiny_transformer(config.seed),
        "vae": lambda: tiny_vae(config.seed),
        "text": lambda: tiny_text(config.seed),
    }


def tiny_unet(seed: int = 0) -> UNetSpatioTemporalConditionModel:
    """The tiny SVD network."""
    return seeded(lambda: UNetSpatioTemporalConditionModel(**TINY_UNET), seed=seed)


def tiny_image_vae(seed: int = 0) -> AutoencoderKLTemporalDecoder:
    """The tiny SVD VAE with the true ratio of 8 pixels a cell."""
    settings: dict[str, Any] = {
        "down_block_types": ("DownEncoderBlock2D",) * 4, "block_out_channels": (32,) * 4, "layers_per_block": 1,
        "latent_channels": 4,
    }  # fmt: skip
    return seeded(lambda: AutoencoderKLTemporalDecoder(**settings), seed=seed)


def tiny_image_encoder(seed: int = 0) -> torch.nn.Module:
    """A two-layer random CLIP over 32x32 pictures."""
    from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

    config = CLIPVisionConfig(
        hidden_size=32, intermediate_size=64, num_hidden_layers=2, num_attention_heads=4, image_size=32, patch_size=16,
        projection_dim=TEXT_CHANNELS,
    )  # fmt: skip
    return seeded(lambda: CLIPVisionModelWithProjection(config), seed=seed)


def tiny_svd_makers(config: BackboneConfig) -> dict[str, Callable[[], Any]]:
    """The makers of an SVD backbone's parts."""
    return {
        "denoiser": lambda: tiny_unet(config.seed),
        "vae": lambda: tiny_image_vae(config.seed),
        "text": lambda: tiny_text(config.seed),
        "image": lambda: tiny_image_encoder(config.seed),
    }
