"""Scores of generated clips: answers computed by hand, properties, and faults that are counted and never averaged."""

from dataclasses import replace

import numpy as np
import pytest
from training_fixtures import walker

from labeling.boxes import iou
from labeling.camera import cover_map, rigid
from labeling.errors import DataError
from labeling.labels import Keypoints
from labeling.schemas import keypoint_schema
from training.evaluation import (
    ClipTruth,
    SampleEstimate,
    common_seconds,
    control_scores,
    label_scores,
    nearest_frames,
    poses_at,
    score_clip,
    too_short,
    trajectory_scores,
    truth_at,
    with_fault,
)
from training.evaluation_baselines import constant_velocity, held_first_frame
from training.evaluation_report import (
    FLOOR,
    SAMPLES,
    TRUE_SKELETONS,
    ClipResult,
    build_report,
    finite_or_none,
    outcome,
    result_from_json,
)
from training.label_agreement import box_agreement, mapped_labels, point_agreement
from training.metrics import paired_interval

WIDTH, HEIGHT, COUNT = 200, 100, 25
TIMES = np.arange(COUNT) / 24


def drive(speed: float, *, sideways: float = 0.0, times: np.ndarray = TIMES) -> np.ndarray:
    """Straight ahead at ``speed`` m/s, drifting sideways at a constant speed."""
    offsets = np.stack([sideways * times, np.zeros(len(times)), speed * times], axis=-1)
    return rigid(np.tile(np.eye(3), (len(times), 1, 1)), offsets)


def car(frame: int, *, left: float = 20, top: float = 30, side: float = 40, track_id: int = 1) -> Keypoints:
    """A car24 of ``side`` x ``side`` pixels whose points lie on its diagonal, corner to corner."""
    count = keypoint_schema("car24").point_count
    share = np.linspace(0, 1, count)
    points = np.stack([left + side * share, top + side * share, np.ones(count)], axis=-1).astype(np.float32)
    return Keypoints(
        frame=frame, track_id=track_id, category="car", schema="car24", score=0.9,
        box_xyxy=np.array([left, top, left + side, top + side], np.float32), points=points,
        point_source=np.ones(count, np.int8),
    )  # fmt: skip


def truth(**changes) -> ClipTruth:
    labels = tuple(car(frame, left=20 + 2 * frame) for frame in range(COUNT))
    made = ClipTruth(
        key="a_0", video_id="a", times_s=TIMES, cam_to_world=drive(10), labels=labels, box_tracks=frozenset({1}),
        width=WIDTH, height=HEIGHT,
    )  # fmt: skip
    return replace(made, **changes)


def sample(name: str = "a_0_0", *, times: np.ndarray = TIMES, **changes) -> SampleEstimate:
    made = SampleEstimate(name=name, times_s=times, width=WIDTH, height=HEIGHT, cam_to_world=drive(10, times=times))
    return replace(made, **changes)


def test_trajectory_scores_by_hand() -> None:
    """Over 1 s: 12 m/s for 10 m/s is 1 m off on average, 11 m/s 0.5 m."""
    scores = trajectory_scores([drive(12), drive(11)], drive(10))
    assert scores["min_ade_m"] == pytest.approx(0.5) and scores["ade_m"] == pytest.approx(0.75)
    # Both differ by t metres at t seconds: the root of the sum of (i / 24)^2 over 25 points.
    assert scores["apd_m"] == pytest.approx(np.sqrt((TIMES**2).sum()))
    assert "apd_m" not in trajectory_scores([drive(12)], drive(10))


def test_control_scores_by_hand() -> None:
    scores = control_scores(drive(12), drive(10))
    assert scores["ate_m"] == pytest.approx(2 * np.sqrt((TIMES**2).mean()))
    assert scores["rpe_m"] == pytest.approx(2) and scores["rpe_deg"] == pytest.approx(0, abs=1e-6)
    assert scores["drift_share"] == pytest.approx(0.2)
    # Scale forgives a wrong speed, a rigid motion does not.
    assert scores["ate_sim3_m"] == pytest.approx(0, abs=1e-9) and scores["ate_se3_m"] > 0.1
    assert "drift_share" not in control_scores(drive(0), drive(0))


