"""How much arithmetic a training step takes, from shapes alone."""

import torch

from training.config import TrainConfig

_TEXT_SIDE = ("attn2.to_k", "attn2.to_v", "caption_projection.linear_1", "caption_projection.linear_2")
"""Linear layers that see the caption's tokens and not the video's."""


def step_flops(denoiser: torch.nn.Module, config: TrainConfig, *, tokens: float, layers: int, hidden: int) -> float:
    """Floating-point operations of one sample's matrix products, forward and backward, recomputation included.

    A frozen layer works twice (its output, and its input's gradient), an adapter and attention three times; with
    checkpointing everything is computed forward once more.

    Args:
        denoiser: without its adapter; the meta device will do.
        config: the recipe.
        tokens: of the sequence.
        layers: blocks of one self- and one cross-attention.
        hidden: channels of a token inside the blocks.
    """
    endings, text = tuple(f".{target}" for target in config.adapter.targets), config.backbone.text_tokens
    frozen = adapter = 0.0
    for name, layer in denoiser.named_modules():
        if isinstance(layer, torch.nn.Linear):
            seen = text if name.endswith(_TEXT_SIDE) else tokens
            frozen += 2 * layer.in_features * layer.out_features * seen
            adapter += (
                2 * config.adapter.rank * (layer.in_features + layer.out_features) * seen * name.endswith(endings)
            )
    attention = 4 * layers * hidden * tokens * (tokens + text)
    again = 1 if config.gradient_checkpointing else 0
    return (2 + again) * frozen + (3 + again) * (adapter + attention)
