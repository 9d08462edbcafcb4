"""What a training step costs beyond the bare loop, what the loader gives, what a checkpoint takes.

The bare loop is the same network, forward, backward and AdamW on batches that are there already, and nothing else. A
bare step follows each step of the trainer, so that a busy machine slows both. The overhead is process CPU time outside
the calls that both make, the trainer's threads included, loader workers (two, as in the paper's recipes) not; with
loading in the process itself it is given as well. The difference of the two steps, which is noisier,
stands beside it. The network is wide enough that a step takes 200 ms or more on one core.

    python tests/benchmarks/bench_trainer.py [--steps 62]
"""

import argparse
import json
import os
import random
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from training_fixtures import cached_job, tiny_config  # noqa: E402

from training import tiny  # noqa: E402
from training.backbones import load_backbone  # noqa: E402
from training.batches import StepBatches, TrainingItems, collate  # noqa: E402
from training.config import TrainConfig  # noqa: E402
from training.latents import open_store  # noqa: E402
from training.prefetch import Prefetched  # noqa: E402
from training.trainer import Trainer  # noqa: E402

WIDE = tiny.TINY_TRANSFORMER | {
    "num_attention_heads": 16, "attention_head_dim": 32, "cross_attention_dim": 512, "num_layers": 3,
}  # fmt: skip


def config_for(steps: int, *, workers: int = 2) -> TrainConfig:
    """Two loader workers, as in the paper's recipes."""
    return tiny_config(
        "motion", optimiser={"steps": steps, "global_batch": 4, "micro_batch": 4}, adapter={"rank": 64},
        checkpoint={"every_steps": 10**6}, trackers=["tensorboard"], loader_workers=workers,
        conditions={"ego_probability": 1.0, "objects_probability": 1.0},
    )  # fmt: skip


class BareLoop:
    """The same network, forward, backward and AdamW on batches that are there already, and nothing else."""

    def __init__(self, job: Path, steps: int) -> None:
        config = config_for(steps)
        self.backbone = load_backbone(config.backbone)
        parameters = self.backbone.attach("motion", config.adapter)
        self.backbone.denoiser.train()
        self.optimiser = torch.optim.AdamW(parameters, lr=config.optimiser.learning_rate)
        store = open_store(job, config.backbone)
        items = TrainingItems(store, store.keys("train"), config)
        self.batches = [collate([items[draw] for draw in draws]) for draws in StepBatches(len(items), config=config)]

    def step(self, number: int) -> float:
        """CPU ms of this thread."""
        began = time.thread_time()
        for batch in self.batches[number]:
            sigma = self.backbone.sigma_from_normal(batch.normal_B, target_shape=batch.inputs.target_shape)
            losses = self.backbone.losses(
                batch.inputs, batch.target_BCFHW, noise_BCFHW=batch.noise_BCFHW, sigma_B=sigma
            )
            losses.mean().backward()
        self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)
        return 1000 * (time.thread_time() - began)


@dataclass(frozen=True, slots=True, kw_only=True)
class StepCost:
    """CPU ms of one step of the trainer and of the bare step after it, over the same batch."""

    full: float
    """All of the process's time but for the bare step's own: the trainer's threads are charged while that runs, too."""
    model: float
    """Of ``full``: inside the calls that the bare loop makes as well."""
    bare: float


class Stopwatch:
    """Adds up this thread's CPU time in calls that it wraps."""

    def __init__(self) -> None:
        self.ms = 0.0

    def around(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any, **named: Any) -> Any:
            began = time.thread_time()
            try:
                return call(*arguments, **named)
            finally:
                self.ms += 1000 * (time.thread_time() - began)

        return timed

    def taken(self) -> float:
        ms, self.ms = self.ms, 0.0
        return ms


