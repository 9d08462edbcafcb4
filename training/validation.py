"""Held-out loss at fixed noise, so that curves compare, and videos of fixed clips, so that eyes can."""

from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import torch
from accelerate import Accelerator

from dataset.pictures import write_picture
from dataset.receipts import storage_errors
from labeling.encoding import VideoWriter
from training.backbone import Backbone, SamplingSettings
from training.batches import TrainingItems
from training.config import TrainConfig, exact_rate
from training.draws import keyed_normal
from training.latent_store import LatentStore

HELD_OUT = "held_out/mean"
"""What the mean over all noise levels is called in a run's metrics."""
_MOMENTS = 8


@torch.no_grad()
def held_out_losses(
    backbone: Backbone, items: TrainingItems, store: LatentStore, config: TrainConfig, *, accelerator: Accelerator
) -> dict[str, float]:
    """Mean loss over the first held-out clips at each fixed noise level, and over all levels.

    Every clip has all its conditions, its caption, no targeted noise, and noise keyed by its name alone. Clips are
    shared out over the processes.

    Returns:
        ``held_out/sigma_<share>`` and ``held_out/mean``; empty where no clip is held out.
    """
    keys = store.keys("val")[: config.validation.clips]
    if not keys:
        return {}
    sums = torch.zeros(len(config.validation.sigmas), device=accelerator.device)
    with _Evaluating(backbone.denoiser):
        for key in keys[accelerator.process_index :: accelerator.num_processes]:
            item = items.item(key, "held-out", held_out=True)
            for place, share in enumerate(config.validation.sigmas):
                sums[place] += backbone.losses(
                    item.inputs.to(accelerator.device), item.target_BCFHW.to(accelerator.device),
                    noise_BCFHW=item.noise_BCFHW.to(accelerator.device),
                    sigma_B=torch.tensor([backbone.sigma_from_share(share)], device=accelerator.device),
                )[0]  # fmt: skip
    means = [float(value) / len(keys) for value in accelerator.reduce(sums, "sum")]  # type: ignore[union-attr]
    named = {f"held_out/sigma_{share:.2f}": mean for share, mean in zip(config.validation.sigmas, means, strict=True)}
    return named | {HELD_OUT: sum(means) / len(means)}


class _Evaluating(AbstractContextManager):
    """Dropout off while it lasts."""

    def __init__(self, module: torch.nn.Module) -> None:
        self._module, self._was = module, module.training

    def __enter__(self) -> None:
        self._module.eval()

    def __exit__(self, *_: object) -> None:
        self._module.train(self._was)


def write_validation_videos(
    backbone: Backbone, items: TrainingItems, store: LatentStore, config: TrainConfig, *, out: Path, step: int
) -> list[Path]:
    """Sample the first held-out clips (training clips where none is held out) and show truth beside sample.

    Returns:
        For each clip an MP4 (truth left, sample right) and a contact sheet PNG (truth above, eight moments).
    """
    keys = (store.keys("val") or store.keys("train"))[: config.validation.video_clips]
    settings = SamplingSettings(steps=config.validation.sampling_steps, guidance=config.validation.guidance)
    paths = []
    for key in keys:
        item = items.item(key, "held-out", held_out=True)
        shape = tuple(item.target_BCFHW.shape)
        with _Evaluating(backbone.denoiser):
            latents = backbone.sample(
                item.inputs.to(backbone.device), noise_BCFHW=keyed_normal(shape, config.seed, "video", key),
                empty_text=store.text(""), settings=settings,
            )  # fmt: skip
        truth, sample = backbone.decode_video(item.target_BCFHW[0]), backbone.decode_video(latents[0])
        stem = out / "validation" / f"step_{step:08d}_{key}"
        with storage_errors(out):
            stem.parent.mkdir(parents=True, exist_ok=True)
            paths += [_write_pair(stem.with_suffix(".mp4"), truth, sample, fps=store.fps)]
            paths += [_write_sheet(stem.with_suffix(".png"), truth, sample)]
    # Else it would stay on the device, which is full when training goes on.
    backbone.release(["vae"])
    return paths


def _write_pair(path: Path, truth: np.ndarray, sample: np.ndarray, *, fps: float) -> Path:
    both = np.concatenate([truth, sample], axis=2)
    with VideoWriter(path, width=both.shape[2], height=both.shape[1], fps=exact_rate(fps)) as writer:
        for frame in both:
            writer.write(frame)
    return path


def _write_sheet(path: Path, truth: np.ndarray, sample: np.ndarray) -> Path:
    moments = np.linspace(0, len(truth) - 1, min(_MOMENTS, len(truth))).round().astype(int)
    rows = [np.concatenate(list(frames[moments]), axis=1) for frames in (truth, sample)]
    sheet = np.concatenate(rows, axis=0)
    write_picture(path, sheet)
    return path
