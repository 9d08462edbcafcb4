"""Networks at several batch sizes and thread counts: ms per frame or crop; and parity with rtmlib on every frame.

Runs are interleaved; medians of processor time (all threads) and wall time go to ``results/batches.json``: YOLOX-nano
on real frames, a whole-body SimCC head of random weights, and every shipped street model whose weights are there. On a
machine with a GPU, ``--providers cuda`` measures that. Wall times mean something on a quiet machine only: see the load.

    python tests/benchmarks/bench_batches.py [--rounds 7] [--providers cpu] [--parity]
"""

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import onnx_fixtures
from conftest import real_data_folder

from labeling.detection import Detector
from labeling.fields import FieldModel
from labeling.keypoints import KeypointHead
from labeling.model_cards import CifcafCard, ModelCard, SimccCard, YoloxCard, find_weights, load_cards

BATCHES = (1, 2, 4, 8, 16)
FRAMES = 16
RESULTS = Path(__file__).parent / "results"


def main() -> None:
    """Measure, print a line per case, and write the JSON."""
    options = argparse.ArgumentParser()
    options.add_argument("--rounds", type=int, default=7)
    options.add_argument("--providers", nargs="+", default=["cpu"])
    options.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    options.add_argument("--parity", action="store_true", help="compare with rtmlib on every frame instead")
    given = options.parse_args()
    cv2.setNumThreads(1)
    RESULTS.mkdir(exist_ok=True)
    if given.parity:
        report = compare_with_rtmlib()
        print(json.dumps(report, indent=2))
        (RESULTS / "parity_rtmlib.json").write_text(json.dumps(report, indent=2) + "\n")
        return
    with tempfile.TemporaryDirectory() as folder:
        cases = measure(Path(folder), rounds=given.rounds, providers=given.providers, threads=given.threads)
    report = {
        "what": f"ms per frame (detectors, fields) or crop (heads), {FRAMES} of them, pre- and postprocessing included",
        "providers": given.providers, "rounds": given.rounds, "cases": cases,
        "machine": {"cpu": platform.machine(), "cores": os.cpu_count(), "onnxruntime": onnxruntime.__version__,
                    "load_average": round(os.getloadavg()[0], 1)},
    }  # fmt: skip
    (RESULTS / "batches.json").write_text(json.dumps(report, indent=2) + "\n")


def measure(folder: Path, *, rounds: int, providers: list[str], threads: list[int]) -> list[dict]:
    """Every model at every batch size and thread count, interleaved."""
    frames = list(every_frame(limit=FRAMES))
    runs = [
        (card.name, batch, count, open_runner(card, path, frames, providers=providers, threads=count, batch=batch))
        for card, path in models(folder)
        for batch in BATCHES
        for count in threads
    ]
    spent: dict[tuple[str, int, int], list[tuple[float, float]]] = {run[:3]: [] for run in runs}
    for number in range(rounds + 1):
        for name, batch, count, runner in runs:
            cpu, wall = time.process_time(), time.perf_counter()
            runner()
            if number:  # the first round warms up
                took = time.process_time() - cpu, time.perf_counter() - wall
                spent[name, batch, count].append(took)
    cases = []
    for (name, batch, count), values in spent.items():
        cpu_ms, wall_ms = (np.median(values, axis=0) / FRAMES * 1e3).round(2).tolist()
        print(f"{name:18} batch {batch:2}, {count} threads: {cpu_ms:8.2f} ms CPU, {wall_ms:8.2f} ms wall")
        cases.append({"model": name, "batch": batch, "threads": count, "cpu_ms": cpu_ms, "wall_ms": wall_ms})
    return cases


def models(folder: Path) -> Iterator[tuple[ModelCard, Path]]:
    """The cards that can be run here, with their weights."""
    cards = load_cards()
    real = real_data_folder() / cards["yolox_nano"].file
    if real.is_file():
        yield cards["yolox_nano"], real
    head = whole_body_card()
    yield (
        head,
        onnx_fixtures.random_simcc(folder / head.file, points=133, width=head.input_width, height=head.input_height),
    )
    for name, card in cards.items():
        path = find_weights(card, folder)
        if name.startswith("street") and path is not None:
            yield card, path


