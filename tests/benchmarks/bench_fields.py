"""CIF/CAF decoding at 1056x704: ms per frame on one core, by scene, beside filling the dense map alone.

Runs are interleaved; medians and 95th percentiles of the thread's processor time go to ``results/fields.json``. The
dense map is what the lazy one spares: every Gaussian added into (K, 704, 1056) float32, compiled too, without decoding.

    python tests/benchmarks/bench_fields.py [--rounds 30]
"""

import argparse
import json
import math
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import njit

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from field_fixtures import car_objects, lane_objects, plant, random_fields

from labeling import field_growth
from labeling.fields import FieldDecoder
from labeling.model_cards import FieldHeadCard

WIDTH, HEIGHT, STRIDE = 1056, 704, 8
ROWS, COLUMNS = HEIGHT // STRIDE + 1, WIDTH // STRIDE + 1
RESULT = Path(__file__).parent / "results" / "fields.json"
LANE_HEAD = FieldHeadCard(schema="lane24", point_threshold=0.3, instance_threshold=0.2, min_points=4)

Way = Callable[[], int]


def main() -> None:
    """Measure, print a line per scene, and write the JSON."""
    options = argparse.ArgumentParser()
    options.add_argument("--rounds", type=int, default=30)
    rounds = options.parse_args().rounds
    ways = make_ways()
    objects = {name: way() for name, way in ways.items()}
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, way in ways.items():
            start = time.thread_time()
            way()
            seconds[name].append(time.thread_time() - start)
    scenes = {
        name: {
            "median_ms": round(float(np.median(values)) * 1e3, 2),
            "p95_ms": round(float(np.quantile(values, 0.95)) * 1e3, 2),
            "objects": objects[name],
        }
        for name, values in seconds.items()
    }
    for name, scene in scenes.items():
        print(f"{name:32} {scene['median_ms']:8.2f} ms  (p95 {scene['p95_ms']:.2f}), {scene['objects']} objects")
    report = {
        "what": "thread CPU ms per frame, one core, fields of 89x133 cells", "rounds": rounds, "scenes": scenes,
        "dense_map_ratio": round(scenes["dense map of 20 car66"]["median_ms"] / scenes["20 car66"]["median_ms"], 2),
        "machine": {"cpu": platform.processor() or platform.machine(), "python": platform.python_version()},
    }  # fmt: skip
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps(report, indent=2) + "\n")


def make_ways() -> dict[str, Way]:
    """The scenes, by name."""
    ways: dict[str, Way] = {}
    for schema, count in (("car66", 0), ("car66", 5), ("car66", 20), ("car24", 20)):
        rng = np.random.default_rng(1)
        cars = car_objects(rng, count, schema=schema, width=WIDTH, height=HEIGHT)
        planted = plant(cars, rng.uniform(1, 4, count), schema=schema, height=ROWS, width=COLUMNS)
        ways[f"{count} {schema}"] = decoding(FieldHeadCard(schema=schema), planted.cif, planted.caf)
        if (schema, count) == ("car66", 20):
            ways["dense map of 20 car66"] = dense_filling(planted.cif)
    lanes = lane_objects(6, width=WIDTH, height=HEIGHT)
    planted = plant(lanes, np.linspace(1, 4, 6), schema="lane24", height=ROWS, width=COLUMNS)
    ways["6 lanes"] = decoding(LANE_HEAD, planted.cif, planted.caf)
    both = ways["20 car66"], ways["6 lanes"]
    ways["20 car66 and 6 lanes"] = lambda: both[0]() + both[1]()
    noise = random_fields(0, schema="car66", height=ROWS, width=COLUMNS, share=0.05)
    ways["noise in 5 % of car66 cells"] = decoding(FieldHeadCard(schema="car66"), *noise)
    return ways


def decoding(head: FieldHeadCard, cif: np.ndarray, caf: np.ndarray) -> Way:
    """Decode one frame; gives the number of objects."""
    decoder = FieldDecoder(head, stride=STRIDE)
    return lambda: len(decoder.decode(cif, caf))


def dense_filling(cif: np.ndarray) -> Way:
    """Fill the dense map of one frame."""

    def fill() -> int:
        cells = field_growth.gather_cells(cif, 0.3, STRIDE)
        fill_dense(np.zeros((len(cif), HEIGHT, WIDTH), np.float32), cells.kind, cells.values)
        return 0

    return fill


@njit
def fill_dense(dense: np.ndarray, kind: np.ndarray, values: np.ndarray) -> None:
    """Add every cell's Gaussian, cut at one sigma."""
    for n in range(len(kind)):
        confidence, x, y, sigma = values[n, 0], values[n, 1], values[n, 2], values[n, 4]
        for row in range(max(math.ceil(y - sigma), 0), min(math.floor(y + sigma) + 1, dense.shape[1])):
            for column in range(max(math.ceil(x - sigma), 0), min(math.floor(x + sigma) + 1, dense.shape[2])):
                squared = ((column - x) ** 2 + (row - y) ** 2) / sigma**2
                if squared <= 1:
                    value = dense[kind[n], row, column] + confidence / 16 * math.exp(-0.5 * squared)
                    dense[kind[n], row, column] = min(1.0, value)


if __name__ == "__main__":
    main()
