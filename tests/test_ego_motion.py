"""Ego-motion on made-up streets with exact truth, on KITTI, and on input that shows nothing."""

from dataclasses import replace

import numpy as np
import pytest
from ego_fixtures import camera, driven, tracks_of

from labeling.camera import Intrinsics, invert, read_kitti, rotation_angle_deg
from labeling.ego_motion import EgoSettings, estimate_ego_motion, solve_run
from labeling.ego_steps import shown_frames
from labeling.errors import DataError
from labeling.video import read_frames

FRAMES = 48


def solved(poses, *, focal_px=640.0, assumed_px=None, height_m=1.5, **street):
    """Ego-motion of a street seen through a camera that may be assumed wrongly."""
    tracks = tracks_of(poses, focal_px=focal_px, **street)
    return solve_run(tracks, intrinsics=camera(assumed_px or focal_px), camera_height_m=height_m)


def steps(poses):
    """(T - 1, 4, 4) second camera to first."""
    return invert(poses[:-1]) @ poses[1:]


def rotation_errors_deg(motion, truth):
    """(T - 1,) degrees a frame."""
    found, true = steps(motion.trajectory.cam_to_world), steps(truth)
    return rotation_angle_deg(found[:, :3, :3] @ true[:, :3, :3].transpose(0, 2, 1))


def yaw_deg(poses):
    """Turned to the right between first and last frame."""
    return np.degrees(np.unwrap(np.arctan2(poses[:, 0, 2], poses[:, 2, 2])))[-1]


@pytest.mark.parametrize("pitch_deg", [0.0, 2.0, -3.0], ids=str)
def test_a_drive_comes_out_in_metres_whatever_the_pitch(pitch_deg):
    truth = driven(np.full(FRAMES, 10.0), 5.0, pitch_deg=pitch_deg)
    motion = solved(truth)
    assert (motion.mode == "moving").all()
    assert np.median(rotation_errors_deg(motion, truth)) < 0.01
    assert motion.trajectory.path_length_m == pytest.approx(10.0 * (FRAMES - 1) / 24, rel=0.02)
    assert np.degrees(motion.road.pitch_rad) == pytest.approx(pitch_deg, abs=0.3)
    assert (motion.scale_source[1:] == "road").mean() > 0.9


def test_scale_is_linear_in_the_camera_height():
    truth = driven(np.full(FRAMES, 8.0))
    tracks = tracks_of(truth)
    low, high = (solve_run(tracks, intrinsics=camera(), camera_height_m=height) for height in (1.5, 1.8))
    assert high.trajectory.path_length_m == pytest.approx(1.2 * low.trajectory.path_length_m, rel=1e-6)


@pytest.mark.parametrize("noise_px", [0.05, 0.3], ids=str)
def test_a_standing_camera_stands(noise_px):
    motion = solved(driven(np.zeros(FRAMES)), noise_px=noise_px)
    assert (motion.mode == "still").all()
    assert motion.trajectory.path_length_m == 0


def test_a_turn_on_the_spot_does_not_move():
    truth = driven(np.zeros(FRAMES), 30.0)
    motion = solved(truth)
    assert (motion.mode == "turning").mean() >= 0.9
    assert motion.trajectory.path_length_m < 0.02
    assert yaw_deg(motion.trajectory.cam_to_world) == pytest.approx(yaw_deg(truth), rel=0.02)


@pytest.mark.parametrize("speed", [0.5, -0.5, -3.0], ids=str)
def test_walking_speed_and_reversing_keep_their_sign(speed):
    truth = driven(np.full(FRAMES, speed))
    motion = solved(truth)
    ahead = motion.trajectory.positions[-1, 2]
    assert np.sign(ahead) == np.sign(speed)
    assert ahead == pytest.approx(truth[-1, 2, 3], rel=0.15)
    assert (np.sign(np.diff(motion.trajectory.positions[:, 2])[2:-2]) == np.sign(speed)).all()


def test_stop_and_go_is_followed_without_flicker():
    speeds = np.concatenate([np.full(24, 6.0), np.linspace(6, 0, 12), np.zeros(24), np.linspace(0, 6, 12)])
    motion = solved(driven(speeds))
    changes = np.flatnonzero(motion.mode[1:] != motion.mode[:-1]) + 1
    assert len(changes) == 2
    assert abs(changes[0] - 36) <= 5 and abs(changes[1] - 60) <= 5


def test_only_road_gives_no_twisted_solution():
    truth = driven(np.full(FRAMES, 8.0), 3.0)
    assert rotation_errors_deg(solved(truth, scene="road"), truth).max() < 0.1


def test_only_a_wall_gives_no_twisted_solution():
    truth = driven(np.full(FRAMES, 2.0))
    assert rotation_errors_deg(solved(truth, scene="wall"), truth).max() < 0.1


