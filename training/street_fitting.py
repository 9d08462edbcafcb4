"""One training loop for all street models: seeded, prefetched, resumable; the same seed gives the same weights."""

import copy
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

LossFunction = Callable[[nn.Module, Any], torch.Tensor]
BatchMaker = Callable[[np.random.Generator], Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSettings:
    """How long and how fast one network learns."""

    seed: int
    steps: int
    learning_rate: float = 2e-3
    """Peak of AdamW's rate; it warms up over the first twentieth and falls to nothing along a cosine."""
    weight_decay: float = 0.01
    average_decay: float = 0.998
    """Of the moving average of weights that is returned."""
    precision: torch.dtype = torch.bfloat16
    """Of convolutions and products; weights and losses stay float32."""
    channels_last: bool = True
    """Lay pictures out pixel by pixel, which 2-D convolutions are faster on; networks over videos cannot."""
    report_every: int = 500
    name: str = "network"


def fit(
    network: nn.Module,
    make_batch: BatchMaker,
    loss_of: LossFunction,
    settings: FitSettings,
    *,
    checkpoint: Path | None = None,
) -> nn.Module:
    """Train ``network`` in place; the moving average of its weights is returned, ready for inference.

    Args:
        network: initialised by the caller, under ``torch.manual_seed``.
        make_batch: gives one batch for a generator that is seeded by ``(seed, step)``, so that batches do not depend on
            threads.
        loss_of: scalar loss of a network and a batch.
        settings: length and rates.
        checkpoint: file that holds the state at every report. Where it is there already, training goes on from it, and
            ends with the same weights as without a pause.
    """
    network.train()
    if settings.channels_last:
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    average = copy.deepcopy(network)
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay, betas=(0.9, 0.99)
    )
    state = _State(network=network, average=average, optimiser=optimiser)
    first = state.load(checkpoint) if checkpoint and checkpoint.is_file() else 0
    recent: list[float] = []
    for step, batch in enumerate(_prefetched(make_batch, settings, first=first), first):
        for group in optimiser.param_groups:
            group["lr"] = settings.learning_rate * rate_at(step, settings.steps)
        with torch.autocast("cpu", settings.precision, enabled=settings.precision != torch.float32):
            loss = loss_of(network, batch)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimiser.step()
        _update_average(average, network, min(settings.average_decay, (step + 1) / (step + 10)))
        recent.append(float(loss.detach()))
        if (step + 1) % settings.report_every == 0:
            print(f"  {settings.name}: step {step + 1} of {settings.steps}, loss {np.mean(recent):.4f}", flush=True)
            recent.clear()
            if checkpoint:
                state.save(checkpoint, step + 1)
    return average.eval()


def rate_at(step: int, steps: int) -> float:
    """Share of the peak rate at a step: linear warm-up, then a cosine to 0."""
    warm = max(1, steps // 20)
    if step < warm:
        return (step + 1) / warm
    return 0.5 * (1 + math.cos(math.pi * (step - warm) / max(1, steps - warm)))


def _prefetched(make_batch: BatchMaker, settings: FitSettings, *, first: int = 0, ahead: int = 3) -> Iterator[Any]:
    def batch_of(step: int) -> Any:
        return make_batch(np.random.default_rng((settings.seed, step)))

    with ThreadPoolExecutor(1) as pool:
        waiting = [pool.submit(batch_of, step) for step in range(first, min(first + ahead, settings.steps))]
        for step in range(first, settings.steps):
            batch = waiting.pop(0).result()
            if step + ahead < settings.steps:
                waiting.append(pool.submit(batch_of, step + ahead))
            yield batch


@dataclass(frozen=True, slots=True, kw_only=True)
class _State:
    """What training goes on from; no batch depends on anything but its step."""

    network: nn.Module
    average: nn.Module
    optimiser: torch.optim.Optimizer

    def save(self, path: Path, steps: int) -> None:
        parts = {"network": self.network, "average": self.average, "optimiser": self.optimiser}
        scratch = path.with_suffix(".part")
        torch.save({"steps": steps} | {name: part.state_dict() for name, part in parts.items()}, scratch)
        scratch.replace(path)

    def load(self, path: Path) -> int:
        """Steps done."""
        kept = torch.load(path, weights_only=True)
        self.network.load_state_dict(kept["network"])
        self.average.load_state_dict(kept["average"])
        self.optimiser.load_state_dict(kept["optimiser"])
        return int(kept["steps"])


@torch.no_grad()
def _update_average(average: nn.Module, network: nn.Module, decay: float) -> None:
    for mean, value in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
        if mean.dtype.is_floating_point:
            mean.lerp_(value, 1 - decay)
        else:
            mean.copy_(value)
