"""LoRA adapters: attach, save, load, switch. Files are safetensors in diffusers' LoRA format, alpha and all.

A file's keys are ``transformer.<module>.lora_A.weight`` and ``lora_B``; its metadata holds ``lora_adapter_metadata``
(what diffusers reads: rank, alpha, targets) and ``animatic`` (stage, config, step). Stock diffusers pipelines load it.
Extra trained tensors (SVD's widened ``conv_in`` and its text projection) go under ``extra.``.

Switching changes flags only: the base weights are never merged, so switching off restores the base to the bit.
"""

import json
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from peft import LoraConfig, inject_adapter_in_model
from peft.tuners.tuners_utils import BaseTunerLayer

from labeling.errors import ModelError
from training.adapter_notes import OUR_METADATA, adapter_file, metadata_object, notes, open_adapter
from training.config import AdapterConfig
from training.weights import tensor_bytes

DIFFUSERS_METADATA = "lora_adapter_metadata"
EXTRA_PREFIX = "extra."
_SPECIAL = ("use_rslora", "use_dora", "alpha_pattern")
"""Settings of PEFT under which a LoRA's scale is not alpha / rank throughout."""
_PREFIXES = ("base_model.model.", "transformer.", "unet.", "diffusion_model.", "model.")
_RENAMED = {".lora_down.": ".lora_A.", ".lora_up.": ".lora_B.", ".lora.down.": ".lora_A.", ".lora.up.": ".lora_B."}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AdapterFile:
    """An adapter as a file holds it."""

    tensors: dict[str, torch.Tensor]
    """``<module>.lora_A.weight`` and ``<module>.lora_B.weight``, without any prefix."""
    extra: dict[str, torch.Tensor]
    """Other trained tensors."""
    rank: int
    alpha: float
    targets: tuple[str, ...]
    """Modules that carry the adapter, full names."""
    about: dict[str, Any]
    """What the trainer noted: stage, config, step; empty in foreign files."""


def attach_adapter(denoiser: torch.nn.Module, name: str, config: AdapterConfig) -> list[torch.nn.Parameter]:
    """Add a fresh adapter in float32 and make it the active and only trainable one.

    Returns:
        Its parameters, in the network's order.

    Raises:
        ModelError: no module of the network has a target's name.
    """
    lora = LoraConfig(
        r=config.rank, lora_alpha=config.lora_alpha, target_modules=list(config.targets),  # type: ignore[arg-type]
        lora_dropout=config.dropout, init_lora_weights=True,
    )  # fmt: skip
    _inject(denoiser, name, lora)
    activate_adapter(denoiser, name)
    parameters = []
    for key, parameter in denoiser.named_parameters():
        mine = _is_of(key, name)
        parameter.requires_grad_(mine)
        if mine:
            parameter.data = parameter.data.float()
            parameters.append(parameter)
    return parameters


def _inject(denoiser: torch.nn.Module, name: str, lora: LoraConfig) -> None:
    try:
        with warnings.catch_warnings():
            # Several adapters on one network is what we want; PEFT warns of it.
            warnings.filterwarnings("ignore", message="Already found a `peft_config`")
            inject_adapter_in_model(lora, denoiser, name)
    except ValueError as error:
        raise ModelError(f"the adapter does not fit the network: {str(error).splitlines()[0]}") from error
    # Stock diffusers asks the model for its adapters' configurations.
    denoiser.__dict__.setdefault("_hf_peft_config_loaded", True)
    denoiser._hf_peft_config_loaded = True  # type: ignore[assignment]


def activate_adapter(denoiser: torch.nn.Module, name: str | None) -> None:
    """Let one adapter act, or none. Only flags change.

    Raises:
        ModelError: no adapter has that name.
    """
    if name is not None and name not in adapter_names(denoiser):
        known = ", ".join(adapter_names(denoiser)) or "none"
        raise ModelError(f"adapter {name!r} is not loaded (loaded: {known}); load it first")
    for layer in _lora_layers(denoiser):
        layer.enable_adapters(name is not None)
        if name is not None:
            layer.set_adapter(name)
    for module in denoiser.modules():
        if isinstance(module, Switchable):
            module.active = name


