"""The study: equal compute, exact scores, verdicts that say when they cannot know, and a smoke run of all of it."""

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest

from dataset.street import Street, StreetConfig
from dataset.street_segments import SEGMENTS
from labeling.boxes import iou
from labeling.camera import Trajectory, rigid
from labeling.errors import ConfigError, DataError
from pipelines.study_data import StudyClip
from pipelines.study_picture import BESIDES, FIGURES, draw_study, shared_reason
from pipelines.study_shipped import _hits
from training.criteria import MATCH_IOU
from training.metrics import mean_interval
from training.study_judge import PAIR_FRAMES, JudgeClip, chained, motion_of, pair_batch
from training.study_plan import ARMS, QUESTIONS, plan_study
from training.study_scores import CAP_PX, Reading, TrueTrack, clip_scores, track_scores, true_tracks
from training.study_shapes import shape_video
from training.study_verdicts import Gate, crossed_interval, find, judge_gate, table_of

HOLDS = Gate(figure="keypoint_error", holds=True, reason="")


@pytest.mark.parametrize("minutes", [8, 40, 360])
def test_every_arm_gets_the_same_compute(minutes):
    plan = plan_study(minutes)
    for arm in ARMS:
        spent = sum(plan.steps(arm, run) * plan.scale.batch * run.tokens(plan.scale) for run in arm.runs)
        step = max(plan.scale.batch * run.tokens(plan.scale) for run in arm.runs)
        assert abs(spent - plan.arm_tokens) <= len(arm.runs) * step


def test_questions_ask_for_arms_that_exist_and_a_larger_budget_buys_more():
    names = {arm.name for arm in ARMS}
    assert all({question.first, question.second} <= names for question in QUESTIONS)
    small, large = plan_study(10), plan_study(300)
    assert large.arm_tokens > small.arm_tokens
    assert large.base.denoiser_steps > small.base.denoiser_steps
    assert plan_study(10).scale.seeds >= 3
    with pytest.raises(ConfigError, match="2 minutes"):
        plan_study(2)


@pytest.mark.parametrize("minutes", [-5, 0, math.nan, math.inf])
def test_a_budget_that_is_no_time_is_refused(minutes):
    with pytest.raises(ConfigError, match=f"a budget of {minutes:g} minutes .*; give a number from 5 on"):
        plan_study(minutes)


def test_one_found_box_is_one_car():
    """Of two cars side by side, a box over both is one at most; a box for each is two, whatever else is found."""
    cars = [SimpleNamespace(box_xyxy=np.array(box), visible_share=1.0) for box in ((0, 0, 60, 60), (20, 0, 80, 60))]
    clip = cast(StudyClip, SimpleNamespace(cars=lambda: [cars]))
    over_both, left, right = (10, 0, 70, 60), (0, 0, 50, 60), (30, 0, 80, 60)
    assert sorted(_hits(clip, 0, np.array([over_both]))) == [0, 1]
    assert _hits(clip, 0, np.array([over_both, right, left])) == [1, 1]
    assert _hits(clip, 0, np.empty(0)) == [0, 0]
    assert _hits(cast(StudyClip, SimpleNamespace(cars=lambda: [[]])), 0, np.array([left])) == []


def test_shape_videos_are_functions_of_seed_and_index_and_move():
    videos = [shape_video(3, index, frames=9, width=64, height=32) for index in range(6)]
    again = shape_video(3, 4, frames=9, width=64, height=32)
    assert (videos[4] == again).all()
    assert not (shape_video(4, 4, frames=9, width=64, height=32) == again).all()
    assert sum((video[0] != video[-1]).any() for video in videos) >= 5
    assert all(video.shape == (9, 32, 64, 3) and video.dtype == np.uint8 for video in videos)


def _still_track(count: int = 4, box: tuple[float, ...] = (20, 20, 60, 50)) -> TrueTrack:
    return TrueTrack(boxes_xyxy=np.tile(np.array(box, float), (count, 1)), asked=np.ones(count, bool))


