"""A backbone's networks, each loaded when it is first used.

Training needs neither the VAE nor the text encoder, and caching does not need the denoiser.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from training.config import BackboneConfig


class LazyParts:
    """Networks by name, frozen, on one device and in one type.

    Args:
        config: names the type.
        device: where they go.
        makers: what loads each part: a network, or a tuple that holds one.
    """

    def __init__(
        self, config: BackboneConfig, *, device: str | torch.device, makers: Mapping[str, Callable[[], Any]]
    ) -> None:
        self.config, self.device = config, torch.device(device)
        self.dtype: torch.dtype = getattr(torch, config.dtype)
        self._makers = dict(makers)
        self._parts: dict[str, Any] = {}

    def part(self, name: str) -> Any:
        """A part, loaded now if it was not."""
        if name not in self._parts:
            part = self._makers[name]()
            for module in part if isinstance(part, tuple) else (part,):
                if isinstance(module, torch.nn.Module):
                    module.to(self.device)
                    # A cast that changes nothing would only make diffusers warn.
                    if any(weight.dtype != self.dtype for weight in module.parameters()):
                        module.to(self.dtype)
                    module.eval().requires_grad_(False)
            self._parts[name] = part
        return self._parts[name]

    def preload(self, parts: Sequence[str]) -> None:
        """Load these parts now."""
        for name in parts:
            self.part(name)

    def release(self, parts: Sequence[str]) -> None:
        """Forget parts; they load again when used."""
        for name in parts:
            self._parts.pop(name, None)

    def autocast(self) -> torch.autocast:
        """In training and in sampling alike: the float32 adapters multiply in the base's bfloat16."""
        kind = "cpu" if self.device.type == "meta" else self.device.type
        return torch.autocast(kind, torch.bfloat16, enabled=self.dtype == torch.bfloat16)
