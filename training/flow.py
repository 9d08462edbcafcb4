"""Flow matching: noise levels, targets, the loss, and the sampling schedule.

x_sigma = (1 - sigma) z + sigma eps, and the network predicts v = eps - z (Lipman et al. 2022; Liu et al. 2022).
Training draws sigma from a logit-normal (Esser et al. 2024, eq. 19) that is shifted with the number of target tokens,
as LTX-Video does: 0.95 at 1,024 tokens, 2.05 at 4,096, *bounded* there; the released trainer extrapolates.
"""

import torch

from training.config import Convention

BASE_TOKENS, MAX_TOKENS = 1024, 4096
BASE_SHIFT, MAX_SHIFT = 0.95, 2.05


def shift_for_tokens(tokens: int, *, convention: Convention = "consistent") -> float:
    """The logit shift for a target of ``tokens``; ``released`` extrapolates beyond 1,024 and 4,096."""
    if convention == "consistent":
        tokens = min(max(tokens, BASE_TOKENS), MAX_TOKENS)
    return BASE_SHIFT + (MAX_SHIFT - BASE_SHIFT) * (tokens - BASE_TOKENS) / (MAX_TOKENS - BASE_TOKENS)


def sigma_from_normal(normal_B: torch.Tensor, *, tokens: int, convention: Convention = "consistent") -> torch.Tensor:
    """Shifted logit-normal noise levels in (0, 1) from standard normal draws."""
    return torch.sigmoid(normal_B.float() + shift_for_tokens(tokens, convention=convention))


def interpolate(clean: torch.Tensor, noise: torch.Tensor, sigma_B: torch.Tensor) -> torch.Tensor:
    """x_sigma, sample by sample."""
    sigma = sigma_B.view(-1, *[1] * (clean.dim() - 1)).to(clean.dtype)
    return (1 - sigma) * clean + sigma * noise


def velocity_target(clean: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """v = eps - z."""
    return noise - clean


def masked_mse(predicted_BNC: torch.Tensor, wanted_BNC: torch.Tensor, mask_BN: torch.Tensor) -> torch.Tensor:
    """Mean squared error of each sample over the tokens that count, (B,) float32."""
    squared_BN = (predicted_BNC.float() - wanted_BNC.float()).square().mean(dim=-1)
    return (squared_BN * mask_BN).sum(dim=1) / mask_BN.sum(dim=1)


def sampling_sigmas(steps: int, *, tokens: int, convention: Convention = "consistent") -> torch.Tensor:
    """(steps + 1,) float32 from 1 to 0, by diffusers' FlowMatchEuler scheduler under LTX's settings.

    The shift is exponential in mu, and the schedule is stretched to end at 0.1 before the last step, as LTX-Video's
    own scheduler configuration says.
    """
    from diffusers.schedulers.scheduling_flow_match_euler_discrete import FlowMatchEulerDiscreteScheduler

    scheduler = FlowMatchEulerDiscreteScheduler(
        use_dynamic_shifting=True, base_shift=BASE_SHIFT, max_shift=MAX_SHIFT, base_image_seq_len=BASE_TOKENS,
        max_image_seq_len=MAX_TOKENS, shift_terminal=0.1,
    )  # fmt: skip
    if steps == 1:
        # One step has no room to stretch.
        return torch.tensor([1.0, 0.0])
    linear = torch.linspace(1.0, 1.0 / steps, steps)
    mu = shift_for_tokens(tokens, convention=convention)
    scheduler.set_timesteps(sigmas=linear.tolist(), mu=mu)
    return torch.as_tensor(scheduler.sigmas, dtype=torch.float32)
