"""``animatic chart generate``: ms a clip against error for denoising steps, guidance and number of motion drafts."""

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from labeling.labels import Keypoints
from labeling.skeleton_video import draw_skeletons
from pipelines.charts import Chart, ChartPoint, Cost, Error, interleaved_ms, machine_name
from training.backbone import SamplingSettings
from training.backbones import load_backbone
from training.clip_generator import ClipConditions, ClipGenerator
from training.config import Stage, backbone_config, load_config
from training.latents import cache_latents
from training.trainer import train

_WIDTH, _HEIGHT, _FRAMES = 96, 64, 17
_PICTURE = {"control_width": _WIDTH, "control_height": _HEIGHT, "rgb_width": _WIDTH, "rgb_height": _HEIGHT}
_FUTURES = 6
_MANY_STEPS = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class _Method:
    steps: int
    drafts: int = 1
    guidance: float = 3.0

    @property
    def name(self) -> str:
        drafts = f", {self.drafts} drafts" if self.drafts > 1 else ""
        guidance = "" if self.guidance == 3.0 else ", no guidance" if self.guidance == 1 else f", g {self.guidance:g}"
        return f"{self.steps} step{'s' if self.steps > 1 else ''}{drafts}{guidance}"

    @property
    def sampling(self) -> SamplingSettings:
        return SamplingSettings(steps=self.steps, guidance=self.guidance)


_REFERENCE = _Method(steps=_MANY_STEPS, drafts=_FUTURES)
_TRIVIAL = _Method(steps=1, guidance=1.0)
_METHODS = (
    _TRIVIAL, _Method(steps=4), _Method(steps=10), _Method(steps=30), _Method(steps=10, guidance=1.0),
    _Method(steps=10, guidance=6.0), _Method(steps=4, drafts=6), _Method(steps=10, drafts=3),
    _Method(steps=10, drafts=6), _Method(steps=30, drafts=6), _REFERENCE,
)  # fmt: skip


def chart(name: str, *, quick: bool = False) -> Chart:
    """A clip is n motion drafts, of which one is painted; the tiny backbone, taught for a minute.

    Six futures are drawn with 100 steps. The first error asks how near to each of them the nearest draft comes, the
    second how far a draft is from what 100 steps make of the same noise; both over the mean distance between futures.
    Draft i starts from the noise of future i: six drafts lack only what fewer steps cost, one lacks five futures.
    """
    methods = (_TRIVIAL, _METHODS[1], _REFERENCE) if quick else _METHODS
    with tempfile.TemporaryDirectory() as folder, _one_thread():
        generator = _taught(Path(folder), steps=4 if quick else 150)
        conditions = _Walk(key="walk_0", speed=2.0).conditions()
        futures = _drafts(generator, conditions, _REFERENCE)
        points = [_errors(_drafts(generator, conditions, method), futures) for method in methods]
        clips = [partial(_clip, generator, conditions, method) for method in methods]
        costs = interleaved_ms(clips, runs=1 if quick else 5)
    return Chart(
        stage=name, cost="ms_per_clip", machine=machine_name(),
        data=f"tiny backbone, {_FRAMES} frames of {_WIDTH}x{_HEIGHT}, n motion drafts and one painted",
        points=tuple(_point(*row) for row in zip(methods, costs, points, strict=True)),
    )  # fmt: skip


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """As the chart says: processor time counts threads that wait for one another as well."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _clip(generator: ClipGenerator, conditions: ClipConditions, method: _Method) -> int:
    """Draw the drafts and paint the first; one clip."""
    drafts = _drafts(generator, conditions, method)
    generator.paint(conditions, drafts[0], settings=method.sampling)
    return 1


def _drafts(generator: ClipGenerator, conditions: ClipConditions, method: _Method) -> torch.Tensor:
    """(n, C, F, H, W) latents; draft i of every method starts from the same noise."""
    drawn = [generator.draft(conditions, number=number, settings=method.sampling) for number in range(method.drafts)]
    return torch.stack(drawn)


def _errors(drafts: torch.Tensor, futures: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """(each future's distance to the nearest draft, each draft's to its own future), over the futures' spread."""
    between = _distances(futures, futures)
    spread = float(between[~np.eye(len(futures), dtype=bool)].mean())
    found = _distances(futures, drafts) / spread
    return found.min(axis=1), np.diagonal(found)


