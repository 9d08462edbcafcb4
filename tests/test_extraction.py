"""How often the networks look, and what is carried in between: on moving textures whose points are known."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from moving_card import HEIGHT, WIDTH, MovingCard, texture

from labeling.between_looks import cut_at_border
from labeling.carrying import carry, close_gaps, interpolate_gaps, small_grey
from labeling.efforts import EFFORTS, Effort, straight_gap
from labeling.errors import ConfigError, ModelError
from labeling.extraction import label_with, without_doubles
from labeling.extractors import choose_extractors
from labeling.fields import FieldModel
from labeling.labels import POINT_CARRIED, POINT_DETECTED, POINT_INTERPOLATED, Keypoints
from labeling.observation import FieldLook
from labeling.smoothing import SmoothingSettings


@pytest.mark.parametrize(("effort", "least_saving"), [("exact", 1), ("balanced", 4), ("fast", 6)])
def test_efforts_look_less_and_stay_near(effort: Effort, least_saving: int) -> None:
    scene = MovingCard(speed=1.7, growth=0.002)
    labels = label_with([scene], (scene.render(t) for t in range(73)), first_frame=0, effort=EFFORTS[effort])
    assert [label.frame for label in labels] == list(range(73))
    assert len(scene.seen) <= 73 / least_saving + 3
    errors = [np.linalg.norm(label.points[:, :2] - scene.truth(label.frame), axis=1).max() for label in labels]
    assert max(errors) < 2.0 and np.median(errors) < 1.0
    assert {label.track_id for label in labels} == {0}


def test_sources_say_what_was_seen_and_what_carried() -> None:
    scene = MovingCard()
    labels = label_with([scene], (scene.render(t) for t in range(40)), first_frame=0, effort="balanced")
    for label in labels:
        seen = label.frame in scene.seen
        expected = (POINT_DETECTED,) if seen else (POINT_CARRIED, POINT_INTERPOLATED)
        assert np.isin(label.point_source, expected).mean() > 0.9, label.frame
    carried = [label.frame for label in labels if (label.point_source == POINT_CARRIED).all()]
    # Flow takes every second frame; what lies between its steps is interpolated.
    assert len(carried) >= (40 - len(scene.seen)) / 2 - len(scene.seen) / 2


def test_nothing_is_shown_long_after_it_was_seen() -> None:
    """A point that only the first look knows, half a second before the next: gone after a quarter of a second."""
    scene = MovingCard(speed=1.0)
    path = [scene.label(frame) for frame in range(0, 13, 3)]
    end = scene.label(12)
    end.points[:12], end.point_source[:12] = 0, 0
    labels = close_gaps([path], [end])
    assert [label.frame for label in labels] == list(range(1, 12))
    assert [bool(label.points[0, 2] > 0) for label in labels] == [True] * 6 + [False] * 5
    assert all(label.points[23, 2] > 0 for label in labels)


@pytest.mark.parametrize(("effort", "after"), [("fast", 6), ("balanced", 2), ("exact", 0)])
@pytest.mark.parametrize("every", [1, 2])
def test_a_run_ends_with_a_look_or_just_after_one(effort: Effort, after: int, every: int) -> None:
    """What the last look saw is carried to the end where that is no further than it may be shown without another."""
    ends = set()
    for length in range(24, 38):
        scene = MovingCard(speed=1.7)
        frames = (scene.render(t - t % every) for t in range(length))
        labels = label_with([scene], frames, first_frame=0, effort=effort)
        assert [label.frame for label in labels] == list(range(length))
        last = (length - 1) // every * every
        ends.add(last - scene.seen[-1])
        errors = np.linalg.norm(labels[-1].points[:, :2] - scene.truth(last), axis=1)
        assert errors.max() < 2.0
    assert max(ends) <= after and (every == 2 or max(ends) == after)


@pytest.mark.parametrize("first", [0, 24])
def test_who_has_just_come_is_looked_at_again_at_the_end(first: int) -> None:
    """A run of few frames, or of few frames after somebody came: one look alone is not believed."""
    for frames in range(2, 8):
        scene = MovingCard(speed=1.0, shown=range(first, 99))
        labels = label_with([scene], (scene.render(t) for t in range(first + frames)), first_frame=0, effort="fast")
        looks = [number for number in scene.seen if number >= first]
        if looks and looks[0] < first + frames - 1:
            assert len(looks) >= 2 and labels[-1].frame == first + frames - 1


def test_what_flow_cannot_take_to_the_end_is_looked_at() -> None:
    ends = {}
    for gone in (25, 26):
        scene = MovingCard(speed=1.7, shown=range(gone))
        label_with([scene], (scene.render(t) for t in range(26)), first_frame=0, effort="fast")
        ends[gone] = scene.seen[-1]
    assert ends == {25: 25, 26: 20}


@pytest.mark.parametrize(("effort", "sure", "shown"), [("fast", 0.91, 40), ("exact", 0.91, 0), ("fast", 1.6, 0)])
def test_who_looks_rarely_believes_sooner(effort: Effort, sure: float, shown: int) -> None:
    """The scene's card scores 0.9, which is 0.6 of 1.5."""
    scene = MovingCard()
    scene.sure_scores = {"car": sure}
    labels = label_with([scene], (scene.render(t) for t in range(40)), first_frame=0, effort=effort)
    assert len(labels) == shown


