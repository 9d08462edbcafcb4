"""A backbone made ready to train: its adapter, gradient checkpointing and compilation as a recipe says."""

import torch

from labeling.errors import ConfigError
from training.backbone import Backbone
from training.config import TrainConfig
from training.draws import keyed_seed


def attach_for_training(backbone: Backbone, config: TrainConfig) -> list[torch.nn.Parameter]:
    """A fresh adapter named by the stage, in training mode; its parameters. The same seed gives the same adapter.

    Raises:
        ConfigError: compilation of a backbone that is not built of blocks.
        ModelError: no module of the network has a target's name.
    """
    denoiser = backbone.denoiser
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(keyed_seed(config.seed, "adapter"))
        parameters = backbone.attach(config.stage, config.adapter)
    if config.gradient_checkpointing:
        denoiser.enable_gradient_checkpointing()  # type: ignore[operator]
    if config.compile:
        try:
            denoiser.compile_repeated_blocks()  # type: ignore[operator]
        except ValueError as error:
            raise ConfigError(f"{config.backbone.name} cannot be compiled by blocks; set compile to false") from error
    denoiser.train()
    return parameters
