"""Track ids on made-up motion whose right answer is known."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from labeling.backward_tracking import reach_back
from labeling.box_tracker import BoxTracker, TrackerSettings
from labeling.boxes import iou
from labeling.labels import POINT_INTERPOLATED, UNTRACKED, Keypoints
from labeling.lane_tracker import LaneTracker, line_distance
from labeling.tracking import RunTracker, TrackedLook, believed_tracks, drop_brief_tracks, trim_doubt


def box(x: float, y: float = 300, *, width: float = 40, height: float = 100) -> np.ndarray:
    return np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])


def follow(paths: Sequence[Sequence[np.ndarray | None]], *, scores: list[float] | None = None) -> np.ndarray:
    """(frames, objects) ids for the paths of several objects; None where an object is not detected."""
    tracker = BoxTracker()
    table = np.full((len(paths[0]), len(paths)), UNTRACKED)
    for frame in range(len(paths[0])):
        seen = [i for i, path in enumerate(paths) if path[frame] is not None]
        boxes = np.array([paths[i][frame] for i in seen]).reshape(-1, 4)
        marks = np.array([(scores or [0.9] * len(paths))[i] for i in seen])
        table[frame, seen] = tracker.update(boxes, marks)
    return table


def test_steady_motion_keeps_its_id() -> None:
    ids = follow([[box(50 + 6 * t) for t in range(60)], [box(900 - 3 * t) for t in range(60)]])
    assert len(set(ids[:, 0])) == len(set(ids[:, 1])) == 1 and ids[0, 0] != ids[0, 1]


def test_one_second_occlusion_keeps_its_id() -> None:
    path = [box(100 + 4 * t) if not 30 <= t < 54 else None for t in range(90)]
    ids = follow([path])
    assert set(ids[:30, 0]) == set(ids[54:, 0]) and len(set(ids[:30, 0])) == 1


def test_long_absence_is_a_new_object() -> None:
    path = [box(100) if not 30 <= t < 100 else None for t in range(120)]
    ids = follow([path])
    assert ids[0, 0] != ids[-1, 0]


def test_crossing_people_do_not_swap() -> None:
    """Two people walk towards each other; while they overlap only the nearer one is detected."""
    left = [box(300 + 5 * t) for t in range(80)]
    right: list[np.ndarray | None] = [box(700 - 5 * t) for t in range(80)]
    for t in range(80):
        if abs((300 + 5 * t) - (700 - 5 * t)) < 30:
            right[t] = None
    ids = follow([left, right])
    assert len(set(ids[:, 0])) == 1
    assert set(ids[:30, 1]) == set(ids[60:, 1])
    assert ids[0, 0] != ids[0, 1]


def walkers_behind_a_column(frame: int, *, phase: float, gap_px: float, speed: float) -> list[np.ndarray | None]:
    """What shows of two people who pass each other behind a column from x = 205 to 380; their legs open and close."""
    shown: list[np.ndarray | None] = []
    for number, (start, step) in enumerate(((60, speed), (520 + gap_px, -speed))):
        middle = start + step * frame
        width = 70 + 22 * np.cos(2 * np.pi * (frame + phase + 9 * number) / 11)
        left, right = middle - width / 2, middle + width / 2
        if left < 205:
            right = min(right, 205)
        elif right > 380:
            left = max(left, 380)
        hidden = left >= 205 and right <= 380
        shown.append(None if hidden or right - left < 20 else np.array([left, 300, right, 460]))
    return shown


def test_people_who_pass_behind_a_column_come_out_as_themselves() -> None:
    """Each stops being seen at one edge and comes out at the other, where the other one just went in."""
    switched, passages = 0, 0
    for phase, gap_px, speed in product(range(0, 11, 2), (-60, -20, 0, 20, 60), (4.5, 5.2, 6.0)):
        rng = np.random.default_rng(int(phase + gap_px + 100))
        frames = [walkers_behind_a_column(t, phase=phase, gap_px=gap_px, speed=speed) for t in range(85)]
        paths = [
            [None if box is None else box + rng.normal(0, 2.5, 4) for box in path] for path in zip(*frames, strict=True)
        ]
        for column in follow(paths).T:
            found = column[column != UNTRACKED]
            switched += len(set(found.tolist())) > 1
            passages += 1
    assert switched <= 0.15 * passages, f"{switched} of {passages}"


def test_who_comes_out_is_the_one_who_went_that_way() -> None:
    """Two hidden people: one is expected 20 px from where somebody comes out, but walks away from there."""
    away: list[np.ndarray | None] = [box(500 - 5 * t) if t < 30 else None for t in range(41)]
    towards: list[np.ndarray | None] = [box(90 + 5 * t) if t < 30 or t == 40 else None for t in range(41)]
    towards[40] = box(320)
    ids = follow([away, towards])
    assert ids[40, 1] == ids[0, 1] != ids[0, 0]


def test_small_fast_objects_are_kept() -> None:
    ids = follow([[box(100 + 11 * t, width=12, height=10) for t in range(40)]])
    assert len(set(ids[2:, 0])) == 1


def test_unsure_boxes_continue_a_track_but_start_none() -> None:
    assert (follow([[box(100 + t) for t in range(5)]], scores=[0.3]) == UNTRACKED).all()
    tracker = BoxTracker()
    first = tracker.update(box(100)[None], np.array([0.9]))
    second = tracker.update(box(101)[None], np.array([0.3]))
    assert first == second


def test_each_category_may_begin_at_a_score_of_its_own() -> None:
    for sure, begun in ((0.95, 0), (0.85, 1)):
        tracker = RunTracker(start_scores={"car": sure})
        (named,) = tracker.update([car(0, 100)], frame=0)
        assert (named.track_id != UNTRACKED) is bool(begun)


def test_growth_is_not_believed_while_nothing_confirms_it() -> None:
    """A car comes nearer by 3 % a frame, stops where something hides it for a second, and is found where it stopped."""
    sizes = [30 * 1.03 ** min(t, 30) for t in range(70)]
    path = [box(300, width=size, height=size) if not 30 <= t < 54 else None for t, size in enumerate(sizes)]
    ids = follow([path])[:, 0]
    assert set(ids[54:]) == set(ids[:30]) == {0}


@pytest.mark.parametrize(("times", "same"), [(1.7, True), (2.1, False)], ids=["a little", "a lot"])
def test_what_is_suddenly_much_larger_is_another_object(times: float, same: bool) -> None:
    for first, second in ((1.0, times), (times, 1.0)):
        tracker = BoxTracker()
        before, after = (
            tracker.update(box(300, width=40, height=100 * size)[None], np.ones(1))[0] for size in (first, second)
        )
        assert bool(before == after) is same


def test_frame_steps_scale_the_prediction() -> None:
    every, fourth = BoxTracker(), BoxTracker()
    dense = [every.update(box(50 + 5 * t)[None], np.ones(1))[0] for t in range(40)]
    sparse = [fourth.update(box(50 + 5 * t)[None], np.ones(1), frame_step=4)[0] for t in range(0, 40, 4)]
    assert len(set(dense)) == 1 and len(set(sparse)) == 1


def test_known_camera_turn_saves_the_match() -> None:
    """A turn that moves everything by 90 px at once: lost without it, held with it."""
    shift = np.array([[1.0, 0, 90], [0, 1, 0], [0, 0, 1]])
    for turn, same in ((None, False), (shift, True)):
        tracker = BoxTracker()
        before = [tracker.update(box(300, width=30)[None], np.ones(1))[0] for _ in range(3)][-1]
        after = tracker.update(box(390, width=30)[None], np.ones(1), previous_to_current=turn)[0]
        assert bool(before == after) is same


@pytest.mark.parametrize("turn_px", [-10, 10])
def test_who_is_hidden_while_the_camera_turns_goes_on_as_before(turn_px: int) -> None:
    """A walker of 4 px a frame is hidden for half a second of a steady turn: the turn is not part of its own motion."""
    tracker, shift = BoxTracker(), np.array([[1.0, 0, turn_px], [0, 1, 0], [0, 0, 1]])
    ids: list[int] = []
    for t in range(36):
        boxes = np.empty((0, 4)) if 20 <= t < 32 else box(500 + (4 + turn_px) * t)[None]
        ids += tracker.update(boxes, np.full(len(boxes), 0.9), previous_to_current=shift).tolist()
    assert len(ids) == 24 and set(ids) == {0}


def car(frame: int, x: float) -> Keypoints:
    return Keypoints(
        frame=frame, category="car", schema="car24", score=0.9, box_xyxy=box(x).astype(np.float32),
        points=np.zeros((24, 3), np.float32), point_source=np.zeros(24, np.int8),
    )  # fmt: skip


def test_nothing_is_carried_over_a_break() -> None:
    """Ids go on counting, so that no two objects of a run share one."""
    for cut, ids in ((None, [0] * 10), (5, [0] * 5 + [1] * 5)):
        tracker, found = RunTracker(), []
        for t in range(10):
            if t == cut:
                tracker.restart()
            found += tracker.update([car(t, 100 + t)], frame=t)
        assert [label.track_id for label in found] == ids


def looks(*frames: list[Keypoints]) -> list[TrackedLook]:
    """What an association of these looks gives, one a frame."""
    tracker = RunTracker()
    return [
        TrackedLook(frame=t, labels=tuple(tracker.update(labels, frame=t)), turn=np.eye(3))
        for t, labels in enumerate(frames)
    ]


def test_tracks_seen_once_are_not_believed() -> None:
    seen = looks(*([car(t, 100)] + ([car(t, 800)] if t == 4 else []) for t in range(10)))
    assert believed_tracks(seen, min_looks=2) == {0}
    assert believed_tracks(seen, min_looks=1) == {0, 1}


def test_a_track_that_was_never_sure_twice_in_a_row_is_not_believed() -> None:
    """Nor one that is sure now and then, but never twice in a row."""
    for sure, believed in (((0,), set()), ((0, 5, 7, 9), set()), ((4, 5), {0})):
        seen = looks(*([replace(car(t, 100), score=0.9 if t in sure else 0.4)] for t in range(10)))
        assert believed_tracks(seen, min_looks=2, sure_looks=2, sure_scores={"car": 0.5}) == believed
        assert believed_tracks(seen, min_looks=2) == {0}


@pytest.mark.parametrize(("at", "believed"), [((4, 6, 8), set()), ((4, 5), {0})], ids=["with gaps", "in a row"])
def test_sure_looks_are_in_a_row_only_where_none_missed_it(at: tuple[int, ...], believed: set[int]) -> None:
    seen = looks(*([car(t, 100)] if t in at else [] for t in range(10)))
    assert {label.track_id for look in seen for label in look.labels} == {0}
    assert believed_tracks(seen, min_looks=2, sure_looks=2, sure_scores={"car": 0.5}) == believed


def test_a_track_is_shown_from_its_first_plain_frame_to_its_last() -> None:
    """What is doubtful before and after goes; in between it stays, and so does what has no doubt."""
    plain = {3, 4, 9}
    track = [replace(car(t, 100), track_id=0, score=0.8 if t in plain else 0.5) for t in range(12)]
    doubtful = [replace(label, track_id=1, score=0.79) for label in track]
    lane = [replace(label, track_id=2, category="lane", schema="lane24") for label in track]
    shown = trim_doubt([*track, *doubtful, *lane], least_scores={"car": 0.8})
    assert shown == [*track[3:10], *lane]
    assert trim_doubt(track, least_scores={}) == track


def test_brief_tracks_are_dropped_but_where_a_run_begins_or_ends() -> None:
    long, brief = ([replace(car(t, 100), track_id=n) for t in range(*span)] for n, span in enumerate(((0, 9), (3, 7))))
    clocks = range(9)
    assert drop_brief_tracks([*long, *brief], clocks, min_frames=5) == long
    assert drop_brief_tracks([*long, *brief], clocks, min_frames=4) == [*long, *brief]
    assert drop_brief_tracks([*long, *brief], clocks, min_frames=5, open_at=(6, 20)) == [*long, *brief]


def test_how_long_a_track_lasts_goes_by_the_clock() -> None:
    """Four moments of two frames of the grid each last eight; of three that a camera froze in between, no longer."""
    track = [replace(car(t, 100), track_id=0) for t in range(3, 7)]
    assert drop_brief_tracks(track, range(0, 18, 2), pace=2, min_frames=8) == track
    assert drop_brief_tracks(track, range(0, 18, 2), pace=2, min_frames=9) == []


def test_a_sure_track_reaches_back_to_what_was_unsure() -> None:
    """Seen from frame 0, believed from frame 6: the detector was unsure of it until then, and once saw nothing."""
    seen = looks(*([] if t == 3 else [replace(car(t, 100 + 6 * t), score=0.9 if t >= 6 else 0.3)] for t in range(12)))
    assert [len([one for one in look.labels if one.track_id != UNTRACKED]) for look in seen] == [0] * 6 + [1] * 6
    found = reach_back(seen, {0})
    assert sorted(label.frame for label in found) == [0, 1, 2, 4, 5]
    assert {label.track_id for label in found} == {0} and {label.score for label in found} == {0.3}
    assert reach_back(seen, set()) == []


def test_what_is_reached_back_to_is_shown_between_looks() -> None:
    """Looks every 6 frames; the third missed it, so that nothing is shown around that."""
    every, sure = 6, 4
    frames = [[] if n == 2 else [replace(car(n * every, 100), score=0.9 if n >= sure else 0.3)] for n in range(7)]
    tracker = RunTracker()
    seen = [
        TrackedLook(frame=n * every, labels=tuple(tracker.update(labels, frame=n * every)), turn=np.eye(3))
        for n, labels in enumerate(frames)
    ]
    found = reach_back(seen, {0})
    assert sorted(label.frame for label in found) == [*range(7), *range(18, 24)]
    between = [label for label in found if label.frame % every]
    assert all((label.point_source[label.present] == POINT_INTERPOLATED).all() for label in between)


def test_no_track_reaches_back_to_what_is_elsewhere_or_long_ago() -> None:
    far = looks(*([replace(car(t, 100 if t >= 6 else 600), score=0.9 if t >= 6 else 0.3)] for t in range(12)))
    assert reach_back(far, {0}) == []
    unseen = looks(*([] if 2 < t < 30 else [replace(car(t, 100), score=0.9 if t >= 30 else 0.3)] for t in range(40)))
    assert reach_back(unseen, {0}) == []


def test_a_track_that_is_seen_takes_no_second_label() -> None:
    """A double beside the object in every frame stays without a track, and a neighbour's name is not taken."""
    frames = [[car(t, 100 + t), replace(car(t, 112 + t), score=0.3), car(t, 500)] for t in range(12)]
    assert reach_back(looks(*frames), {0, 1}) == []


