"""The synthetic street: random access, exact labels, flow that a tracker confirms, and drives that do what they say."""

import functools
from pathlib import Path

import cv2
import numpy as np
import pytest

from dataset.street import SCENARIOS, Scenario, Street, StreetConfig, write_street_video
from dataset.street_car_sizes import CAR_SHAPES
from dataset.street_cars import car_model, hidden_by_itself
from dataset.street_labels import project
from labeling.camera import invert, read_tum, resample, rotation_angle_deg
from labeling.errors import ConfigError
from labeling.schemas import keypoint_schema
from labeling.video import read_frames


def small(scenario: Scenario = "drive", *, seed: int = 3, frames: int = 48, **options) -> StreetConfig:
    """A street at a third of the size, which is quick."""
    return StreetConfig(seed=seed, width=352, height=234, frames=frames, scenario=scenario, **options)


@functools.cache
def small_street(scenario: Scenario = "drive") -> Street:
    """A street that several tests look at."""
    return Street(small(scenario, frames=121))


def test_a_frame_depends_on_nothing_but_its_number() -> None:
    forwards, backwards = Street(small()), Street(small())
    first = [forwards.render(i) for i in (5, 17, 40)]
    second = [backwards.render(i) for i in (40, 17, 5)][::-1]
    for a, b in zip(first, second, strict=True):
        assert a.rgb.tobytes() == b.rgb.tobytes()
        for x, y in zip(a.objects, b.objects, strict=True):
            assert x.track_id == y.track_id
            np.testing.assert_array_equal(x.points_xy, y.points_xy)
            np.testing.assert_array_equal(x.visible, y.visible)


def test_another_seed_is_another_street() -> None:
    assert (Street(small(seed=1)).render(9).rgb != Street(small(seed=2)).render(9).rgb).mean() > 0.3


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_scenario_renders_with_valid_labels(scenario: Scenario) -> None:
    street = small_street(scenario)
    frame = street.render(30)
    assert frame.rgb.shape == (234, 352, 3)
    assert frame.rgb.std() > 15
    records = street.keypoints(frame)
    assert len(records) == len(frame.objects)
    assert len({record.track_id for record in records}) == len(records)
    for record, thing in zip(records, frame.objects, strict=True):
        assert thing.points_xy.shape == (keypoint_schema(thing.schema).point_count, 2)
        inside = np.abs(thing.points_xy[thing.visible] - (175.5, 116.5)) <= (176.0, 117.0)
        assert inside.all()
        assert 0 < thing.visible_share <= 1
        assert (record.present == thing.visible).all()
        assert (thing.box_xyxy[2:] >= thing.box_xyxy[:2]).all()


@pytest.mark.parametrize("scenario", ["empty", "sharp_turn"])
def test_a_tracker_confirms_the_true_flow_at_every_depth(scenario: Scenario) -> None:
    street = Street(StreetConfig(seed=4, scenario=scenario, frames=60))
    errors: dict[tuple[float, float], list[np.ndarray]] = {(5, 10): [], (10, 25): [], (25, 60): []}
    for i in (8, 24, 40):
        one, two = (cv2.cvtColor(street.render(k).rgb, cv2.COLOR_RGB2GRAY) for k in (i, i + 1))
        depth, flow = street.depth(i), street.flow(i, i + 1)
        for band, found in errors.items():
            mask = ((depth >= band[0]) & (depth < band[1])).astype(np.uint8)
            corners = cv2.goodFeaturesToTrack(one, 400, 0.01, 7, mask=cv2.erode(mask, np.ones((5, 5), np.uint8)))
            assert corners is not None
            options = {"winSize": (21, 21), "maxLevel": 4}
            spots = corners.reshape(-1, 2)
            x, y = np.round(spots).astype(int).T
            guess = (spots + flow[y, x]).astype(np.float32)[:, None]
            there, good, _ = cv2.calcOpticalFlowPyrLK(one, two, corners, guess.copy(), flags=0, **options)
            back, again, _ = cv2.calcOpticalFlowPyrLK(two, one, there, np.empty(0), **options)
            kept = (
                (np.asarray(good) > 0).ravel()
                & (np.asarray(again) > 0).ravel()
                & (np.linalg.norm(back - corners, axis=2).ravel() < 0.5)
            )
            found.append(np.linalg.norm((there - corners)[:, 0] - flow[y, x], axis=1)[kept])
    for band, found in errors.items():
        every = np.concatenate(found)
        assert len(every) > 60, f"too few corners at {band} m"
        assert np.median(every) < 0.3, f"{band} m: {np.median(every):.3f} px"


