"""Targeted noise: the appearance stage sees noise on the lit cells of its skeleton, so that it forgives wrong ones.

At sampling the skeleton is a prediction. Noise where skeleton pixels are, and nowhere else, teaches the appearance
stage not to trust them to the pixel (MAD, arXiv 2601.09452). The reference's timestep stays 0.

``variance`` (the paper): z + sqrt(omega) eps. ``blend`` (the released code's formula, which it never reaches):
(1 - omega) z + omega eps. omega ~ U(0, omega_max), one per sample.
"""

import numpy as np
import torch

from labeling.errors import DataError
from training.backbone import LatentGeometry
from training.config import Formula


def latent_mask(lit_THW: np.ndarray, *, geometry: LatentGeometry) -> np.ndarray:
    """(F, H, W) bool: latent cells that hold skeleton pixels in any frame of their group (1, then 8 each).

    Args:
        lit_THW: (T, H, W) bool per video frame and cell, from ``labeling.skeleton_video.lit_cells``.
        geometry: which frames share a latent frame.
    """
    groups = geometry.frame_groups(len(lit_THW))
    return np.stack([lit_THW[start:end].any(axis=0) for start, end in groups])


def add_targeted_noise(
    latents_CFHW: torch.Tensor,
    mask_FHW: torch.Tensor,
    *,
    omega: float,
    noise_CFHW: torch.Tensor,
    formula: Formula = "variance",
) -> torch.Tensor:
    """The latents with noise in lit cells; all other cells keep their very bits.

    Raises:
        DataError: the mask does not fit the latents.
    """
    if mask_FHW.shape != latents_CFHW.shape[1:]:
        raise DataError(
            f"the skeleton mask {tuple(mask_FHW.shape)} does not fit latents {tuple(latents_CFHW.shape)}; "
            "cache them anew"
        )
    noise = noise_CFHW.to(latents_CFHW)
    noisy = latents_CFHW + omega**0.5 * noise if formula == "variance" else (1 - omega) * latents_CFHW + omega * noise
    return torch.where(mask_FHW.bool()[None], noisy, latents_CFHW)
