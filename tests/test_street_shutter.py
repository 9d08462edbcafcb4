"""The street's rolling shutter: nothing changes without one, and a turn leans what stands upright."""

from functools import cache

import cv2
import numpy as np
import pytest
from ego_fixtures import driven

from dataset.street import Scenario, Street, StreetConfig
from dataset.street_shutter import BANDS, car_between, pose_between, row_bands
from labeling.errors import ConfigError

WIDTH, HEIGHT, FPS = 352, 234, 24.0


@cache
def street(scenario: Scenario = "turn", shutter_s: float = 0.0, seed: int = 3) -> Street:
    return Street(
        StreetConfig(
            seed=seed, width=WIDTH, height=HEIGHT, frames=8, scenario=scenario, rolling_shutter_s=shutter_s, fps=FPS
        )
    )


def shift_px(picture: np.ndarray, other: np.ndarray, rows: slice) -> float:
    """How far the middle of a band of rows lies to the right of the same band of another picture."""
    columns = slice(WIDTH // 4, 3 * WIDTH // 4)
    bands = [cv2.cvtColor(one, cv2.COLOR_RGB2GRAY)[rows, columns].astype(np.float32) for one in (other, picture)]
    window = cv2.createHanningWindow(bands[0].shape[::-1], cv2.CV_32F)
    return cv2.phaseCorrelate(bands[0], bands[1], window)[0][0]


@pytest.mark.parametrize("shutter_s", [0.02, 0.04], ids=str)
def test_a_sideways_turn_leans_upright_edges_by_rate_times_focal_length_times_time(shutter_s):
    rolling, still = (street(shutter_s=one).render(4).rgb for one in (shutter_s, 0.0))
    height = HEIGHT // 6
    upper, lower = slice(0, height), slice(HEIGHT - height, HEIGHT)
    elapsed = shutter_s * (HEIGHT - height) / (HEIGHT - 1)
    # To the right, so the picture goes to the left with time, and time goes down the rows.
    lean = np.radians(30.0) * WIDTH * elapsed
    assert shift_px(rolling, still, upper) - shift_px(rolling, still, lower) == pytest.approx(lean, abs=1.0)
    middle = slice(HEIGHT // 2 - height // 2, HEIGHT // 2 + height // 2)
    assert abs(shift_px(rolling, still, middle)) < 0.5, "the truth is that of the middle row"


def test_labels_are_those_of_the_middle_row_s_time():
    rolling, plain = (street("traffic", shutter_s=one).render(3) for one in (0.03, 0.0))
    assert not np.array_equal(rolling.rgb, plain.rgb)
    assert [thing.track_id for thing in rolling.objects] == [thing.track_id for thing in plain.objects]
    assert all(np.array_equal(a.box_xyxy, b.box_xyxy) for a, b in zip(rolling.objects, plain.objects, strict=True))


def test_a_standing_camera_sees_the_still_world_as_without():
    rolling, plain = (street("wall", shutter_s=one, seed=5) for one in (0.04, 0.0))
    rolling.drive.cam_to_street[:] = plain.drive.cam_to_street[:] = plain.drive.cam_to_street[0]
    assert np.array_equal(rolling.render(2).rgb, plain.render(2).rgb)


@pytest.mark.parametrize("index", [0, 7], ids=["first", "last"])
def test_the_first_and_the_last_frame_go_on_as_they_moved(index):
    rolling, still = (street(shutter_s=one).render(index).rgb for one in (0.04, 0.0))
    assert shift_px(rolling, still, slice(0, 40)) > 1.5


def test_bands_cover_every_row_once_about_the_middle():
    bands = list(row_bands(HEIGHT, shutter_s=0.04, fps=FPS))
    assert len(bands) == BANDS
    assert [row for (start, end), _ in bands for row in range(start, end)] == list(range(HEIGHT))
    late = np.array([time for _, time in bands])
    assert (np.diff(late) > 0).all() and late[0] == pytest.approx(-late[-1])
    assert late[-1] - late[0] == pytest.approx(0.04 * FPS * (1 - 1 / BANDS), rel=0.02)
    assert len(list(row_bands(16, shutter_s=0.01, fps=FPS))) == 16


def test_motion_between_frames_is_steady():
    poses = driven(np.full(5, 6.0), 30.0)
    assert np.allclose(pose_between(poses, 2.0), poses[2])
    half = pose_between(poses, 2.5)
    assert np.allclose(half @ np.linalg.inv(poses[2]) @ half, poses[3], atol=0.01)
    assert np.allclose(pose_between(poses, -1.0)[:3, :3], poses[1, :3, :3].T, atol=1e-9)
    assert np.allclose(pose_between(poses[:1], 0.3), poses[0])


def test_a_car_between_frames_takes_the_short_way_round():
    car = street("traffic")._cars[0]
    at_4, at_5 = car_between(car, 4.0), car_between(car, 5.0)
    assert np.array_equal(at_4.position, car.position[4:5]) and len(at_5.heading) == 1
    assert np.allclose(car_between(car, 4.5).position, (at_4.position + at_5.position) / 2, equal_nan=True)


@pytest.mark.parametrize("shutter_s", [-0.01, 0.05, float("nan")], ids=str)
def test_a_shutter_that_cannot_be_is_refused(shutter_s):
    with pytest.raises(ConfigError, match="rolling shutter"):
        StreetConfig(seed=1, rolling_shutter_s=shutter_s)
