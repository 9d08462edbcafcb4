"""Windowed refinement: nothing changes where nothing is wrong, noise falls, lengths stay."""

import numpy as np
import pytest
from ego_fixtures import camera, driven, tracks_of

from labeling.camera import invert
from labeling.ego_motion import solve_run
from labeling.ego_refinement import refined_poses
from pipelines.ego_errors import direction_errors_deg, rotation_errors_deg

FRAMES = 30


def step_lengths(poses: np.ndarray) -> np.ndarray:
    return np.linalg.norm((invert(poses[:-1]) @ poses[1:])[:, :3, 3], axis=1)


@pytest.mark.parametrize("rate", [0.0, 15.0], ids=["straight", "turning"])
def test_refinement_lowers_the_turns_noise_and_keeps_lengths(rate):
    truth = driven(np.full(FRAMES, 8.0), rate)
    tracks = tracks_of(truth, noise_px=0.4)
    motion = solve_run(tracks, intrinsics=camera())
    before, after = motion.trajectory.cam_to_world, refined_poses(tracks, motion, intrinsics=camera())
    assert after.shape == before.shape
    assert np.allclose(step_lengths(after), step_lengths(before), rtol=1e-9)
    assert np.median(rotation_errors_deg(after, truth)) < np.median(rotation_errors_deg(before, truth))
    assert np.median(direction_errors_deg(after, truth)) < 0.3


def test_a_camera_that_stands_stays():
    tracks = tracks_of(driven(np.zeros(12)))
    motion = solve_run(tracks, intrinsics=camera())
    assert np.allclose(refined_poses(tracks, motion, intrinsics=camera()), np.eye(4), atol=1e-12)
