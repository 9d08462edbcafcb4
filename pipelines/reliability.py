"""What a point's score says: of the points that score 0.9, how many are right, in view and hidden.

A reliability diagram (DeGroot and Fienberg 1983; Guo et al. 2017): points sorted into bins by their score, and for each
bin the share that lies within 0.1 of the box diagonal. A wrong point with a high score is the failure that counts.
A low score is not a wrong point: scores are taught to say that a point is seen *and* found, so what scores low is
hidden (98.7 % of 4,568 points below 0.1, counted once), and mostly right, since the rest of the car says where it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

PointKind = Literal["all", "in view", "hidden"]
BINS = np.linspace(0.0, 1.0, 11)
NEAR_NINE = (0.85, 0.95)
"""What is taken for a score of 0.9."""
LEAST_AT_NINE = 0.85

_MEANING = (
    "A score says that a point is seen and found. What scores low is hidden, nearly all of it,\n"
    "and mostly right all the same: the rest of its object says where it is."
)
_LEAST_DRAWN = 0.5
"""Where the axis of shares begins, unless a share is lower."""
_COLOURS = ("#12355b", "#d9822b", "#3c8d5a", "#7a5195")
_HATCHES = ("", "//", "..", "xx")
_LINES: dict[PointKind, tuple[str, str]] = {"all": ("-", "full"), "in view": ("-", "full"), "hidden": ("--", "none")}
"""Dash and filling of the markers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReliabilityBin:
    """Points whose score lies in ``[low, high)``; the last bin holds 1 too."""

    low: float
    high: float
    points: int
    right: int

    @property
    def share(self) -> float:
        """Of the points, those that are right; NaN where there are none."""
        return self.right / self.points if self.points else float("nan")


@dataclass(frozen=True, slots=True, kw_only=True)
class ReliabilityCurve:
    """One line of the diagram."""

    name: str
    """Of what was measured; curves of the same points have the same."""
    kind: PointKind = "all"
    """Which of the points; ``hidden`` is what the truth says, and phantoms' points count as in view."""
    bins: tuple[ReliabilityBin, ...]


def reliability_curve(
    name: str, points: np.ndarray, *, edges: np.ndarray = BINS, kind: PointKind = "all"
) -> ReliabilityCurve:
    """Bins of (N, 3) ``scored_points``, by score, between ``edges``; of one kind of points."""
    if kind != "all":
        points = points[points[:, 2] == (kind == "hidden")]
    place = np.clip(np.searchsorted(edges, points[:, 0], side="right") - 1, 0, len(edges) - 2)
    return ReliabilityCurve(
        name=name, kind=kind,
        bins=tuple(
            ReliabilityBin(
                low=round(float(low), 6), high=round(float(high), 6), points=int((place == n).sum()),
                right=int(points[place == n, 1].sum()),
            )
            for n, (low, high) in enumerate(zip(edges[:-1], edges[1:], strict=True))
        ),
    )  # fmt: skip


def share_right(points: np.ndarray, *, low: float, high: float = np.inf) -> tuple[float, int]:
    """Share of right points among those that score in ``[low, high)``, NaN where there are none; and how many."""
    chosen = points[(points[:, 0] >= low) & (points[:, 0] < high), 1]
    return (float(chosen.mean()) if len(chosen) else float("nan")), len(chosen)


def draw_reliability(curves: Sequence[ReliabilityCurve], path: Path, *, title: str, note: str) -> None:
    """The diagram as a PNG: shares against scores above, below how many of the points score so.

    Args:
        curves: lines, drawn in their order; those of one name in one colour.
        path: where to write it.
        title: above the diagram.
        note: what was measured where, below it.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 7.2), dpi=150, layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(2.4, 1), sharex=True)
    _draw_shares(above, curves)
    _draw_counts(below, curves)
    for axes in (above, below):
        axes.grid(axis="y", color="0.9")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title, x=0.02, ha="left", fontsize=14)
    above.set_title(_MEANING, loc="left", fontsize=9.5, color="0.25")
    below.set_xlabel(f"score\n{note}", fontsize=9.5)
    figure.savefig(path, metadata={"Software": None})


def _draw_shares(axes: Any, curves: Sequence[ReliabilityCurve]) -> None:
    looks = _looks(curves)
    for curve in curves:
        filled = [one for one in curve.bins if one.points]
        dash, filling = _LINES[curve.kind]
        colour, marker = _COLOURS[looks[curve.name]], "os^v"[looks[curve.name]]
        axes.plot(
            [(one.low + one.high) / 2 for one in filled], [one.share for one in filled], color=colour, linestyle=dash,
            marker=marker, fillstyle=filling, markersize=6, linewidth=1.8, label=_label(curve),
        )  # fmt: skip
    axes.plot(
        [NEAR_NINE[0], 1],
        [LEAST_AT_NINE] * 2,
        color="0.2",
        linestyle=":",
        linewidth=2,
        label="at least, at a score of 0.9",
    )
    shares = [one.share for curve in curves for one in curve.bins if one.points]
    axes.set(
        xlim=(0, 1), ylim=(min([_LEAST_DRAWN, *shares]) - 0.03, 1.02), ylabel="share within 0.1 of the box diagonal"
    )
    axes.set_xticks(BINS)
    axes.legend(frameon=False, loc="lower center", fontsize=10)


def _draw_counts(axes: Any, curves: Sequence[ReliabilityCurve]) -> None:
    """Bars from zero, since nearly all points score next to nothing or nearly one; each says its figure."""
    looks = _looks(curves)
    width = 0.84 / max(1, len(curves)) * float(np.diff(BINS).min())
    highest = 0.0
    for number, curve in enumerate(curves):
        total = sum(one.points for other in curves if other.name == curve.name for one in other.bins)
        middles = [(one.low + one.high) / 2 + (number - (len(curves) - 1) / 2) * width for one in curve.bins]
        percents = [100 * one.points / max(1, total) for one in curve.bins]
        colour = _COLOURS[looks[curve.name]]
        axes.bar(
            middles, percents, width, color="white" if curve.kind == "hidden" else colour, edgecolor=colour,
            hatch=_HATCHES[looks[curve.name]],
        )  # fmt: skip
        for middle, percent in zip(middles, percents, strict=True):
            words = f"{percent:.0f}" if percent >= 10 else f"{percent:.1f}"
            axes.annotate(
                words, (middle, percent), xytext=(0, 2), textcoords="offset points", ha="center",
                fontsize=7, rotation=90 if len(curves) > 2 else 0,
            )  # fmt: skip
        highest = max([highest, *percents])
    axes.set(ylabel="% of all points", ylim=(0, 1.2 * max(highest, 1.0)))


def _looks(curves: Sequence[ReliabilityCurve]) -> dict[str, int]:
    """By name, in order: which colour, marker and hatch."""
    return {name: number % len(_COLOURS) for number, name in enumerate(dict.fromkeys(one.name for one in curves))}


def _label(curve: ReliabilityCurve) -> str:
    return curve.name if curve.kind == "all" else f"{curve.name}, {curve.kind}"
