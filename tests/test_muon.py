"""Muon's steps: orthogonal, as long as said, the same for a convolution as for its matrix."""

import math

import pytest
import torch

from training.muon import Muon, orthogonal


def _random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("shape", [(32, 147), (96, 24), (48, 48), (1, 9)])
def test_singular_vectors_stay_and_singular_values_become_one(shape) -> None:
    matrix = _random(*shape)
    left, _, right = torch.linalg.svd(matrix, full_matrices=False)
    values = left.T @ orthogonal(matrix) @ right.T
    assert ((values.diagonal() > 0.6) & (values.diagonal() < 1.25)).all()
    assert (values - torch.diag(values.diagonal())).abs().max() < 1e-4


def test_a_direction_that_is_fifty_times_weaker_is_as_long_afterwards() -> None:
    left, _, right = torch.linalg.svd(_random(8, 30), full_matrices=False)
    strengths = torch.linspace(1.0, 0.02, 8)
    values = torch.linalg.svdvals(orthogonal(left @ torch.diag(strengths) @ right))
    assert values.min() > 0.6 and values.max() < 1.25


def test_rounds_are_those_of_the_paper() -> None:
    matrix = _random(24, 200)
    plain = matrix / matrix.norm()
    for _ in range(5):
        gram = plain @ plain.T
        plain = 3.4445 * plain + (-4.7750 * gram + 2.0315 * gram @ gram) @ plain
    assert torch.allclose(orthogonal(matrix), plain, atol=1e-5)
    assert torch.allclose(orthogonal(matrix.T), plain.T, atol=1e-5)


def _stepped(weight: torch.Tensor, gradients: list[torch.Tensor], **settings: float) -> torch.Tensor:
    weight = torch.nn.Parameter(weight.clone(memory_format=torch.preserve_format))
    optimiser = Muon([weight], **{"lr": 0.01, "weight_decay": 0.0, **settings})
    for gradient in gradients:
        weight.grad = gradient
        optimiser.step()
    return weight.detach()


@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
def test_a_convolution_steps_as_its_matrix_does(memory_format) -> None:
    weight, gradients = _random(6, 5, 3, 3), [_random(6, 5, 3, 3, seed=seed) for seed in (1, 2, 3)]
    laid_out = [one.contiguous(memory_format=memory_format) for one in (weight, *gradients)]
    as_matrix = _stepped(weight.flatten(1), [one.flatten(1) for one in gradients])
    assert torch.allclose(_stepped(laid_out[0], laid_out[1:]).flatten(1), as_matrix, atol=1e-6)


@pytest.mark.parametrize("shape", [(64, 64, 3, 3), (128, 40), (16, 300)])
def test_a_step_is_about_as_long_as_one_of_adamw(shape) -> None:
    step = _stepped(torch.zeros(shape), [_random(*shape)], lr=0.01)
    assert 0.6 < float(step.square().mean().sqrt()) / (0.2 * 0.01) < 1.25


def test_the_second_step_follows_the_mean_of_both_gradients() -> None:
    first, second = _random(4, 6, seed=1), _random(4, 6, seed=2)
    mean = 0.9 * (0.1 * first) + 0.1 * second
    wanted = -0.01 * 0.2 * math.sqrt(6) * orthogonal(0.1 * second + 0.9 * mean)
    before = _stepped(torch.zeros(4, 6), [first])
    assert torch.allclose(_stepped(torch.zeros(4, 6), [first, second]) - before, wanted, atol=1e-6)


def test_no_gradient_no_step_and_weights_decay_alone() -> None:
    weight = _random(4, 6)
    assert torch.equal(_stepped(weight, [torch.zeros(4, 6)]), weight)
    assert torch.allclose(_stepped(weight, [torch.zeros(4, 6)], weight_decay=0.5), weight * (1 - 0.01 * 0.5))
    alone = torch.nn.Parameter(weight.clone())
    Muon([alone], lr=0.01).step()
    assert torch.equal(alone.detach(), weight)
