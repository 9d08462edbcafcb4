"""Frames per second of skeleton drawing, masks and reading back: ``python tests/benchmarks/bench_skeleton_video.py``.

One thread, process time, interleaved runs; writes ``results/skeleton_video.json``. The peer draws the same shapes with
one OpenCV call each, antialiased as the usual drawing code does.
"""

import json
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[1]), str(HERE.parent)]

from skeleton_fixtures import busy_street, car  # noqa: E402

from labeling.skeleton_reading import skeletons_from_frame  # noqa: E402
from labeling.skeleton_video import draw_skeletons, lit_cells, skeleton_capsules  # noqa: E402

WIDTH, HEIGHT = 768, 512
TARGET_FPS = 400
ROUNDS, PER_ROUND = 25, 8


def opencv_drawing(labels) -> np.ndarray:
    """The same shapes, a call each."""
    shapes = skeleton_capsules(labels, width=WIDTH, height=HEIGHT)
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for (x0, y0, x1, y1), radius, colour in zip(shapes.ends, shapes.radii, shapes.colours.tolist(), strict=True):
        start, end = (round(16 * x0), round(16 * y0)), (round(16 * x1), round(16 * y1))
        if start == end:
            cv2.circle(picture, start, round(16 * radius), colour, -1, cv2.LINE_AA, shift=4)
        else:
            cv2.line(picture, start, end, colour, max(1, round(2 * radius)), cv2.LINE_AA, shift=4)
    return picture


def interleaved_ms(methods: dict[str, Callable[[], object]], *, rounds: int, per_round: int) -> dict[str, list[float]]:
    """Milliseconds a call, per method and round, the methods taking turns."""
    times: dict[str, list[float]] = {name: [] for name in methods}
    for method in methods.values():
        method()
    for _ in range(rounds):
        for name, method in methods.items():
            start = time.process_time()
            for _ in range(per_round):
                method()
            times[name].append((time.process_time() - start) / per_round * 1e3)
    return times


def main() -> None:
    """Measure, print and write."""
    cv2.setNumThreads(1)
    streets = {schema: busy_street(cars=20, people=5, schema=schema) for schema in ("car66", "car24")}
    one_car = draw_skeletons([car(heading_deg=35)], width=WIDTH, height=HEIGHT)
    methods: dict[str, Callable[[], object]] = {}
    for schema, labels in streets.items():
        methods[f"draw {schema}"] = lambda labels=labels: draw_skeletons(labels, width=WIDTH, height=HEIGHT)
        methods[f"lit cells {schema}"] = lambda labels=labels: lit_cells([labels], width=WIDTH, height=HEIGHT)
        methods[f"opencv, a call each {schema}"] = lambda labels=labels: opencv_drawing(labels)
    times = interleaved_ms(methods, rounds=ROUNDS, per_round=PER_ROUND)
    times |= interleaved_ms({"read back one car66": lambda: skeletons_from_frame(one_car)}, rounds=5, per_round=1)
    rows = {}
    for name, values in times.items():
        median = float(np.median(values))
        rows[name] = {
            "ms_per_frame": {"median": round(median, 3), "p95": round(float(np.percentile(values, 95)), 3)},
            "frames_per_second": round(1000 / median, 1),
        }
        print(f"{name:32s} {median:8.2f} ms  {1000 / median:7.0f} frames/s")
    ratio = rows["opencv, a call each car66"]["ms_per_frame"]["median"] / rows["draw car66"]["ms_per_frame"]["median"]
    result = {
        "what": f"20 cars, 4 lanes, 5 people with hands and faces, {WIDTH}x{HEIGHT}, one thread, process time",
        "machine": f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}",
        "rounds": ROUNDS, "methods": rows, "opencv_over_draw": round(ratio, 2), "target_frames_per_second": TARGET_FPS,
        "target_met": rows["draw car66"]["frames_per_second"] >= TARGET_FPS,
    }  # fmt: skip
    (HERE / "results").mkdir(exist_ok=True)
    (HERE / "results" / "skeleton_video.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(f"target of {TARGET_FPS} frames/s {'met' if result['target_met'] else 'missed'}")


if __name__ == "__main__":
    main()
