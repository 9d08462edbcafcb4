"""The camera's turn from small pictures of a textured world that only turns."""

import cv2
import numpy as np
import pytest

from labeling import picture_turn as module
from labeling.camera import prior_intrinsics
from labeling.picture_turn import TurnMeter, picture_turn, turn_view

WIDTH, HEIGHT = 528, 352


def turned_view(yaw_deg: float, pitch_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """A far wall before and after a turn (positive: things move right and down), and the true homography."""
    noise = np.random.default_rng(3).integers(0, 256, (HEIGHT // 8, WIDTH // 8, 3), dtype=np.uint8)
    wall = cv2.resize(noise, (WIDTH * 3, HEIGHT * 3), interpolation=cv2.INTER_CUBIC)
    camera = prior_intrinsics(WIDTH, HEIGHT)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    down, _ = cv2.Rodrigues(np.radians([-pitch_deg, 0.0, 0.0]))
    across, _ = cv2.Rodrigues(np.radians([0.0, yaw_deg, 0.0]))
    turn = matrix @ across @ down @ np.linalg.inv(matrix)
    middle = np.array([[1.0, 0, -WIDTH], [0, 1, -HEIGHT], [0, 0, 1]])
    pictures = [cv2.warpPerspective(wall, motion @ middle, (WIDTH, HEIGHT)) for motion in (np.eye(3), turn)]
    return np.stack(pictures), turn


@pytest.mark.parametrize(("yaw_deg", "pitch_deg"), [(0, 0), (1.25, 0), (-6, 0.5), (9, -1)])
def test_far_points_go_where_the_turn_takes_them(yaw_deg: float, pitch_deg: float) -> None:
    (before, after), turn = turned_view(yaw_deg, pitch_deg)
    found = picture_turn(turn_view(before), turn_view(after), width=WIDTH, height=HEIGHT)
    spots = np.array([[60.0, 180, 1], [264, 176, 1], [460, 200, 1]])
    gaps = [(spots @ motion.T)[:, :2] / (spots @ motion.T)[:, 2:] for motion in (found, turn)]
    assert np.abs(gaps[0] - gaps[1]).max() < 3.0


def test_pictures_with_nothing_in_common_turn_nothing() -> None:
    rng = np.random.default_rng(0)
    views = [turn_view(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)) for _ in range(2)]
    np.testing.assert_array_equal(picture_turn(*views, width=WIDTH, height=HEIGHT), np.eye(3))


def test_views_can_be_compared_again() -> None:
    """OpenCV's phase correlation multiplies its inputs by the window where they lie; views are shared."""
    rng = np.random.default_rng(3)
    frame = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8), (0, 0), 6)
    before, after = turn_view(frame), turn_view(np.roll(frame, 24, axis=1))
    kept = before.copy(), after.copy()
    first = picture_turn(before, after, width=WIDTH, height=HEIGHT)
    assert np.array_equal(before, kept[0]) and np.array_equal(after, kept[1])
    assert np.array_equal(picture_turn(before, after, width=WIDTH, height=HEIGHT), first)


def test_a_meter_tells_the_turn_since_any_moment_that_it_measured() -> None:
    """A panorama shown further on, in steps of 6, 10 and 2 px: each kind of look has moments of its own. A pixel of the
    small views is four of the frame: each step is within half of one."""
    noise = np.random.default_rng(5).integers(0, 256, (HEIGHT // 8, WIDTH // 4, 3), dtype=np.uint8)
    panorama = cv2.resize(noise, (2 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    meter = TurnMeter()
    for moment, place in {0: 0, 3: 6, 4: 16, 8: 18}.items():
        meter.reach(panorama[:, place : place + WIDTH], moment)
    middle = np.array([WIDTH / 2, HEIGHT / 2, 1])
    for moment, wanted in {0: -18, 3: -12, 4: -2, 8: 0}.items():
        x, y, scale = meter.since(moment) @ middle
        assert x / scale - WIDTH / 2 == pytest.approx(wanted, abs=2.0) and y / scale == pytest.approx(HEIGHT / 2, abs=1)


def test_a_moment_is_measured_once_and_nothing_is_due_that_nobody_began(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    calls: list[int] = []

    def counted(before: np.ndarray, after: np.ndarray, **size: int) -> np.ndarray:
        calls.append(len(calls))
        return picture_turn(before, after, **size)

    monkeypatch.setattr(module, "picture_turn", counted)
    meter = TurnMeter()
    assert not meter.due(9)
    meter.reach(frame, 9)
    assert not meter.due(12) and meter.due(13) and calls == []
    for _ in range(3):
        meter.reach(frame, 13)
    assert len(calls) == 1 and not meter.due(16)
    meter.forget()
    assert not meter.due(99) and np.array_equal(meter.since(9), np.eye(3))


def test_turns_follow_one_another_in_the_order_of_time(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    steps = [np.random.default_rng(n).normal(size=(3, 3)) for n in range(3)]
    left = iter(steps)
    monkeypatch.setattr(module, "picture_turn", lambda *_, **__: next(left))
    meter = TurnMeter()
    for moment in range(4):
        meter.reach(frame, moment)
    np.testing.assert_allclose(meter.since(0), steps[2] @ steps[1] @ steps[0])
    np.testing.assert_allclose(meter.since(1), steps[2] @ steps[1])
