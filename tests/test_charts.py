"""Charts and stability tables: the front, the files, the picture."""

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from labeling.errors import ConfigError, StorageError
from pipelines import stability_ego
from pipelines.charts import (
    CHARTS,
    Chart,
    ChartPoint,
    Cost,
    Error,
    _named_tick,
    draw_chart,
    interleaved_ms,
    pareto_front,
    run_chart,
    write_chart,
)
from pipelines.label_placing import crossing, place_labels
from pipelines.measure import show_stability
from pipelines.stability import STABILITY, judged, make_table, run_stability, write_stability


def point(method: str, ms: float, error: float, *, reference: bool = False) -> ChartPoint:
    return ChartPoint(
        method=method, ms_per_frame=Cost(median=ms, p95=ms, runs=3), reference=reference,
        error=Error(metric="end error", unit="m", median=error, p95=error),
    )  # fmt: skip


POINTS = (
    point("trivial", 0.1, 9.0, reference=True),
    point("fast", 1, 3.0),
    point("slower and worse", 2, 4.0),
    point("balanced", 4, 1.0),
    point("exact", 20, 0.5, reference=True),
)


def test_front_holds_what_nothing_beats() -> None:
    assert [p.method for p in pareto_front(POINTS)] == ["trivial", "fast", "balanced", "exact"]


def test_chart_files(tmp_path: Path) -> None:
    chart = Chart(stage="ego", data="a street", points=POINTS, machine="a machine")
    write_chart(chart, tmp_path)
    stored = json.loads((tmp_path / "chart-ego.json").read_text())
    assert [p["method"] for p in stored["points"]] == [p.method for p in POINTS]
    picture = cv2.imread(str(tmp_path / "chart-ego.png"))
    assert picture is not None and picture.shape[1] == 1200


@pytest.mark.parametrize("place", ["/proc/none", "file"], ids=["proc", "below a file"])
def test_a_folder_that_cannot_be_made_is_said_before_anything_is_measured(tmp_path: Path, monkeypatch, place) -> None:
    monkeypatch.setattr("importlib.import_module", lambda _: pytest.fail("it was measured"))
    (tmp_path / "file").write_text("")
    for measure, name in ((run_chart, "ego-video"), (run_stability, "ego")):
        with pytest.raises(StorageError, match=f"{place}/x: .*; give a folder that can be written to"):
            measure(name, out=tmp_path / place / "x")


def test_a_picture_that_cannot_be_written_is_an_error_of_storage(tmp_path: Path) -> None:
    (tmp_path / "chart-ego.png").mkdir()
    with pytest.raises(StorageError, match=r"chart-ego\.png: is a directory"):
        write_chart(Chart(stage="ego", data="a street", points=POINTS, machine="a machine"), tmp_path)


def test_each_group_has_a_front_of_its_own(tmp_path: Path) -> None:
    """One point of another group changes nothing in the front of the first, and is on its own."""

    def blue(points: tuple[ChartPoint, ...]) -> int:
        """Pixels in the colour of points on a front."""
        draw_chart(Chart(stage="a", data="", points=points, machine=""), tmp_path / "a.png")
        picture = cv2.imread(str(tmp_path / "a.png"))
        assert picture is not None
        return int((np.abs(picture.astype(int) - (0xB0, 0x6C, 0x2B)).max(axis=2) < 4).sum())

    beaten = point("other", 3, 8.0)
    assert blue((*POINTS, replace(beaten, group="b"))) > 1.2 * blue((*POINTS, beaten))


def test_another_cost_goes_by_its_own_name(tmp_path: Path) -> None:
    chart = Chart(stage="train", data="", points=POINTS, machine="", cost="ms_per_step", left_out=("compile: none",))
    write_chart(chart, tmp_path)
    stored = json.loads((tmp_path / "chart-train.json").read_text())
    assert stored["points"][1]["ms_per_step"]["median"] == 1 and "ms_per_frame" not in stored["points"][1]
    assert stored["left_out"] == ["compile: none"]


def test_names_are_clear_of_each_other_and_inside() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([300, 100], [500, 300], (8, 2))
    widths = [120.0] * 8
    bounds = (0.0, 0.0, 800.0, 500.0)
    starts = points + np.array(place_labels(points, widths, bounds))
    low, high = starts - [0, 8], starts + [120, 8]
    crossed = ((low[:, None] < high[None]) & (low[None] < high[:, None])).all(axis=-1)
    assert crossed.sum() == len(points)
    assert (low >= 0).all() and (high <= [800, 500]).all()


