"""Noise levels, sampling schedules, learning rates, keyed draws."""

import numpy as np
import pytest
import torch

from training.config import OptimiserConfig
from training.draws import keyed_normal, keyed_uniform
from training.flow import masked_mse, sampling_sigmas, shift_for_tokens, sigma_from_normal
from training.schedule import learning_rate


@pytest.mark.parametrize(
    ("tokens", "shift"), [(1024, 0.95), (4096, 2.05), (2560, 1.5), (18, 0.95), (11616, 2.05)], ids=str
)
def test_shift_is_linear_in_tokens_and_bounded(tokens: int, shift: float) -> None:
    assert shift_for_tokens(tokens) == pytest.approx(shift)


def test_released_shift_extrapolates() -> None:
    assert shift_for_tokens(11616, convention="released") == pytest.approx(0.95 + 1.1 * (11616 - 1024) / 3072)
    assert shift_for_tokens(0, convention="released") < 0.95


def test_noise_levels_are_logit_normal_about_the_shift() -> None:
    sigma = sigma_from_normal(torch.randn(20000, generator=torch.Generator().manual_seed(0)), tokens=4096)
    logit = torch.logit(sigma.double())
    assert float(logit.mean()) == pytest.approx(2.05, abs=0.03)
    assert float(logit.std()) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("steps", [1, 2, 30])
def test_sampling_runs_from_pure_noise_to_clean(steps: int) -> None:
    sigmas = sampling_sigmas(steps, tokens=6144)
    assert len(sigmas) == steps + 1
    assert float(sigmas[0]) == pytest.approx(1)
    assert float(sigmas[-1]) == 0
    assert (sigmas.diff() < 0).all()
    if steps > 1:
        assert float(sigmas[-2]) == pytest.approx(0.1)


def test_loss_covers_the_masked_tokens_only() -> None:
    predicted, wanted = torch.zeros(2, 3, 4), torch.ones(2, 3, 4)
    wanted[0, 0] = 100
    mask = torch.tensor([[False, True, True], [False, True, False]])
    assert masked_mse(predicted, wanted, mask).tolist() == [1, 1]


def test_schedule_counts_optimiser_steps() -> None:
    paper = OptimiserConfig(steps=9000, warmup_steps=1500, schedule="cosine")
    assert learning_rate(0, paper) == pytest.approx(2e-4 / 1500)
    assert learning_rate(1499, paper) == pytest.approx(2e-4)
    assert learning_rate(8999, paper) == pytest.approx(0, abs=1e-12)
    linear = OptimiserConfig(steps=5000, schedule="linear", final_factor=0.1)
    assert [learning_rate(step, linear) for step in (0, 4999)] == pytest.approx([2e-4, 2e-5])
    assert learning_rate(2500, linear) == pytest.approx(1.1e-4, rel=1e-3)


def test_keyed_draws_are_uniform_and_independent_of_each_other() -> None:
    names = [f"clip_{number}" for number in range(4000)]
    first = np.array([keyed_uniform(0, 7, name, "ego") for name in names])
    second = np.array([keyed_uniform(0, 7, name, "objects") for name in names])
    assert abs(first.mean() - 0.5) < 0.02
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.05
    assert abs((first < 0.25).mean() - 0.25) < 0.03
    assert keyed_uniform(0, 7, "clip_1", "ego") == first[1]
    assert torch.equal(keyed_normal((3,), 1, "a"), keyed_normal((3,), 1, "a"))
    assert not torch.equal(keyed_normal((3,), 1, "a"), keyed_normal((3,), 1, "b"))