def adapter_names(denoiser: torch.nn.Module) -> list[str]:
    """The adapters that live on the network."""
    names: dict[str, None] = {}
    for layer in _lora_layers(denoiser):
        names.update(dict.fromkeys(layer.lora_A))  # type: ignore[arg-type]
    return list(names)


class Switchable:
    """A module with trained tensors of its own per adapter; ``active`` says whose act."""

    active: str | None = None


def _lora_layers(denoiser: torch.nn.Module) -> Iterator[BaseTunerLayer]:
    return (module for module in denoiser.modules() if isinstance(module, BaseTunerLayer))


def _is_of(key: str, name: str) -> bool:
    return f".lora_A.{name}." in key or f".lora_B.{name}." in key or f".per_adapter.{name}." in key


def adapter_state(denoiser: torch.nn.Module, name: str) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """(LoRA tensors without prefix or adapter name, extra tensors), on the CPU, in the network's order."""
    lora, extra = {}, {}
    for key, tensor in denoiser.state_dict().items():
        if not _is_of(key, name):
            continue
        goal = extra if ".per_adapter." in key else lora
        goal[key.replace(f".{name}.", ".")] = tensor.detach().cpu().contiguous()
    return lora, extra


def adapter_bytes(
    denoiser: torch.nn.Module,
    name: str,
    config: AdapterConfig,
    *,
    about: Mapping[str, Any],
    prefix: str = "transformer",
) -> bytes:
    """The adapter as the bytes of a safetensors file; the same adapter gives the same bytes."""
    lora, extra = adapter_state(denoiser, name)
    modules = sorted({key.split(".lora_")[0] for key in lora})
    settings = {
        "r": config.rank, "lora_alpha": config.lora_alpha, "target_modules": modules, "lora_dropout": config.dropout,
        "bias": "none", "use_rslora": False, "use_dora": False, "rank_pattern": {}, "alpha_pattern": {},
    }  # fmt: skip
    tensors = {f"{prefix}.{key}": tensor for key, tensor in lora.items()}
    tensors |= {f"{EXTRA_PREFIX}{key}": tensor for key, tensor in extra.items()}
    metadata = {
        "format": "pt",
        DIFFUSERS_METADATA: json.dumps({f"{prefix}.{key}": value for key, value in settings.items()}, sort_keys=True),
        OUR_METADATA: json.dumps(dict(about), sort_keys=True),
    }
    return tensor_bytes(tensors, metadata=metadata)


def read_adapter(path: Path) -> AdapterFile:
    """An adapter file: ours, diffusers', PEFT's, ComfyUI's or the released ones; or the folder that training wrote.

    Alpha comes from the metadata, else from ``.alpha`` tensors, else it equals the rank.

    Raises:
        ModelError: missing, not safetensors, without a LoRA in it, or one of a kind that would act at another scale:
            rank-stabilised, DoRA, alphas that differ from module to module; or with numbers that are not finite.
    """
    path = adapter_file(path)
    with open_adapter(path, framework="pt") as file:
        metadata = file.metadata() or {}
        raw = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    _check_finite(path, raw)
    extra = {key.removeprefix(EXTRA_PREFIX): raw.pop(key) for key in list(raw) if key.startswith(EXTRA_PREFIX)}
    alphas = {_number(path, key, raw.pop(key)) for key in list(raw) if key.endswith(".alpha")}
    tensors = {_plain_key(key): tensor for key, tensor in raw.items()}
    ranks = {tensor.shape[:1].numel() for key, tensor in tensors.items() if key.endswith(".lora_A.weight")}
    if len(ranks) != 1 or any(".lora_A.weight" not in key and ".lora_B.weight" not in key for key in tensors):
        raise ModelError(
            f"{path} is no plain LoRA: ranks {sorted(ranks)}, keys such as {next(iter(raw), 'none')!r}; one rank and "
            "lora_A / lora_B pairs are expected"
        )
    rank = ranks.pop()
    settings = _settings(path, metadata)
    special = [name for name in _SPECIAL if settings.get(name)]
    if special or len(alphas) > 1:
        found = special or [f"alphas {sorted(alphas)}"]
        raise ModelError(
            f"{path} is no plain LoRA: it has {', '.join(found)}, and would act at another scale than it was trained "
            "at; one alpha for all modules, and the scale alpha / rank, are expected"
        )
    if "lora_alpha" in settings:
        alphas = {_number(path, "lora_alpha", settings["lora_alpha"])}
    alpha = alphas.pop() if alphas else float(rank)
    targets = tuple(sorted({key.split(".lora_")[0] for key in tensors}))
    about = notes(path, metadata)
    return AdapterFile(tensors=tensors, extra=extra, rank=rank, alpha=alpha, targets=targets, about=about)