@pytest.mark.parametrize("alignment", ["none", "se3", "sim3"])
def test_evo_agrees_on_a_bend_at_another_rate(alignment: str) -> None:
    """The truth's times are met by interpolation, and evo scores what comes of it as we do."""
    metrics = pytest.importorskip("evo.core.metrics", reason="evo is a development extra")
    from evo.core.trajectory import PosePath3D

    turn, radius = np.radians(60) * TIMES, 15.0
    bend = rigid(
        np.stack([[[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]] for a in turn]),
        np.stack([radius * (1 - np.cos(turn)), 0 * turn, radius * np.sin(turn)], axis=-1),
    )
    wide = bend.copy()
    wide[:, :3, 3] *= 1.2
    found = poses_at(TIMES[::2], wide[::2], TIMES)
    reference, estimate = PosePath3D(poses_se3=list(bend)), PosePath3D(poses_se3=list(found))
    relative = metrics.RPE(metrics.PoseRelation.translation_part, delta=24, delta_unit=metrics.Unit.frames)
    relative.process_data((reference, estimate))
    if alignment != "none":
        estimate.align(reference, correct_scale=alignment == "sim3")
    absolute = metrics.APE(metrics.PoseRelation.translation_part)
    absolute.process_data((reference, estimate))
    name = {"none": "ate_m", "se3": "ate_se3_m", "sim3": "ate_sim3_m"}[alignment]
    scores = control_scores(found, bend)
    assert scores[name] == pytest.approx(absolute.get_statistic(metrics.StatisticsType.rmse), abs=1e-9)
    assert scores["rpe_m"] == pytest.approx(relative.get_statistic(metrics.StatisticsType.rmse), rel=1e-6)


def test_box_iou_by_hand() -> None:
    boxes = np.array([[0, 0, 10, 10], [5, 0, 15, 10], [20, 20, 30, 30]], np.float32)
    assert iou(boxes[:1], boxes) == pytest.approx(np.array([[1, 1 / 3, 0]]))
    wanted = [car(0), car(0, left=120, track_id=2), car(1)]
    # One exact, one shifted by a quarter (30 / 50 = 0.6), one missed, one phantom.
    found = [car(0), car(0, left=130), car(2)]
    agreement = box_agreement(found, wanted)
    assert (agreement.wanted, agreement.matched, agreement.found) == (3, 2, 3)
    assert agreement.mean_iou == pytest.approx(1.6 / 3) and agreement.recall == pytest.approx(2 / 3)
    assert np.isnan(box_agreement(found, []).mean_iou)


def test_objects_pair_one_to_one_and_in_their_own_category() -> None:
    twice = box_agreement([car(0)], [car(0), car(0, left=22, track_id=2)])
    assert (twice.matched, twice.wanted) == (1, 2)
    walker = replace(
        car(0), category="person", schema="coco17", points=np.ones((17, 3), np.float32),
        point_source=np.ones(17, np.int8),
    )  # fmt: skip
    assert box_agreement([walker], [car(0)]).matched == 0
    # The greedy pair (0, 1) would leave car 0 without a partner.
    crossed = box_agreement([car(0, left=24), car(0, left=36)], [car(0, left=20), car(0, left=26, track_id=2)])
    assert crossed.matched == 2


def test_pck_by_hand() -> None:
    """The diagonal is 56.6 px: points 5 px off are right, 6 px off are wrong at a tenth of it."""
    near, far = car(0), car(1)
    near.points[:, 0] += 5
    far.points[:, 0] += 6
    agreement = point_agreement([near, far], [car(0), car(1), car(2)])
    assert (agreement.wanted, agreement.matched, agreement.shown, agreement.right) == (3, 2, 72, 24)
    assert agreement.pck == pytest.approx(1 / 3) and agreement.precision == 1
    assert agreement.median_distance == pytest.approx(5.5 / np.hypot(40, 40))


def test_unsure_points_count_as_absent_on_both_sides() -> None:
    unsure = car(0)
    unsure.points[12:, 2] = 0.2
    assert point_agreement([unsure], [car(0)]).right == 0, "half a hull is another box"
    assert point_agreement([unsure], [unsure]).shown == 12
    none = replace(car(0), points=np.zeros_like(car(0).points))
    assert point_agreement([none], [none]).wanted == 0


def test_points_of_other_schemas_are_an_error() -> None:
    other = keypoint_schema("car66").point_count
    points = np.resize(car(0).points, (other, 3))
    with pytest.raises(DataError, match="car66 and car24 cannot be compared"):
        point_agreement(
            [replace(car(0), schema="car66", points=points, point_source=np.ones(other, np.int8))], [car(0)]
        )


def test_labels_follow_the_picture_and_are_cut_at_its_border() -> None:
    """Twice as large and cropped by 100 px on either side: 200x100 onto 200x200."""
    picture = cover_map(WIDTH, HEIGHT, width=200, height=200)
    (moved,) = mapped_labels([car(0, left=45, top=30)], picture)
    assert moved.box_xyxy.tolist() == pytest.approx([0, 60.5, 70.5, 140.5])
    # Of 24 points from x = 45 to 85, those left of x = 49.5 are outside.
    assert int(moved.present.sum()) == int((car(0, left=45).points[:, 0] * 2 + 0.5 - 100 >= -0.5).sum()) < 24
    assert mapped_labels([car(0, left=0)], picture) == []


