"""Verdicts from paired differences: better, worse, no difference, or inconclusive with the reason. Pure.

An interval is a bootstrap over both what is drawn anew for a repetition, seeds, and what is drawn for the test, streets
(the pigeonhole bootstrap of Owen 2007, which errs on the wide side). With three seeds it is rough.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from labeling.errors import DataError
from training.metrics import Interval

Verdict = Literal["better", "worse", "no difference", "inconclusive"]
LEAST_SEEDS = 3
_DRAWS = 4000
SAME_SHARE = 0.1
"""Of what lies between the held first frame and the truth: less than this is no difference."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What one figure says of one comparison."""

    verdict: Verdict
    reason: str
    difference: Interval
    """First minus second, turned so that more is better."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """Whether a figure can be believed at all."""

    figure: str
    holds: bool
    reason: str


def crossed_interval(differences: np.ndarray, *, draws: int = _DRAWS, seed: int = 0) -> Interval:
    """Mean and 95 % interval of paired differences (S seeds, V streets), both drawn anew in each bootstrap draw; NaN
    where a street asks for nothing.

    Raises:
        DataError: nothing to compare.
    """
    table = np.asarray(differences, np.float64)
    table = table[:, np.isfinite(table).all(axis=0)]
    if table.ndim != 2 or not table.size:
        raise DataError("there are no paired differences; judge at least one street that shows what is asked for")
    rng = np.random.default_rng(seed)
    rows = rng.integers(0, table.shape[0], (draws, table.shape[0]))
    columns = rng.integers(0, table.shape[1], (draws, table.shape[1]))
    means = np.array([table[np.ix_(row, column)].mean() for row, column in zip(rows, columns, strict=True)])
    low, high = np.percentile(means, [2.5, 97.5])
    return Interval(mean=float(table.mean()), low=float(low), high=float(high), groups=table.shape[1])


def judge_gate(
    figure: str, truth: np.ndarray, trivial: Mapping[str, np.ndarray], *, more_is_better: bool, unit: str
) -> Gate:
    """Whether the judge tells the truth, through the VAE, from answers that need no model.

    Args:
        figure: its name.
        truth: (V,) of the truth's videos after the VAE.
        trivial: (V,) by name: the first frame held, another street's video.
        more_is_better: of the figure.
        unit: for the reason.
    """
    sign = 1.0 if more_is_better else -1.0
    unsure = [name for name, values in trivial.items() if crossed_interval(sign * (truth - values)[None]).low <= 0]
    shown = ", ".join(f"{np.nanmean(values):.2f} for {name}" for name, values in trivial.items())
    reason = f"on the truth through the VAE the judge reads {np.nanmean(truth):.2f} {unit}, against {shown}"
    return Gate(
        figure=figure, holds=not unsure,
        reason=reason + (f": not surely better than {' and '.join(unsure)}" if unsure else ""),
    )  # fmt: skip


def find(
    first: np.ndarray, second: np.ndarray, *, gate: Gate, trivial: Mapping[str, np.ndarray], same: float,
    more_is_better: bool,
) -> Finding:  # fmt: skip
    """The verdict on one figure.

    Args:
        first: (S, V) the arm that the method prefers.
        second: (S, V) the other.
        gate: of the judge.
        trivial: (V,) by name: what an arm must surely beat to have learnt anything.
        same: differences below this are none, in the figure's unit.
        more_is_better: of the figure.

    Returns:
        ``inconclusive`` where the judge fails, with too few seeds, where neither arm beats the trivial answers, or
        where the interval holds 0 and reaches beyond ``same``.
    """
    sign = 1.0 if more_is_better else -1.0
    difference = crossed_interval(sign * (first - second))
    if not gate.holds:
        return Finding(verdict="inconclusive", reason="the judge cannot judge this", difference=difference)
    if len(first) < LEAST_SEEDS:
        reason = f"{len(first)} of at least {LEAST_SEEDS} seeds"
        return Finding(verdict="inconclusive", reason=reason, difference=difference)
    for name, values in trivial.items():
        if all(crossed_interval(sign * (arm - values[None])).low <= 0 for arm in (first, second)):
            return Finding(
                verdict="inconclusive", reason=f"neither arm surely beats {name}", difference=difference
            )  # fmt: skip
    return Finding(**_read(difference, same), difference=difference)


def _read(difference: Interval, same: float) -> dict:
    if difference.low > 0:
        return {"verdict": "better", "reason": "the whole interval is above 0"}
    if difference.high < 0:
        return {"verdict": "worse", "reason": "the whole interval is below 0"}
    if max(-difference.low, difference.high) <= same:
        return {"verdict": "no difference", "reason": f"the interval lies within {same:.3g} of 0"}
    return {"verdict": "inconclusive", "reason": f"the interval holds 0 and reaches beyond {same:.3g} of it"}


def table_of(scores: Sequence[Mapping[str, Mapping[str, float]]], figure: str, keys: Sequence[str]) -> np.ndarray:
    """(S, V) of a figure from each seed's scores by clip; NaN where a clip has none."""
    return np.array([[seed.get(key, {}).get(figure, np.nan) for key in keys] for seed in scores])
