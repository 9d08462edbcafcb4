"""Cars read back from drawn skeletons: what a pile costs, what comes back, and how much of that is right.

Run: python tests/benchmarks/bench_skeleton_reading.py
"""

import json
import platform
import sys
import time
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[1]), str(HERE.parent)]

from scipy.optimize import linear_sum_assignment  # noqa: E402
from skeleton_fixtures import busy_street  # noqa: E402

from labeling.skeleton_reading import read_skeletons  # noqa: E402
from labeling.skeleton_video import LABEL_HEIGHT, LABEL_WIDTH, draw_skeletons  # noqa: E402

WIDTH, HEIGHT = 768, 512
COUNTS, SEEDS, NEAR_PX = (1, 3, 6, 10, 20), (0, 1), 2.0


def right_points(found, truth) -> int:
    """Points within two pixels of their own, under the best one-to-one choice of cars."""
    right = np.zeros((len(found), len(truth)), int)
    for i, one in enumerate(found):
        for j, other in enumerate(truth):
            both = one.present & other.present
            right[i, j] = (np.hypot(*(one.points - other.points)[both, :2].T) <= NEAR_PX).sum()
    return int(right[linear_sum_assignment(-right)].sum())


def in_view(one) -> int:
    """Points of a car that lie in the picture."""
    places = one.points[one.present, :2]
    return int(((places >= 0) & (places < (LABEL_WIDTH, LABEL_HEIGHT))).all(axis=1).sum())


def measured(schema: str, count: int) -> dict[str, float]:
    """Means over the seeds of one number of cars."""
    rows = []
    for seed in SEEDS:
        labels = busy_street(cars=count, people=0, schema=schema, seed=seed)
        truth = [one for one in labels if one.category == "car"]
        picture = draw_skeletons(labels, width=WIDTH, height=HEIGHT)
        start = time.process_time()
        reading = read_skeletons(picture, schema=schema)
        spent = time.process_time() - start
        right, given = right_points(reading.cars, truth), sum(int(one.present.sum()) for one in reading.cars)
        share = right / sum(map(in_view, truth))
        rows.append((1e3 * spent, share, right / max(1, given), reading.unexplained_share, reading.left_out))
    names = ("ms", "points_read", "of_them_right", "unexplained", "left_out")
    return {name: round(float(value), 3) for name, value in zip(names, np.mean(rows, axis=0), strict=True)}


def main() -> None:
    """Measure, print and write."""
    cv2.setNumThreads(1)
    measured("car24", 1)
    rows = {}
    for schema in ("car66", "car24"):
        for count in COUNTS:
            rows[f"{count} {schema}"] = row = measured(schema, count)
            print(f"{count:3d} {schema}: " + ", ".join(f"{name} {value:g}" for name, value in row.items()))
    result = {
        "what": f"cars over and behind each other with 4 lanes, {WIDTH}x{HEIGHT}, one thread, process time; a point is "
        f"right within {NEAR_PX:g} px of a 1056x704 picture",
        "machine": f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}",
        "seeds": len(SEEDS), "rows": rows,
    }  # fmt: skip
    (HERE / "results").mkdir(exist_ok=True)
    (HERE / "results" / "skeleton_reading.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
