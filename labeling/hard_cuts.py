"""Hard cuts between shots, found on small grey pictures.

A cut is where *every* picture just before differs from *every* picture just after (a flash lets the pictures before
and after it agree), and differs much more than pictures on the same side do among themselves (fast motion makes those
differ as well). Pictures are compared after their brightness and contrast are taken out, and at the best of a few small
shifts, so that neither an exposure step nor a jolt of the camera counts.
"""

import cv2
import numpy as np

THUMBNAIL_SIZE = (48, 32)
"""Width and height of the pictures that are compared."""

_REACH = 3
_SHIFT = 2
_LEAST_DIFFERENCE = 0.45
_LEAST_RATIO = 1.8


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
    flat = _normalised(thumbnails)
    steps = np.array([_difference(flat[i - 1], flat[i]) for i in range(1, count)])
    for i in np.flatnonzero(steps > _LEAST_DIFFERENCE) + 1:
        before, after = range(max(0, i - _REACH), i), range(i, min(count, i + _REACH))
        across = min(_difference(flat[a], flat[b]) for a in before for b in after)
        within = [steps[j - 1] for j in (*before, *after) if j not in (before[0], i)]
        cuts[i] = across > _LEAST_DIFFERENCE and across > _LEAST_RATIO * max(within, default=0.0)
    return cuts


def _normalised(thumbnails: np.ndarray) -> np.ndarray:
    pictures = thumbnails.astype(np.float32)
    mean = pictures.mean(axis=(1, 2), keepdims=True)
    # Nearly flat pictures (black, fog) must not have their noise blown up to full contrast.
    spread = np.maximum(pictures.std(axis=(1, 2), keepdims=True), 8.0)
    return (pictures - mean) / spread


def _difference(first: np.ndarray, second: np.ndarray) -> float:
    """Mean absolute difference at the best shift of a few thumbnail pixels."""
    height, width = first.shape
    inner = first[_SHIFT : height - _SHIFT, _SHIFT : width - _SHIFT]
    return min(
        float(np.abs(inner - second[y : y + inner.shape[0], x : x + inner.shape[1]]).mean())
        for y in range(2 * _SHIFT + 1)
        for x in range(2 * _SHIFT + 1)
    )
