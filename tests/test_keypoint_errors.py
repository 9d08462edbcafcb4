"""Scores of keypoints and tracks on cases counted by hand."""

from collections.abc import Sequence

import numpy as np
import pytest

from dataset.street_labels import StreetObject
from labeling.labels import POINT_DETECTED, Keypoints
from labeling.schemas import Category
from pipelines.demo import CarComparison
from pipelines.keypoint_clips import street_frames
from pipelines.keypoint_errors import lane_score, match_frames, phantom_frames, point_score, recall, track_spans
from pipelines.track_errors import PointSeries, jitter_px, lag_frames, point_series, track_score

GRID = np.stack(np.meshgrid(np.linspace(5, 75, 6), np.linspace(5, 55, 4)), axis=-1).reshape(-1, 2)


def box(x: float, *, width: float = 80.0, height: float = 60.0) -> np.ndarray:
    return np.array([x, 200, x + width, 200 + height], np.float32)


def thing(
    track_id: int, x: float, *, share: float = 1.0, height: float = 60.0, category: Category = "car"
) -> StreetObject:
    return StreetObject(
        track_id=track_id, category=category, schema="car24", box_xyxy=box(x, height=height),
        points_xy=(GRID * (1, height / 60) + (x, 200)).astype(np.float32), visible=np.ones(24, bool),
        visible_share=share, distance_m=10.0,
    )  # fmt: skip


def label(frame: int, track_id: int, x: float, *, score: float = 0.9, off: float = 0.0) -> Keypoints:
    points = np.concatenate([GRID + (x + off, 200), np.ones((24, 1))], axis=1).astype(np.float32)
    return Keypoints(
        frame=frame, track_id=track_id, category="car", schema="car24", score=score, box_xyxy=box(x), points=points,
        point_source=np.full(24, POINT_DETECTED, np.int8),
    )  # fmt: skip


def test_points_of_missed_objects_are_wrong() -> None:
    truth = [[thing(1, 100), thing(2, 500)]]
    found = [label(0, 0, 100)]
    found[0].points[:6, :2] += 11  # beyond 0.1 of the diagonal of 100 px
    (frame,) = match_frames(found, truth)
    assert [(pair[0].track_id, pair[1] is not None) for pair in frame.pairs] == [(1, True), (2, False)]
    score = point_score([frame])
    assert (score.right, score.shown) == (18, 48)
    assert recall([frame]) == (1, 2)
    assert np.isnan(point_score([frame], category="person").pck)


def test_the_demo_lets_no_two_cars_share_a_label() -> None:
    cars = CarComparison()
    cars.add([label(0, 0, 100)], [thing(1, 100), thing(2, 110)], frame=0)
    assert (cars.found, cars.right) == ([True, False], [True]), "one car of two, though both overlap it"
    cars.add([label(5, 0, 100, off=2), label(5, 1, 110, score=0.8)], [thing(1, 100), thing(2, 900, share=0.1)], frame=5)
    assert (cars.found[2:], cars.right[1:]) == ([True], [True, False]), "a second label of one car is wrong"
    assert np.median(np.concatenate(cars.errors_px)) == pytest.approx(1.0)


def test_recall_by_height() -> None:
    truth = [[thing(1, 100, height=60), thing(2, 500, height=20), thing(3, 700, height=20, share=0.1)]]
    matched = match_frames([label(0, 0, 100)], truth)
    assert recall(matched, from_px=48) == (1, 1)
    assert recall(matched, from_px=12, to_px=24) == (0, 1)


def test_phantoms_match_nothing_and_lie_on_nothing() -> None:
    truth = [[thing(1, 100), thing(2, 500, share=0.1, height=200)], [], [thing(1, 100)]]
    found = [label(0, 0, 100), label(0, 1, 520), label(0, 2, 800), label(1, 2, 810), label(2, 0, 100)]
    matched = match_frames(found, truth)
    assert [[p.track_id for p in frame.phantoms] for frame in matched] == [[2], [2], []]
    assert phantom_frames(matched) == pytest.approx(2 / 3)
    assert track_spans(label for frame in matched for label in frame.phantoms) == {2: 2}


