"""The parts of ego-motion one by one: modes, speeds, smoothing, the road, calibration."""

from dataclasses import replace

import numpy as np
import pytest
from ego_fixtures import HEIGHT, WIDTH, driven, tracks_of

from labeling.camera import Intrinsics
from labeling.ego_calibration import calibrate_camera, find_turns, focal_from_turns, pooled_road
from labeling.ego_modes import cheapest_path, travel_signs
from labeling.ego_motion import RoadView
from labeling.ego_scale import Depths, pooled_pitch, step_in_heights
from labeling.ego_smoothing import smoothed
from labeling.ego_speed import LengthEvidence, run_speeds
from labeling.errors import DataError


def test_a_doubtful_step_does_not_switch_the_mode():
    costs = np.zeros((9, 3))
    costs[:, 1:] = 5.0
    costs[4] = [3.0, 5.0, 0.0]
    assert (cheapest_path(costs, switch_cost=4.0) == 0).all()
    assert (cheapest_path(costs, switch_cost=0.5) == 0).sum() == 8


def test_forward_is_assumed_and_evidence_overrules_it():
    axes = np.tile([0.0, 0.0, -1.0], (8, 1))
    assert (travel_signs(axes, np.zeros(8), turn_back_cost=12) == 1).all()
    assert (travel_signs(axes, np.full(8, -9.0), turn_back_cost=12) == -1).all()
    assert (travel_signs(-axes, np.zeros(8), turn_back_cost=12) == -1).all()


@pytest.mark.parametrize(("evidence", "sign"), [(-0.25, 1), (-0.75, -1)], ids=["doubtful", "clear"])
def test_a_run_is_backward_only_on_clear_evidence(evidence, sign):
    """Eight steps that say so a little add up to less than the prior, eight that say so plainly to more."""
    axes = np.tile([0.0, 0.0, -1.0], (8, 1))
    assert (travel_signs(axes, np.full(8, evidence), turn_back_cost=12) == sign).all()


def test_a_real_shake_is_kept_and_noise_is_not():
    rng = np.random.default_rng(0)
    slow = np.stack([np.sin(np.arange(120) / 20)] * 3, axis=1)
    noise = rng.normal(0, 0.05, slow.shape)
    groups = np.zeros(120, int)
    quiet = smoothed(slow + noise, np.full(slow.shape, 0.05), groups, lag=4)
    assert (quiet - slow).std() < 0.7 * noise.std()
    shaken = smoothed(slow + noise, np.full(slow.shape, 0.001), groups, lag=4)
    assert np.abs(shaken - slow - noise).max() < 0.01


def test_smoothing_never_reaches_over_a_cut():
    values = np.concatenate([np.zeros((20, 1)), np.ones((20, 1))])
    out = smoothed(values, np.full(values.shape, 0.5), np.repeat([0, 1], 20), lag=4)
    assert np.abs(out - values).max() < 1e-12


def road_of(pitch_rad, step, *, count=60, seed=0, noise=1e-4):
    """A road seen by a camera with this pitch after a step of this many heights."""
    rng = np.random.default_rng(seed)
    row = rng.uniform(0.08, 0.35, count)
    exact = step * (row * np.cos(pitch_rad) + np.sin(pitch_rad))
    return Depths(
        ids=np.arange(count), turned=np.stack([rng.uniform(-0.2, 0.2, count), row], axis=1),
        inverse_depth=exact + rng.normal(0, noise, count), sigma=np.full(count, noise),
    )  # fmt: skip


@pytest.mark.parametrize("pitch_deg", [-3.0, 0.0, 4.0], ids=str)
def test_pitch_and_step_come_from_one_line(pitch_deg):
    pitch = np.radians(pitch_deg)
    found, sigma = pooled_pitch([road_of(pitch, 0.3, seed=seed) for seed in range(8)])
    assert np.degrees(found) == pytest.approx(pitch_deg, abs=0.2)
    assert sigma < 0.01
    length, relative = step_in_heights(road_of(pitch, 0.3), found)
    assert length == pytest.approx(0.3, rel=0.02) and relative < 0.05


def test_kerbs_and_cars_on_the_road_do_not_lengthen_the_step():
    road = road_of(0.0, 0.3, count=80)
    near = road.inverse_depth.copy()
    near[:30] *= np.random.default_rng(1).uniform(1.3, 3.0, 30)
    length, _ = step_in_heights(Depths(ids=road.ids, turned=road.turned, inverse_depth=near, sigma=road.sigma), 0.0)
    assert length == pytest.approx(0.3, rel=0.03)