@pytest.mark.parametrize("share", [0.2, 0.35], ids=str)
def test_traffic_on_fewer_than_half_of_the_corners_changes_little(share):
    truth = driven(np.full(FRAMES, 8.0))
    motion = solved(truth, traffic=share)
    assert np.median(rotation_errors_deg(motion, truth)) < 0.01
    assert motion.trajectory.positions[-1, 2] == pytest.approx(truth[-1, 2, 3], rel=0.03)


def test_traffic_on_most_corners_costs_confidence():
    clean = solved(driven(np.full(FRAMES, 8.0)))
    swamped = solved(driven(np.full(FRAMES, 8.0)), traffic=0.7)
    assert np.median(clean.confidence) > 0.9
    assert np.median(swamped.confidence) < 0.4


def with_objects(tracks, *, together):
    """150 more corners, that all go to the right, or as fast but each its own way."""
    rng = np.random.default_rng(5)
    start = rng.uniform([100, 150], [540, 330], (150, 2))
    ways = np.zeros(150) if together else rng.uniform(0, 2 * np.pi, 150)
    per_frame = 4 * np.stack([np.cos(ways), np.sin(ways)], axis=1)
    frames = []
    for index, frame in enumerate(tracks.frames):
        points = start + per_frame * index + rng.normal(0, 0.1, start.shape)
        frames.append(
            replace(
                frame, ids=np.concatenate([frame.ids, 10**8 + np.arange(150)]),
                points_px=np.concatenate([frame.points_px, points.astype(np.float32)]),
                forward_backward_px=np.concatenate([frame.forward_backward_px, np.full(150, 0.1, np.float32)]),
            )
        )  # fmt: skip
    return replace(tracks, frames=tuple(frames))


def test_another_motion_that_many_corners_share_costs_confidence():
    """As many corners that disagree with each other too cost less."""
    street = tracks_of(driven(np.full(12, 8.0)))
    together, scattered = (
        np.median(solve_run(with_objects(street, together=one), intrinsics=camera()).confidence)
        for one in (True, False)
    )
    assert together < 0.6 * scattered


def test_traffic_before_a_standing_camera_moves_it_not():
    motion = solved(driven(np.zeros(FRAMES)), traffic=0.4)
    assert (motion.mode == "still").mean() >= 0.95
    assert motion.trajectory.path_length_m < 0.2


def test_a_bonnet_does_not_hold_the_camera_back():
    truth = driven(np.full(FRAMES, 8.0))
    motion = solved(truth, bonnet=0.2)
    assert (motion.mode == "moving").all()
    assert motion.trajectory.path_length_m == pytest.approx(8.0 * (FRAMES - 1) / 24, rel=0.03)


@pytest.mark.parametrize("factor", [0.8, 1.2], ids=str)
def test_a_wrong_focal_length_costs_yaw_in_proportion(factor):
    truth = driven(np.full(FRAMES, 5.0), 20.0)
    motion = solved(truth, assumed_px=640 * factor)
    found = yaw_deg(motion.trajectory.cam_to_world) / yaw_deg(truth)
    assert abs(np.log(found * factor)) < 0.1 or abs(found - 1) < 0.22


def test_repeated_frames_are_bridged():
    truth = driven(np.full(40, 8.0), fps=20.0)
    source = tracks_of(truth, fps=20.0)
    shown = np.minimum(np.round(np.arange(48) * 20 / 24).astype(int), 39)
    frames = tuple(source.frames[index] for index in shown)
    stretched = tracks_of(truth[:1]).__class__(
        width=source.width, height=source.height, source_width=source.source_width,
        source_height=source.source_height, times_s=np.arange(48) / 24, frames=frames,
    )  # fmt: skip
    motion = solve_run(stretched, intrinsics=camera())
    speeds = np.linalg.norm(np.diff(motion.trajectory.positions, axis=0), axis=1) * 24
    assert np.sqrt(np.mean((speeds - 8.0) ** 2)) < 0.8


@pytest.mark.parametrize("speed", [2.0, 8.0], ids=str)
def test_dropped_pictures_under_even_times_leave_the_metres(speed):
    """30 pictures a second shown as 24 by dropping every fifth: every fourth step is twice as long as the others."""
    speeds = np.full(FRAMES, speed)
    speeds[::4] *= 2
    truth = driven(speeds)
    motion = solved(truth)
    found, true = (np.linalg.norm(steps(poses)[:, :3, 3], axis=1) for poses in (motion.trajectory.cam_to_world, truth))
    assert found.sum() == pytest.approx(true.sum(), rel=0.01)
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.02 * true.mean()


@pytest.mark.parametrize("at", [20, FRAMES - 1], ids=["once", "the last"])
def test_one_repeated_picture_leaves_the_times_of_a_run(at):
    source = tracks_of(driven(np.full(FRAMES, 8.0)))
    times = np.ceil(np.arange(FRAMES) / 24 * 30 - 0.5) / 30
    frames = (*source.frames[:at], *source.frames[at - 1 : -1])
    kept, taken = shown_frames(replace(source, times_s=times, frames=frames))
    assert len(kept) == FRAMES - 1
    assert np.array_equal(taken, times[kept])