class Scored(MovingCard):
    """A card that scores otherwise in every look; sure from 0.8 on."""

    sure_scores: Mapping[str, float] = {"car": 0.8}

    def __init__(self, scores: Sequence[float], *, decided: bool) -> None:
        super().__init__()
        self.scores = scores
        self.decided: Collection[str] = ("car",) if decided else ("person",)

    def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
        return [replace(label, score=self.scores[number]) for label in super().see(frame, number)]


_COMES = (*[0.5] * 6, 0.65, *[0.9] * 8, 0.5, *[0.9] * 7, 0.65, *[0.5] * 6)


@pytest.mark.parametrize(
    ("scores", "decided", "shown"),
    [
        (_COMES, True, range(6, 24)),
        # Its first sure look is that of frame 7, and it reaches back.
        (_COMES, False, range(30)),
        ((0.5, 0.75, *[0.9] * 5, *[0.75] * 3, *[0.6] * 20), True, range(1, 10)),
        ([0.75] * 30, True, range(0)),
        ([0.9, 0.75] * 15, True, range(0)),
    ],
)
def test_decided_scores_show_what_is_plain(scores: Sequence[float], decided: bool, shown: range) -> None:
    scene = Scored(scores, decided=decided)
    labels = label_with([scene], (scene.render(t) for t in range(len(scores))), first_frame=0, effort="exact")
    assert [label.frame for label in labels] == list(shown)


@pytest.mark.parametrize(("score", "followed"), [(0.73, True), (0.71, False)])
def test_what_is_nearly_sure_is_followed_though_not_believed(score: float, followed: bool) -> None:
    """Nine tenths of sure begin a track, which brings looks closer together."""
    scene = Scored([score] * 48, decided=False)
    assert label_with([scene], (scene.render(t) for t in range(48)), first_frame=0, effort="balanced") == []
    assert (len(scene.seen) > 48 / 12 + 2) is followed


class Doubled(MovingCard):
    """A card with another beside it, at first sure and apart, then doubtful and half behind it."""

    sure_scores: Mapping[str, float] = {"car": 0.8}

    def __init__(self, decided: Collection[str]) -> None:
        super().__init__(speed=0.5)
        self.decided = decided

    def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
        (first,) = super().see(frame, number)
        shift, score = (60, 0.9) if number < 6 else (34, 0.7)
        return [
            first,
            replace(first, score=score, box_xyxy=first.box_xyxy + np.array([shift, 0, shift, 0], np.float32)),
        ]


@pytest.mark.parametrize(("decided", "late"), [(("car",), 1), (("person",), 2)])
def test_what_turns_doubtful_behind_another_is_not_shown(decided: Collection[str], late: int) -> None:
    scene = Doubled(decided)
    labels = label_with([scene], (scene.render(t) for t in range(24)), first_frame=0, effort="exact")
    assert sum(label.frame == 2 for label in labels) == 2
    assert sum(label.frame == 15 for label in labels) == late


def test_lines_have_no_doubt_and_bottom_up_cars_do() -> None:
    look = FieldLook(cast(FieldModel, None), ["car", "lane"])
    assert set(look.sure_scores) == {"car"} and not look.decided