def given(*frames: list[tuple[float, int]]) -> list[TrackedLook]:
    """Looks at cars at (x, id)."""
    return [
        TrackedLook(frame=t, labels=tuple(replace(car(t, x), track_id=i) for x, i in seen), turn=np.eye(3))
        for t, seen in enumerate(frames)
    ]


def test_a_name_is_given_once_in_a_look() -> None:
    """A track that went from 600 to 100 px: what is free at 100 px while the track itself is at 600 is somebody else,
    and before that only what is where the track came from can be it."""
    later, earlier, first = [(100.0, 0)], [(100.0, UNTRACKED), (600.0, 0)], [(100.0, UNTRACKED), (600.0, UNTRACKED)]
    found = reach_back(given(*[first] * 3, *[earlier] * 3, *[later] * 6), {0})
    assert sorted(label.frame for label in found) == [0, 1, 2]
    assert all(label.box_xyxy[0] > 500 for label in found)


def test_reaching_back_follows_a_camera_that_turns() -> None:
    """90 px a frame: more than the object is wide."""
    shift = np.array([[1.0, 0, 90], [0, 1, 0], [0, 0, 1]])
    labels = [replace(car(t, 100 + 90 * t), score=0.9 if t >= 2 else 0.3) for t in range(6)]
    tracker = RunTracker()
    seen = [
        TrackedLook(
            frame=t, labels=tuple(tracker.update([label], frame=t, previous_to_current=shift)),
            turn=shift,
        )
        for t, label in enumerate(labels)
    ]  # fmt: skip
    assert sorted(label.frame for label in reach_back(seen, {0})) == [0, 1]
    still = [replace(look, turn=np.eye(3)) for look in seen]
    assert reach_back(still, {0}) == []


