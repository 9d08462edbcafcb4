"""Metrics: answers computed by hand, properties, and evo as a second opinion."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from labeling.camera import rigid
from labeling.errors import DataError
from training.metrics import (
    Alignment,
    ade_m,
    align,
    apd_m,
    ate_m,
    drift_share,
    mean_interval,
    min_ade_m,
    pck,
    picture_similarity,
    rpe,
)


def straight(speed: float, *, sideways: float = 0.0, count: int = 121) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = speed * np.arange(count) / 24
    poses[:, 0, 3] = sideways
    return poses


def wandering(seed: int, *, count: int = 60) -> np.ndarray:
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.02, (count, 3)), axis=0)).as_matrix()
    return rigid(turns, np.cumsum(rng.normal((0.02, 0, 0.5), 0.1, (count, 3)), axis=0))


def test_ade_by_hand() -> None:
    """1 m/s too fast for 5 s: 0 to 5 m off, 2.5 m on average."""
    assert ade_m(straight(11), straight(10), alignment="none") == pytest.approx(2.5)


def test_height_does_not_count_in_the_ground_plane() -> None:
    raised = straight(10)
    raised[:, 1, 3] -= 7
    assert ade_m(raised, straight(10), alignment="none") == 0
    assert apd_m([raised, straight(10)]) == 0


def test_min_ade_takes_the_best_sample() -> None:
    samples = [straight(12), straight(10.4), straight(8)]
    assert min_ade_m(samples, straight(10)) == pytest.approx(1.0)


def test_apd_by_hand() -> None:
    """Three samples 1 m and 2 m apart sideways, 121 points: (1 + 1 + 2) / 3 times the root of 121."""
    samples = [straight(10, sideways=s) for s in (0, 1, 2)]
    assert apd_m(samples) == pytest.approx(4 / 3 * 11)


def test_rpe_by_hand() -> None:
    metres, degrees = rpe(straight(11), straight(10), frames=24)
    assert metres == pytest.approx(1.0) and degrees == pytest.approx(0, abs=1e-6)


def test_drift_by_hand() -> None:
    assert drift_share(straight(11), straight(10)) == pytest.approx(0.1, rel=0.05)
    assert np.isnan(drift_share(straight(0), straight(0)))


@pytest.mark.parametrize(("alignment", "scale"), [("se3", 1.0), ("sim3", 2.5)])
def test_alignment_undoes_what_it_claims(alignment: Alignment, scale: float) -> None:
    truth = wandering(3)
    moved = truth.copy()
    moved[:, :3, 3] *= scale
    moved = rigid(Rotation.from_rotvec([0.3, 1.0, -0.2]).as_matrix(), np.array([5.0, -2, 9])) @ moved
    assert ate_m(moved, truth, alignment=alignment) == pytest.approx(0, abs=1e-9)
    assert np.allclose(align(moved, truth, alignment=alignment), truth)


def test_standing_still_can_be_aligned() -> None:
    assert ate_m(straight(0), straight(0), alignment="sim3") == 0


@pytest.mark.parametrize("alignment", ["none", "se3", "sim3"])
def test_evo_agrees(alignment: Alignment) -> None:
    evo_core = pytest.importorskip("evo.core.metrics", reason="evo is a development extra")
    from evo.core.trajectory import PosePath3D

    truth, predicted = wandering(1), wandering(2)
    reference, estimate = PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(predicted))
    if alignment != "none":
        estimate.align(reference, correct_scale=alignment == "sim3")
    ape = evo_core.APE(evo_core.PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    assert ate_m(predicted, truth, alignment=alignment) == pytest.approx(
        ape.get_statistic(evo_core.StatisticsType.rmse)
    )
    if alignment == "none":
        for relation, index in (
            (evo_core.PoseRelation.translation_part, 0),
            (evo_core.PoseRelation.rotation_angle_deg, 1),
        ):
            peer = evo_core.RPE(relation, delta=5, delta_unit=evo_core.Unit.frames, all_pairs=True)
            peer.process_data((reference, estimate))
            expected = peer.get_statistic(evo_core.StatisticsType.rmse)
            assert rpe(predicted, truth, frames=5)[index] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ade_m(straight(1, count=100), straight(1), alignment="none"), "same timestamps"),
        (lambda: ade_m(straight(np.nan), straight(1), alignment="none"), "not finite"),
        (lambda: min_ade_m([], straight(1)), "at least one"),
        (lambda: apd_m([straight(1)]), "at least two"),
        (lambda: rpe(straight(1), straight(1), frames=121), "more than"),
        (lambda: mean_interval([], []), "values"),
        (lambda: picture_similarity(np.zeros((1, 8, 8, 3), np.uint8), np.zeros((1, 9, 8, 3), np.uint8)), "resize"),
    ],
    ids=["length", "nan", "no samples", "one sample", "too short", "no values", "size"],
)
def test_bad_input_is_an_error(call, message: str) -> None:
    with pytest.raises(DataError, match=message):
        call()


def test_intervals_are_over_videos_not_clips() -> None:
    """A hundred equal clips of each of two videos know no more than two videos."""
    values = [1.0] * 100 + [3.0] * 100
    interval = mean_interval(values, ["a"] * 100 + ["b"] * 100)
    assert (interval.mean, interval.low, interval.high, interval.groups) == (2.0, 1.0, 3.0, 2)


def test_intervals_cover_the_truth() -> None:
    rng = np.random.default_rng(5)
    held = 0
    for trial in range(60):
        values = rng.normal(1.0, 1.0, 40)
        interval = mean_interval(values.tolist(), [str(i) for i in range(40)], draws=400, seed=trial)
        held += interval.low <= 1.0 <= interval.high
    assert held >= 50


def test_pck_by_hand() -> None:
    """One within 5 px; one just outside; one that the truth does not show; one in its place that is not claimed."""
    truth = np.array([[0, 0, 1], [10, 0, 1], [20, 0, 0], [30, 0, 1]], float)
    predicted = np.array([[3, 4, 1], [10, 6, 1], [20, 0, 1], [30, 0, 0]], float)
    assert pck(predicted, truth, np.array([0, 0, 30, 40])) == (1, 3)


def test_pictures() -> None:
    video = np.random.default_rng(0).integers(0, 256, (2, 16, 16, 3), dtype=np.uint8)
    assert picture_similarity(video, video) == (99.0, pytest.approx(1.0))
    worse = picture_similarity(video, 255 - video)
    assert worse[0] < 10 and worse[1] < 0.2