def test_the_truth_itself_scores_perfectly_and_nothing_scores_the_cap():
    track = _still_track()
    right = track_scores(list(track.boxes_xyxy[:, None]), [track])
    assert right == {"keypoint_error": 0.0, "track_survival": 1.0, "recall": 1.0}
    nothing = track_scores([np.zeros((0, 4))] * 4, [track])
    assert nothing == {"keypoint_error": CAP_PX, "track_survival": 0.0, "recall": 0.0}


def test_corner_error_is_in_pixels_of_the_picture_and_a_lost_track_stays_lost():
    track = _still_track()
    shifted = track.boxes_xyxy + (3, 4, 3, 4)
    scores = track_scores(list(shifted[:, None]), [track])
    assert scores["keypoint_error"] == pytest.approx(2.5)  # 5 px of twice the picture
    found = list(track.boxes_xyxy[:, None])
    found[2] = np.zeros((0, 4))
    lost = track_scores(found, [track])
    assert lost["track_survival"] == pytest.approx(1 / 3)  # the first frame is given; found once, lost, found again
    assert lost["recall"] == pytest.approx(2 / 3)


def test_one_box_serves_one_car():
    tracks = [_still_track(), _still_track()]
    scores = track_scores(list(tracks[0].boxes_xyxy[:, None]), tracks)
    assert scores["recall"] == 0.5


def test_overlaps_too_small_to_match_keep_no_true_pair_from_being_made():
    # IoU of the first car with the boxes 0.43 and 0.25, of the second 0.25 and 0: 0.25 twice is more than 0.43 once.
    tracks = [_still_track(box=(0, 0, 100, 10)), _still_track(box=(100, 0, 200, 10))]
    boxes = np.array([[40, 0, 140, 10], [-60, 0, 40, 10]], float)
    first, second = (iou(track.boxes_xyxy[:1], boxes)[0] for track in tracks)
    assert first[0] >= MATCH_IOU > max(first[1], second[0]) and first[1] + second[0] > first[0] + second[1]
    assert track_scores([boxes] * 4, tracks)["recall"] == 0.5


def test_tracks_begin_in_the_first_frame_and_end_where_the_truth_shows_them_badly():
    box = np.array([0, 0, 20, 20], float)
    frames = [{1: (box, True), 2: (box, False)}, {1: (box, True), 3: (box, True)}, {1: (box, False)}, {1: (box, True)}]
    (track,) = true_tracks(frames)
    assert track.asked.tolist() == [True, True, False, False]


def test_a_planar_way_is_chained_from_its_motions():
    poses = [np.eye(4)]
    for yaw, forward in [(0.1, 2.0), (-0.05, 1.0), (0.2, 3.0)]:
        rotation = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
        poses.append(poses[-1] @ rigid(rotation, np.array([0.1, 0.0, forward])))
    way = np.stack(poses)
    motions = np.stack([motion_of(np.linalg.inv(a) @ b) for a, b in zip(way[:-1], way[1:], strict=True)])
    assert chained(motions) == pytest.approx(way)


def test_min_ade_is_that_of_the_best_sample():
    way = chained(np.tile([0.0, 2.0, 0.0], (4, 1)))
    wrong = chained(np.tile([0.0, 0.0, 0.0], (4, 1)))
    readings = [Reading(boxes=(np.zeros((0, 4)),) * 4, cam_to_world=path) for path in (wrong, way)]
    scores = clip_scores(readings, [], way)
    assert scores["min_ade"] == 0.0
    assert scores["ade"] == pytest.approx(2.0)  # the mean of 0 and of 0, 2, 4, 6, 8
    assert "keypoint_error" not in scores


def test_pairs_that_are_mirrored_or_reversed_keep_their_truth():
    """A camera that only drives forward: every motion is forward or its exact reverse, never sideways."""
    way = chained(np.tile([0.0, 1.0, 0.0], (8, 1)))
    clip = JudgeClip(
        videos=(np.zeros((9, 32, 32, 3), np.uint8),), boxes=(), counted=(), cam_to_world=way,
    )  # fmt: skip
    pictures, motions = pair_batch([clip], np.random.default_rng(0))
    assert pictures.shape[1:] == (2, 3, 32, 32)
    assert np.abs(np.abs(motions[:, 1].numpy()) - PAIR_FRAMES).max() < 1e-5
    assert np.abs(motions[:, [0, 2]].numpy()).max() < 1e-5


