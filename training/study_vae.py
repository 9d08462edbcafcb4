"""The study's VAE: principal components of moving-shape videos, at LTX's ratios of 32 pixels, 8 frames, 128 channels.

A linear autoencoder has a closed form (Baldi and Hornik 1989): the components of its data. It is fitted in seconds and
is as good as a linear one can be. ``AutoencoderKLLTXVideo`` at tiny size, trained from nothing for a thousand steps of
one thread, gave back two shades of grey. The first latent frame holds one frame, the others eight, as LTX's do.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from training.study_shapes import shape_video

CHANNELS, SIDE, GROUP = 128, 32, 8
_FIRSTS = (0, 6, 12)
"""Frames of each video that teach the code of a single frame."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Encoded:
    """What ``LinearVae.encode`` returns, in the shape of diffusers' answer: a distribution without spread."""

    latents: torch.Tensor

    @property
    def latent_dist(self) -> "Encoded":
        """Itself."""
        return self

    def mode(self) -> torch.Tensor:
        """(B, C, F, H, W)."""
        return self.latents


class LinearVae(nn.Module):
    """A VAE with the interface that ``LtxBackbone`` uses of diffusers' one."""

    first_mean: torch.Tensor
    first_basis: torch.Tensor
    group_mean: torch.Tensor
    group_basis: torch.Tensor
    latents_mean: torch.Tensor
    latents_std: torch.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.config = {"scaling_factor": 1.0, "timestep_conditioning": False, "kind": "linear"}
        for name, frames in (("first", 1), ("group", GROUP)):
            values = 3 * frames * SIDE * SIDE
            self.register_buffer(f"{name}_mean", torch.zeros(values))
            self.register_buffer(f"{name}_basis", torch.zeros(CHANNELS, values))
        self.register_buffer("latents_mean", torch.zeros(CHANNELS))
        self.register_buffer("latents_std", torch.ones(CHANNELS))

    def encode(self, pixels_BCTHW: torch.Tensor) -> Encoded:
        """Pixels from -1 to 1, 8k+1 frames, to latents."""
        first = (blocks(pixels_BCTHW[:, :, :1], 1) - self.first_mean) @ self.first_basis.T
        parts = [first]
        if pixels_BCTHW.shape[2] > 1:
            parts.append((blocks(pixels_BCTHW[:, :, 1:], GROUP) - self.group_mean) @ self.group_basis.T)
        return Encoded(latents=torch.cat(parts, dim=1).permute(0, 4, 1, 2, 3))

    def decode(self, latents_BCFHW: torch.Tensor, timestep: Any = None, *, return_dict: bool = False) -> tuple:
        """Latents to pixels (B, 3, T, H, W); the other arguments are diffusers' and change nothing."""
        tokens = latents_BCFHW.permute(0, 2, 3, 4, 1)
        parts = [from_blocks(tokens[:, :1] @ self.first_basis + self.first_mean, 1)]
        if tokens.shape[1] > 1:
            parts.append(from_blocks(tokens[:, 1:] @ self.group_basis + self.group_mean, GROUP))
        return (torch.cat(parts, dim=2),)


def blocks(pixels_BCTHW: torch.Tensor, frames: int) -> torch.Tensor:
    """(B, F, H, W, 3 * frames * 32 * 32): the pixels of each latent cell."""
    batch, _, count, height, width = pixels_BCTHW.shape
    shape = (batch, 3, count // frames, frames, height // SIDE, SIDE, width // SIDE, SIDE)
    return pixels_BCTHW.reshape(shape).permute(0, 2, 4, 6, 1, 3, 5, 7).flatten(4)


def from_blocks(cells_BFHWN: torch.Tensor, frames: int) -> torch.Tensor:
    """The inverse of ``blocks``."""
    batch, count, rows, columns, _ = cells_BFHWN.shape
    split = cells_BFHWN.reshape(batch, count, rows, columns, 3, frames, SIDE, SIDE).permute(0, 4, 1, 5, 2, 6, 3, 7)
    return split.reshape(batch, 3, count * frames, rows * SIDE, columns * SIDE)


def fit_vae(*, videos: int, width: int, height: int, seed: int) -> LinearVae:
    """The components of ``videos`` shape videos of 17 frames.

    Latents keep half of their spread's range (in logarithms): with all of it noise would drown the fine components,
    with none the fine ones would count as much as the coarse.
    """
    made = [shape_video(seed, one, frames=2 * GROUP + 1, width=width, height=height) for one in range(videos)]
    pixels = torch.from_numpy(np.stack(made)).permute(0, 4, 1, 2, 3).float() / 127.5 - 1
    vae = LinearVae()
    single = torch.cat([blocks(pixels[:, :, one : one + 1], 1) for one in _FIRSTS])
    spreads = []
    for name, cells in (("first", single), ("group", blocks(pixels[:, :, 1:], GROUP))):
        mean, basis, spread = _components(cells.flatten(0, 3), seed=seed)
        getattr(vae, f"{name}_mean").copy_(mean)
        getattr(vae, f"{name}_basis").copy_(basis)
        spreads.append(spread)
    spread = torch.stack(spreads).square().mean(dim=0).sqrt().clamp(min=1e-3)
    # Of unit variance over all components, which is what the noise levels are made for.
    vae.latents_std.copy_(spread.sqrt() * spread.mean().sqrt())
    return vae.eval()


def _components(cells_MN: torch.Tensor, *, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Mean (N,), the first components (C, N), and the spread (C,) along them, by a randomised decomposition."""
    mean = cells_MN.mean(dim=0)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        _, singular, right = torch.svd_lowrank(cells_MN - mean, q=min(CHANNELS + 16, len(cells_MN)), niter=2)
    basis, spread = torch.zeros(CHANNELS, cells_MN.shape[1]), torch.zeros(CHANNELS)
    count = min(CHANNELS, right.shape[1])
    basis[:count] = right.T[:count]
    spread[:count] = singular[:count] / max(1, len(cells_MN)) ** 0.5
    # A component's sign is free: fixed, so that the same fit gives the same code everywhere.
    signs = torch.sign(basis.gather(1, basis.abs().argmax(dim=1, keepdim=True)))
    return mean, basis * torch.where(signs == 0, 1.0, signs), spread


def save_linear(vae: LinearVae, path: Path) -> None:
    """As safetensors."""
    save_file({name: value.contiguous() for name, value in vae.state_dict().items()}, str(path))


def load_linear(path: Path) -> LinearVae:
    """A VAE that was saved."""
    vae = LinearVae()
    vae.load_state_dict(load_file(str(path)))
    return vae.eval()