def whole_body_card() -> SimccCard:
    """A card for a random head of DWPose's size."""
    values = {
        "name": "random_head",
        "file": "head.onnx",
        "schema": "wholebody133",
        "licence": "none",
        "source": "random",
    }
    return SimccCard.model_validate({**values, "input_width": 288, "input_height": 384})


def open_runner(
    card: ModelCard, path: Path, frames: list[np.ndarray], *, providers: list[str], threads: int, batch: int
):
    """A call that runs the model on all frames, one box in each for a head."""
    kwargs = {"providers": providers, "threads": threads, "max_batch": batch}
    if isinstance(card, YoloxCard):
        detector = Detector(card, path, **kwargs)
        return lambda: [detector.detect(frames[i : i + batch]) for i in range(0, len(frames), batch)]
    if isinstance(card, SimccCard):
        head = KeypointHead(card, path, **kwargs)
        boxes = [np.array([[300, 200, 400, 420]], np.float32)] * len(frames)
        return lambda: head.estimate(frames, boxes)
    assert isinstance(card, CifcafCard)
    fields = FieldModel(card, path, **kwargs)
    return lambda: fields.estimate(frames)


def every_frame(*, limit: int | None = None) -> Iterator[np.ndarray]:
    """Frames of the real drive, RGB; noise where it is absent."""
    path = real_data_folder() / "solidWhiteRight.mp4"
    if not path.is_file():
        rng = np.random.default_rng(0)
        yield from (rng.integers(0, 256, (540, 960, 3), dtype=np.uint8) for _ in range(limit or 1))
        return
    capture, number = cv2.VideoCapture(str(path)), 0
    while (limit is None or number < limit) and capture.grab():
        yield np.ascontiguousarray(capture.retrieve()[1][:, :, ::-1])
        number += 1


def compare_with_rtmlib() -> dict:
    """The worst departure of boxes and keypoints from rtmlib, over all frames, and the frames whose counts differ."""
    from rtmlib import YOLOX, RTMPose

    card = load_cards()["yolox_nano"]
    assert isinstance(card, YoloxCard)
    path = real_data_folder() / card.file
    size = card.input_height, card.input_width
    peer = YOLOX(str(path), size, "multiclass", nms_thr=card.nms_threshold, score_thr=card.score_threshold)
    detector = Detector(card, path)
    head_card = whole_body_card()
    with tempfile.TemporaryDirectory() as folder:
        head_path = onnx_fixtures.random_simcc(Path(folder) / head_card.file, points=133, width=288, height=384)
        head, peer_head = KeypointHead(head_card, head_path), RTMPose(str(head_path), (288, 384))
        report = {
            "frames": 0,
            "boxes": 0,
            "frames_with_other_counts": 0,
            "worst_box_px": 0.0,
            "points": 0,
            "worst_point_px": 0.0,
        }
        for frame in every_frame():
            (found,) = detector.detect([frame])
            boxes, labels = peer(np.ascontiguousarray(frame[:, :, ::-1]))
            boxes = np.clip(np.reshape(boxes, (-1, 4)), 0, [frame.shape[1], frame.shape[0]] * 2)
            names = [card.class_names[label] for label in labels]
            report["frames"] += 1
            report["boxes"] += len(boxes)
            report["frames_with_other_counts"] += sorted(names) != sorted(found.classes)
            for name, box in zip(names, boxes, strict=True):
                mine = found.boxes_xyxy[found.classes == name]
                if len(mine):
                    report["worst_box_px"] = max(report["worst_box_px"], float(np.abs(mine - box).max(axis=1).min()))
            if len(boxes):
                (points,) = head.estimate([frame], [boxes])
                theirs, _ = peer_head(frame, list(boxes))
                apart = np.abs(points[..., :2] - theirs)[points[..., 2] > 0]
                report["points"] += len(apart)
                report["worst_point_px"] = max(report["worst_point_px"], float(apart.max()))
    return report


if __name__ == "__main__":
    main()
