"""Muon: momentum whose steps are made orthogonal, layer by layer (Jordan et al. 2024, *Muon: An optimizer for hidden
layers in neural networks*)."""

import math
from collections.abc import Iterable
from typing import Any

import torch

_ROUNDS = 5
_LINEAR, _CUBIC, _QUINTIC = 3.4445, -4.7750, 2.0315
"""Of the polynomial that takes singular values between 0.01 and 1 near 1 in so many rounds (ibid.)."""
_ROOT_MEAN_SQUARE = 0.2
"""Of a step's elements at rate 1, about as AdamW's (Liu et al. 2025, *Muon is scalable for LLM training*, eq. 4)."""


class Muon(torch.optim.Optimizer):
    """For weights of two axes and more; a convolution's are a matrix of outputs by inputs times kernel.

    Not ``torch.optim.Muon``, which takes matrices alone and multiplies in bfloat16, as many processors cannot.

    Args:
        params: weights, or groups of them.
        lr: rate, of the size of AdamW's.
        momentum: share of earlier gradients in what is stepped along, with Nesterov's look ahead.
        weight_decay: as AdamW's.
    """

    def __init__(self, params: Iterable[Any], *, lr: float, momentum: float = 0.9, weight_decay: float = 0.01) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """One step along the gradients that are there."""
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                state = self.state[weight]
                if not state:
                    state["mean"] = torch.zeros_like(weight)
                mean = state["mean"].lerp_(weight.grad, 1 - group["momentum"])
                # Pixel by pixel, as convolutions lie in memory: singular values know no order of columns.
                direction = weight.grad.lerp(mean, group["momentum"]).movedim(1, -1)
                matrix = orthogonal(direction.flatten(1))
                size = _ROOT_MEAN_SQUARE * math.sqrt(max(matrix.shape))
                weight.mul_(1 - group["lr"] * group["weight_decay"])
                weight.add_(matrix.view(direction.shape).movedim(-1, 1), alpha=-group["lr"] * size)


def orthogonal(matrix: torch.Tensor) -> torch.Tensor:
    """A matrix with the same singular vectors, whose singular values all are about 1 (0.7 to 1.2).

    Those under a hundredth of the whole, root of the sum of squares, stay smaller; of nothing nothing is made.
    """
    wide = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
    x = wide / wide.norm().clamp(min=1e-7)
    # All rounds multiply from the left with polynomials of x x^T, so that the long side is needed twice alone.
    gram, made = x @ x.T, torch.eye(len(x), device=x.device, dtype=x.dtype)
    for _ in range(_ROUNDS):
        factor = torch.addmm(gram, gram, gram, beta=_CUBIC, alpha=_QUINTIC)
        factor.diagonal().add_(_LINEAR)
        made, gram = factor @ made, factor @ gram @ factor
    x = made @ x
    return x if wide is matrix else x.T