def lane(offset: float) -> np.ndarray:
    rows = np.linspace(700, 400, 24)
    return np.stack([528 + (offset + rows - 400) * 0.8, rows, np.ones(24)], axis=1)


def test_lanes_keep_their_ids_while_they_drift() -> None:
    tracker = LaneTracker()
    ids = [tracker.update([lane(-150 + 2 * t), lane(150 + 2 * t)]).tolist() for t in range(20)]
    assert ids == [[0, 1]] * 20


def test_line_distance_is_the_horizontal_gap() -> None:
    assert line_distance(lane(0), lane(50)) == pytest.approx(40)
    assert line_distance(lane(0), np.zeros((24, 3))) == float("inf")


def test_iou_by_hand() -> None:
    boxes = np.array([[0, 0, 2, 2.0], [1, 1, 3, 3.0]])
    assert iou(boxes, boxes) == pytest.approx(np.array([[1, 1 / 7], [1 / 7, 1]]))


def test_a_row_of_parked_cars_does_not_move_up_by_one() -> None:
    """One of a row is missed while another comes into view: everyone else keeps their place."""
    tracker = BoxTracker()
    row = [np.array([x, 300, x + 80, 360.0]) for x in range(100, 600, 50)]
    ids = [tracker.update(np.array(row[:-1]), np.ones(9)).tolist() for _ in range(5)][-1]
    later = tracker.update(np.array(row[1:]), np.ones(9)).tolist()
    assert later[:-1] == ids[1:] and later[-1] not in ids


