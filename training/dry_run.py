"""What a run would train and need, from its configuration alone: networks are built on the meta device.

Memory is an estimate: exact for weights, adapters, gradients and AdamW's moments; activations by the formula below.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from labeling.errors import ConfigError
from training.backbone import LatentGeometry
from training.config import TrainConfig
from training.flow import shift_for_tokens
from training.stages import EGO, IMAGE, OBJECTS, reference_names
from training.step_work import step_flops

_KEPT_PER_TOKEN = 1
"""Activations kept per block and token with checkpointing, in hidden sizes: its input."""
_PEAK_PER_TOKEN = 60
"""Activations of one block while it is recomputed, in hidden sizes: six modulations, q, k, v, rotary copies in float32,
the feed-forward's four-fold layer twice, and the adapters' float32 inputs."""
_RELEASED_FRAMES = 121
_COUNTS = {1: "", 1e3: "k", 1e6: "M", 1e9: "B"}
_WORK = {1e6: "MFLOP", 1e9: "GFLOP", 1e12: "TFLOP", 1e15: "PFLOP"}
_TIMES = {3600: "h", 60: "min", 1: "s"}


@dataclass(frozen=True, slots=True, kw_only=True)
class RunPlan:
    """What would be trained, and what it takes."""

    name: str
    stage: str
    backbone: str
    base_parameters: int
    trainable_parameters: int
    target_tokens: int
    """Tokens that are predicted, the clean first latent frame among them."""
    most_tokens: int
    """With every condition present."""
    mean_tokens: float
    """Expected, with the conditions' probabilities."""
    noise_shift: float
    weights_gib: float
    """Frozen base."""
    adapter_gib: float
    """Adapter, gradient and two moments, float32: 16 bytes a number."""
    activations_gib: float
    """Estimate, one micro-batch."""
    steps: int
    global_batch: int
    samples: int
    petaflops_per_step: float
    """Forward, backward, and the recomputation if checkpointing is on; matrix products only, a U-Net's convolutions
    left out."""
    hours: float | None
    """At the rate that was given."""

    @property
    def memory_gib(self) -> float:
        """Per GPU, estimated."""
        return self.weights_gib + self.adapter_gib + self.activations_gib

    def rows(self) -> list[tuple[str, str]]:
        """As a table of two columns."""
        rows = [
            ("recipe", f"{self.name}: {self.stage} on {self.backbone}"),
            ("frozen parameters", _scaled(self.base_parameters, _COUNTS)),
            ("trained parameters", _scaled(self.trainable_parameters, _COUNTS)),
            ("tokens of the target", f"{self.target_tokens:,}"),
            ("tokens per sample", f"{self.mean_tokens:,.0f} on average, {self.most_tokens:,} at most"),
            ("noise shift", f"{self.noise_shift:.2f}"),
            ("memory per GPU (estimate)", (
                f"{_memory(self.memory_gib)}: {_memory(self.weights_gib)} weights, {_memory(self.adapter_gib)} adapter "
                f"and optimiser, {_memory(self.activations_gib)} activations")),
            ("steps", f"{self.steps:,} of {self.global_batch} samples, {self.samples:,} samples in all"),
            ("work per step", _scaled(self.petaflops_per_step * 1e15, _WORK)),
        ]  # fmt: skip
        if self.hours is not None:
            rate = self.steps / self.hours
            shown = f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"
            rows.append(("at the given rate", f"{shown} steps per hour, {_time(self.hours)} in all"))
        return rows


def _scaled(value: float, units: Mapping[float, str]) -> str:
    """A number with the greatest unit that it reaches."""
    size = next((size for size in sorted(units, reverse=True) if value >= size), min(units))
    shown = value / size
    return f"{shown:.{0 if size == 1 else 2 if shown < 100 else 1}f} {units[size]}".rstrip()


def _memory(gib: float) -> str:
    return f"{gib:.1f} GiB" if gib >= 1 else f"{gib * 2**10:.1f} MiB"


def _time(hours: float) -> str:
    seconds = hours * 3600
    return next(f"{seconds / size:.1f} {unit}" for size, unit in _TIMES.items() if seconds >= size or size == 1)


