"""The street models' thresholds, and how bottom-up cars are judged."""

from pathlib import Path

import numpy as np
import pytest

from labeling.detection import Detections
from labeling.labels import POINT_ABSENT, POINT_DETECTED, Keypoints
from labeling.model_cards import SHIPPED_CARDS, YoloxCard
from training.street_models import CHOOSING_STREETS, JUDGED_STREETS
from training.street_plans import HELD_OUT_SEED, TRAIN_SEED, VALIDATION_SEED, plan_lessons, plan_streets
from training.street_pool import ObjectTruth
from training.street_recipes import BUDGETS
from training.street_scores import Tally, grouped_standard_error, is_judged, judge_car_fields, match_boxes
from training.street_thresholds import (
    BOX_SCORES,
    BoxScoreChooser,
    best_threshold,
    choose_thresholds,
    judge_counts,
    sure_threshold,
)


def car(left: float, *, height: float = 60.0, share: float = 1.0) -> ObjectTruth:
    """A car 100 px wide whose 24 points lie along its diagonal; every other one is hidden."""
    box = np.array([left, 200, left + 100, 200 + height], np.float32)
    along = np.linspace(0, 1, 24, dtype=np.float32)[:, None]
    return ObjectTruth(
        category="car", box_xyxy=box, points_xy=box[:2] + along * (box[2:] - box[:2]),
        visible=np.arange(24) % 2 == 0, visible_share=share,
    )  # fmt: skip


def detections(truths: list[ObjectTruth], scores: list[float]) -> Detections:
    names = np.array(["car"] * len(scores))
    return Detections(
        boxes_xyxy=np.array([truth.box_xyxy for truth in truths]).reshape(-1, 4),
        scores=np.array(scores, np.float32), classes=names, categories=names,
    )  # fmt: skip


def bottom_up(truth: ObjectTruth, *, off_px: float = 0.0) -> Keypoints:
    """The truth's visible points, moved right, as a bottom-up network gives them."""
    shown = truth.visible[:, None]
    points = np.concatenate([truth.points_xy + (off_px, 0), np.full((24, 1), 0.95)], axis=1) * shown
    seen = points[truth.visible, :2]
    return Keypoints(
        frame=0, category="car", schema="car24", score=0.6, points=points.astype(np.float32),
        box_xyxy=np.concatenate([seen.min(axis=0), seen.max(axis=0)]).astype(np.float32),
        point_source=np.where(truth.visible, POINT_DETECTED, POINT_ABSENT).astype(np.int8),
    )  # fmt: skip


def test_counts_are_exact_where_all_judged_objects_and_nothing_else_is_found() -> None:
    truths = [car(0), car(200), car(400, height=20), car(600, share=0.2)]
    found = detections([*truths, car(800)], [0.9, 0.5, 0.5, 0.5, 0.4])
    missed, phantoms = judge_counts(found, truths, (0.3, 0.45, 0.6))
    assert missed.tolist() == [0, 0, 1], "objects that are not judged may be found"
    assert phantoms.tolist() == [1, 0, 0], "one is not there"


def test_counts_at_each_threshold_are_as_if_lower_scores_were_not_there() -> None:
    rng = np.random.default_rng(5)
    for _ in range(40):
        places = rng.integers(0, 12, (2, 6)) * 30.0
        truths = [car(left, height=rng.choice([20, 60]), share=rng.choice([0.2, 1.0])) for left in places[0]]
        truths = truths[: rng.integers(0, 7)]
        scores = sorted(rng.choice([0.2, 0.4, 0.5, 0.7, 0.9], rng.integers(0, 7)), reverse=True)
        found = detections([car(left) for left in places[1, : len(scores)]], scores)
        missed, phantoms = judge_counts(found, truths, BOX_SCORES)
        for index, threshold in enumerate(BOX_SCORES):
            partner, extra = match_boxes(found.boxes_xyxy[found.scores > threshold], truths)
            wanted = [at for at, truth in zip(partner, truths, strict=True) if is_judged(truth)]
            assert missed[index] == sum(at < 0 for at in wanted) and phantoms[index] == len(extra)


def test_where_no_card_has_a_threshold_no_frame_is_rendered() -> None:
    asked = iter([(np.zeros((4, 4, 3), np.uint8), ())])
    choose_thresholds(SHIPPED_CARDS, ["street_car24", "street_coco17"], asked)
    assert len(list(asked)) == 1


def test_a_track_may_begin_where_phantoms_are_few() -> None:
    falling = np.linspace(0.2, 0.0, len(BOX_SCORES))
    chosen = BOX_SCORES.index(sure_threshold(falling, BOX_SCORES))
    assert falling[chosen] <= 0.005 < falling[chosen - 1]
    assert sure_threshold(falling + 0.1, BOX_SCORES) == BOX_SCORES[-1]


