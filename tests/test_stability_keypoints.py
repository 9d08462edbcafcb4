"""The parts of the stability table of keypoints, on truth made by hand."""

import json
from dataclasses import replace

import cv2
import matplotlib
import numpy as np
import pytest

from dataset.street_labels import StreetObject
from labeling.camera import Trajectory, prior_intrinsics
from labeling.labels import Keypoints
from labeling.schemas import Category
from pipelines.keypoint_clips import KeypointClip
from pipelines.keypoint_errors import MatchedFrame
from pipelines.keypoint_harm import Board, behind_board, board_targets, frozen, in_condition, spliced
from pipelines.reliability import reliability_curve, share_right
from pipelines.scored_points import scored_points
from pipelines.stability import judged, make_table, read_stability, run_stability, write_stability
from pipelines.stability_keypoints import (
    column_passages,
    drift_shares,
    hidden_below,
    id_switches,
    only_track,
    with_truth,
)

WIDTH, HEIGHT = 320, 240
BOX = (100.0, 80.0, 200.0, 160.0)


def car(track_id=1, *, box=BOX, share=1.0, category: Category = "car"):
    """A true car whose points lie evenly from the left of its box to the right."""
    count = 24 if category == "car" else 17
    x, y = np.linspace(box[0], box[2], count), np.full(count, (box[1] + box[3]) / 2)
    return StreetObject(
        track_id=track_id, category=category, schema="car24" if category == "car" else "coco17",
        box_xyxy=np.array(box, np.float32), points_xy=np.column_stack([x, y]).astype(np.float32),
        visible=np.ones(count, bool), visible_share=share, distance_m=10.0,
    )  # fmt: skip


def found(thing, *, frame=0, track_id=5, score=1.0, shift=0.0):
    points = np.column_stack([thing.points_xy + [shift, 0], np.full(len(thing.points_xy), score)]).astype(np.float32)
    return Keypoints(
        frame=frame, track_id=track_id, category=thing.category, schema=thing.schema, score=0.9,
        box_xyxy=thing.box_xyxy, points=points, point_source=(points[:, 2] > 0).astype(np.int8),
    )  # fmt: skip


def a_clip(truth, *, level=128):
    rng = np.random.default_rng(level)
    frames = tuple(rng.integers(level - 60, level + 60, (HEIGHT, WIDTH, 3)).astype(np.uint8) for _ in truth)
    poses = np.tile(np.eye(4), (len(truth), 1, 1))
    return KeypointClip(
        name="made", frames=frames, truth=tuple(truth), labels=tuple(() for _ in truth),
        intrinsics=prior_intrinsics(WIDTH, HEIGHT),
        trajectory=Trajectory(timestamps_s=np.arange(len(truth)) / 24, cam_to_world=poses),
    )  # fmt: skip


def frame_of(*pairs, phantoms=(), frame=0):
    return MatchedFrame(frame=frame, pairs=pairs, phantoms=phantoms)


@pytest.mark.parametrize("from_left", [True, False])
@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_a_board_hides_its_share_of_the_points_and_of_the_picture(share, from_left):
    clip = a_clip([(car(), car(2, box=(10, 20, 60, 40)))])
    covered = behind_board(clip, Board(track_id=1, share=share, from_left=from_left))
    (thing, other) = covered.truth[0]
    assert thing.visible.mean() == pytest.approx(1 - share, abs=0.05) and other.visible.all()
    assert np.allclose(np.diff(thing.box_xyxy[[0, 2]]), 100 * (1 - share))
    changed = (covered.frames[0] != clip.frames[0]).any(axis=2)
    hidden = np.rint(thing.points_xy[~thing.visible]).astype(int)
    seen = np.rint(thing.points_xy[thing.visible][1:-1]).astype(int)
    assert changed[hidden[1:-1, 1], hidden[1:-1, 0]].all() and not changed[seen[:, 1], seen[:, 0]].any()
    assert covered.truth[0][0].visible_share == 1.0, "it stays judged"


def test_boards_stand_only_before_cars_in_full_view():
    full, cut, low, behind = car(1), car(2, box=(-3, 80, 90, 160)), car(3, box=(10, 10, 60, 50)), car(4, share=0.7)
    clip = a_clip([(full, cut, low, behind), (cut, low, behind)])
    assert board_targets(clip, most=3) == [1]
    covered = behind_board(clip, Board(track_id=1, share=0.5, from_left=True))
    assert covered.frames[1] is clip.frames[1] and covered.frames[0] is not clip.frames[0]
    matched = [frame_of((full, found(full))), frame_of((cut, None), frame=1)]
    (only,) = only_track(matched, 1, covered, clip)
    assert only.pairs[0][0] is full
    assert with_truth(only, covered, 1).pairs[0][0] is covered.truth[0][0]


def test_hidden_points_are_counted_on_found_objects():
    thing = replace(car(), visible=np.arange(24) < 18)
    label = found(thing)
    label.points[18:21, 2] = 0.1
    share, count = hidden_below([frame_of((thing, label)), frame_of((thing, None))])
    assert (share, count) == (0.5, 6)
    assert hidden_below([])[1] == 0


def test_scored_points_know_right_from_wrong():
    thing, small = car(), car(2, box=(10, 10, 30, 30))
    diagonal = float(np.hypot(100, 80))
    label = found(thing, score=0.9)
    label.points[:6, 0] += 0.11 * diagonal
    label.points[23, 2] = 0.0
    rows = scored_points(
        [frame_of((thing, label), (small, found(small)), (thing, None), phantoms=(found(car(), score=0.6),))]
    )
    assert len(rows) == 23 + 24, "absent points and objects that are not judged do not count"
    assert rows[:23, 1].sum() == 17 and not rows[23:, 1].any() and not rows[:, 2].any()
    # A point that is hidden is right where the car's own point lies.
    hidden = replace(thing, visible=np.zeros(24, bool))
    assert scored_points([frame_of((hidden, found(thing)))])[:, 1:].all()
    assert scored_points([]).shape == (0, 3)


