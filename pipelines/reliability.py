"""Whether scores can be believed: of the points that score 0.9, how many are right.

A reliability diagram (DeGroot and Fienberg 1983; Guo et al. 2017): points sorted into bins by their score, and for each
bin the share that lies within 0.1 of the box diagonal. A wrong point with a high score is the failure that counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

BINS = np.linspace(0.0, 1.0, 11)
NEAR_NINE = (0.85, 0.95)
"""What is taken for a score of 0.9."""


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
    bins: tuple[ReliabilityBin, ...]


def reliability_curve(name: str, points: np.ndarray, *, edges: np.ndarray = BINS) -> ReliabilityCurve:
    """Bins of (N, 2) ``scored_points``, by score, between ``edges``."""
    place = np.clip(np.searchsorted(edges, points[:, 0], side="right") - 1, 0, len(edges) - 2)
    return ReliabilityCurve(
        name=name,
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
    """The diagram as a PNG: shares against scores above, how many points there are below.

    Args:
        curves: lines, drawn in their order.
        path: where to write it.
        title: above the diagram.
        note: what was measured where, below it.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context({"font.size": 11, "axes.spines.top": False, "axes.spines.right": False}):
        figure, (above, below) = plt.subplots(
            2, 1, figsize=(7.2, 7.0), height_ratios=(3, 1), sharex=True, layout="constrained"
        )
        above.plot([0, 1], [0, 1], color="0.6", linestyle=(0, (4, 4)), linewidth=1, label="as good as it says")
        above.plot([NEAR_NINE[0], 1], [0.85, 0.85], color="#b02a30", linewidth=1.2, label="least at a score of 0.9")
        colours = ("#1f5fa8", "#d9822b", "#3c8d5a", "#7a5195")
        width = 0.8 / max(1, len(curves)) * float(np.diff(BINS).min())
        for number, (curve, colour) in enumerate(zip(curves, colours, strict=False)):
            filled = [one for one in curve.bins if one.points]
            middles = [(one.low + one.high) / 2 for one in filled]
            above.plot(
                middles, [one.share for one in filled], color=colour, marker="o", markersize=5, linewidth=1.8,
                label=curve.name,
            )  # fmt: skip
            offset = (number - (len(curves) - 1) / 2) * width
            below.bar([x + offset for x in middles], [one.points for one in filled], width, color=colour)
        above.set(ylim=(0, 1.02), xlim=(0, 1), ylabel="share within 0.1 of the box diagonal", title=title)
        above.legend(frameon=False, loc="lower right")
        above.grid(color="0.92")
        below.set(yscale="log", ylabel="points", xlabel="score")
        below.grid(axis="y", color="0.92")
        below.set_axisbelow(True)
        figure.text(0.01, -0.02, note, ha="left", va="top", fontsize=8, color="0.35")
        figure.savefig(path, dpi=160, bbox_inches="tight", metadata={"Software": None})
        plt.close(figure)