def test_a_track_is_where_flow_took_it() -> None:
    """A jump of three widths keeps its id when flow has followed it, and is a new object when nothing did."""
    for carried, same in ((None, False), ({0: box(390, width=30)}, True)):
        tracker = BoxTracker()
        before = tracker.update(box(300, width=30)[None], np.ones(1))[0]
        after = tracker.update(box(390, width=30)[None], np.ones(1), frame_step=4, carried=carried)[0]
        assert bool(before == after) is same


def test_flow_alone_keeps_no_track_alive() -> None:
    tracker = BoxTracker()
    tracker.update(box(300)[None], np.ones(1))
    for _ in range(5):
        tracker.update(np.zeros((0, 4)), np.zeros(0), frame_step=8, carried={0: box(300)})
    assert not tracker.following


def test_an_idle_tracker_follows_nothing() -> None:
    tracker = RunTracker()
    assert tracker.idle
    tracker.update([car(0, 100)], frame=0)
    assert not tracker.idle
    tracker.restart()
    assert tracker.idle


def test_lines_are_compared_where_the_turn_took_them() -> None:
    shift = np.array([[1.0, 0, 300], [0, 1, 0], [0, 0, 1]])
    turned = [line + np.array([300, 0, 0]) for line in (lane(-150), lane(150))]
    tracker = LaneTracker()
    assert tracker.update([lane(-150), lane(150)]).tolist() == [0, 1]
    assert tracker.update(turned, previous_to_current=shift).tolist() == [0, 1]