def _check_finite(path: Path, tensors: Mapping[str, torch.Tensor]) -> None:
    """Refuse what would draw black videos without a word."""
    broken = [key for key, tensor in tensors.items() if not tensor.float().isfinite().all()]
    if broken:
        raise ModelError(
            f"{path} cannot be used: {len(broken)} of its {len(tensors)} tensors hold numbers that are not finite, "
            f"such as {broken[0]}; take an earlier checkpoint, or train again with a lower optimiser.learning_rate"
        )


def _plain_key(key: str) -> str:
    for before, after in _RENAMED.items():
        key = key.replace(before, after)
    changed = True
    while changed:
        changed = False
        for prefix in _PREFIXES:
            if key.startswith(prefix):
                key, changed = key.removeprefix(prefix), True
    head, _, tail = key.rpartition(".lora_")
    # PEFT's own dumps keep the adapter's name: lora_A.default.weight.
    return f"{head}.lora_{tail[0]}.weight" if head and tail.endswith(".weight") else key


def _number(path: Path, name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, RuntimeError):
        number = math.nan
    if not math.isfinite(number):
        raise ModelError(f"{path}: {name} is {value!r}, but must be a finite number; take the file as it was written")
    return number


def _settings(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """PEFT's settings in diffusers' metadata, without the model's name before each."""
    settings = metadata_object(path, metadata, DIFFUSERS_METADATA)
    return {key.split(".")[-1]: value for key, value in settings.items()}


def load_adapter(denoiser: torch.nn.Module, path: Path, name: str) -> AdapterFile:
    """Put an adapter file on the network under ``name``; it does not act until it is activated.

    Raises:
        ModelError: the file is no adapter, or its modules or sizes are not this network's.
    """
    file = read_adapter(path)
    modules = dict(denoiser.named_modules())
    missing = [target for target in file.targets if target not in modules]
    if missing:
        raise ModelError(
            f"{path}: {len(missing)} of {len(file.targets)} modules are not in this backbone, such as {missing[0]!r}; "
            "the adapter was trained on another one"
        )
    lora = LoraConfig(r=file.rank, lora_alpha=file.alpha, target_modules=list(file.targets))  # type: ignore[arg-type]
    _inject(denoiser, name, lora)
    put_adapter(denoiser, name, file.tensors | file.extra, source=str(path))
    for key, parameter in denoiser.named_parameters():
        if _is_of(key, name):
            parameter.requires_grad_(False)
    activate_adapter(denoiser, None)
    return file


def put_adapter(
    denoiser: torch.nn.Module, name: str, tensors: Mapping[str, torch.Tensor], *, source: str = "the adapter"
) -> None:
    """Copy tensors into an adapter that is attached; all must be there and fit.

    Raises:
        ModelError: names or shapes disagree.
    """
    own = {key.replace(f".{name}.", "."): value for key, value in denoiser.state_dict().items() if _is_of(key, name)}
    wrong = sorted(set(own) ^ set(tensors)) or [k for k in own if own[k].shape != tensors[k].shape]
    if wrong:
        shapes = [tuple(group[wrong[0]].shape) if wrong[0] in group else "absent" for group in (own, tensors)]
        raise ModelError(
            f"{source} does not fit this backbone: {wrong[0]} is {shapes[0]} in the network and {shapes[1]} in the "
            f"file ({len(wrong)} such tensors); load it on the backbone it was trained on"
        )
    with torch.no_grad():
        for key, parameter in denoiser.named_parameters():
            if _is_of(key, name):
                parameter.data = tensors[key.replace(f".{name}.", ".")].to(device=parameter.device, dtype=torch.float32)


def trainable_count(parameters: Sequence[torch.nn.Parameter]) -> int:
    """Numbers that are trained."""
    return sum(parameter.numel() for parameter in parameters)