def plan_run(config: TrainConfig, *, steps_per_second: float | None = None) -> RunPlan:
    """The plan of a recipe; loads nothing.

    Raises:
        ConfigError: frame counts or sizes that the backbone does not take, weights whose size is not told, or a rate
            that is none.
    """
    if steps_per_second is not None and not 0 < steps_per_second < math.inf:
        raise ConfigError(
            f"--steps-per-second {steps_per_second:g} is no rate of steps; give a number above 0, such as 0.5"
        )
    denoiser, geometry, hidden, layers = _meta_network(config)
    base = sum(weight.numel() for weight in denoiser.parameters())
    trainable = lora_parameters(denoiser, config.adapter.targets, rank=config.adapter.rank)
    if config.backbone.kind in ("svd", "tiny_svd"):
        from training.svd import extra_parameters

        trainable += extra_parameters(denoiser, config)
    target, most, mean = token_counts(config, geometry)
    optimiser = config.optimiser
    kept = layers * (_KEPT_PER_TOKEN if config.gradient_checkpointing else _PEAK_PER_TOKEN)
    activations = optimiser.micro_batch * most * hidden * 2 * (kept + _PEAK_PER_TOKEN)
    weight_bytes = 2 if config.backbone.dtype == "bfloat16" else 4
    work = step_flops(denoiser, config, tokens=mean, layers=layers, hidden=hidden)
    return RunPlan(
        name=config.name, stage=config.stage, backbone=config.backbone.name, base_parameters=base,
        trainable_parameters=trainable, target_tokens=target, most_tokens=most, mean_tokens=mean,
        noise_shift=shift_for_tokens(target), weights_gib=base * weight_bytes / 2**30,
        adapter_gib=trainable * 16 / 2**30, activations_gib=activations / 2**30,
        steps=optimiser.steps, global_batch=optimiser.global_batch,
        samples=optimiser.steps * optimiser.global_batch,
        petaflops_per_step=optimiser.global_batch * work / 1e15,
        hours=optimiser.steps / steps_per_second / 3600 if steps_per_second is not None else None,
    )  # fmt: skip


def _meta_network(config: TrainConfig) -> tuple[torch.nn.Module, LatentGeometry, int, int]:
    """(network on the meta device, geometry, hidden size, blocks)."""
    if config.backbone.kind in ("svd", "tiny_svd"):
        from training.svd import meta_unet, svd_geometry

        # The widest resolution dominates: 320 channels, about two blocks deep on each side, per latent pixel.
        return meta_unet(config.backbone), svd_geometry(config.backbone), 320, 10
    from diffusers.models.transformers.transformer_ltx import LTXVideoTransformer3DModel

    from training.ltx import TRANSFORMERS
    from training.tiny import TINY_TRANSFORMER

    if config.backbone.kind == "ltx" and "size" not in config.backbone.model_fields_set:
        raise ConfigError(
            f"backbone {config.backbone.name} does not say how large {config.backbone.weights} is, and a plan loads no "
            f"weights; set backbone.size to {' or '.join(TRANSFORMERS)}"
        )
    settings: dict[str, Any] = (
        TINY_TRANSFORMER if config.backbone.size == "tiny" else TRANSFORMERS[config.backbone.size]
    )
    with torch.device("meta"):
        network = LTXVideoTransformer3DModel(**settings)
    hidden = network.config["num_attention_heads"] * network.config["attention_head_dim"]
    return network, LatentGeometry(channels=128, spatial=32, temporal=8), hidden, network.config["num_layers"]


def lora_parameters(denoiser: torch.nn.Module, targets: tuple[str, ...], *, rank: int) -> int:
    """Numbers that a LoRA of ``rank`` trains on the linear layers whose names end in ``targets``."""
    endings = tuple(f".{target}" for target in targets)
    linear = [
        layer
        for name, layer in denoiser.named_modules()
        if isinstance(layer, torch.nn.Linear) and name.endswith(endings)
    ]
    return sum(rank * (layer.in_features + layer.out_features) for layer in linear)


def token_counts(config: TrainConfig, geometry: LatentGeometry) -> tuple[int, int, float]:
    """(tokens of the target, of the longest sequence, expected); 121 frames where the clips decide."""
    picture, conditions = config.backbone.picture, config.conditions
    frames = picture.frames or _RELEASED_FRAMES
    control = _tokens(geometry, frames, picture.control_height, picture.control_width)
    rgb = _tokens(geometry, frames, picture.rgb_height, picture.rgb_width)
    image = _tokens(geometry, 1, picture.control_height, picture.control_width)
    target = control if config.stage == "motion" else rgb
    if config.backbone.kind in ("svd", "tiny_svd"):
        # Conditions are channels there, not tokens.
        return target, target, float(target)
    chance = {EGO: conditions.ego_probability, OBJECTS: conditions.objects_probability}
    references = {
        name: image if name == IMAGE else control for name in reference_names(config.stage, control=conditions.control)
    }
    mean = target + sum(chance.get(name, 1.0) * count for name, count in references.items())
    most = target + sum(count for name, count in references.items() if chance.get(name, 1.0) > 0)
    return target, most, mean


def _tokens(geometry: LatentGeometry, frames: int, height: int, width: int) -> int:
    return math.prod(geometry.latent_shape(frames=frames, height=height, width=width)[1:])