def test_depth_of_the_ground_is_that_of_a_plane() -> None:
    street = Street(small("road_only", camera_height_m=1.7))
    depth, camera = street.depth(3), street.intrinsics
    rows = np.arange(150, 234)
    expected = 1.7 * camera.fy / (rows - camera.cy)
    np.testing.assert_allclose(depth[rows, 176], expected, rtol=1e-5)
    assert np.isinf(depth[20]).all()


def test_flow_to_itself_is_zero_and_the_sky_only_turns() -> None:
    street = small_street("turn")
    assert np.abs(street.flow(4, 4)).max() < 1e-3
    drive = small_street("fast")
    sky = np.isinf(drive.depth(2))
    assert np.abs(drive.flow(2, 9)[sky]).max() < 1e-3


def test_cars_hide_their_own_far_side() -> None:
    names = keypoint_schema("car24").point_names
    for shape in CAR_SHAPES:
        model = car_model(shape)
        from_behind = dict(zip(names, ~hidden_by_itself(model, np.array([-12.0, 0.0, 1.5])), strict=True))
        assert all(
            from_behind[f"rear_{part}_{side}"] for part in ("light", "plate", "low") for side in ("left", "right")
        )
        assert not any(from_behind[f"front_{part}_{side}"] for part in ("light", "low") for side in ("left", "right"))
        from_left = dict(zip(names, ~hidden_by_itself(model, np.array([1.0, 9.0, 1.5])), strict=True))
        assert from_left["front_wheel_left"] and from_left["rear_wheel_left"] and from_left["mirror_edge_left"]
        assert not from_left["front_wheel_right"] and not from_left["rear_plate_right"]
        mirrored = model.keypoints * (1, -1, 1)
        swapped = [names.index(n.replace("left", "~").replace("right", "left").replace("~", "right")) for n in names]
        np.testing.assert_allclose(mirrored[swapped], model.keypoints, atol=1e-9)


def test_visible_points_lie_on_their_object_and_hidden_ones_do_not_count() -> None:
    street = Street(StreetConfig(seed=2, scenario="traffic", frames=60))
    seen = 0
    for i in (10, 50):
        for thing in street.render(i).objects:
            if thing.category == "lane" or thing.box_xyxy[3] - thing.box_xyxy[1] < 40:
                continue
            points = thing.points_xy[thing.visible]
            outside = np.maximum(thing.box_xyxy[:2] - points, points - thing.box_xyxy[2:]).max(axis=1)
            assert (outside < 3.0).all(), f"{thing.category} {thing.track_id}: {outside.max():.1f} px outside its box"
            seen += len(points)
    assert seen > 100


def test_wheels_are_dark_and_rear_plates_light_where_the_labels_say() -> None:
    street = Street(StreetConfig(seed=2, scenario="traffic", frames=60))
    names = keypoint_schema("car24").point_names
    left, right = names.index("rear_plate_left"), names.index("rear_plate_right")
    checked = 0
    for i in (0, 20, 40):
        frame = street.render(i)
        for thing in frame.objects:
            if thing.category != "car" or not thing.visible[[left, right]].all() or thing.distance_m > 22:
                continue
            a, b = thing.points_xy[left], thing.points_xy[right]
            x, y = np.round(a + (b - a) * 0.06).astype(int)
            assert frame.rgb[y, x].min() > 120, f"no plate at {x}, {y} of frame {i}"
            checked += 1
    assert checked >= 3


def test_somebody_who_passes_behind_the_column_is_gone_for_about_a_second() -> None:
    street = small_street("crossing")
    shares = {}
    for i in range(0, 120, 2):
        for thing in street.render(i).objects:
            if thing.category == "person" and thing.distance_m < 25:
                shares.setdefault(thing.track_id, {})[i] = thing.visible_share
    assert len(shares) == 2
    gone = {
        track: [i for i in range(min(s), max(s)) if i % 2 == 0 and s.get(i, 0.0) < 0.02] for track, s in shares.items()
    }
    longest = max(len(frames) * 2 for frames in gone.values())
    assert 16 <= longest <= 40


def test_lane_points_run_from_near_to_far_along_the_paint() -> None:
    street = Street(StreetConfig(seed=6, scenario="empty", frames=30))
    frame = street.render(10)
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY).astype(float)
    lanes = [thing for thing in frame.objects if thing.category == "lane"]
    assert len(lanes) >= 3
    for lane in lanes:
        assert lane.points_xy[0, 1] > lane.points_xy[-1, 1]
        steps = np.linalg.norm(np.diff(lane.points_xy, axis=0), axis=1)
        assert steps.std() < 0.1 * steps.mean()
    solid = {900 + k + 1 for k, line in enumerate(street.plan.lines) if not line.dashed}
    for lane in lanes:
        if lane.track_id in solid:
            near = np.round(lane.points_xy[:8][lane.visible[:8]]).astype(int)
            assert np.median(grey[near[:, 1], near[:, 0]]) > 150


