"""Chart and stability table of ego-motion: errors, harmed clips, trivial methods, scenarios and their verdicts."""

import json
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from ego_fixtures import driven

from dataset.street import Scenario, Street, StreetConfig
from labeling.camera import Intrinsics
from labeling.errors import DataError
from pipelines import charts_ego, ego_scenarios, ego_scenarios_harmed, stability_ego
from pipelines.charts import CHARTS, run_chart
from pipelines.ego_clips import kitti_clip
from pipelines.ego_errors import (
    direction_errors_deg,
    end_yaw_error_deg,
    farthest_m,
    path_m,
    rotation_errors_deg,
    typical_turn_deg,
    window_errors_m,
    yaw_deg,
)
from pipelines.ego_harm import in_condition, noisy, with_movers
from pipelines.ego_methods import EgoClip, constant_speed, constant_zero, default_and_stock
from pipelines.stability import STABILITY, judged

TURN = driven(np.full(25, 6.0), 24.0)


def made_up_clip(frames: int = 14) -> EgoClip:
    """Texture that slides to the left."""
    rng = np.random.default_rng(0)
    wide = rng.integers(0, 256, (24, 60, 3), dtype=np.uint8).repeat(8, axis=0).repeat(8, axis=1)
    return EgoClip(
        name="slide", frames=[wide[:192, 2 * index : 2 * index + 288].copy() for index in range(frames)],
        times_s=np.arange(frames) / 24, truth=np.tile(np.eye(4), (frames, 1, 1)),
        intrinsics=Intrinsics(width=288, height=192, fx=288, fy=288, cx=143.5, cy=95.5, source="given"),
    )  # fmt: skip


def test_the_truth_has_no_error():
    assert rotation_errors_deg(TURN, TURN).max() < 1e-5
    assert direction_errors_deg(TURN, TURN).max() < 1e-4
    assert window_errors_m(TURN, TURN, frames=11, fit_scale=False).max() < 1e-12
    assert end_yaw_error_deg(TURN, TURN) == 0


def test_one_scale_is_fitted_only_where_it_is_asked_for():
    twice = TURN.copy()
    twice[:, :3, 3] *= 2
    assert window_errors_m(twice, TURN, frames=11, fit_scale=True).max() < 1e-9
    assert window_errors_m(twice, TURN, frames=11, fit_scale=False).min() > 0.5
    assert path_m(twice) == pytest.approx(2 * path_m(TURN)) and farthest_m(twice) > farthest_m(TURN)


def test_no_step_is_as_wrong_as_sideways_and_height_can_be_left_out():
    still = np.tile(np.eye(4), (len(TURN), 1, 1))
    assert np.allclose(direction_errors_deg(still, TURN), 90.0)
    climbing = TURN.copy()
    climbing[:, 1, 3] -= np.linspace(0, 0.5, len(TURN))
    assert direction_errors_deg(climbing, TURN).min() > 1.0
    assert direction_errors_deg(climbing, TURN, ground_plane=True).max() < 1e-4


def test_yaw_is_positive_to_the_right_and_unwrapped():
    assert yaw_deg(TURN)[-1] == pytest.approx(24.0)
    assert yaw_deg(driven(np.zeros(241), 30.0))[-1] == pytest.approx(300.0)


def test_what_is_divided_by_is_never_nothing():
    assert typical_turn_deg(TURN, TURN) == 0.01


def test_trivial_methods():
    clip = made_up_clip()
    assert path_m(constant_zero(clip)) == 0
    straight = constant_speed(clip)
    assert path_m(straight) == pytest.approx(8.0 * 13 / 24)
    assert (np.diff(straight[:, 2, 3]) > 0).all() and np.allclose(straight[:, :3, :3], np.eye(3))


def test_default_and_stock_answer_for_every_frame():
    clip = made_up_clip()
    assert {name: poses.shape for name, poses in default_and_stock(clip)} == {
        "default": (14, 4, 4), "stock OpenCV": (14, 4, 4),
    }  # fmt: skip


def test_harmed_clips_are_the_same_each_time_and_leave_the_clip_alone():
    clip = made_up_clip()
    before = clip.frames[3].copy()
    for harm in (lambda: noisy(clip, 4), lambda: in_condition(clip, "wiper"), lambda: with_movers(clip, 0.3)):
        one, other = harm(), harm()
        assert len(one.frames) == len(clip.frames) and one.truth is clip.truth
        assert all(np.array_equal(a, b) for a, b in zip(one.frames, other.frames, strict=True))
        assert not np.array_equal(one.frames[3], before)
    assert np.array_equal(clip.frames[3], before)


def test_more_boards_for_a_larger_share():
    clip = made_up_clip()
    few, many = (
        sum((a != b).any(axis=-1).mean() for a, b in zip(with_movers(clip, share).frames, clip.frames, strict=True))
        for share in (0.2, 0.6)
    )
    assert 0 < few < many


