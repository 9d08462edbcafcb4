"""Captions through a text encoder."""

from collections.abc import Sequence
from typing import Any

import torch

from training.backbone import TextEmbedding


@torch.no_grad()
def embed_captions(
    tokenizer: Any, encoder: torch.nn.Module, captions: Sequence[str], *, length: int
) -> list[TextEmbedding]:
    """One unpadded embedding per caption, cut at ``length`` tokens, float32 on the CPU."""
    device = next(encoder.parameters()).device
    embeddings = []
    for caption in captions:
        tokens = tokenizer([caption], max_length=length, truncation=True, return_tensors="pt")
        hidden = encoder(input_ids=tokens.input_ids.to(device), attention_mask=tokens.attention_mask.to(device))[0]
        embeddings.append(TextEmbedding(tokens_LD=hidden[0].float().cpu()))
    return embeddings
