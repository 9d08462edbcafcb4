"""Training the study's arms with the trainer, and drawing videos from them, by the very code that makes real ones."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from training.adapters import activate_adapter
from training.backbone import Backbone, SamplingSettings, StageInputs
from training.config import (
    AdapterConfig,
    BackboneConfig,
    CheckpointConfig,
    ConditionsConfig,
    OptimiserConfig,
    Stage,
    TargetedNoiseConfig,
    TrainConfig,
    ValidationConfig,
)
from training.draws import keyed_normal
from training.latent_store import LatentStore
from training.latents import cache_latents
from training.stages import EGO, IMAGE, RGB, stack_inputs, stage_inputs, target_name
from training.study_base import TEXT_TOKENS, open_backbone, study_backbone
from training.study_plan import Arm, StageRun, StudyPlan, StudyScale
from training.trainer import TrainSummary, train

CONTROLS = ("segmentation", "boxes")
_LEARNING_RATE = 1e-3
_NEVER = 1_000_000


def rate_backbone(base: Path, scale: StudyScale, *, frame_step: int) -> BackboneConfig:
    """The general video model at one frame rate."""
    return study_backbone(base, picture=scale.picture(frame_step), name=f"study-every{frame_step}")


def cache_rate(
    folder: Path, base: Path, scale: StudyScale, *, frame_step: int, clips: Mapping[str, Sequence[Any]]
) -> LatentStore:
    """Latents of all clips at one frame rate; clips that are there already are kept."""
    backbone = open_backbone(rate_backbone(base, scale, frame_step=frame_step))
    cache_latents(
        folder, backbone_name=backbone.config.name, backbone=backbone, datasets=clips, out=folder,
        controls=CONTROLS if frame_step == 1 else (),
    )  # fmt: skip
    return LatentStore(folder)


def run_config(plan: StudyPlan, run: StageRun, *, steps: int, seed: int, base: Path) -> TrainConfig:
    """The trainer's settings for one adapter: always the ego video, never the objects', one caption."""
    scale = plan.scale
    return TrainConfig(
        name=run.name, stage=run.stage, backbone=rate_backbone(base, scale, frame_step=run.frame_step),
        adapter=AdapterConfig(rank=scale.rank),
        conditions=ConditionsConfig(
            control=run.control, ego_probability=1.0, objects_probability=0.0, caption_dropout=0.0
        ),
        targeted_noise=TargetedNoiseConfig(omega_max=run.omega_max),
        optimiser=OptimiserConfig(
            learning_rate=_LEARNING_RATE, steps=steps, global_batch=scale.batch, micro_batch=scale.batch,
            schedule="cosine", warmup_steps=steps // 20,
        ),
        checkpoint=CheckpointConfig(every_steps=_NEVER, keep=1), validation=ValidationConfig(loss_every_steps=0),
        seed=seed, gradient_checkpointing=False, loader_workers=0, trackers=(), log_every_steps=50,
    )  # fmt: skip


def train_run(config: TrainConfig, *, store: LatentStore, out: Path) -> tuple[Path, list[float]]:
    """The adapter of one run, and its losses; a run that was stopped goes on."""
    summary = train(config, data=store.folder, out=out, backbone=open_backbone(config.backbone), quiet=True)
    assert isinstance(summary, TrainSummary)
    return summary.adapter, list(summary.losses)


def sample_arm(
    arm: Arm, adapters: Mapping[Stage, Path], *, plan: StudyPlan, base: Path, store: LatentStore, keys: Sequence[str],
    seed: int,
) -> Iterator[tuple[torch.Tensor, torch.Tensor | None]]:  # fmt: skip
    """Latents (V, C, F, H, W) of RGB, and of the control video where there is one, sample by sample.

    The noise of a sample is keyed by seed, stage, clip and number: arms of one frame rate start from the same noise.
    """
    backbone = open_backbone(rate_backbone(base, plan.scale, frame_step=arm.frame_step))
    for stage, path in adapters.items():
        backbone.load_adapter(path, stage)
    backbone.denoiser.eval()
    for number in range(plan.scale.samples):
        made: torch.Tensor | None = None
        control: torch.Tensor | None = None
        for run in arm.runs:
            inputs = arm_inputs(run, store=store, keys=keys, control=made)
            activate_adapter(backbone.denoiser, run.stage)
            control, made = (
                made,
                _sampled(backbone, inputs, run, plan=plan, store=store, keys=keys, keyed=(seed, number)),
            )
        assert made is not None
        yield made, control


def arm_inputs(run: StageRun, *, store: LatentStore, keys: Sequence[str], control: torch.Tensor | None) -> StageInputs:
    """One stage's inputs for several clips: what the store holds, and the control video that the arm itself made."""
    target = target_name(run.stage, control=run.control)
    given = {"motion": [EGO, IMAGE], "appearance": [], "end_to_end": [EGO]}[run.stage]
    parts = []
    for place, key in enumerate(keys):
        tensors = store.read(key, [target, *given])
        first = tensors.pop(target)
        if run.stage == "appearance":
            assert control is not None
            tensors[run.control] = control[place]
        channels, frames, rows, columns = first.shape
        parts.append(
            stage_inputs(
                run.stage, first_frame_CFHW=first, target_shape=(channels, frames, rows, columns), references=tensors,
                text=store.text(store.record(key).caption), text_tokens=TEXT_TOKENS, fps=store.fps, control=run.control,
            )
        )  # fmt: skip
    return stack_inputs(parts)


def _sampled(
    backbone: Backbone, inputs: StageInputs, run: StageRun, *, plan: StudyPlan, store: LatentStore,
    keys: Sequence[str], keyed: tuple[int, int],
) -> torch.Tensor:  # fmt: skip
    shape = inputs.target_shape
    noise = torch.stack([keyed_normal(shape, *keyed, "study", run.stage, key) for key in keys])
    # Without guidance: one caption serves all clips, so there is nothing to be guided by.
    settings = SamplingSettings(steps=plan.scale.sampling_steps, guidance=1.0)
    return backbone.sample(inputs, noise_BCFHW=noise, empty_text=store.text(""), settings=settings)


def decoded(backbone: Backbone, latents_BCFHW: torch.Tensor) -> np.ndarray:
    """(V, T, H, W, 3) uint8."""
    return np.stack([backbone.decode_video(one) for one in latents_BCFHW])


def through_vae(backbone: Backbone, store: LatentStore, keys: Sequence[str], *, name: str = RGB) -> np.ndarray:
    """(V, T, H, W, 3) uint8: cached videos, decoded."""
    return decoded(backbone, torch.stack([store.read(key, [name])[name].float() for key in keys]))
