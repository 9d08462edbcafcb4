"""The paper's 2B recipe on this machine's GPU: random weights, real token counts, bfloat16, PyTorch's own attention.

For both stages, with and without gradient checkpointing and compilation: ms a step of one sample, TFLOP/s and the share
of the chip's peak, peak memory, and from them the GPU-hours of the paper's 9,000 + 5,000 steps at a global batch of 32.
Work that checkpointing repeats is not counted as done. The motion stage has the conditions that a sample has on average
(one of ego and objects).

    python tests/benchmarks/bench_gpu.py [--steps 5] [--tiny]

Without a GPU it says so and ends with exit code 2. ``--tiny`` takes the tiny network at small sizes on whatever there
is, to see that the command works.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from training import tiny
from training.config import TrainConfig, load_config
from training.step_probe import StepProbe, counted_flops, measure_steps, random_ltx

PEAK_TFLOPS = {
    "B200": 2250.0, "GH200": 989.0, "H200": 989.0, "H100 PCIe": 756.0, "H100": 989.0, "A100": 312.0, "L40S": 362.0,
    "RTX 4090": 165.0, "A6000": 155.0,
}  # fmt: skip
"""Dense bfloat16 by a part of the chip's name, from the makers' data sheets; the first that fits."""
CONDITIONS = {"motion": ("ego", "image"), "appearance": ("skeleton",)}
PAPER_GPU_HOURS = 128.0
"""For the 2B model on GH200, as the paper says."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One stage at one setting."""

    stage: str
    gradient_checkpointing: bool
    compile: bool
    ms_per_sample: float | None
    """Forward, backward and AdamW over one sample; None where it did not run."""
    tflops: float | None = None
    share_of_peak: float | None = None
    peak_gib: float | None = None
    gpu_hours: float | None = None
    """Of the stage's whole schedule on one GPU."""
    failed: str = ""


def config_for(stage: str, *, small: bool, checkpointing: bool, compiled: bool) -> TrainConfig:
    """The paper's recipe of a stage, or the tiny one with the paper's schedule."""
    overrides: dict[str, Any] = {"gradient_checkpointing": checkpointing, "compile": compiled}
    paper = load_config(f"{stage}_ltx_2b", overrides=overrides)
    if not small:
        return paper
    schedule = {"steps": paper.optimiser.steps, "global_batch": paper.optimiser.global_batch, "micro_batch": 1}
    return load_config("tiny", stage=paper.stage, overrides={**overrides, "optimiser": schedule})


def measure(stage: str, *, small: bool, steps: int, checkpointing: bool, compiled: bool) -> Row:
    """One row; what does not run says why."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    config = config_for(stage, small=small, checkpointing=checkpointing, compiled=compiled)
    about = {"stage": stage, "gradient_checkpointing": checkpointing, "compile": compiled}
    settings, frames = (tiny.TINY_TRANSFORMER, 9) if small else (None, 121)
    sizes: dict[str, Any] = {"references": CONDITIONS[stage], "frames": frames}
    make = partial(random_ltx, config.backbone, device=device, settings=settings)
    try:
        found = measure_steps(lambda: StepProbe(make(), config, device=device, **sizes), steps=steps, warm_up=2)
    except (torch.OutOfMemoryError, RuntimeError) as error:
        return Row(**about, ms_per_sample=None, failed=" ".join(str(error).split())[:160])
    tflops = counted_flops(config, settings=settings, **sizes) / found.median_ms / 1e9
    peak = peak_tflops(torch.cuda.get_device_name()) if device == "cuda" else None
    samples = config.optimiser.steps * config.optimiser.global_batch
    return Row(
        **about, ms_per_sample=found.median_ms, tflops=tflops, share_of_peak=tflops / peak if peak else None,
        peak_gib=found.peak_gib, gpu_hours=found.median_ms * samples / 3.6e6,
    )  # fmt: skip


def peak_tflops(name: str) -> float | None:
    """Of the chip called ``name``; None where it is not known."""
    return next((peak for part, peak in PEAK_TFLOPS.items() if part in name), None)


def best_hours(rows: Sequence[Row]) -> dict[str, float]:
    """GPU-hours of each stage at its fastest setting, and of both."""
    hours = {
        stage: min((row.gpu_hours for row in rows if row.stage == stage and row.gpu_hours is not None), default=None)
        for stage in CONDITIONS
    }
    known = {stage: value for stage, value in hours.items() if value is not None}
    return known | ({"both": sum(known.values())} if len(known) == len(CONDITIONS) else {})


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write ``results/gpu.json``; 2 where there is no GPU."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--tiny", action="store_true")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results")
    chosen = parser.parse_args(arguments)
    if not (chosen.tiny or torch.cuda.is_available()):
        print("no GPU here: nothing was measured; --tiny tries the command on a CPU", file=sys.stderr)
        return 2
    # Whether the tiny network compiles says nothing about the command.
    variants = [(True, False), (False, False)] + ([] if chosen.tiny else [(True, True), (False, True)])
    rows = []
    for stage in CONDITIONS:
        for checkpointing, compiled in variants:
            rows.append(
                measure(stage, small=chosen.tiny, steps=chosen.steps, checkpointing=checkpointing, compiled=compiled)
            )
            print(json.dumps(asdict(rows[-1])))
    result = {
        "machine": torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU", "torch": torch.__version__,
        "network": "tiny" if chosen.tiny else "LTX-Video 2B, random weights, bfloat16",
        "rows": [asdict(row) for row in rows],
        "gpu_hours_at_the_fastest": best_hours(rows), "paper_gpu_hours_on_gh200": PAPER_GPU_HOURS,
    }  # fmt: skip
    chosen.out.mkdir(parents=True, exist_ok=True)
    path = chosen.out / ("gpu-tiny.json" if chosen.tiny else "gpu.json")
    path.write_text(json.dumps(result, indent=1) + "\n")
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
