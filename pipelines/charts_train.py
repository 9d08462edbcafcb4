"""``animatic chart train``: ms a step against memory for rank, gradient checkpointing, compilation and resolution."""

import multiprocessing
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from labeling.errors import DataError
from pipelines.charts import Chart, ChartPoint, Cost, Error, machine_name
from training import tiny
from training.config import TrainConfig, load_config
from training.step_probe import StepMeasure, StepProbe, measure_steps, random_ltx

_WIDE = tiny.TINY_TRANSFORMER | {
    "num_attention_heads": 16, "attention_head_dim": 32, "cross_attention_dim": 512, "num_layers": 4,
}  # fmt: skip
"""Wide enough that matrix products, and not Python, take the time."""
_PATIENCE_S = 600.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Method:
    """One setting of the recipe."""

    name: str
    width: int
    height: int
    rank: int
    checkpointing: bool = False
    compiled: bool = False
    reference: bool = False

    def settings(self) -> dict[str, Any]:
        return {
            "width": self.width, "height": self.height, "rank": self.rank,
            "gradient_checkpointing": self.checkpointing, "compile": self.compiled,
        }  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _Setup:
    """What is measured on one kind of machine."""

    recipe: str
    """The named config whose settings the methods change."""
    network: str
    frames: int
    methods: tuple[_Method, ...]
    backbone: dict[str, Any] = field(default_factory=dict)

    def config(self, method: _Method) -> TrainConfig:
        size = {
            "control_width": method.width, "control_height": method.height, "rgb_width": method.width,
            "rgb_height": method.height, "frames": self.frames,
        }  # fmt: skip
        return load_config(
            self.recipe, stage="motion",
            overrides={
                "backbone": {**self.backbone, "picture": size}, "adapter": {"rank": method.rank, "alpha": None},
                "gradient_checkpointing": method.checkpointing, "compile": method.compiled,
                "optimiser": {"micro_batch": 1},
            },
        )  # fmt: skip


def chart(name: str, *, quick: bool = False) -> Chart:
    """Peak memory against ms a step of the motion stage with all its conditions, one sample, random weights.

    On a GPU the 2B network at its real sizes; on a CPU a small network of the same class, each measurement in a process
    of its own.
    """
    cuda = torch.cuda.is_available()
    setup = _gpu_setup() if cuda else _cpu_setup()
    methods = setup.methods[:3] if quick else setup.methods
    measures: dict[str, list[StepMeasure]] = {method.name: [] for method in methods}
    left_out: dict[str, str] = {}
    # In turns, since machines are shared.
    for _ in range(1 if quick else 2):
        for method in methods:
            if method.name not in left_out:
                try:
                    measures[method.name].append(_measured(setup, method, cuda=cuda))
                except DataError as error:
                    left_out[method.name] = f"{method.name}: {error}"
    points = tuple(_point(method, measures[method.name]) for method in methods if method.name not in left_out)
    return Chart(
        stage=name, points=points, machine=torch.cuda.get_device_name() if cuda else machine_name(),
        data=f"{setup.network}; motion stage, one sample of {setup.frames} frames, all conditions",
        cost="ms_per_step", left_out=tuple(left_out.values()),
    )  # fmt: skip


def _cpu_setup() -> _Setup:
    base = _Method(name="192x128, rank 64", width=192, height=128, rank=64, reference=True)
    other = replace(base, reference=False)
    large = replace(other, width=288, height=192)
    return _Setup(
        recipe="tiny", frames=49, network="4 blocks of 512 channels, random weights, float32", backbone={"seed": 1},
        methods=(
            base,
            replace(other, name="rank 8", rank=8),
            replace(other, name="rank 256", rank=256),
            replace(other, name="checkpointing", checkpointing=True),
            replace(other, name="checkpointing, rank 8", checkpointing=True, rank=8),
            replace(other, name="96x64", width=96, height=64),
            replace(large, name="288x192"),
            replace(large, name="288x192, checkpointing", checkpointing=True),
            replace(other, name="compiled (the compiler's memory too)", compiled=True),
        ),
    )  # fmt: skip


def _gpu_setup() -> _Setup:
    base = _Method(name="768x512, rank 512", width=768, height=512, rank=512, checkpointing=True, reference=True)
    other = replace(base, reference=False)
    return _Setup(
        recipe="motion_ltx_2b", frames=121, network="LTX-Video 2B, random weights, bfloat16, checkpointing",
        methods=(
            base,
            replace(other, name="no checkpointing", checkpointing=False),
            replace(other, name="rank 32", rank=32),
            replace(other, name="rank 128", rank=128),
            replace(other, name="compiled", compiled=True),
            replace(other, name="compiled, no checkpointing", compiled=True, checkpointing=False),
            replace(other, name="512x320", width=512, height=320),
            replace(other, name="1056x704", width=1056, height=704),
        ),
    )  # fmt: skip


def _measured(setup: _Setup, method: _Method, *, cuda: bool) -> StepMeasure:
    """One measurement.

    Raises:
        DataError: it could not be made; why.
    """
    config = setup.config(method)
    if not cuda:
        return _measure_in_child(config, setup)
    try:
        return _measure(config, setup)
    except torch.OutOfMemoryError as error:
        raise DataError("the device's memory does not hold it") from error


def _measure(config: TrainConfig, setup: _Setup, *, steps: int = 2) -> StepMeasure:
    device = "cuda" if torch.cuda.is_available() else "cpu"
    shape = _WIDE if config.backbone.kind == "tiny" else None
    return measure_steps(
        lambda: StepProbe(
            random_ltx(config.backbone, device=device, settings=shape), config, frames=setup.frames, device=device
        ),
        steps=steps,
    )


def _measure_in_child(config: TrainConfig, setup: _Setup) -> StepMeasure:
    """In a forked process, so that what an earlier method left in the heap does not count.

    Raises:
        DataError: the process fell or took too long.
    """
    receiver, sender = multiprocessing.Pipe(duplex=False)

    def body() -> None:
        torch.set_num_threads(1)
        try:
            sender.send(_measure(config, setup))
        except Exception as error:
            sender.send(" ".join(str(error).split())[:200])

    child = multiprocessing.get_context("fork").Process(target=body)
    child.start()
    sender.close()
    try:
        found = receiver.recv() if receiver.poll(_PATIENCE_S) else f"it took over {_PATIENCE_S:.0f} s"
        if isinstance(found, str):
            raise DataError(found)
        return found
    except EOFError as error:
        raise DataError("its process fell, perhaps out of memory") from error
    finally:
        child.kill()
        child.join()


def _point(method: _Method, measures: Sequence[StepMeasure]) -> ChartPoint:
    ms = [one for measure in measures for one in measure.ms]
    gib = [measure.peak_gib for measure in measures]
    return ChartPoint(
        method=method.name, settings=method.settings(), reference=method.reference,
        group=f"{method.width}x{method.height}",
        ms_per_frame=Cost(median=float(np.median(ms)), p95=float(np.percentile(ms, 95)), runs=len(ms)),
        error=Error(
            metric="peak memory", unit="GiB", median=float(np.median(gib)), p95=float(np.percentile(gib, 95))
        ),
    )  # fmt: skip
