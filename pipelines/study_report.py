"""The study's results as a person sees them: a table and a contact sheet."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from dataset.pictures import write_picture

_STYLES = {"better": "green", "worse": "red", "no difference": "blue", "inconclusive": "dim"}
_ORDER = ("truth", "through the VAE", "first frame held")


def print_result(result: Mapping[str, Any], console: Console) -> None:
    """The verdicts, why, and every arm's figures."""
    table = Table(title="does the method work?", title_justify="left", box=None, pad_edge=False)
    for column in ("question", "figure", "difference (95 %)", "verdict", "because"):
        table.add_column(column, style="bold" if column == "question" else None)
    for question in result["questions"]:
        for place, (figure, finding) in enumerate(question["figures"].items()):
            gap, verdict = finding["difference"], finding["verdict"]
            shown = f"{gap['mean']:+.2f} ({gap['low']:+.2f} to {gap['high']:+.2f}) {finding['unit']}"
            table.add_row(
                escape(question["text"]) if not place else "", figure.replace("_", " "), shown,
                f"[{_STYLES[verdict]}]{verdict}[/]", escape(finding["reason"]),
            )  # fmt: skip
    console.print(table)
    console.print("differences are first minus second, turned so that more is better; keypoint error is the headline")
    arms = Table(title=escape("the arms, and [what they stand beside]"), title_justify="left", box=None, pad_edge=False)
    figures = ("keypoint_error", "track_survival", "recall", "min_ade", "apd")
    for column in ("arm", *figures):
        arms.add_column(column.replace("_", " "), justify="left" if column == "arm" else "right")
    for name, row in result["arms"].items():
        arms.add_row(escape(name), *(f"{row[figure]['mean']:.2f}" if figure in row else "" for figure in figures))
    console.print(arms)
    for gate in result["judge"].values():
        console.print(f"{gate['figure'].replace('_', ' ')}: {escape(gate['reason'])}")
    console.print(f"{result['processor_s']['in all'] / 60:.1f} processor minutes on {result['machine']}")


def draw_sheet(folder: Path, path: Path) -> None:
    """All strips of frames under one another, named: the truth first, then every arm."""
    strips = {file.stem: cv2.imread(str(file)) for file in sorted(folder.glob("*.png"))}
    names = [name for name in _ORDER if name in strips] + [name for name in strips if name not in _ORDER]
    rows = []
    for name in names:
        strip = strips[name]
        assert strip is not None
        large = cv2.resize(strip, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
        label = np.full((20, large.shape[1], 3), 255, np.uint8)
        cv2.putText(label, name, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 40, 40), 1, cv2.LINE_AA)
        rows += [label, large]
    if rows:
        write_picture(path, cv2.cvtColor(np.concatenate(rows, axis=0), cv2.COLOR_BGR2RGB))