def test_an_interval_of_one_seed_agrees_with_the_bootstrap_over_streets():
    values = np.random.default_rng(1).normal(size=24)
    mine = crossed_interval(values[None])
    peer = mean_interval(list(values), [str(street) for street in range(24)])
    assert (mine.low, mine.high) == pytest.approx((peer.low, peer.high), abs=0.05)
    assert mine.mean == pytest.approx(values.mean())


def test_streets_that_ask_for_nothing_are_left_out_and_none_at_all_is_an_error():
    table = np.array([[1.0, np.nan, 3.0], [1.0, 5.0, 3.0]])
    assert crossed_interval(table).mean == 2.0
    with pytest.raises(DataError, match="no paired differences"):
        crossed_interval(np.full((2, 3), np.nan))
    assert np.isnan(table_of([{"a": {}}], "recall", ["a", "b"])).all()


@pytest.mark.parametrize(
    ("gain", "spread", "verdict"),
    [(2.0, 0.1, "better"), (-2.0, 0.1, "worse"), (0.0, 0.01, "no difference"), (0.0, 3.0, "inconclusive")],
)
def test_verdicts_follow_the_interval(gain, spread, verdict):
    rng = np.random.default_rng(0)
    second = rng.normal(4.0, 0.1, (3, 12))
    first = second - gain + rng.normal(0, spread, (3, 12))
    trivial = {"the first frame held": np.full(12, 9.0)}
    found = find(first, second, gate=HOLDS, trivial=trivial, same=0.8, more_is_better=False)
    assert found.verdict == verdict, found


def test_no_verdict_without_a_judge_without_motion_or_with_two_seeds():
    truth, copied = np.full(12, 1.0), np.full(12, 6.0)
    trivial = {"the first frame held": copied, "another street": copied + 1}
    good, bad = np.full((3, 12), 2.0), np.full((3, 12), 8.0)
    fails = judge_gate("keypoint_error", copied + 0.1, trivial, more_is_better=False, unit="px")
    assert not fails.holds
    assert "not surely better than the first frame held" in fails.reason
    sides = {"trivial": trivial, "same": 0.5, "more_is_better": False}
    assert "judge" in find(good, bad, gate=fails, **sides).reason
    assert "first frame" in find(bad, bad + 1, gate=HOLDS, **sides).reason
    fooled = {**sides, "trivial": trivial | {"another street": truth}}
    assert "another street" in find(good, bad, gate=HOLDS, **fooled).reason
    assert "2 of at least 3 seeds" in find(good[:2], bad[:2], gate=HOLDS, **sides).reason
    holds = judge_gate("keypoint_error", truth, trivial, more_is_better=False, unit="px")
    assert holds.holds
    assert find(good, bad, gate=holds, **sides).verdict == "better"


def told(*verdicts: tuple[str, str]) -> dict[str, Any]:
    """A study's tree with a question for each (verdict, reason)."""
    gap = {"mean": 0.1, "low": -0.2, "high": 0.4}
    questions = [
        {"text": f"a against b{n}", "first": "a", "second": f"b{n}", "verdict": verdict,
         "figures": {name: {"verdict": verdict, "reason": reason, "difference": gap} for name in FIGURES}}
        for n, (verdict, reason) in enumerate(verdicts)
    ]  # fmt: skip
    arms = ["a", *(question["second"] for question in questions), *BESIDES]
    return {
        "questions": questions, "arms": {arm: dict.fromkeys(FIGURES, gap) for arm in arms}, "seeds": [0, 1, 2],
        "plan": {"scale": {"val_clips": 4}}, "processor_s": {"in all": 60.0},
    }  # fmt: skip


def test_a_reason_that_all_questions_share_is_said_once():
    reason = "neither arm surely beats the first frame held"
    assert shared_reason(told(("inconclusive", reason), ("inconclusive", reason)), "min_ade").endswith(reason)
    assert shared_reason(told(("inconclusive", reason), ("better", "the whole interval is above 0")), "min_ade") == ""


