"""The training loop: one adapter, on accelerate, on one process or many, resumable to the bit.

A step takes the same samples with the same draws whatever the number of processes; each process sums its samples'
losses over the global batch, gradients are summed over processes, and one clipped AdamW step follows (Loshchilov and
Hutter 2019). Nothing random is carried from step to step, so a checkpoint is the adapter, the moments and the step.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from accelerate import Accelerator
from accelerate.tracking import get_available_trackers
from accelerate.utils import LoggerType
from torch.utils.data import DataLoader

from dataset.receipts import atomic_write, storage_errors
from labeling.errors import ConfigError, DataError
from training.adapter_notes import ADAPTER
from training.adapters import trainable_count
from training.attachment import attach_for_training
from training.backbone import Backbone
from training.backbones import load_backbone
from training.batches import StepBatches, TrainingBatch, TrainingItems, collate
from training.checkpoints import check_checkpoint, newest_checkpoint, save_checkpoint
from training.claims import Claim, sweep
from training.config import TrainConfig
from training.draws import keyed_seed
from training.dry_run import RunPlan, plan_run
from training.guards import StopFlag, TrainingError, memory_advice, stop_flag
from training.latent_store import LatentStore
from training.latents import check_store, manifest_picture, open_store
from training.prefetch import Prefetched, leave_signals_to_the_trainer
from training.run_log import METRICS, RunLog
from training.run_state import FILES, RunState, config_differences, pack_state, read_state, restore
from training.schedule import learning_rate
from training.stages import reference_names, target_name
from training.validation import HELD_OUT, held_out_losses, write_validation_videos

Resume = Literal["auto", "never"] | Path
_BUCKET = 2**24
"""Numbers per gradient exchange: 64 MiB, few calls and little extra memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainSummary:
    """How a run ended."""

    steps: int
    """Optimiser steps done in all."""
    started_at: int
    """The step that this call began at."""
    losses: tuple[float, ...]
    """Global mean loss of every step of this call."""
    held_out: dict[str, float]
    """The last held-out losses, by name; empty without held-out clips."""
    adapter: Path
    """The newest adapter file."""
    trainable: int
    interrupted: bool


def train(
    config: TrainConfig,
    *,
    data: Path,
    out: Path,
    resume: Resume = "auto",
    dry_run: bool = False,
    steps_per_second: float | None = None,
    backbone: Backbone | None = None,
    on_step: Callable[[int, float], None] | None = None,
    quiet: bool = False,
) -> TrainSummary | RunPlan:
    """Train one adapter, or say what would be trained.

    Args:
        config: the recipe.
        data: a job whose latents are cached, or a folder of latents.
        out: checkpoints, metrics, ``adapter.safetensors``.
        resume: ``auto`` goes on from the newest whole checkpoint of ``out``; ``never`` refuses a folder that has some;
            a path names one checkpoint.
        dry_run: touch nothing; the plan needs neither data nor weights.
        steps_per_second: for the plan's hours.
        backbone: already loaded; it gets the adapter.
        on_step: called after every step with its number (from 1) and loss.
        quiet: no progress line.

    Raises:
        ConfigError: settings that contradict each other or the checkpoint, or another training that uses ``out``.
        DataError: no latents, stale latents.
        StorageError: no space left, or ``out`` cannot be written to.
        TrainingError: a loss that is no number, no memory left; the last good checkpoint is intact.
    """
    if dry_run:
        return plan_run(config, steps_per_second=steps_per_second)
    return Trainer(config, data=Path(data), out=Path(out), resume=resume, backbone=backbone, quiet=quiet).run(on_step)


