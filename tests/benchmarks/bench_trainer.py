"""What a training step costs beyond the bare loop, what the loader gives, what a checkpoint takes.

The bare loop is the same network, forward, backward and AdamW on batches that are there already, and nothing else. Runs
alternate, so that a busy machine slows both; medians of process CPU time are compared. The network is wide enough that
a step takes 200 ms or more on one core.

    python tests/benchmarks/bench_trainer.py [--rounds 3] [--steps 6]
"""

import argparse
import json
import statistics
import sys
import tempfile
import time
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


def config_for(steps: int) -> TrainConfig:
    return tiny_config(
        "motion", optimiser={"steps": steps, "global_batch": 4, "micro_batch": 4}, adapter={"rank": 64},
        checkpoint={"every_steps": 10**6}, trackers=["tensorboard"],
        conditions={"ego_probability": 1.0, "objects_probability": 1.0},
    )  # fmt: skip


def trainer_step_ms(job: Path, folder: Path, steps: int) -> list[float]:
    """CPU ms of each step of the real trainer, the first left out."""
    marks: list[float] = []
    trainer = Trainer(config_for(steps), data=job, out=folder, resume="never", quiet=False)
    trainer._save = lambda: None  # type: ignore[method-assign]
    trainer.run(lambda *_: marks.append(time.process_time()))
    return [1000 * (b - a) for a, b in zip(marks, marks[1:], strict=False)]


def bare_step_ms(job: Path, steps: int) -> list[float]:
    """CPU ms of each bare step over the same batches, the first left out."""
    config = config_for(steps)
    backbone = load_backbone(config.backbone)
    parameters = backbone.attach("motion", config.adapter)
    backbone.denoiser.train()
    optimiser = torch.optim.AdamW(parameters, lr=config.optimiser.learning_rate)
    store = open_store(job, config.backbone)
    items = TrainingItems(store, store.keys("train"), config)
    batches = [collate([items[draw] for draw in draws]) for draws in StepBatches(len(items), config=config)]
    marks = [time.process_time()]
    for groups in batches:
        for batch in groups:
            sigma = backbone.sigma_from_normal(batch.normal_B, target_shape=batch.inputs.target_shape)
            losses = backbone.losses(batch.inputs, batch.target_BCFHW, noise_BCFHW=batch.noise_BCFHW, sigma_B=sigma)
            losses.mean().backward()
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)
        marks.append(time.process_time())
    return [1000 * (b - a) for a, b in zip(marks[1:], marks[2:], strict=False)]


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
    from training.latent_store import CacheManifest, ClipRecord, text_path
    from training.latents import write_whole
    from training.weights import tensor_bytes

    shapes = {"skeleton": (128, 16, 16, 24), "ego": (128, 16, 16, 24), "objects_0": (128, 16, 16, 24)}
    shapes |= {"image": (128, 1, 16, 24), "rgb": (128, 16, 22, 33)}
    tensors = {name: torch.randn(shape).to(torch.bfloat16) for name, shape in shapes.items()}
    tensors["mask_skeleton"] = torch.ones(16, 16, 24, dtype=torch.uint8)
    store_folder = folder / "big"
    lines = []
    for index in range(8):
        data = tensor_bytes(tensors)
        write_whole(store_folder / f"clips/v/v_{index}.safetensors", data)
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
    write_whole(text_path(store_folder, ""), tensor_bytes({"tokens": torch.zeros(1, 4096)}))
    manifest = CacheManifest(parts={"vae": ""}, frames=121, fps=24.0, backbone={})
    write_whole(store_folder / "cache.json", manifest.to_json().encode())
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


def waiting_percent(folder: Path, *, step_s: float = 0.2, steps: int = 40) -> float:
    """Share of wall time that a step of ``step_s`` waits for two loader workers, at the real sizes, in percent."""
    from torchdata.stateful_dataloader import StatefulDataLoader

    from training.latent_store import LatentStore

    config = tiny_config(
        "motion", optimiser={"steps": steps + 8, "global_batch": 1, "micro_batch": 1},
        conditions={"ego_probability": 1.0, "objects_probability": 1.0},
    )  # fmt: skip
    items = TrainingItems(LatentStore(folder / "big"), [f"v_{index}" for index in range(8)], config)
    loader = StatefulDataLoader(
        items, batch_sampler=StepBatches(8, config=config), collate_fn=collate, num_workers=2, prefetch_factor=4
    )
    waited = 0.0
    with Prefetched(loader) as batches:
        for step in range(steps + 8):
            began = time.perf_counter()
            next(batches)
            # The first batches wait for the workers to start.
            waited += time.perf_counter() - began if step >= 8 else 0.0
            time.sleep(step_s)
    return 100 * waited / (waited + steps * step_s)


def checkpoint_ms(job: Path, folder: Path) -> float:
    """Wall ms to write one checkpoint, disk sync included."""
    trainer = Trainer(config_for(1), data=job, out=folder, quiet=True)
    trainer.run()
    costs = []
    for _ in range(5):
        began = time.perf_counter()
        trainer._save()
        costs.append(1000 * (time.perf_counter() - began))
    return statistics.median(costs)


def measure(rounds: int, steps: int) -> dict[str, Any]:
    tiny.TINY_TRANSFORMER.clear()
    tiny.TINY_TRANSFORMER.update(WIDE)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        job = cached_job(folder / "job")
        bare: list[float] = []
        full: list[float] = []
        for turn in range(rounds):
            # Either goes first every other time.
            for kind in ("bare", "full") if turn % 2 else ("full", "bare"):
                if kind == "bare":
                    bare += bare_step_ms(job, steps)
                else:
                    full += trainer_step_ms(job, folder / f"run_{turn}", steps)
        result = {
            "threads": 1, "rounds": rounds, "steps": steps, "clock": "process CPU time",
            "bare_step_ms": statistics.median(bare), "trainer_step_ms": statistics.median(full),
            "loader_ms_per_tiny_sample": loader_ms(job), "loader_ms_per_real_size_sample": big_sample_ms(folder),
            "checkpoint_wall_ms": checkpoint_ms(job, folder / "checkpoint"),
            "waiting_percent_of_200_ms_steps": waiting_percent(folder),
        }  # fmt: skip
    result["overhead_percent"] = 100 * (result["trainer_step_ms"] / result["bare_step_ms"] - 1)
    result["real_size_samples_per_second_per_worker"] = 1000 / result["loader_ms_per_real_size_sample"]
    return result


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=6)
    arguments = parser.parse_args()
    found = measure(arguments.rounds, arguments.steps)
    results = Path(__file__).parent / "results"
    results.mkdir(exist_ok=True)
    (results / "trainer.json").write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
    print(json.dumps(found, indent=1, sort_keys=True))