def test_every_verdict_and_what_arms_stand_beside_are_drawn(tmp_path):
    result = told(*((verdict, verdict) for verdict in ("better", "worse", "no difference", "inconclusive")))
    draw_study(result, tmp_path / "all.png")
    # Arms of a smoke run may lack a figure, and a study may have been drawn before a baseline was known.
    result["arms"].pop("[another street]")
    result["arms"]["b0"].pop("keypoint_error")
    draw_study(result, tmp_path / "fewer.png")
    whole, fewer = (cv2.imread(str(tmp_path / name)) for name in ("all.png", "fewer.png"))
    assert whole is not None and fewer is not None and whole.shape == fewer.shape and (whole != fewer).any()


def test_segments_agree_with_the_boxes_and_the_horizon():
    street = Street(StreetConfig(seed=3, width=192, height=128, fps=12, frames=2, scenario="traffic", focal_px=288.0))
    frame = street.render(1, segments=True)
    assert (street.render(1).rgb == frame.rgb).all()
    assert not street.render(1).segments.size
    car = frame.segments == SEGMENTS.index("car")
    inside = np.zeros_like(car)
    for thing in frame.objects:
        if thing.category == "car":
            left, top, right, bottom = np.rint(thing.box_xyxy + 0.5).astype(int)
            inside[top:bottom, left:right] = True
    assert car.any()
    assert not (car & ~inside).any()
    assert not (frame.segments[:40] == SEGMENTS.index("ground")).any()
    assert (frame.segments[-4:] == SEGMENTS.index("ground")).mean() > 0.5


@pytest.mark.parametrize("hill_m", [2.0, -2.0], ids=str)
def test_the_road_over_a_hill_is_ground(hill_m):
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, 2, 3] = np.arange(60)
    poses[:, 1, 3] = -hill_m * np.sin(np.pi * np.arange(60) / 59)
    way = Trajectory(timestamps_s=np.arange(60) / 24, cam_to_world=poses)
    config = StreetConfig(seed=3, width=96, height=64, frames=60, scenario="empty", trajectory=way)
    shown = Street(config).render(30, segments=True).segments
    assert (shown[50:, 40:56] == SEGMENTS.index("ground")).all()
    assert (shown == SEGMENTS.index("thing")).any()


def test_a_report_of_nothing_leaves_nothing(tmp_path: Path) -> None:
    """A plan left behind would refuse the study that is to be made there."""
    from pipelines.study import run_study

    with pytest.raises(ConfigError, match="has no seed whose arms are all judged"):
        run_study(tmp_path / "study", report=True)
    assert not (tmp_path / "study").exists()


@pytest.mark.parametrize("damage", [b"{", b"\xff", b"[]", b'{"value": 1}'], ids=["torn", "bytes", "list", "half"])
def test_a_damaged_record_is_named(tmp_path: Path, damage: bytes) -> None:
    from pipelines.study import run_study

    (tmp_path / "records").mkdir()
    (tmp_path / "records" / "vae.json").write_bytes(damage)
    with pytest.raises(DataError, match=r"vae\.json: is no record of the study .*; remove it and run the study again"):
        run_study(tmp_path, quick=True, say=lambda line: None)


def test_a_smoke_run_goes_through_and_goes_on_where_it_was(tmp_path: Path):
    from pipelines.study import run_study

    result = run_study(tmp_path, quick=True, say=lambda line: None)
    assert [question["name"] for question in result["questions"]] == [question.name for question in QUESTIONS]
    assert {question["verdict"] for question in result["questions"]} == {"inconclusive"}
    for arm in ARMS:
        assert result["arms"][arm.name]["apd"]["mean"] >= 0
    assert json.loads((tmp_path / "study.json").read_text())["questions"] == json.loads(json.dumps(result["questions"]))
    for name in ("study.png", "study-sheet.png"):
        assert (tmp_path / name).stat().st_size > 2000
    records = {path: path.stat().st_mtime_ns for path in (tmp_path / "records").iterdir()}
    again = run_study(tmp_path, quick=True, report=True, say=lambda line: None)
    assert again["arms"] == result["arms"]
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "records").iterdir()} == records
    with pytest.raises(ConfigError, match="another plan"):
        run_study(tmp_path, minutes=10)