def test_no_road_is_said_to_be_none():
    empty = road_of(0.0, 0.3, count=0)
    assert step_in_heights(empty, 0.0) == (0.0, np.inf)
    assert pooled_pitch([empty] * 9) == (0.0, np.inf)


def evidence_of(speeds, *, seen, ratio_sigma=0.01):
    count = len(speeds)
    ratio = np.ones(count)
    ratio[1:] = speeds[1:] / speeds[:-1]
    return LengthEvidence(
        elapsed_s=np.full(count, 1 / 24), heights_per_s=speeds / 1.5,
        road_sigma=np.where(seen, 0.05, np.inf), ratio=ratio, ratio_sigma=np.full(count, ratio_sigma),
        depth_per_s=np.zeros(count),
    )  # fmt: skip


def test_ratios_carry_the_scale_where_no_road_is_seen():
    speeds = np.linspace(4, 9, 60)
    seen = np.arange(60) < 12
    found = run_speeds(
        evidence_of(speeds, seen=seen), np.ones(60, bool), height_m=1.5, scale_walk=0.04, default_depth_heights=8
    )
    assert np.allclose(found.metres_per_s, speeds, rtol=0.08)
    assert set(found.source[:12]) == {"road"} and set(found.source[12:]) == {"held"}
    assert found.sigma[55] > found.sigma[5]


def test_a_wrong_depth_counts_once_and_not_in_every_step():
    """Sixty steps share one guess of the scene's depth, here twice too large: four steps of road outweigh it."""
    speeds = np.full(60, 6.0)
    told = replace(evidence_of(speeds, seen=np.arange(60) < 4), depth_per_s=2 * speeds / 1.5 / 8)
    found = run_speeds(told, np.ones(60, bool), height_m=1.5, scale_walk=0.04, default_depth_heights=8)
    assert np.allclose(found.metres_per_s, speeds, rtol=0.03)


def test_one_step_alone_has_a_speed():
    found = run_speeds(
        evidence_of(np.array([6.0]), seen=np.array([True])), np.ones(1, bool), height_m=1.5, scale_walk=0.04,
        default_depth_heights=8,
    )  # fmt: skip
    assert found.metres_per_s[0] == pytest.approx(6.0)


def unknown_camera():
    return Intrinsics(
        width=WIDTH, height=HEIGHT, fx=640, fy=640, cx=(WIDTH - 1) / 2, cy=(HEIGHT - 1) / 2, source="prior",
        focal_sigma=0.25,
    )  # fmt: skip


@pytest.mark.parametrize("focal_px", [470.0, 640.0, 880.0], ids=str)
def test_turns_tell_the_focal_length(focal_px):
    rates = np.zeros(60)
    rates[12:50] = 30.0
    tracks = tracks_of(driven(np.full(60, 6.0), rates), focal_px=focal_px, noise_px=0.15)
    scale, sigma = focal_from_turns(find_turns([tracks], unknown_camera(), most=40), unknown_camera())
    assert 640 * scale == pytest.approx(focal_px, rel=0.08)
    assert sigma < 0.15


def test_a_straight_drive_keeps_the_prior_and_pools_the_pitch():
    runs = [tracks_of(driven(np.full(24, 8.0), pitch_deg=2.0), seed=seed) for seed in range(2)]
    found = calibrate_camera(runs, intrinsics=unknown_camera())
    assert found.intrinsics == unknown_camera() and found.turns == 0
    assert np.degrees(found.road.pitch_rad) == pytest.approx(2.0, abs=0.3)


def test_a_given_focal_length_is_kept():
    given = Intrinsics(width=WIDTH, height=HEIGHT, fx=500, fy=500, cx=319.5, cy=213.5, source="given")
    run = tracks_of(driven(np.full(24, 6.0), 30.0))
    assert calibrate_camera([run], intrinsics=given).intrinsics == given


def test_no_runs_cannot_be_calibrated():
    with pytest.raises(DataError, match="one or more runs"):
        calibrate_camera([], intrinsics=unknown_camera())


def test_runs_that_disagree_widen_the_pitch():
    def view(pitch):
        return RoadView(height_m=1.5, pitch_rad=pitch, pitch_sigma_rad=0.001)

    assert pooled_road([view(0.01), view(0.01)], 1.5).pitch_sigma_rad < 0.001
    assert pooled_road([view(-0.02), view(0.02)], 1.5).pitch_sigma_rad > 0.01
