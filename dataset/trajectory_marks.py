"""How a trajectory's moments look in its picture: a colour and a dash a mode, paler where less sure."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D

from dataset.tables import EgoTable

MODE_COLOURS = {
    "moving": "#2b6cb0", "turning": "#dd6b20", "still": "#718096", "held": "#b83280", "cut": "#c53030",
    "missing": "#c53030",
}  # fmt: skip
INK, FAINT, GRID = "#1a202c", "#4a5568", "#cbd5e0"

_SOLID = (0.0, ())
_DASHES = {
    "turning": (0.0, (3.0, 0.8)), "still": (0.0, (1.0, 0.8)), "held": (0.0, (4.0, 1.0, 1.0, 1.0)),
    "cut": (0.0, (0.5, 1.5)), "missing": (0.0, (0.5, 1.5)),
}  # fmt: skip
"""In line widths, so that modes are told apart in grey too; what is not here is solid."""
_PALEST = 0.3
_SHADES = 12


def moment_colours(ego: EgoTable) -> np.ndarray:
    """(T, 4) RGBA: the mode's colour, paler where it is less sure."""
    rgb = np.array([to_rgb(MODE_COLOURS.get(mode, INK)) for mode in ego.mode])
    # In steps, so that equal pieces can be drawn as one line.
    sure = np.round(np.clip(ego.confidence.astype(np.float64), 0, 1) * _SHADES) / _SHADES
    strength = _PALEST + (1 - _PALEST) * sure
    return np.concatenate([rgb * strength[:, None] + (1 - strength[:, None]), np.ones((len(rgb), 1))], axis=1)


def add_line(axes: Axes, points: np.ndarray, ego: EgoTable, *, width: float) -> None:
    """A line through (T, 2) points whose piece that leads to a point has the look of the point's moment."""
    colours, modes = moment_colours(ego), ego.mode
    if len(points) < 2:
        axes.plot(*points[0], "o", color=tuple(colours[0]), markersize=width * 1.5, zorder=4)
        return
    changed = (np.diff(colours[1:], axis=0) != 0).any(axis=1) | (modes[2:] != modes[1:-1])
    ends = [0, *(np.flatnonzero(changed) + 1).tolist(), len(points) - 1]
    pieces = [points[start : end + 1] for start, end in zip(ends[:-1], ends[1:], strict=True)]
    shades = [tuple(colours[start + 1]) for start in ends[:-1]]
    dashes = [_DASHES.get(modes[start + 1], _SOLID) for start in ends[:-1]]
    axes.add_collection(
        LineCollection(pieces, colors=shades, linestyles=dashes, linewidths=width, capstyle="butt", zorder=4)
    )


def legend_marks(ego: EgoTable) -> list[Line2D]:
    """What the picture's looks mean, those of the clip alone."""
    known = [mode for mode in MODE_COLOURS if mode in set(ego.mode)]
    lines = [
        Line2D([], [], color=MODE_COLOURS[mode], linestyle=_DASHES.get(mode, _SOLID), linewidth=3, label=mode)
        for mode in known
    ]
    return [*lines, Line2D([], [], color=GRID, linewidth=3, label="paler: less sure")]


def tidy(axes: Axes) -> None:
    """A pale grid and no frame."""
    axes.grid(True, color=GRID, alpha=0.55, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(colors=FAINT, labelsize=9, length=0)
    axes.spines[["top", "right", "left", "bottom"]].set_visible(False)
