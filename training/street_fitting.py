"""One training loop for all street models: seeded, prefetched, resumable; on processors the same seed gives the same
weights."""

import copy
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset

from labeling.errors import ModelError
from training.muon import Muon

LossFunction = Callable[[nn.Module, Any], torch.Tensor]
BatchMaker = Callable[[np.random.Generator], Any]
_AHEAD = 3
"""Batches that wait for the network, for each process that makes them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSettings:
    """How long and how fast one network learns, and on what."""

    seed: int
    steps: int
    optimiser: Literal["adamw", "muon"] = "adamw"
    """Of weights with two axes and more; norms and biases are AdamW's in any case."""
    elementwise: tuple[str, ...] = ()
    """Starts of the names of weights that are AdamW's, too: of last layers whose outputs are rare or of many kinds."""
    learning_rate: float = 2e-3
    """Peak of the rate; it warms up over the first twentieth and falls to nothing along a cosine."""
    weight_decay: float = 0.01
    fixed_norms: bool = False
    """Norm by what was learnt before, not by the batch: for a network that is trained already and goes on."""
    average_decay: float = 0.998
    """Of the moving average of weights that is returned."""
    precision: torch.dtype | None = None
    """Of convolutions and products; weights and losses stay float32. None: bfloat16 where the device multiplies it
    faster (``best_precision``)."""
    channels_last: bool = True
    """Lay pictures out pixel by pixel, which 2-D convolutions are faster on; networks over videos cannot."""
    device: str = "cpu"
    """Anywhere else batches must have ``to(device)``."""
    loaders: int = 0
    """Processes that make batches, for a device that outruns one core; 0: a thread."""
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
    """Train ``network`` in place; the moving average of its weights is returned, on the CPU, ready for inference.

    Args:
        network: initialised by the caller, under ``torch.manual_seed``.
        make_batch: gives one batch for a generator that is seeded by ``(seed, step)``, so that batches do not depend on
            threads or processes.
        loss_of: scalar loss of a network and a batch.
        settings: length, rates and device.
        checkpoint: file that holds the state at every report, and in the end the returned weights alone. Where it is
            there already, training goes on from it, and ends with the same weights as without a pause.

    Raises:
        ModelError: the checkpoint is that of a training of another length or seed.
    """
    if checkpoint and is_finished(checkpoint, settings.steps):
        return load_finished(network, checkpoint)
    network.train().to(settings.device)
    if settings.channels_last:
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    average = copy.deepcopy(network)
    means, values = _averaged(average, network)
    optimisers = _optimisers(network, settings)
    if settings.fixed_norms:
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()
    state = _State(network=network, average=average, optimisers=optimisers, settings=settings)
    first = state.load(checkpoint, settings.device) if checkpoint and checkpoint.is_file() else 0
    device = torch.device(settings.device)
    precision = settings.precision or best_precision(device)
    recent: list[torch.Tensor] = []
    for step, batch in enumerate(_prefetched(make_batch, settings, first=first), first):
        for group in (group for one in optimisers for group in one.param_groups):
            group["lr"] = settings.learning_rate * rate_at(step, settings.steps)
        # What the network draws, as a dropout does, follows from the step as well: a pause changes nothing.
        torch.manual_seed(int(np.random.default_rng((settings.seed, step, 1)).integers(2**63)))
        with torch.autocast(device.type, precision, enabled=precision != torch.float32):
            loss = loss_of(network, batch if device.type == "cpu" else batch.to(device))
        network.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        for optimiser in optimisers:
            optimiser.step()
        with torch.no_grad():
            torch._foreach_lerp_(means, values, 1 - min(settings.average_decay, (step + 1) / (step + 10)))
        # Read at reports alone: to read is to wait for the device.
        recent.append(loss.detach())
        if (step + 1) % settings.report_every == 0:
            mean = float(torch.stack(recent).mean())
            print(f"  {settings.name}: step {step + 1} of {settings.steps}, loss {mean:.4f}", flush=True)
            recent.clear()
            if checkpoint:
                state.save(checkpoint, step + 1)
    average.cpu().eval()
    if checkpoint:
        _save({"finished": settings.steps, "average": average.state_dict()}, checkpoint)
    return average


def _optimisers(network: nn.Module, settings: FitSettings) -> tuple[torch.optim.Optimizer, ...]:
    """Those that have something to do."""
    matrices: list[nn.Parameter] = []
    others: list[nn.Parameter] = []
    for name, parameter in network.named_parameters():
        is_matrix = settings.optimiser == "muon" and parameter.ndim >= 2 and not name.startswith(settings.elementwise)
        (matrices if is_matrix else others).append(parameter)
    rate, decay = settings.learning_rate, settings.weight_decay
    muon = [Muon(matrices, lr=rate, weight_decay=decay)] if matrices else []
    adamw = [torch.optim.AdamW(others, lr=rate, weight_decay=decay, betas=(0.9, 0.99), fused=True)] if others else []
    return (*muon, *adamw)