def step_costs(job: Path, folder: Path, steps: int, *, workers: int) -> list[StepCost]:
    """The steps of one run, the first two left out; the time of loader workers, processes of their own, not counted."""
    bare, costs, model = BareLoop(job, steps), [], Stopwatch()
    trainer = Trainer(config_for(steps, workers=workers), data=job, out=folder, resume="never", quiet=False)
    trainer._save = lambda: None  # type: ignore[method-assign]
    trainer.backbone.losses = model.around(trainer.backbone.losses)  # type: ignore[method-assign]
    trainer.optimiser.step = model.around(trainer.optimiser.step)  # type: ignore[method-assign]
    backward = torch.Tensor.backward
    mark = time.process_time()

    def on_step(step: int, _: float) -> None:
        nonlocal mark
        inside = model.taken()
        bare_ms = bare.step(step - 1)
        model.taken()
        now = time.process_time()
        costs.append(StepCost(full=1000 * (now - mark) - bare_ms, model=inside, bare=bare_ms))
        mark = now

    torch.Tensor.backward = model.around(backward)  # type: ignore[method-assign]
    try:
        trainer.run(on_step)
    finally:
        torch.Tensor.backward = backward  # type: ignore[method-assign]
    return costs[2:]


def loader_ms(job: Path) -> float:
    """CPU ms to read one sample and make its draws."""
    config = config_for(50)
    store = open_store(job, config.backbone)
    items = TrainingItems(store, store.keys("train"), config)
    draws = [draw for batch in StepBatches(len(items), config=config) for draw in batch]
    began = time.process_time()
    for draw in draws:
        items[draw]
    return 1000 * (time.process_time() - began) / len(draws)


def big_sample_ms(folder: Path) -> float:
    """CPU ms per sample at the real sizes: latents of 768x512 and 1056x704 by 121 frames, 128 channels, bfloat16."""
    from dataset.receipts import atomic_write
    from training.latent_store import CacheManifest, ClipRecord, text_path
    from training.weights import tensor_bytes

    shapes = {"skeleton": (128, 16, 16, 24), "ego": (128, 16, 16, 24), "objects_0": (128, 16, 16, 24)}
    shapes |= {"image": (128, 1, 16, 24), "rgb": (128, 16, 22, 33)}
    tensors = {name: torch.randn(shape).to(torch.bfloat16) for name, shape in shapes.items()}
    tensors["mask_skeleton"] = torch.ones(16, 16, 24, dtype=torch.uint8)
    store_folder = folder / "big"
    lines = []
    for index in range(8):
        data = tensor_bytes(tensors)
        atomic_write(store_folder / f"clips/v/v_{index}.safetensors", data)
        record = ClipRecord(
            key=f"v_{index}",
            split="train",
            caption="",
            file=f"clips/v/v_{index}.safetensors",
            size=len(data),
            source="",
        )
        lines.append(record.line())
    (store_folder / "clips-0of1.jsonl").write_text("".join(lines))
    atomic_write(text_path(store_folder, ""), tensor_bytes({"tokens": torch.zeros(1, 4096)}))
    manifest = CacheManifest(parts={"vae": ""}, frames=121, fps=24.0, backbone={})
    atomic_write(store_folder / "cache.json", manifest.to_json().encode())
    from training.latent_store import LatentStore

    costs = {}
    for stage in ("motion", "appearance"):
        config = tiny_config(stage, conditions={"ego_probability": 1.0, "objects_probability": 1.0})
        items = TrainingItems(LatentStore(store_folder), [f"v_{index}" for index in range(8)], config)
        began = time.process_time()
        for index in range(8):
            items.item(f"v_{index}", "bench", index)
        costs[stage] = 1000 * (time.process_time() - began) / 8
    return max(costs.values())


