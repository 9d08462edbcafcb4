"""From cached latents to micro-batches: which samples a step takes, and every random draw of each sample.

The order is a function of (seed, step): epoch e is a permutation keyed by (seed, e), step s takes the next
``global_batch`` places, and process r of w takes every w-th of them. So 1, 2 and 4 processes train on the same samples
with the same draws, and a resume needs the step alone.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch.utils.data import Dataset

from labeling.errors import DataError
from training.backbone import StageInputs
from training.config import TrainConfig
from training.draws import keyed_normal, keyed_uniform
from training.latent_store import LatentStore
from training.stages import EGO, OBJECTS, reference_names, stack_inputs, stage_inputs, target_name
from training.targeted_noise import add_targeted_noise


@dataclass(frozen=True, slots=True, kw_only=True)
class Draw:
    """One place of one step."""

    step: int
    epoch: int
    """Sets two turns of one sample in a step apart."""
    index: int
    """Of the sample in the dataset."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingItem:
    """One sample with all its draws made."""

    key: str
    inputs: StageInputs
    """As a batch of one."""
    target_BCFHW: torch.Tensor
    noise_BCFHW: torch.Tensor
    normal_B: torch.Tensor
    """Standard normal; the backbone makes a noise level of it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingBatch:
    """Samples of one layout."""

    keys: tuple[str, ...]
    inputs: StageInputs
    target_BCFHW: torch.Tensor
    noise_BCFHW: torch.Tensor
    normal_B: torch.Tensor


class StepBatches:
    """An iterable of micro-batches of ``Draw``, this process's share of each step from ``start_step`` on.

    It is a batch sampler for torch's ``DataLoader``.
    """

    def __init__(
        self, count: int, *, config: TrainConfig, rank: int = 0, world_size: int = 1, start_step: int = 0
    ) -> None:
        if count < 1:
            raise DataError("there are no latents to train on; `animatic status` says what was dropped and why")
        self._count, self._seed = count, config.seed
        self._global_batch, self._micro_batch = config.optimiser.global_batch, config.optimiser.micro_batch
        self._rank, self._world_size = rank, world_size
        self._steps, self._start_step = config.optimiser.steps, start_step

    @property
    def per_step(self) -> int:
        """Micro-batches of this process in every step."""
        return -(-len(range(self._rank, self._global_batch, self._world_size)) // self._micro_batch)

    def __len__(self) -> int:
        return (self._steps - self._start_step) * self.per_step

    def __iter__(self) -> Iterator[list[Draw]]:
        for step in range(self._start_step, self._steps):
            mine = self.step_draws(step)[self._rank :: self._world_size]
            for start in range(0, len(mine), self._micro_batch):
                yield mine[start : start + self._micro_batch]

    def step_draws(self, step: int) -> list[Draw]:
        """The whole step's draws, over all processes."""
        draws = []
        for place in range(step * self._global_batch, (step + 1) * self._global_batch):
            epoch, position = divmod(place, self._count)
            draws.append(Draw(step=step, epoch=epoch, index=int(self._permutation(epoch)[position])))
        return draws

    def _permutation(self, epoch: int) -> np.ndarray:
        cached = getattr(self, "_cached", None)
        if cached is None or cached[0] != epoch:
            self._cached = cached = (epoch, np.random.default_rng([self._seed, epoch]).permutation(self._count))
        return cached[1]


class TrainingItems(Dataset):
    """Samples by ``Draw``: reads latents and makes every draw."""

    def __init__(self, store: LatentStore, keys: Sequence[str], config: TrainConfig) -> None:
        self._store, self._keys, self._config = store, list(keys), config

    def __len__(self) -> int:
        return len(self._keys)

    def __getitem__(self, draw: Draw) -> TrainingItem:
        key = self._keys[draw.index]
        return self.item(key, "train", draw.step, draw.epoch)

    def item(self, key: str, *purpose: object, held_out: bool = False) -> TrainingItem:
        """The sample ``key`` with its draws for ``purpose``; a held-out one has no dropout and all its conditions."""
        config, conditions = self._config, self._config.conditions
        stage, control = config.stage, conditions.control
        keyed = (config.seed, *purpose, key)

        def drawn(name: str, probability: float) -> bool:
            return held_out or keyed_uniform(*keyed, name) < probability

        wanted = [
            name
            for name in reference_names(stage, control=control)
            if not (name == EGO and not drawn("ego", conditions.ego_probability))
            and not (name == OBJECTS and not drawn("objects", conditions.objects_probability))
        ]
        clip = self._store.record(key)
        variant = int(keyed_uniform(*keyed, "variant") * clip.object_variants)
        tensors = self._store.read(key, [target_name(stage, control=control), *wanted], object_variant=variant)
        target = tensors.pop(target_name(stage, control=control))
        if stage == "appearance" and not held_out and config.targeted_noise.omega_max > 0:
            tensors[control] = self._noised(key, tensors[control].float(), keyed)
        dropped = not held_out and keyed_uniform(*keyed, "caption") < conditions.caption_dropout
        inputs = stage_inputs(
            stage, first_frame_CFHW=target, target_shape=_shape(target), references=tensors, control=control,
            text=self._store.text("" if dropped else clip.caption), fps=self._store.fps,
            text_tokens=config.backbone.text_tokens, image_1D=self._store.image_embedding(key),
        )  # fmt: skip
        noise = keyed_normal(_shape(target), *keyed, "noise")
        normal = keyed_normal((1,), *keyed, "sigma")
        return TrainingItem(key=key, inputs=inputs, target_BCFHW=target[None], noise_BCFHW=noise[None], normal_B=normal)

    def _noised(self, key: str, latents: torch.Tensor, keyed: tuple) -> torch.Tensor:
        settings = self._config.targeted_noise
        return add_targeted_noise(
            latents, self._store.mask(key, self._config.conditions.control), formula=settings.formula,
            omega=settings.omega_max * keyed_uniform(*keyed, "omega"),
            noise_CFHW=keyed_normal(_shape(latents), *keyed, "targeted"),
        )  # fmt: skip


def _shape(latents: torch.Tensor) -> tuple[int, int, int, int]:
    channels, frames, height, width = latents.shape
    return channels, frames, height, width


def collate(items: Sequence[TrainingItem]) -> list[TrainingBatch]:
    """Batches of equal layout, in the order of first appearance."""
    groups: dict[tuple, list[TrainingItem]] = {}
    for item in items:
        groups.setdefault(item.inputs.layout, []).append(item)
    return [
        TrainingBatch(
            keys=tuple(item.key for item in group),
            inputs=stack_inputs([item.inputs for item in group]),
            target_BCFHW=torch.cat([item.target_BCFHW for item in group]),
            noise_BCFHW=torch.cat([item.noise_BCFHW for item in group]),
            normal_B=torch.cat([item.normal_B for item in group]),
        )
        for group in groups.values()
    ]
