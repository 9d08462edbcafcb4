"""Ego-motion's promised figures: ``python tests/benchmarks/bench_ego.py``; writes ``results/ego.json``.

KITTI 03 at half size and 10 fps (where ``../shared/real`` is there): rotation, direction, displacement over 51-frame
windows with one fitted scale and metric, milliseconds a frame. A street at 640x427 and 24 fps: milliseconds a frame.
Street videos with a hidden focal length of 0.7 to 1.4 of the prior: what calibration finds from the turns that three
minutes hold, four of about 90 degrees each. One thread, process time.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[1])]

from dataset.street import Street, StreetConfig  # noqa: E402
from labeling.camera import prior_intrinsics  # noqa: E402
from labeling.ego_calibration import calibrate_camera  # noqa: E402
from labeling.ego_motion import estimate_ego_motion  # noqa: E402
from labeling.ego_tracks import RunTracks, track_run  # noqa: E402
from labeling.errors import DataError  # noqa: E402
from pipelines.charts import machine_name  # noqa: E402
from pipelines.ego_clips import kitti_clip  # noqa: E402
from pipelines.ego_errors import direction_errors_deg, rotation_errors_deg, window_errors_m  # noqa: E402
from pipelines.ego_methods import default_motion  # noqa: E402

ROUNDS = 2
VIDEOS, WIDTH, HEIGHT, FPS = 6, 480, 320, 24
TURNS, TURN_FRAMES = 4, (18, 96)


def ms_per_frame(run: Callable[[], object], frames: int) -> dict[str, float]:
    """Process time, after one round that warms up."""
    run()
    taken = []
    for _ in range(ROUNDS):
        start = time.process_time()
        run()
        taken.append((time.process_time() - start) * 1000 / frames)
    return {"median": round(float(np.median(taken)), 2), "least": round(min(taken), 2), "most": round(max(taken), 2)}


def kitti() -> dict[str, object] | None:
    """Accuracy and speed on the real drive; None where it is absent."""
    try:
        clip = kitti_clip()
    except DataError:
        return None
    found = default_motion(clip).trajectory.cam_to_world
    figures = {
        "rotation_deg_per_frame": rotation_errors_deg(found, clip.truth),
        "direction_ground_plane_deg": direction_errors_deg(found, clip.truth, least_m=0.1, ground_plane=True),
        "direction_3d_deg": direction_errors_deg(found, clip.truth, least_m=0.1),
        "displacement_51_frames_fitted_m": window_errors_m(found, clip.truth, frames=51, fit_scale=True),
        "displacement_51_frames_metric_m": window_errors_m(found, clip.truth, frames=51, fit_scale=False),
    }
    return {
        "picture": "621x188, 10 fps, 300 frames; camera height 1.65 m given, pitch not",
        **{name: round(float(np.median(errors)), 4) for name, errors in figures.items()},
        "ms_per_frame": ms_per_frame(lambda: default_motion(clip), len(clip.frames)),
    }


def street_speed() -> dict[str, object]:
    """Speed on a street drive at 24 fps."""
    street = Street(StreetConfig(seed=1, width=640, height=427, frames=60, scenario="traffic"))
    frames = [street.render(index).rgb for index in range(60)]
    times = np.arange(60) / 24
    run = lambda: estimate_ego_motion(frames, times, intrinsics=street.intrinsics)  # noqa: E731
    return {"picture": "640x427, 24 fps, 60 frames", "ms_per_frame": ms_per_frame(run, 60)}


def video_runs(video: int, focal_px: float) -> list[RunTracks]:
    """Tracks of one video's runs: what counts of three minutes are the turns, so each run is one, on a street anew."""
    runs = []
    for turn in range(TURNS):
        seed = 100 + 10 * video + turn
        config = StreetConfig(
            seed=seed, width=WIDTH, height=HEIGHT, frames=TURN_FRAMES[1], focal_px=focal_px, fps=FPS,
            scenario="sharp_turn",
        )  # fmt: skip
        street = Street(config)
        shown = range(*TURN_FRAMES)
        runs.append(track_run((street.render(index).rgb for index in shown), np.array(shown) / FPS))
    return runs


def calibration() -> dict[str, object]:
    """Hidden focal lengths, spread evenly in their logarithm, and what is found of them."""
    prior = prior_intrinsics(WIDTH, HEIGHT)
    videos = []
    for number, factor in enumerate(np.geomspace(0.7, 1.4, VIDEOS)):
        found = calibrate_camera(video_runs(100 + number, prior.fx * factor), intrinsics=prior)
        error = found.intrinsics.fx / (prior.fx * factor) - 1
        videos.append({
            "hidden_f_over_prior": round(float(factor), 3),
            "error": round(float(error), 4), "sigma": round(found.intrinsics.focal_sigma, 4), "turns": found.turns,
        })  # fmt: skip
        print(videos[-1], flush=True)
    errors, sigmas = (np.array([video[name] for video in videos]) for name in ("error", "sigma"))
    return {
        "videos": videos,
        "picture": f"{WIDTH}x{HEIGHT}, {TURNS} turns of {(TURN_FRAMES[1] - TURN_FRAMES[0]) / FPS:g} s a video",
        "median_error": round(float(np.median(np.abs(errors))), 4),
        "share_within_one_sigma": round(float((np.abs(errors) <= sigmas).mean()), 3),
    }


def main() -> None:
    """Measure, print and write."""
    cv2.setNumThreads(1)
    result: dict[str, object] = {"machine": machine_name(), "threads": 1}
    for name, measure in (
        ("kitti_03_half_size", kitti),
        ("street_640x427", street_speed),
        ("calibration", calibration),
    ):
        result[name] = measure()
        print(name, json.dumps(result[name], indent=1), flush=True)
    text = json.dumps(result, indent=1)
    (HERE / "results" / "ego.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
