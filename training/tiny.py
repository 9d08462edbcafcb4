"""Random tiny networks of the very classes that the real backbones are, so that everything runs on a CPU in seconds.

Nothing is learnt in them: they stand in for weights that cannot be shipped. The same seed gives the same weights. The
text encoder is a two-layer random T5 over bytes (``ByT5Tokenizer`` needs no vocabulary file), so that captions still
have different, deterministic embeddings.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from diffusers.models.autoencoders.autoencoder_kl_ltx import AutoencoderKLLTXVideo
from diffusers.models.transformers.transformer_ltx import LTXVideoTransformer3DModel

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
    settings = TINY_VAE | {"timestep_conditioning": timestep_conditioning}
    return seeded(lambda: AutoencoderKLLTXVideo(**settings), seed=seed)


def tiny_text(seed: int = 0) -> tuple[Any, torch.nn.Module]:
    """(byte tokenizer, two-layer T5 encoder)."""
    from transformers import ByT5Tokenizer, T5Config, T5EncoderModel

    config = T5Config(
        vocab_size=384, d_model=TEXT_CHANNELS, d_kv=8, d_ff=64, num_layers=2, num_heads=4, dropout_rate=0.0
    )
    return ByT5Tokenizer(), seeded(lambda: T5EncoderModel(config), seed=seed)


def tiny_ltx_makers(config: BackboneConfig) -> dict[str, Callable[[], Any]]:
    """The makers that ``LtxBackbone`` takes."""
    return {
        "make_denoiser": lambda: tiny_transformer(config.seed),
        "make_vae": lambda: tiny_vae(config.seed),
        "make_text": lambda: tiny_text(config.seed),
    }
