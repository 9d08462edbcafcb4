"""``animatic chart detect``: milliseconds a frame against objects missed, and against phantoms.

The shipped street detector at several input sizes, in int8, on two threads, and in rtmlib, on frames whose truth is
known; beside them, in the settings, YOLOX-nano on the real drive in our decoder and in rtmlib's.
"""

import importlib.util
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from labeling.detection import Detector
from labeling.extractors import ExtractorChoice
from labeling.labels import POINT_ABSENT, Keypoints
from labeling.model_cards import YoloxCard, load_cards
from labeling.video import read_frames
from pipelines.charts import Chart, ChartPoint, Cost, Error, machine_name
from pipelines.charts_keypoints import keypoint_clips
from pipelines.ego_clips import real_folder
from pipelines.keypoint_clips import HEIGHT, WIDTH, KeypointClip, pooled_names, street_extractors
from pipelines.keypoint_errors import match_frames, phantom_frames, recall
from pipelines.model_variants import int8_choice, resized_detector
from pipelines.peers import rtmlib_detector

TRIVIAL = "nothing found"
_SIZES = ((768, 512), (480, 320), (352, 224))
_EVERY = 6
_REAL_FRAMES = 60
_SCHEMA = {"car": "car24", "person": "coco17"}

Found = list[tuple[str, np.ndarray, float]]
"""Category, box (4,), score of each object of a frame."""
Method = Callable[[np.ndarray], Found]


def chart(name: str, *, quick: bool = False) -> Chart:
    """Share of judged objects (at least 32 px high, 30 % visible) that are missed, and of frames with a phantom.

    An error's upper end is its worst clip.

    Raises:
        ModelError: the street detector's weights are not there.
    """
    clips = keypoint_clips(quick=quick)
    choice = street_extractors().choice
    left_out: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        methods = _methods(choice, clips, Path(folder), left_out)
        spent, found = _run(methods, clips)
    real = _real_drive(left_out, frames=4 if quick else _REAL_FRAMES)
    points = tuple(_point(method, spent[method], found[method], clips, real) for method in methods)
    data = f"every {_EVERY}th of the frames of {WIDTH}x{HEIGHT}: {pooled_names(clips)}"
    return Chart(stage=name, data=data, points=points, machine=machine_name(), left_out=tuple(left_out))


def _methods(
    choice: ExtractorChoice, clips: Sequence[KeypointClip], folder: Path, left_out: list[str]
) -> dict[str, Method]:
    ours = street_extractors().detector
    assert ours is not None
    card = ours.card
    small = int8_choice(ExtractorChoice(detector=card), clips[-1:], folder).detector
    twice = street_extractors(threads=2).detector
    assert small is not None and twice is not None
    methods: dict[str, Method] = {TRIVIAL: lambda _: []}
    for width, height in _SIZES:
        other = resized_detector(card, folder, width=width, height=height)
        methods[f"{width}x{height}"] = partial(_ours, detector=Detector(other, folder / other.file))
    methods[f"{card.input_width}x{card.input_height} (shipped)"] = partial(_ours, detector=ours)
    methods["int8"] = partial(_ours, detector=Detector(small, folder / small.file))
    methods["2 threads"] = partial(_ours, detector=twice)
    if importlib.util.find_spec("rtmlib"):
        methods["rtmlib, same file"] = partial(_rtmlib, card=card, detect=rtmlib_detector(card))
    else:
        left_out.append("rtmlib: not installed (pip install --no-deps rtmlib==0.0.16)")
    return methods


def _ours(frame: np.ndarray, *, detector: Detector) -> Found:
    (found,) = detector.detect([frame])
    return [
        (str(category), box, float(score))
        for category, box, score in zip(found.categories, found.boxes_xyxy, found.scores, strict=True)
    ]


def _rtmlib(frame: np.ndarray, *, card: YoloxCard, detect: Callable[[np.ndarray], Any]) -> Found:
    boxes, classes = detect(np.ascontiguousarray(frame[:, :, ::-1]))
    boxes = np.clip(np.asarray(boxes).reshape(-1, 4), 0, [frame.shape[1], frame.shape[0]] * 2)
    return [(card.categories[card.class_names[i]], box, 1.0) for box, i in zip(boxes, classes, strict=True)]


