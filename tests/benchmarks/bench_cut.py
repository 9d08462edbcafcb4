"""Cutting every clip of a 60 s 1080p video: ours, against one ffmpeg call per clip, and against one bare ffmpeg pass.

All three encode with libx264 at the same settings and thread count. Runs are interleaved; medians of the processor time
of the whole process tree (wall time too, but that suffers from whatever else the machine does) and their ratios go to
``results/cut.json``. Ours includes Python's start, the index, hard-cut detection and the packet copies.

    python tests/benchmarks/bench_cut.py [--seconds 60] [--rounds 3]
"""

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from labeling.camera import cover_map
from labeling.encoding import EncoderSettings
from labeling.timeline import Span, copy_clip, cut_run, plan_clips, plan_runs, plan_timeline, run_name
from labeling.video import probe, read_packet_times

WIDTH, HEIGHT = 1056, 704
RESULT = Path(__file__).parent / "results" / "cut.json"


def main() -> None:
    """Measure, print a line per run, and write the JSON."""
    options = argparse.ArgumentParser()
    options.add_argument("--seconds", type=int, default=60)
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--source", type=Path, help="reuse this video instead of making one")
    options.add_argument("--ours", type=Path, nargs=2, metavar=("SOURCE", "OUT"), help=argparse.SUPPRESS)
    given = options.parse_args()
    if given.ours:
        cut_all(*given.ours)
        return
    with tempfile.TemporaryDirectory() as folder:
        source = given.source or write_drive(Path(folder) / "source.mp4", seconds=given.seconds)
        for report in measured(source, Path(folder), rounds=given.rounds):
            RESULT.parent.mkdir(exist_ok=True)
            RESULT.write_text(json.dumps(report, indent=2) + "\n")
            print(json.dumps(report["ratios"]), flush=True)


def measured(source: Path, folder: Path, *, rounds: int) -> Iterator[dict]:
    """Interleaved rounds of the three ways; the report so far after each."""
    clips = list(plan_clips(plan_timeline(read_packet_times(source).times_s)).kept)
    ways: dict[str, Callable[[], list[list[str]]]] = {
        "ours": lambda: [[sys.executable, __file__, "--ours", str(source), str(folder)]],
        "per_clip": lambda: [per_clip_command(source, clip, folder) for clip in clips],
        "bare_pass": lambda: [bare_command(source, clips[-1].end, folder)],
    }
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in ways}
    for _ in range(rounds):
        for name, commands in ways.items():
            runs[name].append(timed(commands()))
            print(name, runs[name][-1], flush=True)
        yield summary(source, len(clips), runs, json.loads((folder / "ours.json").read_text()))


def summary(source: Path, clips: int, runs: dict[str, list[dict[str, float]]], peak: dict[str, int]) -> dict:
    """Medians and ratios of what was measured so far."""
    median = {
        name: {unit: statistics.median(run[unit] for run in of_way) for unit in ("cpu_s", "wall_s")}
        for name, of_way in runs.items()
    }
    info = probe(source)
    return {
        "source": f"{info.duration_s:.0f} s {info.width}x{info.height} {info.frame_rate:.2f} fps {info.codec}",
        "clips": clips,
        "encoder": EncoderSettings().model_dump(),
        "machine": {"cpus": os.cpu_count(), "load": os.getloadavg()[0], "processor": platform.machine()},
        "versions": {"av": av.__version__, "ffmpeg": ffmpeg_version()},
        "runs": runs,
        "median": median,
        "peak_memory_mb": peak["peak_memory_mb"],
        "ratios": {
            unit: {
                "per_clip_over_ours": round(median["per_clip"][unit] / median["ours"][unit], 3),
                "ours_over_bare_pass": round(median["ours"][unit] / median["bare_pass"][unit], 3),
            }
            for unit in ("cpu_s", "wall_s")
        },
    }


def cut_all(source: Path, folder: Path) -> None:
    """Ours: index, plan, cut the runs, copy the clips out of them."""
    info = probe(source)
    timeline = plan_timeline(read_packet_times(source).times_s)
    clips = plan_clips(timeline).kept
    picture = cover_map(info.width, info.height, width=WIDTH, height=HEIGHT)
    for run in plan_runs(clips):
        out = folder / f"{run_name(run)}.mp4"
        cut_run(source, timeline, run, out, picture=picture)
        for clip in clips:
            if run.contains(clip):
                copy_clip(out, run, clip, folder / f"clip_{clip.start}.mp4")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    (folder / "ours.json").write_text(json.dumps({"peak_memory_mb": round(peak)}))


