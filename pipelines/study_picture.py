"""The study as a picture: what arms differ by, and how far every arm is from the truth and from trivial answers."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

FIGURES = {
    "keypoint_error": "keypoint error (box corners), px, less is better",
    "track_survival": "track survival, share of the clip, more is better",
    "min_ade": "minADE, m, less is better",
}
"""A column of panels each, and its title."""
BESIDES = {
    "[vae]": "truth through the VAE", "[held]": "first frame held", "[another street]": "another street's video",
}  # fmt: skip
"""What arms stand beside, by its name among the arms: the best that can be, and answers that need no model."""

_INK, _FAINT = "#1a202c", "#4a5568"
_VERDICTS = {
    "better": ("#1c7c43", "^", ""), "worse": ("#b3261e", "v", ""), "no difference": ("#2b6cb0", "s", ""),
    "inconclusive": ("#4a5568", "o", "white"),
}  # fmt: skip
"""Colour, marker, and its filling where that is another."""
_BESIDE_LOOKS: dict[str, tuple[str, Any]] = {"[vae]": ("D", "-"), "[held]": ("s", "--"), "[another street]": ("X", ":")}
"""Marker, and dash of the line through all arms."""


def draw_study(result: Mapping[str, Any], path: Path) -> None:
    """A column per figure: paired differences above, the arms themselves beside truth and trivial answers below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 8.6), dpi=110, layout="constrained")
    rows = len(result["questions"]), len(_arm_rows(result))
    panels = figure.subplots(2, len(FIGURES), sharey="row", height_ratios=rows)
    for (name, title), above, below in zip(FIGURES.items(), *panels, strict=True):
        _draw_differences(above, result, name)
        _draw_arms(below, result, name)
        above.set_title(f"{title}\n{shared_reason(result, name)}", fontsize=10, color=_INK)
        for axes in (above, below):
            axes.grid(axis="x", color="#e2e8f0")
            axes.set_axisbelow(True)
            axes.spines[["top", "right"]].set_visible(False)
            axes.tick_params(colors=_INK, labelsize=9)
            axes.locator_params(axis="x", nbins=6)
    questions = result["questions"]
    named = [f"{question['text']}\n{question['verdict']}" for question in questions]
    panels[0][0].set_yticks(range(len(questions)), named)
    panels[0][0].set_ylim(len(questions) - 0.5, -0.5)
    arms = _arm_rows(result)
    panels[1][0].set_yticks(range(len(arms)), [BESIDES.get(arm, arm) for arm in arms])
    panels[1][0].set_ylim(len(arms) - 0.5, -0.5)
    figure.legend(handles=_legend(result), loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    scale = result["plan"]["scale"]
    figure.suptitle(
        f"animatic study: {len(result['seeds'])} seeds, {scale['val_clips']} streets, "
        f"{result['processor_s']['in all'] / 60:.0f} processor minutes; means and 95 % intervals; above paired "
        "differences of two arms, below each arm by itself", fontsize=11, color=_INK,
    )  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Software": None})


def shared_reason(result: Mapping[str, Any], figure: str) -> str:
    """Why the verdicts on a figure are what they are, where all questions have one reason; else nothing."""
    reasons = {question["figures"][figure]["reason"] for question in result["questions"]}
    verdicts = {question["figures"][figure]["verdict"] for question in result["questions"]}
    if len(reasons) > 1 or len(verdicts) > 1:
        return ""
    return f"all {verdicts.pop()}:\n{reasons.pop()}"


def _arm_rows(result: Mapping[str, Any]) -> list[str]:
    """The arms in the order in which questions ask for them, then what they stand beside."""
    asked = dict.fromkeys(arm for question in result["questions"] for arm in (question["first"], question["second"]))
    return [*asked, *(name for name in BESIDES if name in result["arms"])]


def _draw_differences(axes: Any, result: Mapping[str, Any], figure: str) -> None:
    axes.axvline(0, color=_INK, linewidth=1.0)
    for row, question in enumerate(result["questions"]):
        finding = question["figures"][figure]
        gap = finding["difference"]
        colour, marker, filling = _VERDICTS[finding["verdict"]]
        axes.plot([gap["low"], gap["high"]], [row, row], color=colour, linewidth=2.5, solid_capstyle="butt")
        axes.plot(
            gap["mean"], row, marker, color=colour, markerfacecolor=filling or colour, markersize=8, markeredgewidth=2
        )
    low, high = axes.get_xlim()
    reach = 1.08 * max(abs(low), abs(high))
    axes.set_xlim(-reach, reach)
    axes.set_xlabel("← second is better        first is better →", fontsize=9, color=_INK)


def _draw_arms(axes: Any, result: Mapping[str, Any], figure: str) -> None:
    for row, name in enumerate(_arm_rows(result)):
        interval = result["arms"][name].get(figure)
        if interval is None:
            continue
        marker, dash = _BESIDE_LOOKS.get(name, ("o", ""))
        colour = _FAINT if name in BESIDES else _INK
        axes.plot([interval["low"], interval["high"]], [row, row], color=colour, linewidth=2.5, solid_capstyle="butt")
        axes.plot(interval["mean"], row, marker, color=colour, markersize=7)
        if name in BESIDES:
            axes.axvline(interval["mean"], color=_FAINT, linestyle=dash, linewidth=1.3, zorder=0)
    axes.margins(x=0.06)


def _legend(result: Mapping[str, Any]) -> list[Any]:
    """The verdicts that occur, and the lines of what arms stand beside."""
    from matplotlib.lines import Line2D

    found = {finding["verdict"] for question in result["questions"] for finding in question["figures"].values()}
    marks = [
        Line2D([], [], color=colour, marker=marker, markerfacecolor=filling or colour,
               markersize=8, markeredgewidth=2, linewidth=2.5, label=verdict)
        for verdict, (colour, marker, filling) in _VERDICTS.items()
        if verdict in found
    ]  # fmt: skip
    lines = [
        Line2D([], [], color=_FAINT, marker=marker, linestyle=dash, linewidth=1.3, label=BESIDES[name])
        for name, (marker, dash) in _BESIDE_LOOKS.items()
        if name in result["arms"]
    ]
    return marks + lines
