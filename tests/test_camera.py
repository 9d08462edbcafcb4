"""Camera geometry: picture maps, intrinsics, SE(3), trajectory files."""

from pathlib import Path

import numpy as np
import pytest
from ego_fixtures import write_kitti
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from labeling.camera import (
    Intrinsics,
    Trajectory,
    cover_map,
    invert,
    prior_intrinsics,
    read_kitti,
    read_tum,
    rebased_trajectory,
    resample,
    rigid,
    rotation_angle_deg,
    write_tum,
)
from labeling.errors import TrajectoryError


def random_trajectory(seed: int = 0, *, count: int = 20) -> Trajectory:
    rng = np.random.default_rng(seed)
    steps = rigid(
        Rotation.from_rotvec(rng.normal(0, 0.05, (count, 3))).as_matrix(), rng.normal((0, 0, 0.5), 0.1, (count, 3))
    )
    poses = np.eye(4)[None].repeat(count, axis=0)
    for i in range(1, count):
        poses[i] = poses[i - 1] @ steps[i]
    return rebased_trajectory(np.arange(count) / 24, poses)


@given(st.integers(16, 4000), st.integers(16, 4000))
def test_cover_map_covers_with_even_numbers(source_width: int, source_height: int) -> None:
    picture = cover_map(source_width, source_height, width=1056, height=704)
    assert picture.scaled_width >= 1056 and picture.scaled_height >= 704
    assert picture.scaled_width % 2 == picture.scaled_height % 2 == picture.crop_x % 2 == picture.crop_y % 2 == 0
    assert 0 <= picture.crop_x <= picture.scaled_width - 1056
    assert 0 <= picture.crop_y <= picture.scaled_height - 704
    assert abs(picture.crop_x - (picture.scaled_width - 1056) / 2) <= 2


def test_mapped_intrinsics_project_to_the_mapped_pixel() -> None:
    """A point projected in the source and then carried over the map lands where the mapped camera projects it."""
    camera = Intrinsics(width=1242, height=375, fx=721.5, fy=721.5, cx=609.6, cy=172.9, source="given")
    picture = cover_map(1242, 375, width=1056, height=704)
    point = np.array([1.3, -0.4, 9.0])
    u, v, _ = camera.matrix @ point / point[2]
    expected = (
        (u + 0.5) * picture.scale_x - 0.5 - picture.crop_x,
        (v + 0.5) * picture.scale_y - 0.5 - picture.crop_y,
    )
    got = camera.mapped(picture).matrix @ point / point[2]
    assert got[:2] == pytest.approx(expected)


@pytest.mark.parametrize("focal", [0.0, -700.0, float("nan"), float("inf"), 30.0, 30000.0], ids=str)
def test_impossible_focal_lengths_are_refused(focal: float) -> None:
    with pytest.raises(TrajectoryError, match="focal"):
        Intrinsics(width=1242, height=375, fx=focal, fy=700.0, cx=600, cy=180, source="given")


def test_prior_is_the_longer_side_and_the_middle() -> None:
    camera = prior_intrinsics(960, 540)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (960, 960, 479.5, 269.5)
    assert camera.source == "prior"


def test_invert_undoes() -> None:
    poses = random_trajectory().cam_to_world
    assert np.allclose(invert(poses) @ poses, np.eye(4), atol=1e-12)


def test_slices_are_rebased_and_consistent() -> None:
    whole = random_trajectory()
    part = whole.slice(5, 12)
    assert np.allclose(part.cam_to_world[0], np.eye(4))
    assert np.allclose(whole.cam_to_world[5] @ part.cam_to_world, whole.cam_to_world[5:12])


def test_rotation_angle() -> None:
    angles = np.array([0.0, 1e-4, 30.0, 179.0])
    rotations = Rotation.from_euler("y", angles[:, None], degrees=True).as_matrix()
    assert rotation_angle_deg(rotations) == pytest.approx(angles, abs=1e-9)


def test_resample_hits_the_samples_and_halves_between() -> None:
    whole = random_trajectory()
    same = resample(whole, whole.timestamps_s)
    assert np.allclose(same.cam_to_world, whole.cam_to_world, atol=1e-9)
    middle = resample(whole, np.array([0.0, 0.5 / 24]))
    assert middle.positions[1] == pytest.approx(whole.positions[1] / 2)
    with pytest.raises(TrajectoryError, match="leave"):
        resample(whole, np.array([0.0, 99.0]))


@pytest.mark.parametrize("far", [1e9, 1e200, -1e200])
def test_positions_that_are_on_no_road_are_refused(tmp_path: Path, far: float) -> None:
    (tmp_path / "a.tum").write_text(f"0 0 0 0 0 0 0 1\n1 0 {far} 0 0 0 0 1\n")
    (tmp_path / "a.txt").write_text(f"1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 {far}\n")
    with pytest.raises(TrajectoryError, match="row 1 lies .* m from the origin; give metres"):
        read_tum(tmp_path / "a.tum")
    with pytest.raises(TrajectoryError, match="row 1 lies"):
        read_kitti(tmp_path / "a.txt", fps=24)


def test_tum_and_kitti_files_round_trip(tmp_path: Path) -> None:
    whole = random_trajectory()
    write_tum(whole, tmp_path / "a.tum")
    write_kitti(whole, tmp_path / "a.txt")
    for read in (read_tum(tmp_path / "a.tum"), read_kitti(tmp_path / "a.txt", fps=24)):
        assert read.timestamps_s == pytest.approx(whole.timestamps_s)
        assert np.allclose(read.cam_to_world, whole.cam_to_world, atol=1e-7)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "needs rows"),
        ("0 1 2\n", "needs rows"),
        ("hello\n", "cannot be read"),
        ("0 0 0 0 0 0 0 2\n", "quaternion"),
        ("1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", "does not increase"),
        ("0 nan 0 0 0 0 0 1\n", "not finite"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 nan 0 0 1\n", "row 1 has a quaternion of length nan"),
    ],
    ids=["empty", "too few columns", "text", "not a unit quaternion", "time backwards", "nan", "nan turn"],
)
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_bad_trajectory_files_say_what_is_wrong(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.tum"
    path.write_text(text)
    with pytest.raises(TrajectoryError, match=message):
        read_tum(path)


def test_non_rotations_are_refused() -> None:
    poses = random_trajectory().cam_to_world.copy()
    poses[3, :3, :3] *= 1.1
    with pytest.raises(TrajectoryError, match=r"cam_to_world\[3\] is not a rigid motion"):
        Trajectory(timestamps_s=np.arange(20) / 24, cam_to_world=poses)


def test_kitti_truth_reads(real_data: Path) -> None:
    truth = read_kitti(real_data / "kitti_03" / "poses.txt", fps=10)
    assert len(truth) >= 300
    assert 150 < truth.slice(0, 300).path_length_m < 400


def test_comma_truth_reads(real_data: Path) -> None:
    truth = read_tum(real_data / "trajectories" / "comma2k19.tum")
    assert truth.path_length_m == pytest.approx(1000, rel=0.3)