def test_repeats_that_come_regularly_are_spread_evenly():
    source = tracks_of(driven(np.full(40, 8.0), fps=20.0))
    shown = np.arange(48) * 20 // 24
    frames = tuple(source.frames[index] for index in shown)
    kept, taken = shown_frames(replace(source, times_s=np.arange(48) / 24, frames=frames))
    assert len(kept) == 40
    assert np.diff(taken)[8:-8] == pytest.approx(1 / 20, abs=1 / 200)


def test_equal_source_times_give_increasing_output_times():
    truth = driven(np.full(20, 8.0))
    source = tracks_of(truth)
    index = np.array([0, 1, 2, 2, 3, 4, 5, 6, 6, 7, 8, 9])
    repeated = source.__class__(
        width=source.width, height=source.height, source_width=source.source_width,
        source_height=source.source_height, times_s=index / 24, frames=tuple(source.frames[i] for i in index),
    )  # fmt: skip
    motion = solve_run(repeated, intrinsics=camera())
    assert len(motion.trajectory) == len(motion.mode) == 12
    assert (np.diff(motion.trajectory.timestamps_s) > 0).all()


def test_the_same_tracks_give_the_same_bytes():
    tracks = tracks_of(driven(np.full(FRAMES, 8.0), 4.0), traffic=0.3)
    one, other = (solve_run(tracks, intrinsics=camera()) for _ in range(2))
    assert one.trajectory.cam_to_world.tobytes() == other.trajectory.cam_to_world.tobytes()
    assert one.confidence.tobytes() == other.confidence.tobytes()


@pytest.mark.parametrize("count", [1, 2, 9], ids=str)
def test_blank_pictures_are_held_with_no_confidence(count):
    black = [np.zeros((120, 160, 3), np.uint8)] * count
    intrinsics = Intrinsics(width=160, height=120, fx=160, fy=160, cx=79.5, cy=59.5, source="prior")
    motion = estimate_ego_motion(black, np.arange(count) / 24, intrinsics=intrinsics)
    assert len(motion.trajectory) == count
    assert np.isfinite(motion.trajectory.cam_to_world).all() and np.isfinite(motion.scale_sigma).all()
    assert (motion.confidence == 0).all()
    assert (motion.mode == "held").all()


def test_what_disappears_is_held():
    truth = driven(np.full(FRAMES, 8.0))
    source = tracks_of(truth)
    empty = np.zeros((0, 2), np.float32)
    blind = [
        frame.__class__(
            ids=np.zeros(0, np.int64), points_px=empty, forward_backward_px=empty[:, 0], cut=False, repeated=False,
        )
        for frame in source.frames[30:36]
    ]  # fmt: skip
    frames = (*source.frames[:30], *blind, *source.frames[36:])
    gone = source.__class__(
        width=source.width, height=source.height, source_width=source.source_width,
        source_height=source.source_height, times_s=source.times_s, frames=frames,
    )  # fmt: skip
    motion = solve_run(gone, intrinsics=camera())
    assert (motion.mode[30:37] == "held").all() and (motion.confidence[30:37] == 0).all()
    assert motion.trajectory.path_length_m == pytest.approx(8.0 * (FRAMES - 1) / 24, rel=0.05)


def test_intrinsics_of_another_picture_are_refused():
    tracks = tracks_of(driven(np.full(4, 8.0)))
    other = Intrinsics(width=1056, height=704, fx=1056, fy=1056, cx=527.5, cy=351.5, source="prior")
    with pytest.raises(DataError, match=r"Intrinsics\.mapped"):
        solve_run(tracks, intrinsics=other)


def test_unknown_settings_are_refused():
    with pytest.raises(ValueError, match="extra"):
        EgoSettings.model_validate({"corner": 3})


def test_kitti_at_half_resolution(real_data):
    """The figures that the project promises, on a third of the sequence; the whole of it is `animatic chart ego`."""
    import cv2

    folder = real_data / "kitti_03"
    truth = read_kitti(folder / "poses.txt", fps=10).slice(0, 100).cam_to_world
    pictures = (
        cv2.resize(picture[:375], (621, 188), interpolation=cv2.INTER_AREA)
        for picture in read_frames(folder / "left_gray_10fps.mp4", end=100)
    )
    intrinsics = Intrinsics(
        width=1242, height=375, fx=721.5377, fy=721.5377, cx=609.5593, cy=172.854, source="given"
    ).resized(621, 188)
    motion = estimate_ego_motion(pictures, np.arange(100) / 10, intrinsics=intrinsics, camera_height_m=1.65)
    assert np.median(rotation_errors_deg(motion, truth)) <= 0.03
    found = motion.trajectory.cam_to_world
    errors = []
    for start in range(0, 50, 5):
        ours = (invert(found[start]) @ found[start : start + 51])[:, :3, 3]
        true = (invert(truth[start]) @ truth[start : start + 51])[:, :3, 3]
        errors.append(np.linalg.norm(ours - true, axis=1).mean())
    assert np.median(errors) <= 1.5