def test_a_perfect_sample_is_perfect_at_any_rate_and_size() -> None:
    clip = truth()
    times = np.arange(11) / 10
    small = cover_map(WIDTH, HEIGHT, width=100, height=50)
    shown = [replace(car(0, left=20 + 2 * int(i)), frame=n) for n, i in enumerate(nearest_frames(TIMES, times))]
    one = sample(times=times, width=100, height=50, labels=tuple(mapped_labels(shown, small)))
    score = score_clip(clip, {SAMPLES: [one]})[SAMPLES]
    assert score.values["min_ade_m"] == pytest.approx(0, abs=1e-9)
    assert score.values["box_iou"] == pytest.approx(1, abs=1e-5) and score.values["truth_pck"] == 1
    assert (score.seconds, score.points) == (pytest.approx(1.0), 25)


def test_nearest_frames_take_the_earlier_of_two() -> None:
    assert nearest_frames(np.array([0.0, 1.0, 2.0]), np.array([0.0, 0.5, 0.6, 1.5, 2.0, 9.0])).tolist() == [
        0, 0, 1, 1, 2, 2,
    ]  # fmt: skip
    assert nearest_frames(np.array([0.0]), np.array([0.0, 1.0])).tolist() == [0, 0]


def test_all_sets_are_compared_on_the_duration_they_share() -> None:
    short = sample("a_0_1", times=TIMES[:13], cam_to_world=drive(14, times=TIMES[:13]))
    scores = score_clip(truth(), {SAMPLES: [sample(cam_to_world=drive(12)), short], FLOOR: [sample()]})
    assert {score.seconds for score in scores.values()} == {0.5}
    assert scores[SAMPLES].points == 13
    # 2 m/s too fast for half a second.
    assert scores[SAMPLES].values["min_ade_m"] == pytest.approx(0.5)
    assert common_seconds(truth(), [sample()], seconds=0.25) == 0.25


def test_the_floors_apd_is_its_distance_from_the_truth() -> None:
    scores = score_clip(truth(), {FLOOR: [sample(cam_to_world=drive(11))]}, floor=FLOOR)
    assert scores[FLOOR].values["apd_m"] == pytest.approx(np.sqrt((TIMES**2).sum()))


def test_faults_are_counted_and_never_averaged() -> None:
    good = sample(cam_to_world=drive(11), psnr_db=np.full(COUNT, 20.0), ssim=np.full(COUNT, 0.5))
    lost = with_fault(good, "ego", "confidence 0.10 < 0.3")
    gone = with_fault(good, "video", "no video")
    samples = [good, replace(lost, name="a_0_1"), replace(gone, name="a_0_2")]
    score = score_clip(truth(), {SAMPLES: samples})[SAMPLES]
    assert score.values["min_ade_m"] == pytest.approx(0.5) and score.values["psnr_db"] == 20
    assert (score.samples["min_ade_m"], score.samples["psnr_db"], score.of) == (1, 2, 3)
    found = outcome(score, samples)
    assert found.estimated == {"video": 2, "ego": 1, "labels": 0, "skeleton": 0, "picture": 2}
    assert [fault[:2] for fault in found.faults] == [("a_0_1", "ego"), ("a_0_2", "video")]


def test_a_sample_that_broke_off_does_not_cut_the_others_down() -> None:
    samples = [sample(f"a_0_{n}") for n in range(3)] + [sample("a_0_3", times=TIMES[:7])]
    assert list(too_short(samples)) == ["a_0_3"]
    assert too_short(samples)["a_0_3"] == "too short: 0.25 s, at least 0.50 s are needed"
    assert too_short([]) == {}


def test_a_blink_is_too_short_though_all_samples_are() -> None:
    blinks = [sample(f"a_0_{n}", times=TIMES[:4]) for n in range(3)]
    assert too_short(blinks) == {one.name: "too short: 0.12 s, at least 0.20 s are needed" for one in blinks}
    assert too_short([sample(times=TIMES[:6])]) == {}


def test_boxes_are_those_that_were_given_and_low_objects_are_not_asked_for() -> None:
    labels = (car(0), car(0, left=120, track_id=2), car(0, left=180, side=2, track_id=3))
    clip = truth(labels=labels, box_tracks=frozenset({1, 3}))
    assert [one.track_id for one in truth_at(clip, sample(), end_s=1)] == [1, 2]
    scores = label_scores(clip, sample(labels=(car(0),)), end_s=1.0)
    assert scores["box_iou"] == 1 and scores["truth_recall"] == 0.5


