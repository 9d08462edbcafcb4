"""The token sequence of an LTX transformer: layout, coordinates, timesteps. One function for training and sampling.

Tokens are concatenated along the sequence: references first (ego, objects, RGB frame 0, or the skeleton video), the
target last. References and the target's first latent frame are clean and carry timestep 0; the loss covers the other
target tokens only. Coordinates are (seconds, row px, column px) of a cell's corner, what ``video_coords`` of
``LTXVideoTransformer3DModel`` expects.

Two conventions. ``consistent``: 8 f / fps for all, and references are rescaled onto the target's grid, so that the
same place has the same coordinates whatever the resolution. ``released``: max(0, 8 f - 7) / fps and no rescaling, which
is how the released code samples (it trains with 8 f / fps); for sampling with the released adapters only.
"""

from dataclasses import dataclass

import torch

from training.backbone import LatentGeometry, StageInputs
from training.config import Convention

TIMESTEP_SCALE = 1000.0
"""The network's timestep at pure noise."""
IMAGE_LATENT_FRAME = 1000
"""Where the RGB first frame lies on the motion stage's time axis: far from every skeleton frame."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TokenSequence:
    """What the transformer is fed."""

    hidden_BNC: torch.Tensor
    timestep_BN: torch.Tensor
    """0 for clean tokens, 1000 sigma for noisy ones."""
    coordinates_B3N: torch.Tensor
    """Seconds, row, column."""
    target_start: int
    """Tokens from here on are the target's."""
    loss_mask_BN: torch.Tensor
    """Bool over the target's tokens: False for its first latent frame."""


def pack(latents_BCFHW: torch.Tensor) -> torch.Tensor:
    """(B, F*H*W, C): one token per latent cell, frames slowest."""
    return latents_BCFHW.flatten(2).transpose(1, 2)


def unpack(tokens_BNC: torch.Tensor, shape: tuple[int, int, int, int]) -> torch.Tensor:
    """The inverse of ``pack``; ``shape`` is (C, F, H, W)."""
    return tokens_BNC.transpose(1, 2).reshape(len(tokens_BNC), *shape)


def token_coordinates(
    shape_FHW: tuple[int, int, int],
    *,
    fps: float,
    geometry: LatentGeometry,
    convention: Convention = "consistent",
    first_latent_frame: int = 0,
    scale_hw: tuple[float, float] = (1.0, 1.0),
) -> torch.Tensor:
    """(3, N) float32: seconds, row px and column px of each token.

    Args:
        shape_FHW: latent frames, rows, columns.
        fps: video frames per second.
        geometry: pixels and frames per cell.
        convention: see the module.
        first_latent_frame: index of the first frame on the time axis.
        scale_hw: factors onto the target's grid; ignored by ``released``.
    """
    frames, rows, columns = (torch.arange(n, dtype=torch.float32) for n in shape_FHW)
    video_frames = (frames + first_latent_frame) * geometry.temporal
    if convention == "released":
        video_frames = (video_frames + 1 - geometry.temporal).clamp(min=0)
        scale_hw = (1.0, 1.0)
    rows = rows * geometry.spatial * scale_hw[0]
    columns = columns * geometry.spatial * scale_hw[1]
    return torch.stack(torch.meshgrid(video_frames / fps, rows, columns, indexing="ij")).flatten(1)


def sequence_coordinates(
    inputs: StageInputs, *, geometry: LatentGeometry, convention: Convention = "consistent"
) -> torch.Tensor:
    """(3, N) of the whole sequence: references in their order, then the target."""
    _, frames, height, width = inputs.target_shape
    parts = []
    for reference in inputs.references:
        shape_FHW = tuple(reference.latents_BCFHW.shape[2:])
        parts.append(
            token_coordinates(
                (shape_FHW[0], shape_FHW[1], shape_FHW[2]), fps=inputs.fps, geometry=geometry, convention=convention,
                first_latent_frame=reference.first_latent_frame, scale_hw=(height / shape_FHW[1], width / shape_FHW[2]),
            )
        )  # fmt: skip
    parts.append(token_coordinates((frames, height, width), fps=inputs.fps, geometry=geometry, convention=convention))
    return torch.cat(parts, dim=1)


def assemble_tokens(
    inputs: StageInputs,
    noisy_BCFHW: torch.Tensor,
    *,
    sigma_B: torch.Tensor,
    geometry: LatentGeometry,
    convention: Convention = "consistent",
) -> TokenSequence:
    """The sequence for a noisy target at ``sigma_B``; its first latent frame is replaced by the clean one."""
    target_BCFHW = torch.cat([inputs.first_frame_BCFHW.to(noisy_BCFHW), noisy_BCFHW[:, :, 1:]], dim=2)
    parts = [pack(reference.latents_BCFHW.to(noisy_BCFHW)) for reference in inputs.references]
    target_start = sum(part.shape[1] for part in parts)
    hidden_BNC = torch.cat([*parts, pack(target_BCFHW)], dim=1)
    batch, length = hidden_BNC.shape[:2]
    cells = target_BCFHW.shape[3] * target_BCFHW.shape[4]
    loss_mask_BN = torch.ones(batch, length - target_start, dtype=torch.bool, device=hidden_BNC.device)
    loss_mask_BN[:, :cells] = False
    timestep_BN = torch.zeros(batch, length, dtype=torch.float32, device=hidden_BNC.device)
    timestep_BN[:, target_start + cells :] = sigma_B.float().to(hidden_BNC.device)[:, None] * TIMESTEP_SCALE
    coordinates_3N = sequence_coordinates(inputs, geometry=geometry, convention=convention)
    return TokenSequence(
        hidden_BNC=hidden_BNC, timestep_BN=timestep_BN, target_start=target_start, loss_mask_BN=loss_mask_BN,
        coordinates_B3N=coordinates_3N.to(hidden_BNC.device).expand(batch, -1, -1),
    )  # fmt: skip


def sequence_tokens(inputs: StageInputs) -> tuple[int, int]:
    """(tokens of the target, tokens in all)."""
    _, frames, height, width = inputs.target_shape
    target = frames * height * width
    return target, target + sum(r.latents_BCFHW[0, 0].numel() for r in inputs.references)