def test_every_scenario_of_the_table_is_played_once_and_quick_plays_some(monkeypatch):
    named = stability_ego._SCENARIOS
    assert [int(name.split()[0]) for name in named] == list(range(1, 22)) and len(set(named.values())) == 21
    monkeypatch.setattr(
        stability_ego, "_SCENARIOS", {name: lambda name: [judged(name, 1.0, unit="times")] for name in named}
    )
    assert [row.scenario for row in stability_ego.stability().rows] == list(named)
    played = [row.scenario for row in stability_ego.stability(quick=True).rows]
    assert played == [name for name in named if name in stability_ego._QUICK] and len(played) == 5


def test_the_table_and_the_chart_of_ego_are_where_they_are_said_to_be():
    assert CHARTS["ego"] == charts_ego.__name__ and STABILITY["ego"] == stability_ego.__name__


@cache
def small_street(scenario: Scenario) -> EgoClip:
    """A second of a scenario, a quarter of the table's picture."""
    street = Street(StreetConfig(seed=1, width=240, height=160, frames=24, scenario=scenario))
    return EgoClip(
        name=scenario, frames=[street.render(index).rgb for index in range(24)], times_s=np.arange(24) / 24,
        truth=street.trajectory.cam_to_world, intrinsics=street.intrinsics,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["3 pure turn", "4 crawl", "8 one plane", "19 reversing"])
def test_scenarios_are_held_on_a_second_of_a_small_street(name, monkeypatch):
    monkeypatch.setattr(ego_scenarios, "street_clip", small_street)
    rows = stability_ego._SCENARIOS[name](name)
    ours, stock = ([row for row in rows if row.method == method] for method in ("default", "stock OpenCV"))
    assert ours and stock and len(ours) + len(stock) == len(rows)
    assert [row for row in ours if row.verdict != "held"] == []


def test_each_step_backwards_in_a_crawl_is_a_flip(monkeypatch):
    clip = replace(made_up_clip(25), truth=driven(np.full(25, 0.5)))
    back = clip.truth.copy()
    back[[8, 16], 2, 3] -= 0.1
    monkeypatch.setattr(ego_scenarios, "street_clip", lambda _: clip)
    monkeypatch.setattr(
        ego_scenarios, "default_and_stock", lambda clip: [("default", clip.truth), ("stock OpenCV", back)]
    )
    flips = [row for row in ego_scenarios.crawl("crawl") if row.unit == "flips of direction"]
    assert [(row.figure, row.verdict) for row in flips] == [(0, "held"), (2, "not held")]


@pytest.mark.parametrize(
    ("confidence", "least", "verdict"),
    [(0.9, 0.5, "not held"), (0.3, 0.5, "held"), (0.3, None, "not held")],
    ids=["sure of it", "says so", "no excuse"],
)
def test_an_estimate_that_got_worse_is_excused_only_where_it_says_so(monkeypatch, confidence, least, verdict):
    """Five times the rotation error of the unharmed clip, where twice is allowed."""
    clip = replace(made_up_clip(25), truth=TURN)
    clean, worse = (driven(np.full(25, 6.0), 24.0 + 24 * error) for error in (0.05, 0.25))
    harmed = SimpleNamespace(trajectory=SimpleNamespace(cam_to_world=worse), confidence=np.full(25, confidence))
    monkeypatch.setattr(ego_scenarios_harmed, "default_motion", lambda _: harmed)
    monkeypatch.setattr(ego_scenarios_harmed, "stock_opencv", lambda _: worse)
    monkeypatch.setattr(
        ego_scenarios_harmed, "default_and_stock", lambda _: [("default", clean), ("stock OpenCV", worse)]
    )
    ours, stock = ego_scenarios_harmed._against_clean("night", clip, clip, times=2.0, least_confidence=least)
    assert ours.figure == pytest.approx(5, rel=0.01) and ours.verdict == verdict
    assert ("says so" in ours.note) is (verdict == "held")
    assert stock.figure == pytest.approx(1) and stock.verdict == "held"


def test_the_chart_tells_its_methods_apart(tmp_path):
    chart = run_chart("ego", out=tmp_path, quick=True)
    stored = json.loads((tmp_path / "chart-ego.json").read_text())
    assert [point["method"] for point in stored["points"]] == list(charts_ego._METHODS)
    assert (tmp_path / "chart-ego.png").is_file()
    away_m = {point.method: point.error.median for point in chart.points}
    turned_deg = {point.method: point.more_errors[0].median for point in chart.points}
    default, stock = "ladder at 1/2 (default)", "stock findEssentialMat + recoverPose"
    assert away_m[default] < 0.02 * away_m["constant zero"]
    assert turned_deg[default] < 0.5 * turned_deg[stock]
    assert turned_deg["constant forward speed"] > 1, "the drive does not turn"
    assert away_m[default] < 0.05 * away_m["constant forward speed"]


def test_names_of_methods_stand_by_themselves():
    assert not [name for name in charts_ego._METHODS if "the same" in name]


def test_windows_are_five_seconds_or_the_clip():
    clip = made_up_clip()
    assert charts_ego._window(clip) == 14
    slow = replace(clip, times_s=np.arange(14) / 2)
    assert charts_ego._window(slow) == 11


def test_real_material_that_is_absent_says_where_it_should_be(monkeypatch, tmp_path):
    monkeypatch.setenv("ANIMATIC_REAL_DATA", str(tmp_path))
    with pytest.raises(DataError, match="ANIMATIC_REAL_DATA"):
        kitti_clip()
