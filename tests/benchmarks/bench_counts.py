"""Exact counts of cars and people in what a job's labels show, beside those of single frames.

The streets are those that judge the shipped models (``python -m training.street_models --evaluate``), played for a
second and a half each. A frame counts as exact where every object at least 32 px high and 30 % visible is labelled and
nothing else but lower or more hidden ones. All efforts get the same looks.

    python tests/benchmarks/bench_counts.py
"""

import argparse
import json
import platform
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import get_args

import cv2
import numpy as np

from dataset.street import Street
from labeling.efforts import Effort
from labeling.extraction import label_with
from labeling.observation import looks_of
from pipelines.charts_track import Remembered
from pipelines.keypoint_clips import street_extractors
from pipelines.keypoint_errors import MatchedFrame, match_frames
from pipelines.track_errors import NO_TRACKS, TrackScore, track_score
from training.street_models import JUDGED_FRAMES, JUDGED_STREETS
from training.street_plans import HELD_OUT_SEED, RenderPlan, plan_streets
from training.street_scores import grouped_standard_error

FRAMES = 37
SINGLE = "single frames"
RESULT = Path(__file__).parent / "results" / "bench_counts.json"


def judge_street(plan: RenderPlan) -> dict[str, tuple[list[bool], TrackScore]]:
    """Whether each frame of a street has exact counts, and the tracks' score, by method."""
    cv2.setNumThreads(1)
    street = Street(plan.config)
    rendered = [street.render(index) for index in range(FRAMES)]
    truth = [frame.objects for frame in rendered]
    look = looks_of(street_extractors())[0]
    seen = [look.see(frame.rgb, index) for index, frame in enumerate(rendered)]
    alone = [label for labels in seen for label in labels]
    results = {SINGLE: ([is_exact(frame) for frame in match_frames(alone, truth)], NO_TRACKS)}
    for effort in get_args(Effort):
        again = Remembered(seen, look.sure_scores, decided=look.decided)
        labels = label_with([again], [frame.rgb for frame in rendered], first_frame=0, effort=effort)
        exact = [is_exact(frame) for frame in match_frames(labels, truth)]
        results[effort] = (exact, track_score(labels, truth))
    return results


def is_exact(frame: MatchedFrame) -> bool:
    """Nothing that counts is missed, and nothing is there that is not."""
    return not frame.phantoms and all(label is not None for _, label in frame.judged)


def summary(method: str, streets: Sequence[tuple[list[bool], TrackScore]]) -> dict[str, float]:
    """The figures of one method over all streets."""
    exact = [flag for flags, _ in streets for flag in flags]
    figures = {"count_exact": round(float(np.mean(exact)), 4)}
    if len(streets) > 1:
        figures["standard_error"] = round(grouped_standard_error(exact, FRAMES), 4)
    if method == SINGLE:
        return figures
    score = sum((score for _, score in streets), NO_TRACKS)
    return figures | {
        "mota": round(score.mota, 4), "idf1": round(score.idf1, 4), "switches": score.switches,
        "missed": score.missed, "phantoms": score.phantoms, "objects": score.objects,
    }  # fmt: skip


def main() -> None:
    """Measure, print and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--streets", type=int, default=JUDGED_STREETS)
    parser.add_argument("--seed", type=int, default=HELD_OUT_SEED, help="of the first street")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    plans = plan_streets(options.seed, options.streets, frames=JUDGED_FRAMES, every=17)
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        streets = list(pool.map(judge_street, plans))
    result: dict[str, object] = {
        "machine": f"{platform.machine()}, {options.workers} processes", "streets": options.streets,
        "first_seed": options.seed, "frames": FRAMES * options.streets,
    }  # fmt: skip
    result |= {method: summary(method, [street[method] for street in streets]) for method in streets[0]}
    RESULT.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
