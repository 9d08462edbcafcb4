"""The backbones by name: which module loads which."""

from collections.abc import Sequence

import torch

from training.backbone import Backbone
from training.config import BackboneConfig


def load_backbone(config: BackboneConfig, *, device: str | torch.device = "cpu", parts: Sequence[str] = ()) -> Backbone:
    """The backbone that ``config`` names.

    Args:
        config: what to load and from where.
        device: where its networks go.
        parts: of ``denoiser``, ``vae``, ``text``: loaded now. Every other one loads when it is first used.

    Raises:
        ModelError: weights that are absent or do not fit.
    """
    # A backbone's libraries take seconds to import; only the one that is asked for is.
    if config.kind in ("svd", "tiny_svd"):
        from training.svd import load_svd

        return load_svd(config, device=device, parts=parts)
    from training.ltx import load_ltx

    return load_ltx(config, device=device, parts=parts)