def test_the_middle_of_a_plateau_beats_a_lone_peak() -> None:
    shares = np.full(len(BOX_SCORES), 0.2)
    shares[1] = 0.9
    shares[6:9] = 0.85
    assert best_threshold(shares, BOX_SCORES) == BOX_SCORES[7]


def test_of_thresholds_as_good_as_the_best_the_lowest_is_taken() -> None:
    shares = np.full(len(BOX_SCORES), 0.8)
    shares[:3] = 0.1
    shares[8] = 0.81
    assert best_threshold(shares, BOX_SCORES) == BOX_SCORES[4]


def test_bottom_up_cars_are_judged_point_by_point() -> None:
    truths = (car(0), car(300))
    tally = Tally()
    judge_car_fields([bottom_up(truths[0], off_px=5), bottom_up(truths[1], off_px=20)], truths, tally)
    figures = tally.figures()
    assert figures["fields_car_recall"] == figures["fields_car_count_exact"] == 1
    assert figures["fields_car_pck10"] == 0.5, "5 px are within a tenth of the diagonal, 20 px are not"
    assert figures["fields_car_right_above_0.9"] == 0.5
    assert figures["fields_car_hidden_below_0.3"] == 1


def test_missed_bottom_up_cars_and_phantoms_count_against_the_model() -> None:
    tally = Tally()
    judge_car_fields([bottom_up(car(600))], (car(0),), tally)
    figures = tally.figures()
    assert figures["fields_car_pck10"] == figures["fields_car_recall"] == figures["fields_car_count_exact"] == 0
    assert figures["fields_car_phantoms_per_frame"] == 1


def test_no_street_both_trains_chooses_and_judges() -> None:
    most = max(budget.streets for budget in BUDGETS.values())
    plans = [
        plan_lessons(TRAIN_SEED, most, frames=7, every=15), plan_streets(VALIDATION_SEED, CHOOSING_STREETS),
        plan_streets(HELD_OUT_SEED, JUDGED_STREETS),
    ]  # fmt: skip
    seeds = [{plan.config.seed for plan in each} for each in plans]
    assert len(set.union(*seeds)) == sum(map(len, seeds))


def test_learners_see_every_scene_crowded_and_not_from_any_camera() -> None:
    lessons = [plan.config for plan in plan_lessons(7, 240, frames=2, every=3)]
    busy = {config.scenario for config in lessons} - {"empty", "wall", "road_only"}
    for scene in busy:
        mine = [config for config in lessons if config.scenario == scene]
        assert {config.focal_px is None for config in mine} == {True, False}, scene
        assert len({config.walkers_per_100_m for config in mine}) > 2, scene


def test_judges_see_streets_as_they_are() -> None:
    walkers = {plan.config.walkers_per_100_m for plan in plan_streets(7, 40)}
    assert walkers == {None}


def test_frames_of_one_street_count_as_one() -> None:
    # Means 1, 0, 1, 0: a deviation of sqrt(1/3), four streets.
    outcomes = np.repeat([1.0, 0.0, 1.0, 0.0], 6)
    np.testing.assert_allclose(grouped_standard_error(outcomes.tolist(), 6), np.sqrt(1 / 3) / 2)
    assert grouped_standard_error(outcomes.tolist(), 1) < 0.5 * grouped_standard_error(outcomes.tolist(), 6)


def test_sure_is_what_phantoms_in_bad_light_do_not_reach(monkeypatch: pytest.MonkeyPatch) -> None:
    """A detector that is right in clear light and sees a second car, at 0.7, in bad light, in one frame of four."""
    there, ghost = car(0), car(400)
    pictures = [np.full((704, 1056, 3), level, np.uint8) for level in (90, 91, 92, 93)]

    class Detector:
        def __init__(self, card: YoloxCard, path: Path) -> None:
            assert card.score_thresholds == {} and card.score_threshold == BOX_SCORES[0]

        def detect(self, frames: list[np.ndarray]) -> list[Detections]:
            clear, harmed = frames
            assert any((clear == picture).all() for picture in pictures) and (harmed != clear).any()
            boxes = [there, ghost] if clear[0, 0, 0] == 93 else [there]
            return [detections([there], [0.9]), detections(boxes, [0.9, 0.7][: len(boxes)])]

    monkeypatch.setattr("training.street_thresholds.Detector", Detector)
    card = YoloxCard(
        name="d", file="d.onnx", licence="none", source="here", classes=("car", "person"), input_width=64,
        input_height=64, categories={"car": "car", "person": "person"}, sure_scores={"car": 0.2},
    )  # fmt: skip
    chooser = BoxScoreChooser(card, Path())
    for picture in pictures:
        chooser.add(picture, (there,))
    chosen = chooser.chosen()
    assert chosen.score_thresholds == {"car": BOX_SCORES[0], "person": BOX_SCORES[0]}
    assert chosen.sure_scores == {"car": 0.7, "person": 0.7}, "the ghost scores 0.7, no more"
