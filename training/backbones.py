"""The backbones by name: which module loads which."""

from collections.abc import Sequence

import torch

from labeling.errors import ConfigError
from training.backbone import Backbone
from training.config import BackboneConfig


def load_backbone(config: BackboneConfig, *, device: str | torch.device = "cpu", parts: Sequence[str] = ()) -> Backbone:
    """The backbone that ``config`` names.

    Args:
        config: what to load and from where.
        device: where its networks go.
        parts: of ``denoiser``, ``vae``, ``text``: loaded now. Every other one loads when it is first used.

    Raises:
        ConfigError: no such device here.
        ModelError: weights that are absent or do not fit.
    """
    device = usable_device(device)
    # A backbone's libraries take seconds to import; only the one that is asked for is.
    if config.kind in ("svd", "tiny_svd"):
        from training.svd import load_svd

        return load_svd(config, device=device, parts=parts)
    from training.ltx import load_ltx

    return load_ltx(config, device=device, parts=parts)


def usable_device(device: str | torch.device) -> torch.device:
    """The device, tried.

    Raises:
        ConfigError: it is not known, or not on this machine.
    """
    try:
        found = torch.device(device)
    except RuntimeError as error:
        raise ConfigError(
            f"device {device!r} is not known; give cpu, cuda, or cuda:N for the Nth GPU from 0"
        ) from error
    try:
        torch.zeros(1, device=found).item()
    except (RuntimeError, AssertionError, NotImplementedError, ImportError) as error:
        raise ConfigError(
            f"device {str(device)!r} cannot be used on this machine: torch {torch.__version__} finds "
            f"{torch.cuda.device_count()} GPUs; give cpu"
        ) from error
    return found
