"""A clip's way from above: where the camera was, where it looked, and how wide."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from matplotlib.ticker import MultipleLocator

from dataset.tables import EgoTable
from dataset.trajectory_marks import FAINT, INK, add_line, moment_colours, tidy

_LEAST_SPAN_M = 6.0
_LEAST_SHOWN_M = np.array([3.0, 2.0])
_VIEW_SHARE = 0.11
"""How far a view reaches, of the way's span."""
_HEADS_PER_VIEW = 0.26
_WIDEST_HALF_RAD = 1.2
_SAME_LOOK = math.cos(math.radians(3.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A way from above in metres, forward of the first camera to the right and left upwards."""

    way: np.ndarray
    """(T, 2) places."""
    looks: np.ndarray
    """(T, 2) unit directions in which the camera looks."""
    moments: Sequence[int]
    """Rows nearest to each whole second."""
    reach_m: float
    """How far a view is drawn."""
    half_angle: float
    """Of a view, radians."""
    low: np.ndarray
    """(2,) least forward and left of what is shown."""
    high: np.ndarray
    """(2,) greatest."""

    @property
    def aspect(self) -> float:
        """Width of what is shown over its height."""
        width, height = self.high - self.low
        return float(width / height)

    @property
    def apart(self) -> list[int]:
        """The moments in which the camera stands or looks otherwise than in the one before."""
        found = [self.moments[0]]
        for moment in self.moments[1:]:
            moved_m = float(np.linalg.norm(self.way[moment] - self.way[found[-1]]))
            if moved_m > 0.05 * self.reach_m or self.looks[moment] @ self.looks[found[-1]] < _SAME_LOOK:
                found.append(moment)
        return found

    def view(self, moment: int) -> np.ndarray:
        """(3, 2) the end of the left side of a view, the camera, and the end of the right side."""
        ahead = self.looks[moment]
        side = np.array([-ahead[1], ahead[0]]) * math.tan(self.half_angle)
        at = self.way[moment]
        return np.stack([at + self.reach_m * (ahead + side), at, at + self.reach_m * (ahead - side)])

    def head(self, moment: int) -> np.ndarray:
        """(4, 2) a dart at the camera, whose tip is where it looks."""
        ahead = self.looks[moment] * self.reach_m * _HEADS_PER_VIEW
        side = np.array([-ahead[1], ahead[0]]) * 0.55
        at = self.way[moment]
        return np.stack([at + ahead, at - 0.6 * ahead + side, at - 0.25 * ahead, at - 0.6 * ahead - side])


def plan_of(ego: EgoTable) -> Plan:
    """What is to be drawn of a clip, with limits that fit the way, its views and its labels."""
    poses, times = ego.trajectory.cam_to_world, ego.trajectory.timestamps_s
    way = np.stack([poses[:, 2, 3], -poses[:, 0, 3]], axis=1)
    looks = np.stack([poses[:, 2, 2], -poses[:, 0, 2]], axis=1)
    looks = looks / np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), 1e-9)
    span = max(_LEAST_SPAN_M, float(np.ptp(way, axis=0).max()))
    wanted = np.arange(math.floor(float(times[-1]) + 1e-6) + 1)
    half_angle = min(math.atan(ego.intrinsics.width / 2 / ego.intrinsics.fx), _WIDEST_HALF_RAD)
    plan = Plan(
        way=way, looks=looks, moments=[int(np.abs(times - second).argmin()) for second in wanted],
        reach_m=_VIEW_SHARE * span, half_angle=half_angle, low=way.min(axis=0), high=way.max(axis=0),
    )  # fmt: skip
    return _fitted(plan)


def draw_plan(axes: Axes, ego: EgoTable, plan: Plan) -> None:
    """The way, at each whole second the camera's heading and the open sides of its view."""
    colours = moment_colours(ego)
    for moment in plan.apart:
        view = plan.view(moment)
        axes.add_patch(Polygon(view, closed=True, facecolor=(*colours[moment][:3], 0.13), linewidth=0, zorder=2))
        axes.plot(*view.T, color=tuple(colours[moment]), linewidth=1.1, solid_joinstyle="miter", zorder=3)
    add_line(axes, plan.way, ego, width=3.2)
    for moment in plan.apart:
        axes.add_patch(
            Polygon(plan.head(moment), closed=True, facecolor=INK, edgecolor="white", linewidth=0.8, zorder=6)
        )
    _draw_labels(axes, plan, ego.trajectory.timestamps_s)
    axes.set_xlim(plan.low[0], plan.high[0])
    axes.set_ylim(plan.low[1], plan.high[1])
    axes.set_aspect("equal", adjustable="box")
    step = tick_step(float((plan.high - plan.low).max()))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(step))
    axes.set_xlabel("forward of the first camera, m", color=FAINT)
    axes.set_ylabel("left, m", color=FAINT)
    tidy(axes)


def tick_step(span_m: float) -> float:
    """Metres between ticks, a round number, so that there are five to twelve."""
    power = 10.0 ** math.floor(math.log10(span_m / 5))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= span_m / 5)


def _fitted(plan: Plan) -> Plan:
    """The plan with limits about everything that is drawn, no narrower than a band that can be read."""
    drawn = np.concatenate([plan.way, *(plan.view(moment) for moment in plan.moments), _label_spots(plan)])
    margin = 0.35 * plan.reach_m
    low, high = drawn.min(axis=0) - margin, drawn.max(axis=0) + margin
    lacking = np.maximum(0.0, _LEAST_SHOWN_M - (high - low)) / 2
    return Plan(
        way=plan.way, looks=plan.looks, moments=plan.moments, reach_m=plan.reach_m, half_angle=plan.half_angle,
        low=low - lacking, high=high + lacking,
    )  # fmt: skip


def _label_spots(plan: Plan) -> np.ndarray:
    """(M, 2) where the seconds stand: beside the way, on the side that it does not bend to, clear of the dart."""
    first, last = plan.looks[0], plan.looks[-1]
    outside = -1.0 if first[0] * last[1] - first[1] * last[0] > 0 else 1.0
    looks = plan.looks[plan.moments]
    beside = np.stack([-looks[:, 1], looks[:, 0]], axis=1)
    return plan.way[plan.moments] + plan.reach_m * (0.45 * outside * beside - 0.2 * looks)


def _draw_labels(axes: Axes, plan: Plan, times_s: np.ndarray) -> None:
    """Seconds beside the way; those that would lie on one another as one."""
    spots = _label_spots(plan)
    groups: list[list[int]] = []
    for number in range(len(spots)):
        if groups and np.linalg.norm(spots[number] - spots[groups[-1][0]]) < 0.65 * plan.reach_m:
            groups[-1].append(number)
        else:
            groups.append([number])
    for group in groups:
        first, last = (times_s[plan.moments[number]] for number in (group[0], group[-1]))
        axes.annotate(
            f"{first:.0f} to {last:.0f} s" if len(group) > 1 else f"{first:.0f} s", spots[group[0]], fontsize=9.5,
            color=INK, ha="center", va="center", zorder=7,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.8},
        )  # fmt: skip