def test_keypoints_agree_between_skeleton_video_rgb_and_truth() -> None:
    """RGB follows the skeletons exactly, and both are 6 px (more than a tenth of the diagonal) beside the truth."""
    shifted = tuple(car(frame, left=20 + 2 * frame + 6) for frame in range(COUNT))
    one = sample(labels=shifted, skeletons=(shifted[0], shifted[8]), skeleton_frames=(0, 8))
    scores = label_scores(truth(), one, end_s=1.0)
    assert (scores["skeleton_pck"], scores["motion_pck"], scores["truth_pck"]) == (1, 0, 0)
    assert scores["skeleton_recall"] == 1


def test_baselines_are_what_they_say() -> None:
    clip, floor = truth(), sample("truth video", labels=truth().labels)
    on, held = constant_velocity(clip), held_first_frame(floor)
    assert on.cam_to_world == pytest.approx(drive(10)) and held.cam_to_world == pytest.approx(drive(0))
    scores = score_clip(clip, {"on": [on], "held": [held]})
    # The car goes 2 px a frame, at a constant velocity.
    assert scores["on"].values["box_iou"] == pytest.approx(1) and scores["on"].values["min_ade_m"] == pytest.approx(0)
    assert scores["on"].values["truth_pck"] == 1 > scores["held"].values["truth_pck"]
    assert scores["held"].values["min_ade_m"] == pytest.approx(5)
    assert {label.frame for label in held.labels or ()} == set(range(COUNT))
    assert scores["held"].values["box_iou"] < 0.6
    assert held_first_frame(with_fault(floor, "labels", "x")).labels is None


def results() -> list[ClipResult]:
    """Two videos, three clips; the judged samples are 1 m worse than those over true skeletons."""
    found = []
    for key, video, base in (("a_0", "a", 1.0), ("a_48", "a", 2.0), ("b_0", "b", 4.0)):
        sets = {}
        for name, extra in ((SAMPLES, 1.0), (TRUE_SKELETONS, 0.0)):
            clip = truth(key=key, video_id=video)
            one = sample(f"{key}_0", cam_to_world=drive(10 + 2 * (base + extra)))
            bad = with_fault(sample(f"{key}_1"), "ego", f"confidence 0.{len(found)}1 < 0.3")
            sets[name] = outcome(score_clip(clip, {name: [one, bad]})[name], [one, bad])
        found.append(ClipResult(key=key, video_id=video, split="val", sets=sets))
    return found


def test_reports_average_clips_and_draw_videos() -> None:
    report = build_report(results())
    judged = report.sets[SAMPLES]
    assert judged.figures["min_ade_m"].mean == pytest.approx((2 + 3 + 5) / 3)
    assert (judged.figures["min_ade_m"].groups, judged.clips["min_ade_m"]) == (2, 3)
    assert judged.figures["min_ade_m"].low == pytest.approx(2.5) and judged.figures["min_ade_m"].high == 5
    # What is common to both sets cancels in pairs.
    difference = report.differences[TRUE_SKELETONS]["min_ade_m"]
    assert (difference.mean, difference.low, difference.high) == pytest.approx((1, 1, 1))


def test_coverage_counts_alike_reasons_together() -> None:
    coverage = build_report(results()).sets[SAMPLES].coverage
    assert (coverage["ego"].estimated, coverage["ego"].of) == (3, 6)
    assert coverage["ego"].reasons == {"confidence 0.01 < 0.3": 3}
    assert "labels" not in coverage, "a part that was never tried has no coverage"


def test_results_survive_json() -> None:
    import json
    from dataclasses import asdict

    for result in results():
        assert result_from_json(json.loads(json.dumps(asdict(result)))) == result
    assert finite_or_none({"a": [float("nan"), 1.0]}) == {"a": [None, 1.0]}


def test_paired_intervals_need_pairs() -> None:
    first, second = {"a": 1.0, "b": 5.0, "c": float("nan")}, {"a": 3.0, "b": 9.0, "c": 1.0, "d": 2.0}
    found = paired_interval(first, second, {"a": "x", "b": "y", "c": "z"})
    assert (found.mean, found.low, found.high, found.groups) == (3, 2, 4, 2)
    with pytest.raises(DataError, match="no key has a value on both sides"):
        paired_interval({"a": 1.0}, {"b": 1.0}, {"a": "x", "b": "y"})


def test_a_clip_of_one_frame_goes_on_as_it_is() -> None:
    """``clip.clip_frames`` may be 1."""
    truth = ClipTruth(
        key="v_0", video_id="v", times_s=np.zeros(1), cam_to_world=np.eye(4)[None], labels=(walker(0, x=30),), width=96,
        height=64,
    )  # fmt: skip
    found = constant_velocity(truth)
    assert found.cam_to_world is not None and np.array_equal(found.cam_to_world, np.eye(4)[None])
    assert found.labels is not None and np.array_equal(found.labels[0].box_xyxy, truth.labels[0].box_xyxy)
