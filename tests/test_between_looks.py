"""What is shown between two looks: carried on, carried back, cut at the border, and never for long."""

from dataclasses import replace

import numpy as np
import pytest
from moving_card import MovingCard

from labeling.between_looks import BetweenLooks, cut_at_border
from labeling.carrying import COARSE, FINE, Carried, FlowWindow, carry, small_grey
from labeling.efforts import Effort
from labeling.errors import DataError
from labeling.extraction import label_with
from labeling.labels import Keypoints

SCENE = MovingCard(speed=1.5)


def grey(frame: int) -> np.ndarray:
    return small_grey(SCENE.render(frame))


def seen(frame: int, *, track_id: int = 0) -> Keypoints:
    return replace(SCENE.label(frame), track_id=track_id)


def carried_to(end: int, *, first: list[Keypoints], shown: int = 4) -> BetweenLooks:
    """A look at frame 0 whose objects flow has taken to ``end``, two frames a step."""
    between = BetweenLooks(flow_step=2, shown_frames=shown, clocks=range(end + 1))
    between.start(first, frame=0, grey=grey(0))
    for frame in range(2, end + 1, 2):
        assert between.due(frame) and not between.due(frame - 1)
        assert between.carry(grey(frame), frame=frame)
    return between


def test_an_object_seen_twice_is_shown_in_every_frame_between() -> None:
    labels, miss = carried_to(6, first=[seen(0)]).close([seen(6)], frame=6)
    assert [label.frame for label in labels] == [1, 2, 3, 4, 5] and miss < 0.01
    for label in labels:
        assert np.abs(label.points[:, :2] - SCENE.truth(label.frame)).max() < 0.5


def test_a_lost_object_is_carried_on_for_a_while() -> None:
    labels, _ = carried_to(8, first=[seen(0)]).close([], frame=8)
    assert [label.frame for label in labels] == [1, 2, 3, 4]


@pytest.mark.parametrize("pace", [1, 2])
def test_how_long_it_is_carried_goes_by_the_clock(pace: int) -> None:
    """Pictures that are each shown for two frames of the grid make half as many."""
    between = carried_to(8, first=[seen(0)])
    between.clocks = range(0, 9 * pace, pace)
    labels, _ = between.close([], frame=8)
    assert [label.frame for label in labels] == [1, 2, 3, 4][: 4 // pace]


def test_what_flow_lost_is_not_shown_on() -> None:
    """Something steps before an object: flow loses it, and the next look does not see it."""
    between = BetweenLooks(flow_step=2, shown_frames=4, clocks=range(7))
    between.start([seen(0)], frame=0, grey=grey(0))
    assert between.carry(grey(2), frame=2)
    assert not between.carry(np.random.default_rng(0).integers(0, 256, grey(4).shape, np.uint8), frame=4)
    labels, _ = between.close([], frame=6)
    assert [label.frame for label in labels] == [1, 2]


def test_a_new_object_is_carried_back_for_a_while() -> None:
    """Another object was there all the time, so that flow has a way; the new one is followed back along it."""
    labels, _ = carried_to(8, first=[seen(0)]).close([seen(8), seen(8, track_id=1)], frame=8)
    new = [label for label in labels if label.track_id == 1]
    assert [label.frame for label in new] == [4, 5, 6, 7]
    for label in new:
        assert np.abs(label.points[:, :2] - SCENE.truth(label.frame)).max() < 1.0


def test_the_tracker_is_told_where_flow_went() -> None:
    between = carried_to(6, first=[seen(0)])
    boxes = between.carried(6)
    assert set(boxes) == {0} and np.abs(boxes[0] - SCENE.label(6).box_xyxy).max() < 1.0
    assert between.carried(7) == {}


def test_boxes_end_at_the_border_and_what_left_is_not_shown() -> None:
    outside = replace(seen(0), box_xyxy=np.array([-60.0, 70, 20, 142], np.float32))
    partly = replace(seen(0, track_id=1), box_xyxy=np.array([-20.0, 70, 60, 142], np.float32))
    labels, _ = carried_to(2, first=[outside, partly]).close([], frame=2)
    assert {label.track_id for label in labels} == {1}
    assert all(label.box_xyxy[0] >= 0 for label in labels)


def test_boxes_are_cut_at_the_picture() -> None:
    boxes = np.array([[-4, -3, 50, 60], [300, 200, 330, 230], [10, 10, 20, 20], [321, 0, 400, 9]], np.float32)
    labels = [replace(seen(0, track_id=n), box_xyxy=box) for n, box in enumerate(boxes)]
    cut = cut_at_border(labels, width=320, height=224)
    assert [label.box_xyxy.tolist() for label in cut] == [[0, 0, 50, 60], [300, 200, 320, 224], [10, 10, 20, 20]]
    assert cut[2] is labels[2] and cut_at_border([], width=320, height=224) == []
    assert [label.track_id for label in cut_at_border(labels, width=320, height=224, least_inside=0.6)] == [0, 2]


@pytest.mark.parametrize("wrong", ["a number that is none", "a point too few"])
def test_labels_made_together_are_checked_together(wrong: str) -> None:
    label = seen(0)
    boxes, points = np.stack([label.box_xyxy] * 3), np.stack([label.points] * 3)
    sources, scores = np.stack([label.point_source] * 3), np.full(3, 0.5)
    made = label.elsewhere([4, 5, 6], boxes_xyxy=boxes, points=points, point_source=sources, scores=scores)
    assert [(one.frame, one.track_id, one.score) for one in made] == [(n, label.track_id, 0.5) for n in (4, 5, 6)]
    if wrong == "a point too few":
        points = points[:, :-1]
    else:
        points[1, 3, 0] = np.nan
    with pytest.raises(DataError):
        label.elsewhere([4, 5, 6], boxes_xyxy=boxes, points=points, point_source=sources, scores=scores)


def test_flow_compares_what_the_effort_says(monkeypatch: pytest.MonkeyPatch) -> None:
    windows: list[FlowWindow] = []

    def noted(*pictures: np.ndarray, window: FlowWindow, **rest: int) -> list[Carried]:
        windows.append(window)
        return carry(*pictures, window=window, **rest)  # type: ignore[arg-type]

    monkeypatch.setattr("labeling.between_looks.carry", noted)
    wanted: dict[Effort, FlowWindow] = {"balanced": FINE, "fast": COARSE}
    for effort, window in wanted.items():
        windows.clear()
        label_with([SCENE], [SCENE.render(n) for n in range(16)], first_frame=0, effort=effort)
        assert windows and set(windows) == {window}