class Trainer:
    """One run. See ``train``."""

    def __init__(
        self, config: TrainConfig, *, data: Path, out: Path, resume: Resume = "auto", backbone: Backbone | None = None,
        quiet: bool = False,
    ) -> None:  # fmt: skip
        self.config, self.out, self.quiet = config, out, quiet
        self.accelerator = _accelerator(config, out)
        self.store = _fitting_store(config, data)
        # One process writes for all.
        self.claim = Claim(out) if self.accelerator.is_main_process else None
        try:
            self._prepare(resume, backbone)
        except BaseException:
            self._release()
            raise

    def _release(self) -> None:
        if self.claim is not None:
            self.claim.release()

    def _prepare(self, resume: Resume, backbone: Backbone | None) -> None:
        """Load the backbone and put it where the run stands."""
        config = self.config
        if self.claim is not None:
            sweep(half for name in (ADAPTER, METRICS) for half in self.out.glob(f".{name}.*"))
        self.backbone = backbone or load_backbone(config.backbone, device=self.accelerator.device)
        if self.accelerator.is_main_process:
            check_store(self.store, config.backbone, vae_fingerprint=self.backbone.fingerprint_vae())
            self.backbone.release(["vae"])
        self.keys = self.store.keys("train")
        self.items = TrainingItems(self.store, self.keys, config)
        with memory_advice(config):
            self.parameters = attach_for_training(self.backbone, config)
        self.names = [name for name, one in self.backbone.denoiser.named_parameters() if one.requires_grad]
        self.optimiser = torch.optim.AdamW(
            self.parameters, lr=config.optimiser.learning_rate, betas=config.optimiser.betas,
            eps=config.optimiser.epsilon, weight_decay=config.optimiser.weight_decay,
        )  # fmt: skip
        self.draws_inside = any(
            isinstance(one, torch.nn.Dropout) and one.p > 0 for one in self.backbone.denoiser.modules()
        )
        self.step = self._resume(resume)
        self.loader = self._loader(self.step)

    def _resume(self, resume: Resume) -> int:
        """Steps done, with the adapter and the moments put back."""
        root = self.out / "checkpoints"
        checkpoint = newest_checkpoint(root, wanted=FILES) if isinstance(resume, str) else resume
        if checkpoint is None:
            return 0
        if resume == "never":
            raise ConfigError(f"{self.out} already has checkpoints; give another --out, or --resume auto to go on")
        check_checkpoint(checkpoint, wanted=FILES)
        state = read_state(checkpoint)
        changed = config_differences(state.config, self.config)
        if changed:
            raise ConfigError(
                f"{checkpoint} was trained with other settings ({', '.join(changed)}); restore them, or give "
                "another --out"
            )
        if state.data not in ("", self.store.data_digest("train")):
            raise ConfigError(
                f"{checkpoint} was trained on other clips, labels or captions than the latents hold now; give another "
                "--out to train on these"
            )
        restore(checkpoint, self.backbone.denoiser, self.optimiser, self.names, adapter=self.config.stage)
        if self.accelerator.is_main_process:
            self._put_adapter((checkpoint / ADAPTER).read_bytes())
        return state.step

    def _put_adapter(self, adapter: bytes) -> None:
        """The adapter beside the checkpoints: a kill, or a full disk, between the two leaves an earlier one or none."""
        path = self.out / ADAPTER
        if not path.is_file() or path.read_bytes() != adapter:
            atomic_write(path, adapter)

    def _loader(self, start_step: int) -> DataLoader:
        # The order is a function of the step alone: how far a loader got differs from process to process.
        self.batches = StepBatches(
            len(self.keys), config=self.config, rank=self.accelerator.process_index,
            world_size=self.accelerator.num_processes, start_step=start_step,
        )  # fmt: skip
        workers = self.config.loader_workers
        return DataLoader(
            self.items, batch_sampler=self.batches, collate_fn=collate, num_workers=workers,
            prefetch_factor=4 if workers else None,
            worker_init_fn=leave_signals_to_the_trainer if workers else None,
            # Else it would draw a number from the process's own generator.
            generator=torch.Generator().manual_seed(keyed_seed(self.config.seed, "loader")),
        )  # fmt: skip

    def run(self, on_step: Callable[[int, float], None] | None = None) -> TrainSummary:
        """Train to the last step, or until Ctrl-C, and give ``out`` free."""
        try:
            return self._run(on_step)
        finally:
            self._release()

    def _run(self, on_step: Callable[[int, float], None] | None) -> TrainSummary:
        config, start = self.config, self.step
        if config.trackers:
            about = {"name": config.name, "stage": config.stage, "seed": config.seed}
            with storage_errors(self.out):
                self.accelerator.init_trackers("logs", config=about)
        losses: list[float] = []
        held_out: dict[str, float] = {}
        log = RunLog(
            self.accelerator, self.out, steps=config.optimiser.steps, start=start, quiet=self.quiet,
            samples_per_step=config.optimiser.global_batch,
        )  # fmt: skip
        self.micro_batches = Prefetched(self.loader)
        with stop_flag() as flag, log, memory_advice(config), self.micro_batches:
            stopping = False
            # What was killed between a checkpoint and its held-out loss owes it.
            owed = _due(start, config.validation.loss_every_steps, last=start == config.optimiser.steps)
            if start and owed and log.lacks_at_start(HELD_OUT):
                held_out = self._validate(log)
            while self.step < config.optimiser.steps and not stopping:
                values, stopping = self._one_step(flag)
                losses.append(values["loss"])
                if self.step % config.log_every_steps == 0:
                    log.step(self.step, values)
                last = self.step == config.optimiser.steps or stopping
                if last or self.step % config.checkpoint.every_steps == 0:
                    self._save()
                if _due(self.step, config.validation.loss_every_steps, last=last and not stopping):
                    held_out = self._validate(log)
                if _due(self.step, config.validation.videos_every_steps, last=False):
                    self._videos()
                if on_step:
                    on_step(self.step, values["loss"])
        with storage_errors(self.out):
            self.accelerator.end_training()
        return TrainSummary(
            steps=self.step, started_at=start, losses=tuple(losses), held_out=held_out, adapter=self.out / ADAPTER,
            trainable=trainable_count(self.parameters), interrupted=stopping,
        )  # fmt: skip

    def _one_step(self, flag: StopFlag) -> tuple[dict[str, float], bool]:
        total = torch.zeros((), device=self.accelerator.device)
        for _ in range(self.batches.per_step):
            for batch in next(self.micro_batches):
                total += self._backward(batch)
        loss, stop = self._shared(total, flag)
        norm = self._gradient_norm() if math.isfinite(loss) else math.nan
        if not math.isfinite(norm):
            what = "loss" if not math.isfinite(loss) else "gradient"
            raise TrainingError(
                f"the {what} is not a number at step {self.step + 1}; the checkpoint before it is intact. Lower "
                "optimiser.learning_rate, or look at the clips of this step"
            )
        rate = learning_rate(self.step, self.config.optimiser)
        self.optimiser.param_groups[0]["lr"] = rate
        self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)
        self.step += 1
        return {"loss": loss, "learning_rate": rate, "gradient_norm": norm}, stop

    def _shared(self, loss: torch.Tensor, flag: StopFlag) -> tuple[float, bool]:
        """The loss over all processes, and whether any of them was asked to stop, in one exchange."""
        if self.accelerator.num_processes == 1:
            return float(loss), flag.set
        both: torch.Tensor = self.accelerator.reduce(torch.stack([loss, torch.full_like(loss, float(flag.set))]), "sum")  # type: ignore[assignment]
        return float(both[0]), float(both[1]) > 0

    def _backward(self, batch: TrainingBatch) -> torch.Tensor:
        device, config = self.accelerator.device, self.config
        if self.draws_inside:
            # Keyed as well: by step and clips, not by process.
            torch.manual_seed(keyed_seed(config.seed, self.step, *batch.keys, "network"))
        sigma_B = self.backbone.sigma_from_normal(batch.normal_B, target_shape=batch.inputs.target_shape)
        losses_B = self.backbone.losses(
            batch.inputs.to(device), batch.target_BCFHW.to(device), noise_BCFHW=batch.noise_BCFHW.to(device),
            sigma_B=sigma_B.to(device),
        )  # fmt: skip
        loss = losses_B.sum() / config.optimiser.global_batch
        loss.backward()
        return loss.detach()

    def _gradient_norm(self) -> float:
        """Gradients summed over processes and clipped; their norm before clipping."""
        if self.accelerator.num_processes > 1:
            reduce_gradients(self.accelerator, self.parameters)
        gradients = [one.grad for one in self.parameters if one.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients)
        value, limit = float(norm), self.config.optimiser.max_gradient_norm or math.inf
        # clip_grads_with_norm_ multiplies by limit / (norm + 1e-6), or by 1: a pass over all gradients for nothing.
        if value + 1e-6 > limit:
            torch.nn.utils.clip_grads_with_norm_(self.parameters, limit, norm)
        return value

    def _save(self) -> None:
        if not self.accelerator.is_main_process:
            return
        state = RunState(
            step=self.step, config=self.config.model_dump(mode="json"), data=self.store.data_digest("train")
        )
        files = pack_state(
            self.backbone.denoiser, self.optimiser, self.names, config=self.config, state=state,
            frames=self.store.manifest.frames, prefix=self.backbone.adapter_prefix,
        )  # fmt: skip
        save_checkpoint(self.out / "checkpoints", self.step, files, keep=self.config.checkpoint.keep)
        adapter = files[ADAPTER]
        assert isinstance(adapter, bytes)
        self._put_adapter(adapter)

    def _validate(self, log: RunLog) -> dict[str, float]:
        values = held_out_losses(self.backbone, self.items, self.store, self.config, accelerator=self.accelerator)
        if values:
            log.write(self.step, values)
        return values

    def _videos(self) -> None:
        if self.accelerator.is_main_process:
            write_validation_videos(self.backbone, self.items, self.store, self.config, out=self.out, step=self.step)
        self.accelerator.wait_for_everyone()


