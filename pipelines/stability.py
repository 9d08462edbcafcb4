"""Where methods fail: named scenarios, a figure and a bound for each, held or not, never left out."""

import importlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from dataset.receipts import atomic_write, storage_errors, try_folder
from labeling.errors import ConfigError
from pipelines.charts import machine_name
from pipelines.reliability import ReliabilityBin, ReliabilityCurve, draw_reliability

STABILITY: dict[str, str] = {
    "ego": "pipelines.stability_ego",
    "keypoints": "pipelines.stability_keypoints",
}
"""The module of each table; it has ``stability(*, quick) -> StabilityTable``."""

Verdict = Literal["held", "not held", "reported"]


@dataclass(frozen=True, slots=True, kw_only=True)
class StabilityRow:
    """One scenario played against one method."""

    scenario: str
    method: str
    figure: float
    """What was measured."""
    unit: str
    bound: str
    """As a person reads it, such as ``<= 0.1``."""
    verdict: Verdict
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class StabilityTable:
    """All scenarios of a stage."""

    stage: str
    data: str
    machine: str
    rows: tuple[StabilityRow, ...]
    curves: tuple[ReliabilityCurve, ...] = ()
    """Whether scores can be believed, where the stage gives scores; drawn as ``reliability-<stage>.png``."""
    references: tuple[str, ...] = ()
    """Methods that stand beside ours for comparison; where they fail, nothing of ours does."""

    @property
    def failed(self) -> tuple[StabilityRow, ...]:
        """The rows of our own methods whose bound is not held."""
        return tuple(row for row in self.rows if row.verdict == "not held" and row.method not in self.references)


def judged(
    scenario: str, figure: float, *, unit: str, at_most: float | None = None, at_least: float | None = None,
    method: str = "default", note: str = "",
) -> StabilityRow:  # fmt: skip
    """A row with its verdict; without a bound the figure is reported only."""
    if at_most is not None:
        bound, held = f"<= {at_most:g}", figure <= at_most
    elif at_least is not None:
        bound, held = f">= {at_least:g}", figure >= at_least
    else:
        return StabilityRow(
            scenario=scenario, method=method, figure=figure, unit=unit, bound="", verdict="reported", note=note
        )
    return StabilityRow(
        scenario=scenario, method=method, figure=figure, unit=unit, bound=bound,
        verdict="held" if held else "not held", note=note,
    )  # fmt: skip


def run_stability(name: str, *, out: Path, quick: bool = False) -> StabilityTable:
    """Play the scenarios of the stage called ``name`` and write ``stability-<name>.json`` into ``out``.

    Raises:
        ConfigError: no table has that name.
        StorageError: ``out`` cannot be written to.
    """
    if name not in STABILITY:
        raise ConfigError(
            f"no stability table is called {name!r}; choose one of {', '.join(STABILITY) or 'none so far'}"
        )
    # Before the minutes are spent.
    try_folder(out)
    table: StabilityTable = importlib.import_module(STABILITY[name]).stability(quick=quick)
    write_stability(table, out)
    return table


def write_stability(table: StabilityTable, out: Path) -> None:
    """``stability-<stage>.json`` in the folder ``out``, and where the table has curves ``reliability-<stage>.png``."""
    values = asdict(table)
    for optional in ("curves", "references"):
        if not values[optional]:
            values.pop(optional)
    text = json.dumps(values, indent=1, ensure_ascii=False) + "\n"
    atomic_write(out / f"stability-{table.stage}.json", text.encode())
    if table.curves:
        draw_curves(table, out)


def draw_curves(table: StabilityTable, out: Path) -> None:
    """``reliability-<stage>.png`` in the folder ``out``."""
    picture = out / f"reliability-{table.stage}.png"
    with storage_errors(picture):
        draw_reliability(table.curves, picture, title=f"{table.stage}: what a score says", note=table.data)


def read_stability(path: Path) -> StabilityTable:
    """A table as ``write_stability`` wrote it, to be drawn again without being measured again."""
    values = json.loads(path.read_text(encoding="utf-8"))
    rows = tuple(StabilityRow(**row) for row in values.pop("rows"))
    curves = tuple(
        ReliabilityCurve(**curve | {"bins": tuple(ReliabilityBin(**one) for one in curve["bins"])})
        for curve in values.pop("curves", [])
    )
    return StabilityTable(**values, rows=rows, curves=curves)


def make_table(
    stage: str, data: str, rows: Sequence[StabilityRow], *, references: tuple[str, ...] = ()
) -> StabilityTable:
    """A table measured on this machine."""
    return StabilityTable(stage=stage, data=data, machine=machine_name(), rows=tuple(rows), references=references)