def test_bins_hold_their_scores():
    points = np.array([[0.0, 1], [0.05, 0], [0.85, 1], [0.9, 1], [0.94, 0], [1.0, 1], [0.95, 1]])
    curve = reliability_curve("made", points)
    assert [(one.points, one.right) for one in curve.bins] == [(2, 1), *[(0, 0)] * 7, (1, 1), (4, 3)]
    assert curve.bins[9].share == 0.75 and np.isnan(curve.bins[3].share)
    assert sum(one.points for one in curve.bins) == len(points)
    assert share_right(points, low=0.85, high=0.95) == (pytest.approx(2 / 3), 3)
    assert share_right(points, low=0.85)[1] == 5 and share_right(points[:0], low=0.5)[1] == 0


def test_hidden_points_have_a_curve_of_their_own():
    points = np.array([[0.05, 1, 1], [0.05, 1, 1], [0.05, 0, 0], [0.95, 1, 0], [0.95, 0, 1]])
    every, seen, hidden = (reliability_curve("made", points, kind=kind) for kind in ("all", "in view", "hidden"))
    assert (hidden.bins[0].points, hidden.bins[0].share) == (2, 1.0)
    assert (seen.bins[0].points, seen.bins[0].share) == (1, 0.0)
    for both, one, other in zip(every.bins, seen.bins, hidden.bins, strict=True):
        assert (both.points, both.right) == (one.points + other.points, one.right + other.right)


def test_a_spliced_clip_has_its_cut_found():
    plain, dark = a_clip([(car(),)] * 20), a_clip([(car(2),)] * 20)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    shades = [
        np.repeat(picture[..., None], 3, axis=2).astype(np.uint8) for picture in (x * 255 // WIDTH, y * 255 // 240)
    ]
    plain, dark = (replace(one, frames=(shade,) * 20) for one, shade in zip((plain, dark), shades, strict=True))
    clip, cuts = spliced(plain, dark, at=8)
    assert cuts == {8} and len(clip) == 20
    assert clip.truth[7][0].track_id == 1 and clip.truth[8][0].track_id == 2


def test_a_frozen_clip_repeats_one_frame_and_its_truth():
    clip = a_clip([(car(number + 1),) for number in range(6)])
    still = frozen(clip, at=2, frames=3)
    assert [things[0].track_id for things in still.truth] == [1, 2, 3, 3, 3, 3, 4, 5, 6]
    assert all(still.frames[i] is clip.frames[2] for i in (2, 3, 4, 5))


def test_drift_is_in_box_diagonals():
    labels = [found(car(), frame=3), found(car(), frame=9, shift=0.05 * float(np.hypot(100, 80)))]
    labels += [found(car(), frame=3, track_id=6), found(car(), frame=9, track_id=7)]
    assert drift_shares(labels, first=3, last=9) == [pytest.approx(0.05, abs=1e-5)]


def test_switches_and_passages_of_people():
    truth = [[car(501, category="person"), car(502, box=(220, 80, 260, 160), category="person")] for _ in range(20)]
    for number in range(6, 14):
        truth[number] = truth[number][1:]
    clip = a_clip([tuple(things) for things in truth])
    assert column_passages(clip) == {501: 14, 502: None}
    labels = []
    for number, things in enumerate(truth):
        ids = {501: 1 if number < 6 else 3, 502: 2 if number < 17 else 9}
        labels += [found(thing, frame=number, track_id=ids[thing.track_id]) for thing in things]
    assert id_switches(labels, clip, 501) == [14] and id_switches(labels, clip, 502) == [17]


def test_conditions_keep_the_truth_and_change_the_pictures():
    clip = a_clip([(car(),)] * 3)
    for condition in ("dusk", "h264"):
        harmed = in_condition(clip, condition, seed=1)
        assert harmed.truth == clip.truth and len(harmed) == 3
        assert not np.array_equal(harmed.frames[0], clip.frames[0])


def test_curves_are_written_beside_the_table(tmp_path):
    curve = reliability_curve("made", np.array([[0.9, 1.0], [0.2, 0.0]]))
    table = replace(make_table("keypoints", "made", [judged("x", 1.0, unit="%", at_most=2)]), curves=(curve, curve))
    settings = dict(matplotlib.rcParams)
    write_stability(table, tmp_path)
    assert dict(matplotlib.rcParams) == settings
    assert read_stability(tmp_path / "stability-keypoints.json") == table
    values = json.loads((tmp_path / "stability-keypoints.json").read_text())
    assert values["curves"][0]["bins"][9] == {"low": 0.9, "high": 1.0, "points": 1, "right": 1}
    picture = cv2.imread(str(tmp_path / "reliability-keypoints.png"))
    assert picture is not None and picture.shape[1] > 800
    write_stability(make_table("ego", "made", []), tmp_path)
    assert "curves" not in json.loads((tmp_path / "stability-ego.json").read_text())


def test_the_table_plays_two_conditions_quickly(tmp_path):
    table = run_stability("keypoints", out=tmp_path, quick=True)
    scenarios = {row.scenario for row in table.rows}
    assert {"undisturbed", "dusk, gain 0.4", "night, gain 0.15"} <= scenarios
    assert all(row.figure is not None and np.isfinite(row.figure) for row in table.rows)
    assert [(curve.name, curve.kind) for curve in table.curves] == [
        (name, kind) for name in ("undisturbed", "in every condition") for kind in ("in view", "hidden")
    ]
