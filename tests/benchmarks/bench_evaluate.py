"""Can the judge judge? ``animatic evaluate`` on videos whose errors are known, and what a sample costs.

Street drives are labelled as a job; each clip's own video then stands for generated ones: encoded again, at half the
size and rate, played at 0.8 of its speed (so that the displacement from the truth is known exactly), blurred, and its
first frame held. Process CPU time of one thread.

Usage: python tests/benchmarks/bench_evaluate.py
"""

import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_variable] = "1"
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from dataset.loader import Sample, ShardDataset  # noqa: E402
from dataset.street import Scenario, StreetConfig, write_street_video  # noqa: E402
from labeling.encoding import VideoWriter  # noqa: E402
from pipelines.commands import JobOptions, run_label  # noqa: E402
from pipelines.evaluate import EvaluateOptions, Evaluation, evaluate  # noqa: E402
from training.evaluation_report import FLOOR, SAMPLES  # noqa: E402

RESULTS = Path(__file__).parent / "results" / "bench_evaluate.json"
STREETS: dict[str, tuple[Scenario, int]] = {"avenue": ("traffic", 11), "road": ("drive", 5), "bend": ("turn", 21)}
WIDTH, HEIGHT, CLIP, SPEED = 480, 320, 33, 0.8
SETTINGS = f"""
clip: {{clip_frames: {CLIP}, stride_frames: 32, run_frames: 96}}
encoder: {{gop: 8}}
picture: {{width: {WIDTH}, height: {HEIGHT}}}
keypoints: {{extractors: [street]}}
views: {{width: 192, height: 128, skeleton_encoder: {{gop: 8}}, view_encoder: {{gop: 8}}}}
pack: {{videos: rgb}}
select: {{keep_share: 1.0, split: {{avenue: val, road: val, bend: val}}}}
"""
SHOWN = ("min_ade_m", "ate_sim3_m", "box_iou", "truth_pck", "psnr_db", "ssim")

Frames = Sequence[np.ndarray]


def slower(frames: Frames) -> Frames:
    """Played at ``SPEED``: each moment shows what was there at that share of its time."""
    return [frames[round(SPEED * index)] for index in range(len(frames))]


KINDS: dict[str, tuple[Callable[[Frames], Frames], int]] = {
    "encoded again": (lambda frames: frames, 24),
    "half size, 12 fps": (
        lambda frames: [cv2.resize(one, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for one in frames[::2]],
        12,
    ),
    "at 0.8 speed": (slower, 24),
    "blurred by 4 px": (lambda frames: [cv2.GaussianBlur(one, (0, 0), 4) for one in frames], 24),
    "first frame held": (lambda frames: [frames[0]] * len(frames), 24),
}


def make_job(root: Path) -> Path:
    """Three drives, labelled by the street models."""
    videos = root / "videos"
    videos.mkdir()
    for name, (scenario, seed) in STREETS.items():
        config = StreetConfig(seed=seed, scenario=scenario, frames=CLIP, width=WIDTH, height=HEIGHT)
        write_street_video(config, videos / f"{name}.mp4")
    (root / "job.yaml").write_text(SETTINGS, encoding="utf-8")
    if run_label([videos], root / "job", JobOptions(config=root / "job.yaml", workers=0)):
        raise SystemExit("labelling failed")
    return root / "job"


def write_samples(clips: Sequence[Sample], folder: Path, change: Callable[[Frames], Frames], fps: int) -> None:
    """Every clip's video, changed."""
    folder.mkdir()
    for clip in clips:
        frames = change(list(clip.iterate_frames("rgb.mp4")))
        height, width = frames[0].shape[:2]
        with VideoWriter(folder / f"{clip.key}_0.mp4", width=width, height=height, fps=fps) as writer:
            for frame in frames:
                writer.write(frame)


def exact_ade(clip: Sample, kind: str) -> float:
    """The displacement that a changed video has by its making, from the job's trajectory."""
    indices = {"at 0.8 speed": np.rint(SPEED * np.arange(CLIP)).astype(int), "first frame held": np.zeros(CLIP, int)}
    ground = clip.cam_to_world[:, [0, 2], 3]
    return float(np.linalg.norm(ground[indices[kind]] - ground, axis=1).mean()) if kind in indices else 0.0


def row(found: Evaluation, name: str) -> dict[str, float | None]:
    """The figures that are shown, and in how many of the clips the camera's motion was found."""
    summary = found.report.sets[name]
    shown = {figure: round(summary.figures[figure].mean, 4) if figure in summary.figures else None for figure in SHOWN}
    return {"ego_clips": summary.coverage["ego"].estimated, **shown}


def main() -> None:
    """Measure, print a table, write the JSON."""
    cv2.setNumThreads(1)
    rows: dict[str, dict[str, float | None]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        job = make_job(root)
        clips = list(ShardDataset(job, "val"))
        for number, (kind, (change, fps)) in enumerate(KINDS.items()):
            folder = root / f"samples{number}"
            write_samples(clips, folder, change, fps)
            started = time.process_time()
            found = evaluate(job, folder, EvaluateOptions())
            spent = time.process_time() - started
            if not number:
                rows["truth (floor)"] = {"exact_ade_m": 0.0, **row(found, FLOOR)}
            looked = 2 * len(clips) * CLIP * fps / 24  # the samples, and the floor at their rate and size
            rows[kind] = {
                "exact_ade_m": round(float(np.mean([exact_ade(clip, kind) for clip in clips])), 4),
                **row(found, SAMPLES), "ms_per_frame": round(1e3 * spent / looked, 1),
            }  # fmt: skip
    for kind, figures in rows.items():
        print(f"{kind:28s}", "  ".join(f"{name} {value}" for name, value in figures.items()))
    machine = {"platform": platform.platform(), "load": os.getloadavg(), "cores": os.cpu_count()}
    about = {"size": [WIDTH, HEIGHT], "frames": CLIP, "clips": len(STREETS), "threads": 1, "machine": machine}
    RESULTS.write_text(json.dumps({**about, "rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
