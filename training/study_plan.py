"""What the study compares, at what sizes, and how its budget is spent. Pure: no file, no network, no clock.

Compute is counted in tokens: one step of a batch of B sequences of N tokens is B N tokens through the network. Each arm
gets the same number of tokens in training; an arm of two stages spends half on each. Minutes of the budget become
numbers of steps by nominal costs, so that the same budget gives the same study on every machine.
"""

import math
from dataclasses import dataclass
from typing import Literal

from labeling.errors import ConfigError
from training.config import PictureConfig, Stage
from training.ltx import LTX_GEOMETRY
from training.study_base import BasePlan

QuestionName = Literal["decoupling", "noise", "control: segmentation", "control: boxes", "rate"]
DEFAULT_MINUTES = 360.0
"""Processor minutes: 3 h of 2 cores."""
JUDGED_EVERY = 2
"""Native frames between judged ones: what the halved rate has too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyScale:
    """Sizes and counts."""

    width: int = 96
    height: int = 64
    frames: int = 17
    """At the native rate; the halved rate shows the same time in half the frames, and one."""
    clip_fps: float = 12.0
    """The native rate, which the general video model is taught at."""
    train_clips: int = 60
    val_clips: int = 15
    """Each from a street of its own."""
    samples: int = 6
    seeds: int = 3
    sampling_steps: int = 8
    batch: int = 8
    rank: int = 32
    """Of the adapters."""

    @property
    def label_width(self) -> int:
        """Streets are drawn, and judged, at twice the size."""
        return 2 * self.width

    @property
    def label_height(self) -> int:
        """See ``label_width``."""
        return 2 * self.height

    def picture(self, frame_step: int) -> PictureConfig:
        """The sizes at a frame rate: every frame or every second."""
        return PictureConfig(
            control_width=self.width, control_height=self.height, rgb_width=self.width, rgb_height=self.height,
            frames=(self.frames - 1) // frame_step + 1, frame_step=frame_step, clip_fps=self.clip_fps,
        )  # fmt: skip

    def video_tokens(self, frame_step: int) -> int:
        """Latent cells of one video."""
        frames = (self.frames - 1) // frame_step + 1
        _, groups, rows, columns = LTX_GEOMETRY.latent_shape(frames=frames, height=self.height, width=self.width)
        return groups * rows * columns


@dataclass(frozen=True, slots=True, kw_only=True)
class StageRun:
    """One adapter to train; arms that share one train it once."""

    stage: Stage
    control: str = "skeleton"
    frame_step: int = 1
    omega_max: float = 0.0
    """Of the targeted noise; appearance only."""

    @property
    def name(self) -> str:
        """For folders and records."""
        noise = "-noise" if self.omega_max else ""
        return f"{self.stage}-{self.control}-every{self.frame_step}{noise}"

    def tokens(self, scale: StudyScale) -> int:
        """Of one sequence: the ego video and the first picture, or the control video, and the target."""
        video = scale.video_tokens(self.frame_step)
        image = scale.width * scale.height // LTX_GEOMETRY.spatial**2 if self.stage == "motion" else 0
        return 2 * video + image

    def steps(self, scale: StudyScale, tokens: int) -> int:
        """Steps that ``tokens`` pay for, at least one."""
        return max(1, round(tokens / (scale.batch * self.tokens(scale))))


@dataclass(frozen=True, slots=True, kw_only=True)
class Arm:
    """One way of making street videos."""

    name: str
    runs: tuple[StageRun, ...]
    """Motion and appearance, or the baseline alone."""

    @property
    def frame_step(self) -> int:
        """Native frames per frame."""
        return self.runs[0].frame_step

    @property
    def control(self) -> str | None:
        """The intermediate representation; None where there is none."""
        return None if self.runs[0].stage == "end_to_end" else self.runs[0].control


def two_stages(name: str, *, control: str = "skeleton", frame_step: int = 1, omega_max: float = 0.0) -> Arm:
    """Motion, then appearance."""
    motion = StageRun(stage="motion", control=control, frame_step=frame_step)
    appearance = StageRun(stage="appearance", control=control, frame_step=frame_step, omega_max=omega_max)
    return Arm(name=name, runs=(motion, appearance))


ARMS: tuple[Arm, ...] = (
    two_stages("method", omega_max=0.3),
    two_stages("no noise"),
    Arm(name="end to end", runs=(StageRun(stage="end_to_end"),)),
    two_stages("segmentation", control="segmentation"),
    two_stages("boxes", control="boxes"),
    two_stages("half rate", frame_step=2, omega_max=0.3),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """Two arms, the first of which the method prefers."""

    name: QuestionName
    text: str
    first: str
    second: str


QUESTIONS: tuple[Question, ...] = (
    Question(name="decoupling", text="motion + appearance against end to end", first="method", second="end to end"),
    Question(name="noise", text="targeted noise against none", first="method", second="no noise"),
    Question(
        name="control: segmentation", text="skeletons against segmentation", first="no noise", second="segmentation"
    ),
    Question(name="control: boxes", text="skeletons against boxes", first="no noise", second="boxes"),
    Question(name="rate", text="native against halved frame rate", first="method", second="half rate"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyPlan:
    """A budget, spent."""

    minutes: float
    """Processor minutes in all, nominal."""
    scale: StudyScale
    base: BasePlan
    detector_steps: int
    pair_steps: int
    arm_tokens: int
    """Through the network while an arm is trained, over all its stages."""

    def steps(self, arm: Arm, run: StageRun) -> int:
        """Optimiser steps of one of an arm's stages."""
        return run.steps(self.scale, self.arm_tokens // len(arm.runs))


SHARES = {"denoiser": 0.13, "detector": 0.15, "pair": 0.05, "arms": 0.32}
"""Of the budget; the rest fits the VAE, draws and encodes streets, samples and judges."""
COSTS_S = {"denoiser": 0.08, "detector": 0.2, "pair": 0.08, "token": 2.4e-4}
"""Nominal processor seconds of one step, and of one token in training (AMD EPYC, one thread)."""
_LEAST_MINUTES = 5.0


def plan_study(minutes: float = DEFAULT_MINUTES, *, quick: bool = False) -> StudyPlan:
    """How a budget is spent; ``quick`` is a smoke run of seconds that shows nothing.

    Raises:
        ConfigError: fewer than five minutes, or no number.
    """
    if quick:
        scale = StudyScale(train_clips=2, val_clips=2, samples=2, seeds=1, sampling_steps=2, batch=2, rank=4)
        base = BasePlan(vae_videos=20, denoiser_steps=2, videos=2)
        return StudyPlan(minutes=0.3, scale=scale, base=base, detector_steps=2, pair_steps=2, arm_tokens=200)
    if not _LEAST_MINUTES <= minutes < math.inf:
        raise ConfigError(
            f"a budget of {minutes:g} minutes cannot be spent on a study; give a number from {_LEAST_MINUTES:g} on "
            "(less is gone before anything is learnt)"
        )
    scale = _scale(minutes)
    steps = {name: max(1, round(60 * minutes * SHARES[name] / COSTS_S[name])) for name in COSTS_S if name in SHARES}
    return StudyPlan(
        minutes=minutes, scale=scale, detector_steps=steps["detector"], pair_steps=steps["pair"],
        base=BasePlan(
            vae_videos=min(1500, round(300 + 20 * minutes)), denoiser_steps=steps["denoiser"],
            videos=min(4000, round(100 + 40 * minutes)),
        ),
        arm_tokens=round(60 * minutes * SHARES["arms"] / arm_units(scale) / COSTS_S["token"]),
    )  # fmt: skip


def _scale(minutes: float) -> StudyScale:
    """More streets where there is time to draw them and to judge on them."""
    if minutes < 30:
        return StudyScale(train_clips=40, val_clips=8, sampling_steps=6)
    return StudyScale() if minutes < 120 else StudyScale(train_clips=240, val_clips=30)


def arm_units(scale: StudyScale) -> float:
    """How many arms' worth of training the study does: shared adapters count once, over all seeds."""
    own: dict[str, float] = {}
    for arm in ARMS:
        for run in arm.runs:
            own[run.name] = 1 / len(arm.runs)
    return scale.seeds * sum(own.values())
