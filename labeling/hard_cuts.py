"""Hard cuts between shots, found on small grey pictures.

A cut is where *every* picture just before differs from *every* picture just after (a flash lets the pictures before
and after it agree), and differs much more than pictures on the same side do among themselves (fast motion makes those
differ as well). Grey levels are replaced by their ranks within the picture, which no exposure step changes, and
pictures are compared at the best of a few small shifts, so that a jolt of the camera does not count.

What it cannot see: a jump within one scene that looks the same before and after (the same motorway, a minute later).
"""

import cv2
import numpy as np

THUMBNAIL_SIZE = (48, 32)
"""Width and height of the pictures that are compared."""

_REACH = 6
"""Pictures looked at on each side: a flash of up to five is seen through."""
_SHIFT = 2
# On ranks scaled to unit variance, unrelated pictures differ by 1.1. Set on real drives at up to 4 times their speed,
# with flashes, exposure steps, wipers and shaking put in: 0.28 at a ratio of 1.3 was the worst of them.
_LEAST_DIFFERENCE = 0.25
_LEAST_RATIO = 1.8
_FLAT_CONTRAST = 8.0


def thumbnail(luma: np.ndarray) -> np.ndarray:
    """(H, W) uint8 shrunk to ``THUMBNAIL_SIZE`` by area: (32, 48) uint8."""
    return cv2.resize(luma, THUMBNAIL_SIZE, interpolation=cv2.INTER_AREA)


def find_hard_cuts(thumbnails: np.ndarray) -> np.ndarray:
    """Which pictures are the first of a new shot.

    Args:
        thumbnails: (N, h, w) uint8, pictures in order, none shown twice in a row.

    Returns:
        (N,) bool; the first is never a cut.
    """
    count = len(thumbnails)
    cuts = np.zeros(count, dtype=bool)
    if count < 2:
        return cuts
    ranks = np.stack([_ranks(picture) for picture in thumbnails])
    # Shifts only make a difference smaller, so most steps are settled without them.
    unshifted = np.abs(np.diff(ranks, axis=0)).mean(axis=(1, 2))
    for i in np.flatnonzero(unshifted > _LEAST_DIFFERENCE) + 1:
        cuts[i] = _is_cut(ranks[max(0, i - _REACH) : i], ranks[i : i + _REACH])
    return cuts


def _is_cut(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether a cut lies between two stacks of ranks, (B, h, w) and (A, h, w)."""
    across = _difference(before[-1], after[0])
    if across <= _LEAST_DIFFERENCE:
        return False
    steps = [_difference(side[i - 1], side[i]) for side in (before, after) for i in range(1, len(side))]
    least = max(_LEAST_DIFFERENCE, _LEAST_RATIO * max(steps, default=0.0))
    return across > least and all(_difference(a, b) > least for a in before for b in after)


def _ranks(picture: np.ndarray) -> np.ndarray:
    """Grey levels as mid-ranks of zero mean and unit variance; nearly flat pictures keep little contrast."""
    counts = np.bincount(picture.ravel(), minlength=256)
    above = np.cumsum(counts)
    levels = ((above - 0.5 * counts) / above[-1] - 0.5) * np.sqrt(12.0)
    # Noise in black or fog must not be blown up to full contrast.
    return (levels * min(1.0, float(picture.std()) / _FLAT_CONTRAST)).astype(np.float32)[picture]


def _difference(first: np.ndarray, second: np.ndarray) -> float:
    """Mean absolute difference at the best shift of a few thumbnail pixels."""
    height, width = first.shape
    inner = first[_SHIFT : height - _SHIFT, _SHIFT : width - _SHIFT]
    return min(
        float(np.abs(inner - second[y : y + inner.shape[0], x : x + inner.shape[1]]).mean())
        for y in range(2 * _SHIFT + 1)
        for x in range(2 * _SHIFT + 1)
    )