def test_leaders_cross_neither_each_other_nor_names() -> None:
    points = np.array([(300.0, 200.0), (318.0, 200.0), (322.0, 200.0), (280.0, 240.0), (326.0, 240.0)])
    widths = [124.0, 75.0, 120.0, 60.0, 30.0]
    starts = points + np.array(place_labels(points, widths, (0.0, 0.0, 800.0, 500.0)))
    middles = starts + np.array([(width / 2, 0.0) for width in widths])
    leaders = np.stack([points, middles], axis=1)
    assert not crossing(leaders[:, None], leaders[None]).any()
    low, high = starts - [0, 10], starts + [(width, 10) for width in widths]
    for corner in (low, high):
        other = low + high - corner
        across = np.stack([corner, np.stack([other[:, 0], corner[:, 1]], axis=1)], axis=1)
        mine = np.eye(len(points), dtype=bool)
        assert not (crossing(leaders[:, None], across[None]) & ~mine).any()


@pytest.mark.parametrize(
    ("line", "other", "cross"),
    [
        ([(0, 0), (2, 2)], [(0, 2), (2, 0)], True),
        ([(0, 0), (2, 2)], [(1, 1), (2, 0)], False),
        ([(0, 0), (2, 2)], [(3, 0), (5, 2)], False),
        ([(0, 0), (2, 0)], [(1, 1), (1, 5)], False),
    ],
    ids=["through", "touching", "apart", "short"],
)
def test_lines_cross(line: list[tuple[int, int]], other: list[tuple[int, int]], cross: bool) -> None:
    lines = np.array([line, other], np.float64)
    assert bool(crossing(lines[0], lines[1])) is cross and bool(crossing(lines[1], lines[0])) is cross


def test_ticks_are_named_as_people_write_numbers() -> None:
    named = [_named_tick(value) for value in (0, 0.02, 0.05, 0.3, 1, 20, 70, 100, 5000)]
    assert named == ["0", "0.02", "0.05", "", "1", "20", "", "100", "5000"]


def test_a_panel_for_each_error(tmp_path: Path) -> None:
    other = Error(metric="yaw", unit="degrees", median=0.5, p95=1.0)
    points = tuple(replace(point, more_errors=(other,)) for point in POINTS)
    write_chart(Chart(stage="one", data="a street", points=POINTS, machine="a machine"), tmp_path)
    write_chart(Chart(stage="two", data="a street", points=points, machine="a machine"), tmp_path)
    one, two = (cv2.imread(str(tmp_path / f"chart-{name}.png")) for name in ("one", "two"))
    assert one is not None and two is not None and two.shape[0] > 1.5 * one.shape[0]


def test_methods_take_turns() -> None:
    order: list[str] = []

    def method(name: str):
        return lambda: order.append(name) or 10

    costs = interleaved_ms([method("a"), method("b")], runs=3)
    assert order == ["a", "b"] * 3
    assert [cost.runs for cost in costs] == [3, 3]


@pytest.mark.parametrize(
    ("limits", "verdict"),
    [({"at_most": 1.0}, "not held"), ({"at_least": 1.0}, "held"), ({}, "reported")],
    ids=["above", "enough", "no bound"],
)
def test_verdicts(limits: dict[str, Any], verdict: str) -> None:
    assert judged("night", 2.0, unit="degrees", **limits).verdict == verdict


def test_tables_are_written(tmp_path: Path) -> None:
    write_stability(make_table("ego", "a street", [judged("night", 2.0, unit="m", at_most=3)]), tmp_path)
    assert json.loads((tmp_path / "stability-ego.json").read_text())["rows"][0]["verdict"] == "held"


@pytest.mark.parametrize(("table", "called"), [(CHARTS, "chart"), (STABILITY, "stability")], ids=["chart", "stability"])
def test_every_name_has_a_module_that_can_be_run(table: dict[str, str], called: str) -> None:
    """Read and not imported: some of them load torch."""
    for module in table.values():
        spec = find_spec(module)
        assert spec is not None and spec.origin is not None, module
        assert f"\ndef {called}(" in Path(spec.origin).read_text(), module


@pytest.mark.parametrize(
    ("method", "code"), [("default", 1), ("stock OpenCV", 0)], ids=["our own fails", "a reference fails"]
)
def test_only_our_own_methods_fail_the_command(
    method: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [judged("night", figure, unit="m", at_most=3, method=name) for name, figure in (("default", 2), (method, 4))]
    table = make_table("ego", "a street", rows, references=("stock OpenCV",))
    monkeypatch.setattr(stability_ego, "stability", lambda *, quick: table)
    assert show_stability("ego", out=tmp_path) == code
    assert "not held" in capsys.readouterr().out, "every row stays in the table"
    written = json.loads((tmp_path / "stability-ego.json").read_text())
    assert written["references"] == ["stock OpenCV"] and len(written["rows"]) == 2


def test_unknown_names_list_the_known(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="count"):
        run_chart("ergo", out=tmp_path)
    with pytest.raises(ConfigError, match="ergo"):
        run_stability("ergo", out=tmp_path)
