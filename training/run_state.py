"""A run's state as checkpoint files: adapter, optimiser moments, and the step with its settings, all plain data."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

from labeling.errors import DataError
from training.adapter_notes import ADAPTER
from training.adapters import adapter_bytes, put_adapter, read_adapter
from training.config import TrainConfig

OPTIMISER, STATE = "optimiser.safetensors", "state.json"
FILES = (ADAPTER, OPTIMISER, STATE)
"""Of a checkpoint; the run goes on from no fewer."""
_MOMENTS = ("exp_avg", "exp_avg_sq", "step")
_SECTIONS = ("backbone", "optimiser")
"""Of the settings, those that are compared field by field."""
_HARMLESS = ("backbone.vae_tiling",)
"""Of the backbone's settings: training decodes validation videos alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunState:
    """Where a run stands. Learning rate, order and every draw follow from the step, so there is no more."""

    step: int
    """Optimiser steps done."""
    config: dict[str, Any]
    data: str = ""
    """Digest of the clips that are learnt from (``LatentStore.data_digest``); empty where an older version wrote it."""


def pack_state(
    denoiser: torch.nn.Module, optimiser: torch.optim.Optimizer, names: Sequence[str], *, config: TrainConfig,
    state: RunState, frames: int, prefix: str = "transformer",
) -> dict[str, bytes | dict[str, torch.Tensor]]:  # fmt: skip
    """Checkpoint files by name: bytes, or tensors for a safetensors file.

    Args:
        denoiser: carries the adapter, named by the stage.
        optimiser: over the parameters ``names``, in one group.
        names: of the parameters, in the optimiser's order.
        config: the run's.
        state: the step, and the data.
        frames: video frames per clip that it was trained on.
        prefix: of the adapter's keys.
    """
    about = {"stage": config.stage, "step": state.step, "frames": frames, "config": config.model_dump(mode="json")}
    return {
        ADAPTER: adapter_bytes(denoiser, config.stage, config.adapter, about=about, prefix=prefix),
        OPTIMISER: _moments(optimiser, names),
        STATE: json.dumps({"step": state.step, "config": state.config, "data": state.data}, sort_keys=True).encode(),
    }  # fmt: skip


def _moments(optimiser: torch.optim.Optimizer, names: Sequence[str]) -> dict[str, torch.Tensor]:
    parameters = optimiser.param_groups[0]["params"]
    tensors = {}
    for name, parameter in zip(names, parameters, strict=True):
        for kind in _MOMENTS:
            if kind in optimiser.state[parameter]:
                tensors[f"{kind}/{name}"] = optimiser.state[parameter][kind].detach().cpu().contiguous()
    return tensors


def read_state(checkpoint: Path) -> RunState:
    """The state of a whole checkpoint.

    Raises:
        DataError: it is not what this version writes.
    """
    try:
        tree = json.loads((checkpoint / STATE).read_text(encoding="utf-8"))
        # Older checkpoints hold how far a loader got as well, which is not needed.
        state = RunState(step=tree["step"], config=tree["config"], data=tree.get("data", ""))
        _check(state)
        return state
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{checkpoint / STATE} is no run state ({error}); take an earlier checkpoint with --resume, or give "
            "another --out"
        ) from error


def _check(state: RunState) -> None:
    """ValueError where a state is none."""
    if not isinstance(state.step, int) or state.step < 0:
        raise ValueError(f"step is {state.step!r}")
    if not isinstance(state.data, str):
        raise ValueError(f"data is {state.data!r}")
    sections = [state.config.get(name, {}) for name in _SECTIONS] if isinstance(state.config, dict) else [state.config]
    if not all(isinstance(one, dict) for one in sections):
        raise ValueError("config holds no settings by name")


def restore(
    checkpoint: Path, denoiser: torch.nn.Module, optimiser: torch.optim.Optimizer, names: Sequence[str], *, adapter: str
) -> None:
    """Put a checkpoint's adapter and moments back.

    Raises:
        ModelError: the adapter does not fit.
        DataError: moments are missing or cannot be read.
    """
    file = read_adapter(checkpoint / ADAPTER)
    put_adapter(denoiser, adapter, file.tensors | file.extra, source=str(checkpoint))
    try:
        tensors = load_file(checkpoint / OPTIMISER)
    except (OSError, SafetensorError) as error:
        raise DataError(f"{checkpoint / OPTIMISER} cannot be read ({error}); take an earlier checkpoint") from error
    for name, parameter in zip(names, optimiser.param_groups[0]["params"], strict=True):
        moments = {kind: tensors[f"{kind}/{name}"] for kind in _MOMENTS if f"{kind}/{name}" in tensors}
        if tensors and len(moments) != len(_MOMENTS):
            raise DataError(f"{checkpoint / OPTIMISER} lacks the moments of {name}; give another --out to start afresh")
        if moments:
            # AdamW keeps its step counter on the CPU unless it is fused.
            optimiser.state[parameter] = {
                kind: value if kind == "step" else value.to(parameter.device) for kind, value in moments.items()
            }


def _changed(held: Mapping[str, Any], now: Mapping[str, Any], path: str) -> list[str]:
    differences = []
    for name, value in now.items():
        place = f"{path}.{name}"
        if isinstance(value, dict) and isinstance(held.get(name), dict):
            differences += _changed(held[name], value, place)
        # A setting that an older version did not know was as its default is.
        elif name in held and held[name] != value and place not in _HARMLESS:
            differences.append(place)
    return differences


def config_differences(held: Mapping[str, Any], config: TrainConfig) -> list[str]:
    """Settings that a resume must not change, where they do: everything that moves the losses."""
    now = config.model_dump(mode="json")
    watched = ("stage", "adapter", "conditions", "targeted_noise", "seed")
    differences = [name for name in watched if held.get(name) != now[name]]
    differences += _changed(held.get("backbone", {}), now["backbone"], "backbone")
    for name, value in now["optimiser"].items():
        if name != "micro_batch" and held.get("optimiser", {}).get(name) != value:
            differences.append(f"optimiser.{name}")
    return differences