def test_who_comes_out_where_another_went_in_is_not_the_same() -> None:
    """Two people pass each other behind a column: slivers of one, then of the other, show at the same edge of it."""
    left, right = 202.0, 378.0

    def shown(middle: float, height: float) -> tuple[np.ndarray, float] | None:
        start, end = middle - 35, middle + 35
        if start < left < end:
            end = left
        elif start < right < end:
            start = right
        elif start >= left and end <= right:
            return None
        share = (end - start) / 70
        return (np.array([start, 500 - height, end, 500]), 0.9 if share > 0.45 else 0.35) if share > 0.15 else None

    tracker = BoxTracker(TrackerSettings(high_score=0.48))
    ids: dict[str, list[int]] = {"leftward": [], "rightward": []}
    for frame in range(75):
        seen = {
            name: found
            for name, found in (
                ("leftward", shown(600 - 6 * frame, 150)), ("rightward", shown(142 + 5.5 * frame, 170)),
            )
            if found is not None
        }  # fmt: skip
        boxes = np.array([box for box, _ in seen.values()]).reshape(-1, 4)
        found = tracker.update(boxes, np.array([score for _, score in seen.values()]))
        for name, track_id in zip(seen, found, strict=True):
            ids[name].append(int(track_id))
    assert set(ids["leftward"]) - {-1} == {0} and set(ids["rightward"]) - {-1} == {1}
    assert min(len(found) for found in ids.values()) > 40
