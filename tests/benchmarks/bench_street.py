"""How fast the synthetic street renders, and how well a tracker confirms its true flow.

Thread CPU time on one core, at 1056x704, scenarios interleaved over rounds, beside one bilinear ``cv2.warpAffine`` of
the same picture (so that two machines, or a busy and a quiet one, can be compared).

Usage: python tests/benchmarks/bench_street.py
"""

import json
import os
import platform
import sys
import time
from pathlib import Path

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from dataset.street import Scenario, Street, StreetConfig  # noqa: E402

RESULTS = Path(__file__).parent / "results" / "bench_street.json"
SCENES: tuple[Scenario, ...] = ("empty", "drive", "parked", "sharp_turn", "crossing", "traffic")
SEEDS, FRAMES, ROUNDS, BLOCK = (1, 2, 3), 120, 5, 4
GOAL_FPS = 15.0


def thread_ms(work) -> float:
    """Thread CPU time of one call, milliseconds."""
    start = time.thread_time()
    work()
    return (time.thread_time() - start) * 1e3


def main() -> None:
    """Measure, print a table, write the JSON."""
    cv2.setNumThreads(1)
    streets = {(s, seed): Street(StreetConfig(seed=seed, scenario=s, frames=FRAMES)) for s in SCENES for seed in SEEDS}
    for street in streets.values():
        street.render(0)
    picture = streets["drive", 1].render(0).rgb
    turn = np.array([[1.01, 0.01, 3.0], [0.01, 0.99, 2.0]])
    spent: dict[str, list[float]] = {scene: [] for scene in SCENES}
    counts: dict[str, list[int]] = {scene: [] for scene in SCENES}
    yardstick: list[float] = []
    for turn_number in range(ROUNDS):
        for (scene, _), street in streets.items():
            frame = (turn_number * 23 + 7) % (FRAMES - BLOCK)
            counts[scene].append(len(street.render(frame).objects))
            for k in range(BLOCK):  # Frames in a row, as a video is made.
                spent[scene].append(thread_ms(lambda street=street, k=frame + k: street.render(k)))
            yardstick.append(thread_ms(lambda: cv2.warpAffine(picture, turn, (1056, 704))))
    table = {
        scene: {
            "ms_per_frame": {
                "median": float(np.median(times)),
                "p95": float(np.quantile(times, 0.95)),
                "runs": len(times),
            },
            "frames_per_second": 1e3 / float(np.median(times)),
            "objects": float(np.mean(counts[scene])),
        }
        for scene, times in spent.items()
    }
    warp = float(np.median(yardstick))
    for scene, row in table.items():
        held = "held" if row["frames_per_second"] >= GOAL_FPS else "not held"
        median = row["ms_per_frame"]["median"]
        print(
            f"{scene:11s} {median:6.1f} ms  {row['frames_per_second']:5.1f} frames/s  {median / warp:4.1f} warps  "
            f"{row['objects']:3.0f} objects  {GOAL_FPS:g} frames/s: {held}"
        )
    print(f"yardstick: one cv2.warpAffine of the picture takes {warp:.1f} ms")
    machine = {"platform": platform.platform(), "load": os.getloadavg(), "cores": os.cpu_count()}
    RESULTS.parent.mkdir(exist_ok=True)
    result = {"size": [1056, 704], "threads": 1, "scenes": table, "warp_affine_ms": warp, "machine": machine}
    RESULTS.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
