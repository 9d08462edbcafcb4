"""Smoothing: less jitter, no lag, nothing made up."""

import numpy as np
import pytest

from labeling.labels import POINT_DETECTED, POINT_INTERPOLATED, Keypoints
from labeling.smoothing import SmoothingSettings, fill_holes, smooth_series, smooth_tracks

SETTINGS = SmoothingSettings()


def series(path: np.ndarray, *, noise: float, points: int = 24, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Truth and noisy observation of points that follow a common (T, 2) path."""
    rng = np.random.default_rng(seed)
    truth = path[:, None] + rng.uniform(-40, 40, (1, points, 2))
    noisy = np.concatenate([truth + rng.normal(0, noise, truth.shape), np.ones((*truth.shape[:2], 1))], axis=2)
    return truth, noisy


def jitter(positions: np.ndarray) -> float:
    return float(np.diff(positions, n=2, axis=0).std())


def test_parked_cars_shake_less_than_half() -> None:
    truth, noisy = series(np.full((96, 2), 300.0), noise=1.5)
    smooth = smooth_series(noisy, SETTINGS)
    assert jitter(smooth) < 0.15 * jitter(noisy[..., :2])
    assert (smooth - truth).std() < 0.5 * (noisy[..., :2] - truth).std()


def lag_frames(smooth: np.ndarray, truth: np.ndarray, *, upsampled: int = 20) -> float:
    """The delay, in frames, that explains ``smooth`` best as a late ``truth``."""
    times = np.arange(len(truth))
    middle = slice(12, len(truth) - 12)
    shifts = np.arange(-3 * upsampled, 3 * upsampled + 1) / upsampled
    errors = [np.abs(smooth[middle] - np.interp(times - s, times, truth)[middle]).mean() for s in shifts]
    return float(shifts[int(np.argmin(errors))])


@pytest.mark.parametrize("motion", ["braking", "walking"])
def test_moving_points_do_not_lag(motion: str) -> None:
    t = np.arange(96) / 24
    if motion == "braking":  # 12 m/s down to a stop at 6 m/s^2, seen at 40 px a metre
        column = 40 * np.where(t < 2, 12 * t - 3 * t**2, 12.0)
    else:  # an ankle: 1 Hz, 30 px
        column = 30 * np.sin(2 * np.pi * t) + 20 * t
    truth, noisy = series(np.stack([column, np.full(96, 300.0)], axis=1), noise=1.0, points=12)
    smooth = smooth_series(noisy, SETTINGS)
    lags = [lag_frames(smooth[:, k, 0], truth[:, k, 0]) for k in range(12)]
    assert np.abs(np.mean(lags)) < 0.25
    assert np.abs(smooth - truth).mean() < np.abs(noisy[..., :2] - truth).mean()


def test_a_foot_that_swings_while_the_body_stands_is_followed() -> None:
    truth, noisy = series(np.full((96, 2), 300.0), noise=0.5)
    swing = 30 * np.sin(2 * np.pi * np.arange(96) / 18)
    truth[:, 0, 0] += swing
    noisy[:, 0, 0] += swing
    errors = (smooth_series(noisy, SETTINGS) - truth)[12:-12]
    assert np.abs(errors[:, 0]).max() < 3
    assert errors[:, 1:].std() < 0.5 * (noisy[..., :2] - truth).std(), "the body is as steady as if nothing swung"


def test_even_motion_passes_unchanged() -> None:
    t = np.arange(60)[:, None]
    truth, noisy = series(np.concatenate([3 * t + 0.1 * t**2, 200 - 2 * t], axis=1), noise=0)
    assert smooth_series(noisy, SETTINGS)[8:-8] == pytest.approx(truth[8:-8], abs=0.05)


def label(frame: int, *, x: float = 100.0, score: float = 0.8, present: bool = True, track: int = 3) -> Keypoints:
    points = np.zeros((24, 3), np.float32)
    if present:
        points[:] = (x, 200, score)
    return Keypoints(
        frame=frame, track_id=track, category="car", schema="car24", score=0.9, points=points,
        box_xyxy=np.array([x - 20, 180, x + 20, 220], np.float32),
        point_source=np.where(points[:, 2] > 0, POINT_DETECTED, 0).astype(np.int8),
    )  # fmt: skip


@pytest.mark.parametrize(("hole", "bridged"), [(6, True), (7, False)], ids=["a quarter of a second", "longer"])
def test_only_short_holes_are_bridged(hole: int, bridged: bool) -> None:
    frames = [t for t in range(40) if not 20 <= t < 20 + hole]
    out = smooth_tracks([label(t) for t in frames])
    assert [item.frame for item in out] == (list(range(40)) if bridged else frames)
    for item in out:
        made_up = 20 <= item.frame < 20 + hole
        assert (item.point_source == (POINT_INTERPOLATED if made_up else POINT_DETECTED)).all()


def test_nothing_crosses_a_break() -> None:
    before, after = [label(t, x=100) for t in range(10)], [label(t, x=500) for t in range(12, 22)]
    out = smooth_tracks(before + after, breaks=frozenset({11}))
    assert [item.frame for item in out] == [*range(10), *range(12, 22)]
    assert {round(float(item.points[0, 0])) for item in out} == {100, 500}


def test_absent_points_stay_absent() -> None:
    out = smooth_tracks([label(t, present=False) for t in range(20)])
    assert all(not item.present.any() for item in out)


def test_filled_scores_are_the_lesser_neighbour() -> None:
    points = np.zeros((3, 1, 3))
    points[0], points[2] = (0, 0, 0.4), (2, 2, 0.9)
    filled, made_up = fill_holes(points, 6)
    assert filled[1, 0].tolist() == [1, 1, 0.4] and made_up[:, 0].tolist() == [False, True, False]


def test_single_frames_survive() -> None:
    (out,) = smooth_tracks([label(5)])
    assert out.points == pytest.approx(label(5).points, abs=1e-3)
