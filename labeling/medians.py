"""Medians of many small ragged groups at once: a call of ``np.median`` for each would cost more than what it serves."""

import numpy as np


def masked_median(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Medians over P of (N, P, ...) values, counting those that (N, P) ``mask`` names; 0 where it names none.

    Returns:
        (N, ...).
    """
    spread = mask.reshape(*mask.shape, *(1,) * (values.ndim - 2))
    ordered = np.sort(np.where(spread, values, np.inf), axis=1)
    count, rows = mask.sum(axis=1), np.arange(len(values))
    middle = ordered[rows, np.maximum(count - 1, 0) // 2] + ordered[rows, np.minimum(count // 2, mask.shape[1] - 1)]
    return np.where((count > 0).reshape(-1, *(1,) * (values.ndim - 2)), middle / 2, 0.0)
