"""Fixed-lag smoothing of steps: as much as the measurement noise asks for, and no more.

A camera on a car really shakes, and its labels should too. So each step is drawn towards a local parabola over its
neighbours only as far as its own scatter about that parabola is no more than the noise it was measured with.
"""

from functools import cache

import numpy as np


def smoothed(values: np.ndarray, sigma: np.ndarray, groups: np.ndarray, *, lag: int) -> np.ndarray:
    """Steps smoothed over ``lag`` neighbours on either side.

    Args:
        values: (m, k) a vector for each step: a rotation vector, a direction.
        sigma: (m, k) standard deviation each was measured with.
        groups: (m,) int; steps of different groups are never mixed (a cut, another mode, nothing seen lies between).
        lag: neighbours on either side; below two nothing is done.
    """
    out = values.copy()
    edges = np.flatnonzero(np.diff(groups)) + 1
    for part in np.split(np.arange(len(values)), edges):
        if lag >= 2 and len(part) > 2 * lag:
            out[part] = _smoothed_group(values[part], sigma[part], lag)
    return out


def _smoothed_group(values: np.ndarray, sigma: np.ndarray, lag: int) -> np.ndarray:
    count = len(values)
    fitted = np.empty_like(values)
    leverage = np.empty(count)
    for index in range(count):
        # At the ends the window leans inwards and keeps its width, so that the parabola stays determined.
        start = min(max(0, index - lag), count - 2 * lag - 1)
        offsets = np.arange(start, start + 2 * lag + 1) - index
        row = _parabola_row(tuple(offsets.tolist()))
        fitted[index] = row @ values[start : start + 2 * lag + 1]
        leverage[index] = row[index - start]
    scatter = values - fitted
    # White noise leaves (1 - leverage) of its variance about its own fit.
    free = np.maximum(1.0 - leverage, 0.1)[:, None]
    window = 4 * lag + 1
    actual = _running_mean(scatter**2 / free, window)
    expected = _running_mean(sigma**2, window)
    trust = np.clip(1.0 - expected / np.maximum(actual, 1e-30), 0.0, 1.0)
    return fitted + trust * scatter


def _running_mean(values: np.ndarray, window: int) -> np.ndarray:
    half = window // 2
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    at = np.arange(len(values))
    start, end = np.maximum(at - half, 0), np.minimum(at + half + 1, len(values))
    return (total[end] - total[start]) / (end - start)[:, None]


@cache
def _parabola_row(offsets: tuple[int, ...]) -> np.ndarray:
    """Weights that read a least-squares parabola through values at these offsets off at offset zero."""
    design = np.vander(np.array(offsets, dtype=np.float64), 3, increasing=True)
    return np.linalg.pinv(design)[0]