def _run(
    methods: dict[str, Method], clips: Sequence[KeypointClip]
) -> tuple[dict[str, list[float]], dict[str, list[list[Keypoints]]]]:
    """Milliseconds of each frame, and each clip's labels, by method; methods take turns frame by frame."""
    spent: dict[str, list[float]] = {method: [] for method in methods}
    found: dict[str, list[list[Keypoints]]] = {method: [[] for _ in clips] for method in methods}
    for detect in methods.values():
        detect(clips[0].frames[0])
    for n, clip in enumerate(clips):
        for number, frame in enumerate(clip.frames[::_EVERY]):
            for method, detect in methods.items():
                start = time.process_time()
                objects = detect(frame)
                spent[method].append((time.process_time() - start) * 1000)
                found[method][n] += [_label(number, *thing) for thing in objects if thing[0] in _SCHEMA]
    return spent, found


def _label(frame: int, category: str, box: np.ndarray, score: float) -> Keypoints:
    count = 24 if category == "car" else 17
    return Keypoints(
        frame=frame, category="car" if category == "car" else "person", schema=_SCHEMA[category], score=score,
        box_xyxy=np.asarray(box, np.float32), points=np.zeros((count, 3), np.float32),
        point_source=np.full(count, POINT_ABSENT, np.int8),
    )  # fmt: skip


def _point(
    method: str,
    spent: list[float],
    found: list[list[Keypoints]],
    clips: Sequence[KeypointClip],
    real: dict[str, float],
) -> ChartPoint:
    matched = [match_frames(labels, clip.truth[::_EVERY]) for labels, clip in zip(found, clips, strict=True)]
    missed, phantoms = [], []
    for frames in matched:
        hits, asked = recall(frames)
        missed.append(100 * (1 - hits / asked) if asked else np.nan)
        phantoms.append(100 * phantom_frames(frames))
    every = [frame for frames in matched for frame in frames]
    hits, asked = recall(every)
    settings: dict[str, Any] = {
        "car_recall": _share(recall(every, category="car")), "person_recall": _share(recall(every, category="person")),
    }  # fmt: skip
    if method in ("rtmlib, same file",) or method.endswith("(shipped)"):
        settings["yolox_nano_on_the_real_drive_ms"] = real
    return ChartPoint(
        method=method, settings=settings, reference=method == TRIVIAL,
        ms_per_frame=Cost(
            median=float(np.median(spent)), p95=float(np.percentile(spent, 95)), runs=len(spent), over="frames"
        ),
        error=Error(
            metric="cars and people missed", unit="%", median=100 * (1 - hits / max(1, asked)),
            p95=float(np.nanmax(missed)),
        ),
        more_errors=(
            Error(
                metric="frames with a phantom", unit="%", median=100 * phantom_frames(every),
                p95=float(np.max(phantoms)),
            ),
        ),
    )  # fmt: skip


def _share(counts: tuple[int, int]) -> float | None:
    return round(counts[0] / counts[1], 4) if counts[1] else None


def _real_drive(left_out: list[str], *, frames: int) -> dict[str, float]:
    """Milliseconds a frame of YOLOX-nano on the real drive, by software; empty where the real material is absent."""
    video, weights = real_folder() / "solidWhiteRight.mp4", real_folder() / "yolox_nano.onnx"
    if not (video.is_file() and weights.is_file()):
        left_out.append("YOLOX-nano on the real drive: its video and weights are not there (ANIMATIC_REAL_DATA)")
        return {}
    card = load_cards()["yolox_nano"]
    assert isinstance(card, YoloxCard)
    detector = Detector(card, weights)
    pictures = [frame.copy() for _, frame in zip(range(frames), read_frames(video), strict=False)]
    methods: dict[str, Callable[[np.ndarray], Any]] = {"ours": lambda frame: detector.detect([frame])}
    if importlib.util.find_spec("rtmlib"):
        peer = rtmlib_detector(card, weights)
        methods["rtmlib"] = lambda frame: peer(np.ascontiguousarray(frame[:, :, ::-1]))
    spent: dict[str, list[float]] = {name: [] for name in methods}
    for picture in pictures:
        for name, detect in methods.items():
            start = time.process_time()
            detect(picture)
            spent[name].append((time.process_time() - start) * 1000)
    return {name: round(float(np.median(values)), 2) for name, values in spent.items()}
