"""What ``animatic evaluate`` looks with: its options, and the ruler that they and the job make."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from dataset.layout import JOB_FILE
from dataset.receipts import digest
from labeling.errors import ConfigError
from labeling.extraction import Effort
from labeling.extractors import ExtractorChoice, choose_extractors
from labeling.model_cards import ModelCard, find_weights
from labeling.onnx_files import weights_sha256
from labeling.timeline import FPS
from pipelines.config import EFFORTS
from pipelines.job import open_job
from training.evaluation_estimates import EstimateSettings

_VERSION = 3
"""Counts changes of what is estimated or scored: results of another version are made anew."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateOptions:
    """Options of ``animatic evaluate``; what is None is as the job has it."""

    out: Path | None = None
    """Folder of the results; ``evaluation`` in the samples' folder where None."""
    true_skeletons: Path | None = None
    """Samples painted over the true skeletons, for stage attribution."""
    trajectories: Path | None = None
    """Folder of imported trajectories, ``<key>[_n].tum``."""
    skeletons: Path | None = None
    """Folder of skeleton videos; ``skeleton`` in the samples' folder where None."""
    samples_per_clip: int = 6
    seconds: float | None = None
    """Compare no more than this of each clip."""
    object_variant: int | None = None
    """Which of the clips' object videos the samples were conditioned on."""
    every: int = 8
    extractors: tuple[str, ...] | None = None
    models_dir: Path | None = None
    effort: str | None = None
    workers: int = 1
    """Processes, a clip each; the results do not depend on them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ruler:
    """What every video is looked at with; the same for all, and stored with the figures."""

    choice: ExtractorChoice
    models_dir: Path | None
    settings: EstimateSettings
    seconds: float | None
    object_variant: int

    def as_json(self) -> dict[str, Any]:
        """Plain values; of each extractor sha256 of its weights as they lie there, then a digest of its card."""
        return {
            "version": _VERSION,
            "extractors": {card.name: _model_hash(card, self.models_dir) for card in self.choice.cards},
            "every": self.settings.every, "effort": self.settings.effort, "seconds": self.seconds,
            "ego": self.settings.ego.model_dump(mode="json"), "object_variant": self.object_variant,
        }  # fmt: skip


def _model_hash(card: ModelCard, models_dir: Path | None) -> str:
    path = find_weights(card, models_dir)
    return f"{card.sha256 if path is None else weights_sha256(path)} {digest(card.model_dump(mode='json'))}"


def read_ruler(job: Path, options: EvaluateOptions) -> Ruler:
    """The extractors, effort and object video of the job, where the options name no others.

    Raises:
        ConfigError: ``job.yaml`` or an option cannot be used.
        ModelError: an extractor that was asked for has no weights.
    """
    known = open_job(job) if (job / JOB_FILE).is_file() else None
    names, models_dir = options.extractors, options.models_dir
    effort, variant = options.effort, options.object_variant
    if known is not None:
        names, models_dir = names or known.config.keypoints.extractors, models_dir or known.models_dir
        effort = effort or known.config.keypoints.effort
        variant = known.config.views.object_variant if variant is None else variant
    settings = EstimateSettings(every=options.every, effort=cast(Effort, effort or "balanced"))
    return Ruler(
        choice=choose_extractors(names, models_dir=models_dir), models_dir=models_dir, settings=settings,
        seconds=options.seconds, object_variant=variant or 0,
    )  # fmt: skip


def check_options(options: EvaluateOptions) -> None:
    """Refuse options that leave nothing to do.

    Raises:
        ConfigError: which one, and what it can be.
    """
    if options.effort is not None and options.effort not in EFFORTS:
        raise ConfigError(f"effort {options.effort!r} is not known; choose one of {', '.join(EFFORTS)}")
    if options.seconds is not None and not options.seconds * FPS >= 1:
        raise ConfigError(
            f"--seconds {options.seconds:g} leaves nothing to compare; give a frame's duration, 1/{FPS} s, at least"
        )
    if options.samples_per_clip < 1 or options.every < 1:
        raise ConfigError("--samples-per-clip and --every count from 1; give at least 1")