def best_precision(device: torch.device) -> torch.dtype:
    """bfloat16, but float32 on processors without instructions for it, which are seven times slower in bfloat16."""
    fast = device.type != "cpu" or torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return torch.bfloat16 if fast else torch.float32


def is_finished(checkpoint: Path, steps: int) -> bool:
    """Whether the file holds what a training of so many steps ended with."""
    return checkpoint.is_file() and torch.load(checkpoint, weights_only=True, mmap=True).get("finished") == steps


def load_finished(network: nn.Module, checkpoint: Path) -> nn.Module:
    """The network with the weights that its training ended with."""
    network.load_state_dict(torch.load(checkpoint, weights_only=True)["average"])
    return network.eval()


def rate_at(step: int, steps: int) -> float:
    """Share of the peak rate at a step: linear warm-up, then a cosine to 0."""
    warm = max(1, steps // 20)
    if step < warm:
        return (step + 1) / warm
    return 0.5 * (1 + math.cos(math.pi * (step - warm) / max(1, steps - warm)))


@dataclass(frozen=True, slots=True, kw_only=True)
class _SeededBatches(Dataset[Any]):
    """Batch by step."""

    make_batch: BatchMaker
    seed: int

    def __getitem__(self, index: int) -> Any:
        return self.make_batch(np.random.default_rng((self.seed, index)))


def _prefetched(make_batch: BatchMaker, settings: FitSettings, *, first: int = 0) -> Iterator[Any]:
    batches = _SeededBatches(make_batch=make_batch, seed=settings.seed)
    steps = range(first, settings.steps)
    if settings.loaders:
        # Forked, so that the pool, which is gigabytes, is shared and not sent.
        yield from DataLoader(
            batches, batch_size=None, sampler=steps, num_workers=settings.loaders, prefetch_factor=_AHEAD,
            pin_memory=settings.device != "cpu", multiprocessing_context="fork",
        )  # fmt: skip
        return
    with ThreadPoolExecutor(1) as pool:
        waiting = [pool.submit(batches.__getitem__, step) for step in steps[:_AHEAD]]
        for step in steps:
            batch = waiting.pop(0).result()
            if step + _AHEAD in steps:
                waiting.append(pool.submit(batches.__getitem__, step + _AHEAD))
            yield batch


@dataclass(frozen=True, slots=True, kw_only=True)
class _State:
    """What training goes on from; no batch depends on anything but its step."""

    network: nn.Module
    average: nn.Module
    optimisers: tuple[torch.optim.Optimizer, ...]
    settings: FitSettings

    def save(self, path: Path, steps: int) -> None:
        parts = {"network": self.network, "average": self.average}
        states = {name: part.state_dict() for name, part in parts.items()}
        optimisers = [one.state_dict() for one in self.optimisers]
        _save({"steps": steps, **self._run(), **states, "optimisers": optimisers}, path)

    def _run(self) -> dict[str, int | str]:
        """What batches and rates depend on: a state of another run is not gone on from."""
        return {"seed": self.settings.seed, "of_steps": self.settings.steps, "learnt_by": self.settings.optimiser}

    def load(self, path: Path, device: str) -> int:
        """Steps done."""
        kept = torch.load(path, weights_only=True, map_location=device)
        if "steps" not in kept:
            raise ModelError(f"{path}: finished after {kept['finished']} steps; remove it to train for another length")
        if "optimisers" not in kept:
            raise ModelError(f"{path}: was left by an older version; remove it to start afresh")
        if any(kept[name] != value for name, value in self._run().items()):
            raise ModelError(
                f"{path}: stopped in a training of {kept['of_steps']} steps with seed {kept['seed']} by "
                f"{kept['learnt_by']}, this one is of {self.settings.steps} with seed {self.settings.seed} by "
                f"{self.settings.optimiser}; remove it to start afresh"
            )
        self.network.load_state_dict(kept["network"])
        self.average.load_state_dict(kept["average"])
        for optimiser, state in zip(self.optimisers, kept["optimisers"], strict=True):
            optimiser.load_state_dict(state)
        return int(kept["steps"])


def _save(content: dict[str, Any], path: Path) -> None:
    scratch = path.with_suffix(".part")
    torch.save(content, scratch)
    scratch.replace(path)


def _averaged(average: nn.Module, network: nn.Module) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Tensors that follow, and those that they follow: all but whole numbers, such as a norm's count of batches."""
    pairs = zip(average.state_dict().values(), network.state_dict().values(), strict=True)
    followed = [pair for pair in pairs if pair[0].dtype.is_floating_point]
    return [mean for mean, _ in followed], [value for _, value in followed]
