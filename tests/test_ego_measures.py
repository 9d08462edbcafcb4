"""What chart and stability table of ego-motion measure with: errors, harmed clips, trivial methods, every scenario."""

from dataclasses import replace

import numpy as np
import pytest
from ego_fixtures import driven

from dataset.street import SCENARIOS
from labeling.camera import Intrinsics
from labeling.errors import DataError
from pipelines import charts_ego, stability_ego
from pipelines.charts import CHARTS
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
from pipelines.stability import STABILITY

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


def test_every_scenario_of_the_table_is_played():
    numbers = [int(name.split()[0]) for name in stability_ego._SCENARIOS]
    assert numbers == list(range(1, 22))
    assert set(stability_ego._QUICK) <= set(stability_ego._SCENARIOS)
    assert CHARTS["ego"] == charts_ego.__name__ and STABILITY["ego"] == stability_ego.__name__
    assert {"still", "turn", "crawl", "fast", "wall", "road_only", "reverse"} <= set(SCENARIOS)


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