def reduce_gradients(accelerator: Accelerator, parameters: list[torch.nn.Parameter]) -> None:
    """Sum gradients over processes, some 64 MiB at a time; a process without samples counts as zeros."""
    for parameter in parameters:
        if parameter.grad is None:
            parameter.grad = torch.zeros_like(parameter)
    bucket: list[torch.Tensor] = []
    for place, parameter in enumerate(parameters, start=1):
        bucket.append(parameter.grad)  # type: ignore[arg-type]
        if sum(one.numel() for one in bucket) >= _BUCKET or place == len(parameters):
            flat = accelerator.reduce(torch.cat([one.flatten() for one in bucket]), "sum")
            for one, summed in zip(bucket, flat.split([one.numel() for one in bucket]), strict=True):  # type: ignore
                one.copy_(summed.view_as(one))
            bucket = []


def _accelerator(config: TrainConfig, out: Path) -> Accelerator:
    known = {kind.value for kind in LoggerType}
    unknown = [name for name in config.trackers if name not in known]
    if unknown:
        raise ConfigError(
            f"trackers {', '.join(unknown)} are not known to accelerate; choose of {', '.join(sorted(known))}"
        )
    # accelerate leaves out, without a word, what is not installed.
    absent = [name for name in config.trackers if name not in {str(kind) for kind in get_available_trackers()}]
    if absent:
        raise ConfigError(f"trackers {', '.join(absent)} are not installed; `pip install {' '.join(absent)}`")
    # Precision is the backbone's affair: accelerate would fix it for the whole process, and two runs may differ.
    return Accelerator(
        mixed_precision="no", log_with=list(config.trackers) or None, project_dir=str(out),
        cpu=not torch.cuda.is_available(),
    )  # fmt: skip


def _fitting_store(config: TrainConfig, data: Path) -> LatentStore:
    store = open_store(data, config.backbone)
    check_store(store, config.backbone)
    if not store.keys("train"):
        raise DataError(f"{store.folder} has no clips for training; run `animatic cache` first")
    control = config.conditions.control
    held = ["skeleton", *filter(None, store.manifest.parts.get("controls", "").split(","))]
    needed = (target_name(config.stage, control=control), *reference_names(config.stage, control=control))
    if control in needed and control not in held:
        raise DataError(
            f"{store.folder} holds {' and '.join(held)} videos, but none called {control}; cache again with "
            f"`animatic cache --controls {','.join([*held[1:], control])} --refresh`, or set conditions.control to one "
            "that is there"
        )
    picture = manifest_picture(store)
    if config.backbone.picture.frames not in (None, picture.frames):
        raise ConfigError(f"latents have {picture.frames} frames, the config asks for {config.backbone.picture.frames}")
    return store


def _due(step: int, every: int, *, last: bool) -> bool:
    return every > 0 and (last or step % every == 0)