def waiting_percent(folder: Path, *, step_s: float = 0.2, steps: int = 40) -> dict[str, float]:
    """Share of wall time that steps of ``step_s`` wait for two loader workers, at the real sizes, in percent."""
    from torch.utils.data import DataLoader

    from training.latent_store import LatentStore

    config = tiny_config(
        "motion", optimiser={"steps": steps + 8, "global_batch": 1, "micro_batch": 1},
        conditions={"ego_probability": 1.0, "objects_probability": 1.0},
    )  # fmt: skip
    items = TrainingItems(LatentStore(folder / "big"), [f"v_{index}" for index in range(8)], config)
    loader = DataLoader(
        items, batch_sampler=StepBatches(8, config=config), collate_fn=collate, num_workers=2, prefetch_factor=4
    )
    waits = []
    with Prefetched(loader) as batches:
        for _ in range(steps + 8):
            began = time.perf_counter()
            next(batches)
            waits.append(time.perf_counter() - began)
            time.sleep(step_s)
    # The first batches wait for the workers to start.
    waits = waits[8:]
    return {
        "waiting_percent_of_200_ms_steps": 100 * sum(waits) / (sum(waits) + steps * step_s),
        "waiting_percent_of_the_median_step": 100 * statistics.median(waits) / step_s,
    }


def checkpoint_cost(job: Path, folder: Path) -> dict[str, float]:
    """Wall seconds to write one checkpoint, disk sync and digests included, and its size."""
    trainer = Trainer(config_for(1), data=job, out=folder, quiet=True)
    trainer.run()
    costs = []
    for _ in range(5):
        began = time.perf_counter()
        trainer._save()
        costs.append(time.perf_counter() - began)
    size = sum(path.stat().st_size for path in (folder / "checkpoints").rglob("*.safetensors"))
    return {"checkpoint_wall_s": statistics.median(costs), "checkpoint_megabytes": size / 1e6}


def overhead(costs: list[StepCost]) -> float:
    """Percent: what is not the model's over the bare step, medians."""
    return 100 * statistics.median(c.full - c.model for c in costs) / statistics.median(c.bare for c in costs)


def paired_overhead(costs: list[StepCost]) -> float:
    """Percent: medians compared."""
    return 100 * (statistics.median(c.full for c in costs) / statistics.median(c.bare for c in costs) - 1)


def paired_interval(costs: list[StepCost], *, draws: int = 500) -> list[float]:
    """Percent: 95 of a hundred bootstrap draws lie between."""
    rng = random.Random(0)
    found = sorted(paired_overhead(rng.choices(costs, k=len(costs))) for _ in range(draws))
    return [found[round(0.025 * draws)], found[round(0.975 * draws) - 1]]


def measure(steps: int) -> dict[str, Any]:
    tiny.TINY_TRANSFORMER.clear()
    tiny.TINY_TRANSFORMER.update(WIDE)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        job = cached_job(folder / "job")
        costs = step_costs(job, folder / "run", steps, workers=2)
        inline = step_costs(job, folder / "inline", steps, workers=0)
        bare = statistics.median(cost.bare for cost in costs)
        return {
            "threads": 1, "pairs": len(costs), "clock": "process CPU time", "bare_step_ms": bare,
            "trainer_step_ms": statistics.median(cost.full for cost in costs),
            "loader_workers": 2, "overhead_percent": overhead(costs),
            "overhead_percent_loading_in_process": overhead(inline),
            "overhead_percent_by_difference": paired_overhead(costs),
            "overhead_percent_by_difference_95_interval": paired_interval(costs),
            "loader_ms_per_tiny_sample": loader_ms(job),
            "real_size_samples_per_second_per_worker": 1000 / big_sample_ms(folder),
            "load_average": os.getloadavg()[0],
        } | waiting_percent(folder) | checkpoint_cost(job, folder / "checkpoint")  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=62)
    arguments = parser.parse_args()
    found = measure(arguments.steps)
    results = Path(__file__).parent / "results"
    results.mkdir(exist_ok=True)
    (results / "trainer.json").write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
    print(json.dumps(found, indent=1, sort_keys=True))
