"""One training step at given sizes over random latents and random weights: what charts and benchmarks time.

A step's time and memory do not depend on what the numbers are, so neither weights nor data are needed.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from diffusers.models.transformers.transformer_ltx import LTXVideoTransformer3DModel
from torch.utils.flop_counter import FlopCounterMode

from training.attachment import attach_for_training
from training.backbone import Backbone, StageInputs, TextEmbedding
from training.config import BackboneConfig, TrainConfig
from training.ltx import LTX_GEOMETRY, TRANSFORMERS, LtxBackbone
from training.stages import IMAGE, reference_names, stack_inputs, stage_inputs

_CAPTION_CHANNELS = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class StepMeasure:
    """What a few steps took."""

    ms: tuple[float, ...]
    """Of each step: processor time on a CPU, time on the clock on a GPU."""
    peak_gib: float
    """On a GPU what was allocated at most, on a CPU what the process grew by from before the network was built."""

    @property
    def median_ms(self) -> float:
        """Of one step."""
        return statistics.median(self.ms)


class StepProbe:
    """A network with its adapter, AdamW, and one micro-batch of random latents.

    Args:
        backbone: carries no adapter yet.
        config: the recipe: stage, rank, micro-batch, checkpointing, compilation, sizes.
        references: conditions that are present; all of the stage's where None.
        frames: video frames of a clip.
        device: where the network is.
    """

    def __init__(
        self, backbone: Backbone, config: TrainConfig, *, references: Sequence[str] | None = None, frames: int = 121,
        device: str = "cpu",
    ) -> None:  # fmt: skip
        self.backbone, self.config, self.device = backbone, config, torch.device(device)
        self.parameters = attach_for_training(backbone, config)
        self.optimiser = torch.optim.AdamW(self.parameters, lr=config.optimiser.learning_rate)
        self.inputs = random_inputs(config, references=references, frames=frames).to(self.device)
        shape = (config.optimiser.micro_batch, *self.inputs.target_shape)
        self.target, self.noise = torch.randn(shape, device=device), torch.randn(shape, device=device)

    def backward(self) -> torch.Tensor:
        """Forward and backward of one micro-batch; its mean loss."""
        normal_B = torch.zeros(len(self.target), device=self.device)
        sigma_B = self.backbone.sigma_from_normal(normal_B, target_shape=self.inputs.target_shape)
        loss = self.backbone.losses(self.inputs, self.target, noise_BCFHW=self.noise, sigma_B=sigma_B).mean()
        loss.backward()
        return loss.detach()

    def step(self) -> float:
        """One optimiser step over one micro-batch; the loss."""
        loss = self.backward()
        self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)
        return float(loss)


def random_inputs(config: TrainConfig, *, references: Sequence[str] | None = None, frames: int = 121) -> StageInputs:
    """A micro-batch of an LTX stage's conditions, random, at the recipe's sizes.

    Raises:
        ConfigError: frame counts or sizes that the backbone does not take.
    """
    picture, control = config.backbone.picture, config.conditions.control
    small = {"height": picture.control_height, "width": picture.control_width}
    control_shape = LTX_GEOMETRY.latent_shape(frames=frames, **small)
    image_shape = LTX_GEOMETRY.latent_shape(frames=1, **small)
    rgb_shape = LTX_GEOMETRY.latent_shape(frames=frames, height=picture.rgb_height, width=picture.rgb_width)
    target_shape = control_shape if config.stage == "motion" else rgb_shape
    names = reference_names(config.stage, control=control) if references is None else references
    dtype = getattr(torch, config.backbone.latent_dtype)
    given = {name: torch.randn(image_shape if name == IMAGE else control_shape, dtype=dtype) for name in names}
    tiny = config.backbone.kind == "tiny"
    text = torch.randn(config.backbone.text_tokens, 32 if tiny else _CAPTION_CHANNELS, dtype=dtype)
    sample = stage_inputs(
        config.stage, first_frame_CFHW=torch.randn(target_shape, dtype=dtype), target_shape=target_shape,
        references=given, text=TextEmbedding(tokens_LD=text), text_tokens=config.backbone.text_tokens,
        fps=picture.fps, control=control,
    )  # fmt: skip
    return stack_inputs([sample] * config.optimiser.micro_batch)


def random_ltx(config: BackboneConfig, *, device: str = "cpu", settings: dict[str, Any] | None = None) -> LtxBackbone:
    """An LTX backbone without VAE and text encoder whose transformer has random weights, made where it will live.

    Args:
        config: names size and type.
        device: ``cpu``, ``cuda`` or ``meta``.
        settings: of the transformer, instead of those that ``config.size`` has.
    """
    chosen = TRANSFORMERS[config.size] if settings is None else settings
    return LtxBackbone(config, device=device, makers={"denoiser": lambda: _random_transformer(config, chosen, device)})


def _random_transformer(config: BackboneConfig, settings: dict[str, Any], device: str) -> LTXVideoTransformer3DModel:
    with torch.device("meta"):
        network = LTXVideoTransformer3DModel(**settings)
    # diffusers' own ``to`` warns of modules that stay float32, of which this class has none.
    torch.nn.Module.to(network, getattr(torch, config.dtype))
    network.to_empty(device=device)
    if device == "meta":
        return network
    generator = torch.Generator(device).manual_seed(config.seed)
    for name, weight in network.named_parameters():
        if weight.dim() > 1:
            weight.data.normal_(0, 0.02, generator=generator)
        else:
            # Normalisations start at one, biases at zero.
            weight.data.fill_(1.0 if name.endswith("weight") else 0.0)
    return network


def counted_flops(
    config: TrainConfig, *, references: Sequence[str] | None = None, frames: int = 121,
    settings: dict[str, Any] | None = None,
) -> float:  # fmt: skip
    """Floating-point operations of the matrix products of one micro-batch, forward and backward.

    Counted on the meta device by torch, without checkpointing: recomputation is work, but no progress.
    """
    plain = config.model_copy(update={"gradient_checkpointing": False, "compile": False})
    backbone = random_ltx(config.backbone, device="meta", settings=settings)
    probe = StepProbe(backbone, plain, references=references, frames=frames, device="meta")
    with FlopCounterMode(display=False) as counter:
        probe.backward()
    return float(counter.get_total_flops())


def measure_steps(make: Callable[[], StepProbe], *, steps: int, warm_up: int = 1) -> StepMeasure:
    """Build, warm up, and time single steps."""
    cuda = torch.cuda.is_available()
    before = _start_of_peak(cuda)
    probe = make()
    for _ in range(warm_up):
        probe.step()
    ms = [_timed_ms(probe, cuda) for _ in range(steps)]
    return StepMeasure(ms=tuple(ms), peak_gib=(_peak_bytes(cuda) - before) / 2**30)


def _timed_ms(probe: StepProbe, cuda: bool) -> float:
    clock = time.perf_counter if cuda else time.process_time
    if cuda:
        torch.cuda.synchronize()
    began = clock()
    # A step ends by reading its loss; AdamW is still under way.
    probe.step()
    if cuda:
        torch.cuda.synchronize()
    return 1000 * (clock() - began)


def _start_of_peak(cuda: bool) -> int:
    if cuda:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
        return torch.cuda.memory_allocated()
    # Linux: 5 sets the peak back to what is held now (proc(5)).
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return _peak_bytes(cuda)


def _peak_bytes(cuda: bool) -> int:
    if cuda:
        return torch.cuda.max_memory_allocated()
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024