class ShownInOrder(MovingCard):
    """A card whose frames are shown in some order; it is told the number of the frame that it sees."""

    def __init__(self, order: Sequence[int], *, first: int, speed: float) -> None:
        super().__init__(speed=speed)
        self.order, self.first = order, first

    def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
        return super().see(frame, self.order[number - self.first])


@pytest.mark.parametrize("effort", ["exact", "balanced", "fast"])
def test_a_picture_shown_again_is_the_same_moment(effort: Effort) -> None:
    """A second that stands still in the midst of a drive: nothing drifts, nothing is looked at, ids go on."""
    order = [*range(20), *[19] * 24, *range(20, 40)]
    plain, frozen = (ShownInOrder(shown, first=5, speed=1.7) for shown in (range(40), order))
    labels = label_with([plain], (plain.render(t) for t in range(40)), first_frame=5, effort=effort)
    held = label_with([frozen], (frozen.render(t) for t in order), first_frame=5, effort=effort)
    assert frozen.seen == plain.seen
    assert [label.frame for label in held] == list(range(5, 5 + len(order)))
    for label, moment in zip(held, order, strict=True):
        np.testing.assert_array_equal(label.points, labels[moment].points)
        np.testing.assert_array_equal(label.point_source, labels[moment].point_source)


@pytest.mark.parametrize("effort", ["exact", "balanced", "fast"])
def test_a_picture_known_to_be_shown_again_is_the_same_moment_however_it_was_coded(effort: Effort) -> None:
    """At 12 fps, each picture coded twice: to the eye, and to any threshold, the second is another picture."""
    rng, scene = np.random.default_rng(0), MovingCard(speed=3.0)
    frames = [
        np.clip(scene.render(t - t % 2).astype(int) + rng.integers(-9, 10, (HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8)
        for t in range(48)
    ]
    labels = label_with([scene], frames, first_frame=0, effort=effort, repeats=frozenset(range(1, 48, 2)))
    assert [label.frame for label in labels] == list(range(48))
    assert all(number % 2 == 0 for number in scene.seen)
    for label, again in zip(labels[::2], labels[1::2], strict=True):
        np.testing.assert_array_equal(label.points, again.points)


@pytest.mark.parametrize("effort", ["exact", "balanced", "fast"])
@pytest.mark.parametrize("score", [0.9, 0.2], ids=["sure", "unsure"])
def test_a_shot_that_is_one_still_picture_is_labelled(effort: Effort, score: float) -> None:
    class Still(MovingCard):
        def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
            return [replace(label, score=score) for label in super().see(frame, number)]

    scene = Still(speed=0)
    labels = label_with([scene], (scene.render(0) for _ in range(40)), first_frame=0, effort=effort)
    assert scene.seen == [0]
    assert [label.frame for label in labels] == (list(range(40)) if score > 0.5 else [])


@pytest.mark.parametrize("at", [(40, 60), (40, 75), (40, 60, 80, 100)], ids=str)
def test_mistakes_now_and_then_are_no_object(at: tuple[int, ...]) -> None:
    assert shown(ComesAndGoes(at), frames=120) == []


@pytest.mark.parametrize(("effort", "unsure"), [("exact", 0.4), ("balanced", 0.4), ("fast", 0.2)])
def test_what_is_reached_back_to_does_not_flash(effort: Effort, unsure: float) -> None:
    """Unsure at first, and looked at rarely, since nothing else is there: it is shown between these looks as well."""

    class Late(MovingCard):
        def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
            return [replace(label, score=0.9 if number >= 30 else unsure) for label in super().see(frame, number)]

    scene = Late(speed=0.5)
    labels = label_with([scene], (scene.render(t) for t in range(80)), first_frame=0, effort=effort)
    assert [label.frame for label in labels] == list(range(80))
    assert max(np.abs(label.points[:, :2] - scene.truth(label.frame)).max() for label in labels) < 1.0


@pytest.mark.parametrize("every", [1, 2])
@pytest.mark.parametrize("effort", ["balanced", "fast"])
def test_boxes_alone_are_not_shown_for_long_either(effort: Effort, every: int) -> None:
    class Boxes(MovingCard):
        def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
            return [without_points(label) for label in super().see(frame, number)]

    for last in range(60, 72, every):
        scene = Boxes(speed=0.5, shown=range(last))
        frames = (scene.render(t - t % every) for t in range(120))
        labels = label_with([scene], frames, first_frame=0, effort=effort)
        seen = [number for number in scene.seen if number < last]
        assert max(label.frame for label in labels) <= seen[-1] + 6 + every - 1


def test_a_frozen_picture_makes_no_object_of_what_passes_in_a_blink() -> None:
    """Seen in two moments, the second of which stands for a second."""
    order = [*range(20), *[19] * 24, *range(20, 40)]
    scene, pictures = ShownInOrder(order, first=0, speed=1.0), MovingCard(speed=1.0)
    scene.shown = range(18, 20)
    assert label_with([scene], (pictures.render(t) for t in order), first_frame=0, effort="exact") == []


@pytest.mark.parametrize("speed", [-20.0, 20.0, 60.0])
def test_boxes_stay_in_the_picture(speed: float) -> None:
    """Whatever smoothing makes of an object that leaves it fast."""

    class Cut(MovingCard):
        def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
            return cut_at_border(super().see(frame, number), width=WIDTH, height=HEIGHT)

    scene = Cut(speed=speed)
    labels = label_with([scene], (scene.render(t) for t in range(24)), first_frame=0, effort="exact")
    assert labels
    for label in labels:
        assert (label.box_xyxy >= 0).all() and (label.box_xyxy <= [WIDTH, HEIGHT, WIDTH, HEIGHT]).all()


def test_labels_are_in_the_order_of_frames_then_of_tracks() -> None:
    """The second look's object comes first, and is therefore track 0."""
    looks = [MovingCard(shown=range(10, 99)), Lower()]
    labels = label_with(looks, (looks[1].render(t) for t in range(30)), first_frame=0, effort="exact")
    order = [(label.frame, label.track_id) for label in labels]
    assert order == sorted(order) and len(set(order)) == len(order)
    assert {label.track_id for label in labels if label.frame < 10} == {0}


def test_what_is_not_shown_covers_nothing() -> None:
    """B is A's double; C is half behind B and not behind A."""
    a = replace(MovingCard().label(3), track_id=0, score=0.95, box_xyxy=np.array([0, 0, 100, 100], np.float32))
    b = replace(a, track_id=1, score=0.9, box_xyxy=np.array([15, 0, 115, 100], np.float32))
    c = replace(a, track_id=2, score=0.5, box_xyxy=np.array([85, 0, 145, 100], np.float32))
    kept = without_doubles([a, b, c], doubts={"car": 0.8})
    assert [label.track_id for label in kept] == [0, 2]


def test_no_label_is_covered_by_a_better_one_of_its_kind() -> None:
    card = MovingCard()
    first, far = (
        replace(card.label(3), track_id=0),
        replace(card.label(3), track_id=2, box_xyxy=np.array([200.0, 70, 296, 142], np.float32)),
    )
    over = replace(first, track_id=1, score=0.5, box_xyxy=first.box_xyxy + 6)
    other = replace(over, category="person", track_id=3)
    later = replace(over, frame=4)
    # An overlap of 0.65: a detector tells such cars apart, one a third in view behind the other.
    beside = replace(over, track_id=4, box_xyxy=first.box_xyxy + np.array([17, 0, 17, 0], np.float32))
    kept = without_doubles([over, first, far, other, later, beside])
    assert [(label.frame, label.track_id) for label in kept] == [(3, 0), (3, 2), (3, 3), (3, 4), (4, 1)]


@pytest.mark.parametrize(("score", "shift", "kept"), [(0.79, 47, False), (0.79, 50, True), (0.81, 47, True)])
def test_what_is_doubtful_needs_room_of_its_own(score: float, shift: int, kept: bool) -> None:
    """Shifted by 47 of 96 parts of the width, the lesser is 0.51 covered; by 50, 0.48."""
    first = replace(MovingCard().label(3), track_id=0)
    width = float(first.box_xyxy[2] - first.box_xyxy[0])
    moved = first.box_xyxy + np.array([shift * width / 96, 0, shift * width / 96, 0], np.float32)
    other = replace(first, track_id=1, score=score, box_xyxy=moved)
    assert len(without_doubles([first, other], doubts={"car": 0.8})) == 1 + kept
    assert len(without_doubles([first, other])) == 2


def test_nothing_is_carried_over_a_cut() -> None:
    scene = MovingCard(cut=30)
    frames = (scene.render(t) for t in range(60))
    labels = label_with([scene], frames, first_frame=0, effort="balanced", breaks=frozenset({30}))
    assert max(label.frame for label in labels) == 29
    assert 30 in scene.seen


def test_an_object_that_vanishes_is_not_shown_for_long() -> None:
    scene = MovingCard(speed=0.5, shown=range(30))
    labels = label_with([scene], (scene.render(t) for t in range(60)), first_frame=0, effort="fast")
    assert max(label.frame for label in labels) <= 29 + 6


def test_an_empty_road_is_looked_at_twice_a_second() -> None:
    scene = MovingCard(shown=range(0))
    label_with([scene], (scene.render(t) for t in range(240)), first_frame=0, effort="balanced")
    late = [frame for frame in scene.seen if frame >= 48]
    assert len(late) <= (240 - 48) / 12 + 1


class Lanes(MovingCard):
    """The card as a lane line: flow carries nothing of it."""

    carries = False
    sure_scores: Mapping[str, float] = {"lane": 0.5}

    def label(self, number: int) -> Keypoints:
        return replace(super().label(number), category="lane", schema="lane24")


def test_lanes_are_looked_at_twice_a_second_from_the_first_frame() -> None:
    scene = Lanes(speed=0.2)
    label_with([scene], (scene.render(t) for t in range(121)), first_frame=0, effort="balanced")
    assert scene.seen == list(range(0, 121, 12))


def test_what_passes_in_a_blink_is_no_object() -> None:
    scene = MovingCard(shown=range(10, 13))
    assert label_with([scene], (scene.render(t) for t in range(40)), first_frame=0, effort="exact") == []


class SeenOnce(MovingCard):
    """A card that a network takes for an object in one look alone, with or without the points of a head."""

    def __init__(self, look: int, *, points: bool) -> None:
        super().__init__()
        self.look, self.points = look, points

    def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
        found = super().see(frame, number) if len(self.seen) == self.look else []
        self.seen += [] if found else [number]
        return [label if self.points else without_points(label) for label in found]


def without_points(label: Keypoints) -> Keypoints:
    return replace(label, points=0 * label.points, point_source=0 * label.point_source)


@pytest.mark.parametrize("shown", [1, 2, 8])
@pytest.mark.parametrize("points", [True, False])
@pytest.mark.parametrize("effort", ["exact", "balanced", "fast"])
def test_what_one_look_alone_saw_is_no_object(effort: Effort, points: bool, shown: int) -> None:
    """However long it was carried, and however often its picture was shown again."""
    scene = SeenOnce(4, points=points)
    frames = (scene.render(t // shown) for t in range(60 * shown))
    assert label_with([scene], frames, first_frame=0, effort=effort) == []


@pytest.mark.parametrize("every", [2, 3])
@pytest.mark.parametrize("effort", ["balanced", "fast"])
def test_sources_of_fewer_frames_show_nothing_long_unseen(effort: Effort, every: int) -> None:
    """At 12 and 8 fps, as at 24: a quarter of a second after the last sight at most, and looks as often a second."""
    for last in range(60, 72):
        scene = MovingCard(speed=0.5, shown=range(last))
        frames = (scene.render(t - t % every) for t in range(120))
        labels = label_with([scene], frames, first_frame=0, effort=effort)
        seen = [number for number in scene.seen if number < last]
        assert max(label.frame for label in labels) <= seen[-1] + 6 + every
        assert max(np.diff(scene.seen)) <= EFFORTS[effort].max_gap + every


def test_a_picture_that_is_held_at_the_start_makes_no_slow_source() -> None:
    scene = MovingCard(speed=0.5)
    label_with([scene], (scene.render(max(0, t - 8)) for t in range(40)), first_frame=0, effort="balanced")
    # Frame 9 is the second moment; what has just come is looked at again after ``news_gap`` moments.
    assert scene.seen[:2] == [0, 8 + EFFORTS["balanced"].news_gap]


def test_a_source_of_fewer_frames_is_smoothed_over_the_same_time() -> None:
    assert SmoothingSettings().at_pace(1) == SmoothingSettings()
    assert SmoothingSettings(narrow=5, wide=12, fill_frames=6).at_pace(2) == SmoothingSettings(
        narrow=3, wide=6, fill_frames=3
    )


class ComesAndGoes(MovingCard):
    """A card that is seen in some frames alone, and from one of them on surely."""

    def __init__(self, seen: Sequence[int], *, sure_from: int = 0) -> None:
        super().__init__(speed=0.5)
        self.frames, self.sure_from = frozenset(seen), sure_from

    def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
        found = super().see(frame, number) if number in self.frames else []
        return [replace(label, score=0.9 if number >= self.sure_from else 0.3) for label in found]


def shown(scene: MovingCard, *, frames: int = 100) -> list[Keypoints]:
    return label_with([scene], (scene.render(t) for t in range(frames)), first_frame=0, effort="exact")


@pytest.mark.parametrize("every", [1, 2, 3, 4])
@pytest.mark.parametrize(("hidden", "tracks"), [(24, 1), (60, 2)])
def test_who_is_hidden_for_a_second_is_the_same_at_any_frame_rate(hidden: int, tracks: int, every: int) -> None:
    scene = ComesAndGoes([*range(48), *range(48 + hidden, 156)])
    frames = (scene.render(t - t % every) for t in range(156))
    labels = label_with([scene], frames, first_frame=0, effort="exact")
    assert len({label.track_id for label in labels}) == tracks


def test_ids_count_from_0_whatever_was_dropped() -> None:
    """What was there for four frames leaves no gap in the numbers."""
    labels = shown(ComesAndGoes([*range(10, 14), *range(70, 90)]))
    assert [label.frame for label in labels] == list(range(70, 90))
    assert {label.track_id for label in labels} == {0}


class Lower(MovingCard):
    def place(self, frame: int) -> tuple[float, np.ndarray]:
        return 1.0, np.array([200.0 - 2 * frame, 150.0])


def test_two_kinds_of_look_share_no_ids() -> None:
    looks = [MovingCard(), Lower()]
    labels = label_with(looks, (looks[0].render(t) for t in range(48)), first_frame=0, effort="exact")
    for track_id, look in enumerate(looks):
        own = [label for label in labels if label.track_id == track_id]
        assert [label.frame for label in own] == list(range(48))
        assert all(np.allclose(label.points[:, :2], look.truth(label.frame), atol=0.1) for label in own)
    assert len(labels) == 96


def test_who_is_there_at_a_runs_ends_need_not_last() -> None:
    labels = shown(ComesAndGoes([*range(4), *range(48, 52), *range(96, 100)]))
    assert [label.frame for label in labels] == [*range(4), *range(96, 100)]


def test_what_becomes_sure_is_labelled_from_where_it_was_first_seen() -> None:
    labels = shown(ComesAndGoes(range(20, 60), sure_from=40))
    assert [label.frame for label in labels] == list(range(20, 60))
    assert {label.track_id for label in labels} == {0}
    assert shown(ComesAndGoes(range(20, 60), sure_from=60)) == []


def test_fast_growth_brings_looks_closer() -> None:
    """A size that goes as 1 / t departs from its chord by no more than the bound, and nearly by that."""
    scene = MovingCard(growth=0.05)
    gap = straight_gap(scene.label(0), scene.label(4), max_bend=0.03)
    rate = 0.05
    size = 1 / (1 - rate * np.array([-gap / 2, 0.0, gap / 2]))
    bend = (size[0] + size[2]) / 2 - size[1]
    assert bend == pytest.approx(0.03, rel=0.15)


def test_flow_says_when_it_lost_an_object() -> None:
    scene = MovingCard()
    grey, other = small_grey(scene.render(0)), small_grey(texture(7, WIDTH, HEIGHT))
    (kept,) = carry(grey, small_grey(scene.render(1)), [scene.label(0)], frame=1)
    (lost,) = carry(grey, other, [scene.label(0)], frame=1)
    assert kept.followed and not lost.followed
    assert np.abs(kept.label.points[:, :2] - scene.truth(1)).max() < 1.0


def moved(label: Keypoints, frame: int, shift: float) -> Keypoints:
    points = label.points.copy()
    points[:, 0] += shift
    return replace(
        label, frame=frame, points=points, box_xyxy=label.box_xyxy + np.array([shift, 0, shift, 0], np.float32)
    )


def test_the_miss_is_spread_over_the_way() -> None:
    start = MovingCard(speed=0).label(0)
    path = [start, *(moved(start, t, 2.0 * t) for t in range(1, 5))]  # drifts by 2 px a frame
    between = close_gaps([path], [moved(start, 4, 4.0)])  # it really moved by 1 px a frame
    assert [round(float(label.points[0, 0] - start.points[0, 0]), 3) for label in between] == [1.0, 2.0, 3.0]


def test_a_far_miss_is_interpolated_instead() -> None:
    start = MovingCard(speed=0).label(0)
    path = [start, moved(start, 1, 50.0), moved(start, 2, 100.0)]
    (between,) = close_gaps([path], [moved(start, 2, 10.0)])
    assert (between.point_source == POINT_INTERPOLATED).all()
    assert between.points[:, 0] == pytest.approx(start.points[:, 0] + 5)


def test_points_that_one_end_lacks_are_not_made_up() -> None:
    start = MovingCard(speed=0).label(0)
    end = moved(start, 4, 8.0)
    end.points[3] = 0
    assert all(label.points[3, 2] == 0 for label in interpolate_gaps([start], [end]))


def test_a_gap_is_crossed_on_straight_lines() -> None:
    start = MovingCard(speed=0).label(5)
    end = replace(moved(start, 9, 8.0), score=start.score / 2, box_xyxy=start.box_xyxy + 12)
    end.points[::2, 2] /= 2
    between = interpolate_gaps([start], [end])
    assert [label.frame for label in between] == [6, 7, 8]
    for label, share in zip(between, (0.25, 0.5, 0.75), strict=True):
        np.testing.assert_allclose(label.points[:, :2], start.points[:, :2] + (8 * share, 0), atol=1e-4)
        # No surer than the less sure end; the object itself fades evenly.
        np.testing.assert_array_equal(label.points[:, 2], end.points[:, 2])
        np.testing.assert_allclose(label.box_xyxy, start.box_xyxy + 12 * share, atol=1e-4)
        assert label.score == pytest.approx(start.score * (1 - share / 2), abs=1e-6)
        assert (label.point_source == POINT_INTERPOLATED).all()
    assert interpolate_gaps([start], [replace(end, frame=6)]) == []


def test_objects_closed_together_are_closed_as_each_by_itself() -> None:
    """Points absent at one end or both, followed well and missed by far; nodes, and frames between them."""
    rng = np.random.default_rng(7)
    shape = MovingCard(speed=0).label(0)

    def drawn(track_id: int, frame: int) -> Keypoints:
        label = replace(moved(shape, frame, float(rng.normal(0, 12))), track_id=track_id, score=float(rng.random()))
        label.box_xyxy[2:] += 40 * track_id  # what is a far miss goes by the object's size
        label.points[:, :2] += rng.normal(0, 4, (len(label.points), 2))
        absent = rng.random(len(label.points)) < 0.3
        label.points[absent] = 0
        return replace(label, point_source=np.where(absent, 0, label.point_source).astype(np.int8))

    paths = [[drawn(n, frame) for frame in (2, 5, 7, 13)] for n in range(6)]
    ends = [drawn(n, 13) for n in range(6)]
    together = close_gaps(paths, ends)
    alone = [label for path, end in zip(paths, ends, strict=True) for label in close_gaps([path], [end])]
    assert [(label.frame, label.track_id) for label in together] == [(f, n) for n in range(6) for f in range(3, 13)]
    for one, other in zip(together, alone, strict=True):
        assert one.score == other.score
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.point_source, other.point_source)
        np.testing.assert_array_equal(one.box_xyxy, other.box_xyxy)
    starts = [path[0] for path in paths]
    for one, other in zip(
        interpolate_gaps(starts, ends),
        [label for pair in zip(starts, ends, strict=True) for label in interpolate_gaps([pair[0]], [pair[1]])],
        strict=True,
    ):
        np.testing.assert_array_equal(one.points, other.points)
        # An absent point has no place, and comes from nowhere.
        assert not one.points[~one.present].any() and not one.point_source[~one.present].any()
        assert one.point_source[one.present].all()


def test_unknown_extractors_are_named() -> None:
    with pytest.raises(ConfigError, match="yolox_nano"):
        choose_extractors(["yolo_nano"])


def test_absent_weights_say_how_to_get_them(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="yolox_l"):
        choose_extractors(["yolox_l"], models_dir=tmp_path)
    choice = choose_extractors(None, models_dir=tmp_path)
    assert choice.cards == () and "yolox_l" in choice.absent
    assert choice.missing_categories == ("car", "person", "lane")
