"""Small jobs for tests: short videos, small pictures, and a detector that counts by brightness."""

import functools
from pathlib import Path

import numpy as np
from onnx import helper
from onnx_fixtures import save_graph

from dataset.receipts import Receipt
from labeling.encoding import EncoderSettings, VideoWriter
from labeling.model_cards import YoloxCard, file_sha256, write_card
from pipelines.config import Config, merged
from pipelines.engine import Engine
from pipelines.job import Job
from pipelines.label import StageReport, run_stages
from pipelines.stage import STAGES, Part

WIDTH, HEIGHT, CLIP = 96, 64, 9

SMALL = {
    "clip": {"clip_frames": CLIP, "stride_frames": 8, "run_frames": 48},
    "picture": {"width": WIDTH, "height": HEIGHT},
    "encoder": {"gop": 4, "preset": "ultrafast"},
    "views": {
        "width": WIDTH, "height": HEIGHT, "skeleton_encoder": {"gop": 4}, "view_encoder": {"gop": 4},
    },
}  # fmt: skip
"""Settings under which a clip is 9 frames of 96x64."""


def small_config(**changes: object) -> Config:
    """``SMALL`` with changes."""
    return merged(merged(Config(), SMALL), changes)


def write_street(
    path: Path, *, frames: int = 48, level: int = 90, seed: int = 0, fps: int = 24, slide: int = 2
) -> Path:
    """A camera that slides over a noise texture by ``slide`` pixels a frame; ``level`` is the mean grey value."""
    texture = np.random.default_rng(seed).integers(-60, 60, (HEIGHT // 4, WIDTH, 1)).repeat(4, 0).repeat(4, 1)
    settings = EncoderSettings(gop=12, preset="ultrafast")
    path.parent.mkdir(parents=True, exist_ok=True)
    with VideoWriter(path, width=WIDTH, height=HEIGHT, fps=fps, settings=settings) as writer:
        for index in range(frames):
            window = texture[:, slide * index % WIDTH :][:, :WIDTH]
            picture = np.concatenate([window, texture], axis=1)[:, :WIDTH]
            writer.write(np.clip(np.repeat(picture, 3, axis=2) + level, 0, 255).astype(np.uint8))
    return path


def write_detector(folder: Path, *, name: str = "counter") -> Path:
    """A YOLOX whose picture holds one car more for every 32 grey levels of its mean brightness; the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    size = 64
    cells = sum((size // stride) ** 2 for stride in (8, 16, 32))
    rows = np.zeros((1, cells, 6), np.float32)
    rows[..., 5] = 1.0
    thresholds = np.full((1, cells, 1), 1e6, np.float32)
    thresholds[0, :64:9, 0] = 32.0 * np.arange(1, 9)
    mask = np.zeros((1, 1, 6), np.float32)
    mask[..., 4] = 1.0
    nodes = [
        helper.make_node("ReduceMean", ["images"], ["mean"], axes=[1, 2, 3], keepdims=1),
        helper.make_node("Reshape", ["mean", "shape"], ["level"]),
        helper.make_node("Sub", ["level", "thresholds"], ["above"]),
        helper.make_node("Sigmoid", ["above"], ["sure"]),
        helper.make_node("Mul", ["sure", "mask"], ["objectness"]),
        helper.make_node("Add", ["objectness", "rows"], ["output"]),
    ]
    save_graph(
        folder / f"{name}.onnx", nodes, inputs={"images": [1, 3, size, size]}, outputs={"output": [1, cells, 6]},
        weights={"shape": np.array([1, 1, 1]), "thresholds": thresholds, "mask": mask, "rows": rows},
    )  # fmt: skip
    card = YoloxCard(
        name=name, file=f"{name}.onnx", sha256=file_sha256(folder / f"{name}.onnx"), input_width=size,
        input_height=size, classes=("car",), categories={"car": "car"}, licence="Apache-2.0", source="a test",
    )  # fmt: skip
    write_card(card, folder / f"{name}.toml")
    return folder


class SilentReporter:
    """Remembers what was made."""

    def __init__(self) -> None:
        self.made: list[Receipt] = []
        self.waits: list[str] = []

    def stage_started(self, stage: str, *, items: int, weight: float, current: int) -> None:
        """Nothing is shown."""

    def item_finished(self, receipt: Receipt, *, weight: float) -> None:
        """Remember it."""
        self.made.append(receipt)

    def stage_finished(self, report: StageReport) -> None:
        """Nothing is shown."""

    def waiting(self, message: str) -> None:
        """Remember what was waited for."""
        self.waits.append(message)


def run_all(job: Job, *, workers: int = 0, part: Part | None = None, stages: tuple[str, ...] = tuple(STAGES)):
    """Run stages; what was made, as (stage, item) pairs, and the reports."""
    reporter = SilentReporter()
    job.root.mkdir(parents=True, exist_ok=True)
    job.save()
    job.refresh()
    with Engine(job.root, workers=workers) as engine:
        reports = run_stages(job, stages, engine, reporter, part=part)
    return [(receipt.stage, receipt.item) for receipt in reporter.made], reports


def tree(root: Path) -> dict[str, bytes]:
    """Every output of a job with its bytes: all files but receipts, settings and staging."""
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.relative_to(root).parts[0] not in ("receipts", "job.yaml", ".staging")
    }


@functools.cache
def tiny_text() -> str:
    """What a text file named .mp4 holds."""
    return "this is no video\n" * 100