def ffmpeg() -> str:
    """The ffmpeg binary of the imageio-ffmpeg wheel."""
    import imageio_ffmpeg

    return imageio_ffmpeg.get_ffmpeg_exe()


def ffmpeg_version() -> str:
    """Its version."""
    import imageio_ffmpeg

    return imageio_ffmpeg.get_ffmpeg_version()


def per_clip_command(source: Path, clip: Span, folder: Path) -> list[str]:
    """What people do: seek, cut, scale and encode each clip by itself."""
    span = ["-ss", f"{clip.start / 24:.6f}", "-t", f"{len(clip) / 24:.6f}"]
    return [*head(), *span, "-i", str(source), *tail(source), str(folder / f"ffmpeg_{clip.start}.mp4")]


def bare_command(source: Path, frames: int, folder: Path) -> list[str]:
    """One pass over the same frames, and nothing else."""
    return [*head(), "-i", str(source), "-frames:v", str(frames), *tail(source), str(folder / "bare.mp4")]


def head() -> list[str]:
    """Decoding on one thread, as ours."""
    return [ffmpeg(), "-v", "error", "-y", "-threads", "1"]


def tail(source: Path) -> list[str]:
    """The same picture and the same encoder settings as ours."""
    info, chosen = probe(source), EncoderSettings()
    picture = cover_map(info.width, info.height, width=WIDTH, height=HEIGHT)
    scale = f"scale={picture.scaled_width}:{picture.scaled_height}"
    crop = f"crop={WIDTH}:{HEIGHT}:{picture.crop_x}:{picture.crop_y}"
    x264 = f"keyint={chosen.gop}:min-keyint={chosen.gop}:scenecut=0:open-gop=0"
    return [
        "-filter_threads", "1", "-vf", f"fps=24,{scale},{crop}", "-an", "-c:v", chosen.codec,
        "-preset", chosen.preset, "-crf", str(chosen.crf), "-bf", str(chosen.b_frames),
        "-threads", str(chosen.threads), "-x264-params", x264,
    ]  # fmt: skip


def timed(commands: list[list[str]]) -> dict[str, float]:
    """Seconds that the commands and their children took, one after the other."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    before, started = _children_cpu_s(), time.perf_counter()
    for command in commands:
        subprocess.run(command, check=True, env=environment)
    return {"cpu_s": round(_children_cpu_s() - before, 2), "wall_s": round(time.perf_counter() - started, 2)}


def _children_cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def write_drive(path: Path, *, seconds: int, fps: int = 30) -> Path:
    """A textured, grainy scene that is driven past, 1080p, encoded with x264's own choice of keyframes."""
    width, height = 1920, 1080
    rng = np.random.default_rng(0)
    ground = _texture(rng, height, 4 * width)
    car = _texture(rng, 220, 360)
    noise = rng.normal(scale=4.0, size=(2 * height, 2 * width)).astype(np.float32)
    with av.open(str(path), "w") as container:
        options = {"preset": "veryfast", "crf": "23"}
        stream = container.add_stream("libx264", rate=Fraction(fps), options=options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.thread_count = 2
        for i in range(seconds * fps):
            left = int((1 + np.sin(i / (6.0 * fps))) * 1.45 * width)
            picture = ground[:, left : left + width].copy()
            x, y = 200 + (i * 5) % 1300, 600 + int(60 * np.sin(i / 20))
            picture[y : y + 220, x : x + 360] = car
            down, right = rng.integers(0, height), rng.integers(0, width)
            grain = noise[down : down + height, right : right + width]
            picture = np.clip(picture + grain, 16, 235).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="gray").reformat(format="yuv420p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def _texture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Grey noise at several scales."""
    total = np.zeros((height, width), np.float32)
    for step in (4, 16, 64, 256):
        coarse = rng.normal(size=(height // step + 2, width // step + 2)).astype(np.float32)
        rows, columns = np.arange(height) / step, np.arange(width) / step
        total += step**0.5 * _bilinear(coarse, rows, columns)
    return np.clip(128 + 5 * total, 16, 235).astype(np.uint8)


def _bilinear(coarse: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    y, x = rows.astype(int), columns.astype(int)
    fy, fx = (rows - y)[:, None], (columns - x)[None]
    top = coarse[y][:, x] * (1 - fx) + coarse[y][:, x + 1] * fx
    bottom = coarse[y + 1][:, x] * (1 - fx) + coarse[y + 1][:, x + 1] * fx
    return top * (1 - fy) + bottom * fy


if __name__ == "__main__":
    main()