def _distances(first: torch.Tensor, second: torch.Tensor) -> np.ndarray:
    """(n, m) root mean squared differences; the first latent frame, which is given, does not count."""
    pairs = [[(a[:, 1:] - b[:, 1:]).square().mean().sqrt().item() for b in second] for a in first]
    return np.array(pairs)


def _point(method: _Method, cost: Cost, errors: tuple[np.ndarray, np.ndarray]) -> ChartPoint:
    nearest, own = (
        Error(
            metric=metric, unit="of their spread", median=float(np.median(values)), p95=float(np.percentile(values, 95))
        )
        for metric, values in zip(("six futures to the nearest draft", "draft to its own future"), errors, strict=True)
    )
    return ChartPoint(
        method=method.name, ms_per_frame=cost, error=nearest, more_errors=(own,),
        settings={"steps": method.steps, "guidance": method.guidance, "drafts": method.drafts},
        reference=method in (_REFERENCE, _TRIVIAL),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class _Walk:
    """A person who crosses at a speed that the first frame does not tell; what ``cache_latents`` reads of a clip."""

    key: str
    speed: float
    """Pixels a frame."""
    meta: dict[str, Any] = field(default_factory=lambda: {"width": _WIDTH, "height": _HEIGHT})

    @property
    def caption(self) -> str:
        return "A person crosses."

    @property
    def cam_to_world(self) -> np.ndarray:
        return np.tile(np.eye(4), (_FRAMES, 1, 1))

    def keypoints(self) -> list[Keypoints]:
        return [_walker(frame, x=30 + self.speed * frame) for frame in range(_FRAMES)]

    def frames(self, suffix: str) -> np.ndarray:
        """Bright where the person is, on a grey ramp."""
        ramp = np.tile(np.linspace(40, 160, _WIDTH), (_HEIGHT, 1))[None, :, :, None]
        video = np.repeat(np.repeat(ramp, _FRAMES, axis=0), 3, axis=3).astype(np.uint8)
        for frame, label in enumerate(self.keypoints()):
            left, top, right, bottom = label.box_xyxy.astype(int)
            video[frame, max(0, top) : bottom, max(0, left) : max(0, right)] = (230, 90, 60)
        return video

    def conditions(self) -> ClipConditions:
        first = [label for label in self.keypoints() if label.frame == 0]
        skeleton = draw_skeletons(first, width=_WIDTH, height=_HEIGHT, label_width=_WIDTH, label_height=_HEIGHT)
        return ClipConditions(image=self.frames("rgb.mp4")[0], caption=self.caption, first_control=skeleton)


def _walker(frame: int, *, x: float) -> Keypoints:
    points = np.ones((17, 3), np.float32)
    points[:, 0], points[:, 1] = x + 8 * np.cos(np.arange(17)), 12 + 2.5 * np.arange(17)
    return Keypoints(
        frame=frame, track_id=1, category="person", schema="coco17", score=1.0, points=points,
        box_xyxy=np.array([x - 8, 12, x + 8, 54], np.float32), point_source=np.ones(17, np.int8),
    )  # fmt: skip


def _taught(folder: Path, *, steps: int) -> ClipGenerator:
    """A generator whose two adapters have seen people cross at eight speeds."""
    walks = [_Walk(key=f"walk_{place}", speed=speed) for place, speed in enumerate(np.linspace(-3, 5, 8).tolist())]
    datasets: dict[str, Sequence[_Walk]] = {"train": walks, "val": []}
    cache_latents(folder, backbone_name="tiny", picture=_PICTURE, datasets=datasets)
    adapters: dict[Stage, Path] = {"motion": folder / "motion", "appearance": folder / "appearance"}
    for stage, out in adapters.items():
        config = load_config(
            "tiny", stage=stage,
            overrides={
                "backbone": {"picture": _PICTURE}, "trackers": [], "validation": {"loss_every_steps": 0},
                "optimiser": {"steps": steps, "schedule": "cosine"}, "adapter": {"rank": 16},
                "conditions": {"ego_probability": 0.0, "objects_probability": 0.0},
                "checkpoint": {"every_steps": 10**6},
            },
        )  # fmt: skip
        train(config, data=folder, out=out, quiet=True)
    backbone = load_backbone(backbone_config("tiny", picture=_PICTURE))
    return ClipGenerator(backbone, motion=adapters["motion"], appearance=adapters["appearance"])
