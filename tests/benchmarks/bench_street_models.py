"""Time of the shipped street models on one core: one frame with 5 cars, 2 people and its lanes, through the labelling
code. Processor time of this thread, medians of interleaved runs; the bound of the four together is 60 ms.

    python tests/benchmarks/bench_street_models.py
"""

import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from dataset.street import Street, StreetConfig
from labeling.model_cards import SHIPPED_CARDS
from training.street_models import open_models

RUNS = 30
CARS, PEOPLE = 5, 2
RESULT = Path(__file__).parent / "results" / "bench_street_models.json"


def main() -> None:
    """Measure, print and write the result."""
    cv2.setNumThreads(1)
    frame = Street(StreetConfig(seed=90_001, scenario="traffic", frames=30)).render(12).rgb
    models = open_models(SHIPPED_CARDS)
    detector, heads, fields = models.detector, models.heads, models.fields
    assert detector is not None and fields is not None
    rng = np.random.default_rng(0)
    boxes = {"car": _boxes(rng, CARS, (120, 80)), "person": _boxes(rng, PEOPLE, (40, 110))}
    steps: dict[str, Callable[[], object]] = {
        "street_detector": lambda: detector.detect([frame]),
        "street_car24": lambda: heads["car"].estimate([frame], [boxes["car"]]),
        "street_coco17": lambda: heads["person"].estimate([frame], [boxes["person"]]),
        # As a job asks it: cars have their boxes and their head.
        "street_fields": lambda: fields.estimate([frame], categories=("lane",)),
    }
    spent: dict[str, list[float]] = {name: [] for name in steps}
    for run in range(RUNS + 3):
        for name, step in steps.items():
            start = time.thread_time()
            step()
            if run >= 3:
                spent[name].append(1000 * (time.thread_time() - start))
    medians = {name: round(statistics.median(values), 2) for name, values in spent.items()}
    result = {
        "machine": f"{platform.machine()} with {torch.backends.cpu.get_cpu_capability()}, one thread",
        "frame": "1056x704", "cars": CARS, "people": PEOPLE,
        "runs": RUNS,
        "ms_per_frame": medians, "total_ms": round(sum(medians.values()), 2), "bound_ms": 60.0,
    }  # fmt: skip
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=2))


def _boxes(rng: np.random.Generator, count: int, size: tuple[int, int]) -> np.ndarray:
    corners = rng.uniform((0, 300), (800, 500), (count, 2))
    return np.concatenate([corners, corners + size], axis=1).astype(np.float32)


if __name__ == "__main__":
    main()