@pytest.mark.parametrize("scenario", ["still", "crossing", "lead_leaves", "cross_traffic"])
def test_a_still_camera_stands_still(scenario: Scenario) -> None:
    assert small_street(scenario).trajectory.path_length_m == 0.0


def test_drives_do_what_their_scenario_says() -> None:
    turn = small_street("turn").trajectory
    assert turn.path_length_m == 0.0
    assert rotation_angle_deg(turn.cam_to_world[24, :3, :3]) == pytest.approx(30.0)
    assert small_street("reverse").trajectory.positions[-1, 2] < -3
    assert small_street("crawl").trajectory.path_length_m == pytest.approx(2.5)
    assert small_street("fast").trajectory.positions[24, 2] == pytest.approx(30.0)
    sharp = small_street("sharp_turn").trajectory
    assert rotation_angle_deg(sharp.cam_to_world[-1, :3, :3]) == pytest.approx(90.0, abs=2)
    speeds = np.linalg.norm(np.diff(small_street("stop_and_go").trajectory.positions, axis=0), axis=1) * 24
    assert speeds.max() > 5 and (speeds < 1e-9).sum() > 20


def test_the_picture_moves_as_the_trajectory_says() -> None:
    street = Street(small("drive"))
    spot = np.array([[2.0, 0.3, 15.0]])
    for i in (0, 20):
        pixels, _ = project(spot, invert(street.trajectory.cam_to_world[i]), street.intrinsics)
        assert np.isfinite(pixels).all()
    relative = invert(street.drive.cam_to_street[0]) @ street.drive.cam_to_street[20]
    np.testing.assert_allclose(relative, street.trajectory.cam_to_world[20], atol=1e-9)


def test_camera_pitch_and_height_move_the_horizon() -> None:
    level, down = Street(small("road_only")), Street(small("road_only", camera_pitch_deg=5.0))
    horizons = [int(np.isfinite(street.depth(0)[:, 176]).argmax()) for street in (level, down)]
    assert horizons[0] - horizons[1] == pytest.approx(352 * np.tan(np.radians(5)), abs=2)


def test_the_road_lies_under_a_given_trajectory(real_data: Path) -> None:
    recorded = read_tum(real_data / "trajectories" / "comma2k19.tum")
    times = np.arange(0, 480) / 24
    given = resample(recorded, times)
    street = Street(small("drive", frames=480, trajectory=given))
    np.testing.assert_allclose(street.trajectory.cam_to_world, given.cam_to_world, atol=1e-6)
    ground, _ = street.drive.path.at(street.drive.arc_m)
    offset = street.drive.cam_to_street[:, :3, 3] - ground
    assert np.abs(offset[:, [0, 2]]).max() < 0.3
    np.testing.assert_allclose(-offset[:, 1], 1.5, atol=0.15)
    tilt = np.degrees(np.arcsin(street.drive.cam_to_street[:, 1, 2]))
    assert 2.5 < np.median(tilt) < 5.5
    depth = street.depth(240)
    assert 1.5 < depth[-1, 176] < 6


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scenario": "moon"}, "moon"),
        ({"frames": 0}, "at least one frame"),
        ({"width": 0}, "16x16"),
    ],
    ids=["scenario", "frames", "size"],
)
def test_a_street_that_cannot_be_is_refused(options: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        StreetConfig(**{"seed": 1, **options})


def test_a_short_trajectory_and_a_frame_outside_are_refused() -> None:
    given = Street(small(frames=10)).trajectory
    with pytest.raises(ConfigError, match="10 poses for 11 frames"):
        StreetConfig(seed=1, frames=11, trajectory=given)
    with pytest.raises(ConfigError, match="0 to 9"):
        Street(small(frames=10)).render(10)


def test_the_video_holds_the_rendered_frames(tmp_path: Path) -> None:
    config = StreetConfig(seed=5, width=192, height=128, frames=6, scenario="still")
    write_street_video(config, tmp_path / "street.mp4")
    write_street_video(config, tmp_path / "again.mp4")
    assert (tmp_path / "street.mp4").read_bytes() == (tmp_path / "again.mp4").read_bytes()
    frames = list(read_frames(tmp_path / "street.mp4"))
    assert len(frames) == 6
    assert np.abs(frames[3].astype(int) - Street(config).render(3).rgb).mean() < 6