def test_lanes_by_hand() -> None:
    rows = np.linspace(600, 400, 24)
    line = StreetObject(
        track_id=901, category="lane", schema="lane24", box_xyxy=np.array([300, 400, 300, 600], np.float32),
        points_xy=np.stack([np.full(24, 300.0), rows], axis=1).astype(np.float32), visible=np.ones(24, bool),
        visible_share=1.0, distance_m=5.0,
    )  # fmt: skip
    points = np.stack([np.full(24, 303.0), rows, np.ones(24)], axis=1).astype(np.float32)
    near = Keypoints(
        frame=0, category="lane", schema="lane24", score=0.5, box_xyxy=line.box_xyxy, points=points,
        point_source=np.full(24, POINT_DETECTED, np.int8),
    )  # fmt: skip
    score = lane_score([near, near], [[line], [line]])
    assert (score.error_px, score.recall, score.phantoms_per_frame) == (pytest.approx(3.0), 0.5, 0.5)


def test_tracks_counted_by_hand() -> None:
    """Two cars, six frames. Car 1 changes from id 0 to 5 at frame 3; car 2 is missed twice; one phantom at frame 5.

    Objects 12, missed 2, phantoms 1, switches 1: MOTA = 1 - 4/12. The best one-to-one assignment is 0 (or 5) to car 1,
    3 frames, and 7 to car 2, 4 frames: IDTP 7; found 11: IDF1 = 14 / 23.
    """
    truth = [[thing(1, 100 + 4 * t), thing(2, 600 - 4 * t)] for t in range(6)]
    found = [label(t, 0 if t < 3 else 5, 100 + 4 * t) for t in range(6)]
    found += [label(t, 7, 600 - 4 * t) for t in (0, 1, 2, 5)]
    found += [label(5, 9, 900)]
    score = track_score(found, truth, categories=("car",))
    assert (score.objects, score.missed, score.phantoms, score.switches) == (12, 2, 1, 1)
    assert (score.found, score.kept) == (11, 7)
    assert score.mota == pytest.approx(1 - 4 / 12) and score.idf1 == pytest.approx(14 / 23)
    both = score + score
    assert both.mota == score.mota and both.objects == 24


def test_who_was_matched_before_stays_matched() -> None:
    """A second box that overlaps better does not take the object over."""
    truth = [[thing(1, 100)], [thing(1, 100)]]
    found = [label(0, 0, 100), label(1, 0, 110), label(1, 3, 100)]
    score = track_score(found, truth, categories=("car",))
    assert (score.switches, score.phantoms, score.missed) == (0, 1, 0)


def test_what_is_not_judged_counts_neither_way() -> None:
    truth = [[thing(1, 100, share=0.1)], [thing(1, 100)]]
    score = track_score([label(0, 4, 100), label(1, 4, 100)], truth, categories=("car",))
    assert (score.objects, score.found, score.kept, score.mota, score.idf1) == (1, 1, 1, 1.0, 1.0)


def moving(path: np.ndarray, found: np.ndarray) -> PointSeries:
    truth = np.repeat(path[:, None], 5, axis=1)
    return PointSeries(category="car", truth=truth, found=found, visible=np.ones(found.shape[:2], bool))


@pytest.mark.parametrize("late", [0, 1, 2])
def test_lag_is_found_beside_a_constant_error(late: int) -> None:
    times = np.arange(80.0)
    path = np.stack([300 + 40 * np.sin(times / 6), 200 + 0 * times], axis=1)
    noise = np.random.default_rng(0).normal(0, 0.5, (80, 5, 2))
    found = np.repeat(path[np.maximum(0, np.arange(80) - late)][:, None], 5, axis=1) + 6.0 + noise
    assert lag_frames([moving(path, found)]) == pytest.approx(late, abs=0.15)


def test_jitter_of_white_noise_is_its_sigma() -> None:
    times = np.arange(400.0)
    path = np.stack([3 * times, 200 + 0.5 * times], axis=1)
    noise = np.random.default_rng(0).normal(0, 1.7, (400, 5, 2))
    found = np.repeat(path[:, None], 5, axis=1) + noise
    assert jitter_px([moving(path, found)]) == pytest.approx(1.7, rel=0.05)
    assert np.isnan(jitter_px([]))


def test_the_truth_scores_full_marks() -> None:
    clip = street_frames("crossing", 97_001, 4, width=264, height=176)
    found: Sequence[Keypoints] = [label for labels in clip.labels for label in labels]
    matched = match_frames(found, clip.truth)
    assert point_score(matched).pck == 1.0 and not phantom_frames(matched)
    tracks = track_score(found, clip.truth)
    assert tracks.objects and tracks.mota == tracks.idf1 == 1.0
    assert lane_score(found, clip.truth).recall == 1.0
    assert jitter_px(point_series(matched)) < 1e-3
