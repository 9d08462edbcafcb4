"""The learning rate as a function of the optimiser step, and nothing else."""

import math

from training.config import OptimiserConfig


def learning_rate(step: int, config: OptimiserConfig) -> float:
    """The rate of optimiser step ``step`` (from 0), whatever the number of processes or micro-batches.

    The warm-up rises linearly and its last step is at the peak; then a half cosine or a line to ``final_factor``, which
    the last step reaches.
    """
    if step < config.warmup_steps:
        return config.learning_rate * (step + 1) / config.warmup_steps
    if config.schedule == "constant":
        return config.learning_rate
    span = max(1, config.steps - 1 - config.warmup_steps)
    done = min(1.0, (step - config.warmup_steps) / span)
    falling = (1 + math.cos(math.pi * done)) / 2 if config.schedule == "cosine" else 1 - done
    return config.learning_rate * (config.final_factor + (1 - config.final_factor) * falling)
