"""Two-view models: exact on exact corners, derivatives right, the right rung and the right sign."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from labeling.ego_ladder import Corners, explain_pair, gric, sideways, sign_evidence
from labeling.ego_models import (
    _sampson_system,
    fit_moving,
    fit_turning,
    parallaxes,
    rotation_from_vector,
    sampson_residuals,
    tangent_basis,
)

NOISE = 0.1 / 640
SCALES = NOISE * np.geomspace(100, 3, 12)


def scene(rotation_vector_deg, translation, *, count=200, seed=0, noise=0.0):
    """Exact corners of random points 4 to 40 m ahead, before and after ``x2 = R x1 + t``."""
    rng = np.random.default_rng(seed)
    points = np.stack([rng.uniform(-0.5, 0.5, count), rng.uniform(-0.3, 0.3, count), np.ones(count)], axis=1)
    depth = rng.uniform(4, 40, count)
    rotation = Rotation.from_rotvec(np.radians(rotation_vector_deg)).as_matrix()
    moved = (points * depth[:, None]) @ rotation.T + np.asarray(translation, float)
    second = moved[:, :2] / moved[:, 2:]
    return points[:, :2] + rng.normal(0, noise, (count, 2)), second + rng.normal(0, noise, (count, 2)), rotation, depth


@pytest.mark.parametrize("vector", [(0, 0, 0), (0.3, -2.0, 0.1), (5, 3, -4)], ids=str)
def test_a_pure_turn_is_found_exactly(vector):
    first, second, rotation, _ = scene(vector, (0, 0, 0))
    found = fit_turning(first, second, np.ones(len(first)), np.eye(3), np.geomspace(0.5, 0.01, 10))
    assert np.abs(found - rotation).max() < 1e-9


@pytest.mark.parametrize("translation", [(0, 0, -1.0), (0.1, -0.05, -0.5), (0.02, 0, 0.3)], ids=str)
def test_a_motion_is_found_exactly(translation):
    first, second, rotation, _ = scene((0.2, -0.8, 0.1), translation)
    start = np.array([0.0, 0.0, -1.0])
    found, axis, _ = fit_moving(first, second, np.ones(len(first)), np.eye(3), start, SCALES * 5, NOISE, start, 0.0)
    truth = np.array(translation) / np.linalg.norm(translation)
    assert np.abs(found - rotation).max() < 1e-6
    assert abs(abs(axis @ truth) - 1) < 1e-9


def test_derivatives_agree_with_differences():
    first, second, rotation, _ = scene((0.2, -0.8, 0.1), (0.1, -0.05, -0.5), count=40, noise=0.002)
    axis = np.array([0.1, 0.1, -1.0]) / np.linalg.norm([0.1, 0.1, -1.0])
    basis = tangent_basis(axis)
    weight = np.ones(len(first))
    wide = 1e6
    normal, right = _sampson_system(first, second, weight, rotation, axis, basis, wide)

    def residuals(step):
        turned = rotation_from_vector(step[:3]) @ rotation
        moved = axis + step[3] * basis[0] + step[4] * basis[1]
        return sampson_residuals(first, second, turned, moved / np.linalg.norm(moved))

    jacobian = np.stack([(residuals(h) - residuals(-h)) / 2e-6 for h in 1e-6 * np.eye(5)], axis=1)
    assert np.allclose(jacobian.T @ jacobian, normal, rtol=1e-4, atol=1e-6)
    assert np.allclose(-jacobian.T @ residuals(np.zeros(5)), right, rtol=1e-4, atol=1e-8)


def test_parallax_gives_the_depth():
    first, second, rotation, depth = scene((0.2, -0.8, 0.1), (0.1, -0.05, -0.5))
    length = np.linalg.norm([0.1, -0.05, -0.5])
    along, gain = parallaxes(first, second, rotation, np.array([0.1, -0.05, -0.5]) / length).T
    # Inverse depth is in the turned first camera: its z is the third row of R applied to the point.
    points = np.concatenate([first, np.ones((len(first), 1))], axis=1) * depth[:, None]
    assert np.allclose(along / gain * (points @ rotation.T)[:, 2], length, rtol=1e-6)


@pytest.mark.parametrize(
    ("vector", "translation", "rung"),
    [((0, 0, 0), (0, 0, 0), 0), ((0.05, -1.0, 0), (0, 0, 0), 1), ((0, -0.3, 0), (0, 0, -0.4), 2)],
    ids=["still", "turning", "moving"],
)
@pytest.mark.parametrize("noise_px", [0.1, 0.3], ids=str)
def test_the_lowest_sufficient_rung_is_cheapest(vector, translation, rung, noise_px):
    first, second, _, _ = scene(vector, translation, noise=noise_px / 640)
    motion = explained(first, second)
    assert motion.costs.argmin() == rung


def test_the_sign_is_told_by_parallax_even_from_afar():
    # Corners lie 4 to 40 m ahead, the step is 2 cm: cv2.recoverPose would look at none beyond fifty baselines, 1 m.
    first, second, _, _ = scene((0, 0, 0), (0, 0, -0.02), noise=0.05 / 640)
    motion = explained(first, second)
    assert motion.evidence * -motion.axis[2] > 5


def test_sign_evidence_is_bounded_for_each_corner():
    assert sign_evidence(np.array([1e9]), 1.0) == pytest.approx(4.0)
    assert sign_evidence(np.array([-1e9, 1e9]), 1.0) == 0.0


def test_gric_charges_parameters_and_dimensions():
    square = np.full(100, 1.0)
    assert gric(square, dimension=2, parameters=0) < gric(square, dimension=2, parameters=3)
    assert gric(square, dimension=2, parameters=3) < gric(square, dimension=3, parameters=3)


def test_sideways_is_even_and_bounded():
    ahead = np.array([0.0, 0.0, 1.0])
    assert sideways(ahead) == sideways(-ahead) == 0.0
    assert sideways(np.array([1.0, 0.0, 0.0])) == 1.0


def test_traffic_on_a_third_of_the_corners_does_not_turn_the_camera():
    first, second, rotation, _ = scene((0, -0.4, 0), (0, 0, -0.4), count=240, noise=0.1 / 640)
    second[:80] = first[:80] + np.array([10 / 640, 0.0])
    motion = explained(first, second)
    assert np.degrees(Rotation.from_matrix(motion.rotation @ rotation.T).magnitude()) < 0.03
    assert motion.second_share > 0.25


def explained(first, second):
    count = len(first)
    corners = Corners(ids=np.arange(count), first=first, second=second, weight=np.ones(count))
    return explain_pair(
        corners, rotation=np.eye(3), axis=np.array([0.0, 0.0, -1.0]), axis_sigma=0.35, noise_floor=NOISE,
        least_inlier_share=0.6,
    )  # fmt: skip
