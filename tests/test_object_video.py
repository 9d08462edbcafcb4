"""Object video: which tracks are shown, where, in which colours."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skeleton_fixtures import car, lane, person

from labeling.errors import ConfigError
from labeling.labels import UNTRACKED
from labeling.object_video import BOX_COLOURS, chosen_tracks, object_frames

CLIP = SimpleNamespace(start=48, end=52)


def _street(count: int = 9):
    """Cars that drift to the right, one label per frame, with a person, a lane, and labels outside the clip."""
    labels = []
    for frame in range(46, 54):
        labels += [
            car(right_m=-8 + 2 * i + 0.1 * frame, ahead_m=15, frame=frame, track_id=100 + i) for i in range(count)
        ]
        labels += [person(right_m=-2, ahead_m=7, frame=frame, track_id=3), lane(frame=frame, track_id=4)]
        labels += [car(right_m=2, ahead_m=9, frame=frame, track_id=UNTRACKED)]
    return labels


def _frames(labels, **kwargs):
    kwargs = {"clip": CLIP, "key": "a_48", **kwargs}
    return list(object_frames(labels, **kwargs))


def _colours(picture) -> set[tuple[int, ...]]:
    return {tuple(colour) for colour in picture[picture.any(axis=2)].tolist()}


def test_at_most_five_boxes_each_in_a_colour_of_its_own():
    frames = _frames(_street())
    assert len(frames) == 4 and frames[0].shape == (512, 768, 3) and frames[0].dtype == np.uint8
    seen = set().union(*(_colours(frame) for frame in frames))
    assert 2 <= len(seen) <= 5 and seen <= set(BOX_COLOURS)


def test_a_box_is_filled_where_the_label_says_and_nowhere_else():
    one = car(ahead_m=15, frame=48, track_id=1)
    picture = _frames([one], width=1056, height=704)[0]
    left, top, right, bottom = np.rint(one.box_xyxy).astype(int)
    expected = np.zeros((704, 1056), bool)
    expected[top : bottom + 1, left : right + 1] = True
    assert np.array_equal(picture.any(axis=2), expected)
    half = _frames([one], width=528, height=352)[0].any(axis=2)
    rows, columns = np.nonzero(half)
    assert abs(columns.min() - ((left + 0.5) / 2 - 0.5)) <= 1 and abs(rows.max() - ((bottom + 0.5) / 2 - 0.5)) <= 1


def test_only_tracked_cars_and_people_of_the_clip_are_shown():
    outside = [car(frame=47, track_id=1), car(frame=52, track_id=2)]
    unfit = [lane(frame=49, track_id=3), car(frame=49, track_id=UNTRACKED)]
    assert not np.any(_frames([*outside, *unfit]))
    assert np.any(_frames([car(frame=49, track_id=1)])[1]) and not np.any(_frames([car(frame=49, track_id=1)])[0])


def test_the_choice_follows_from_key_and_variant_alone():
    labels = _street()
    same, again = _frames(labels), _frames(labels[::-1])
    assert all(np.array_equal(a, b) for a, b in zip(same, again, strict=True))
    choices = {tuple(chosen_tracks(labels, key=key, variant=v)) for key in ("a_48", "b_48") for v in range(5)}
    assert len(choices) > 5, "variants and clips differ"
    assert chosen_tracks(labels, key="a_48", variant=1) == [3, 107, 103, 104, 108], "for good: no hash of Python's"


@given(st.sets(st.integers(0, 50), min_size=1, max_size=12), st.integers(0, 50), st.integers(0, 9))
def test_one_more_track_takes_at_most_one_place(tracks, extra, variant):
    tracks = tracks - {extra}
    before = chosen_tracks([car(track_id=t) for t in sorted(tracks)], key="k_0", variant=variant)
    after = chosen_tracks([car(track_id=t) for t in sorted(tracks | {extra})], key="k_0", variant=variant)
    assert len(before) == min(5, len(tracks))
    assert [t for t in after if t != extra] == [t for t in before if t in after] and len(set(before) - set(after)) <= 1


def test_every_track_is_chosen_equally_often():
    labels = [car(track_id=t) for t in range(10)]
    counts = np.zeros(10)
    for variant in range(1000):
        counts[chosen_tracks(labels, key="k_0", variant=variant)] += 1
    assert np.abs(counts - 500).max() < 5 * np.sqrt(1000 * 0.25)


def test_near_boxes_cover_far_ones():
    near, far = car(ahead_m=8, frame=48, track_id=1), car(ahead_m=30, frame=48, track_id=2)
    colours = dict(zip(chosen_tracks([near, far], key="a_48"), BOX_COLOURS, strict=False))
    for labels in ([near, far], [far, near]):
        picture = _frames(labels)[0]
        x, y = (far.box_xyxy[:2] + far.box_xyxy[2:]) / 2 * 768 / 1056
        assert tuple(picture[int(y), int(x)].tolist()) == colours[1]


def test_the_nearer_is_the_one_that_stands_lower_however_tall_it_is():
    """A tall thing in front begins above what it hides: feet tell the distance, heads do not."""
    near = replace(car(frame=48, track_id=1), box_xyxy=np.array([100, 100, 300, 600], np.float32))
    far = replace(car(frame=48, track_id=2), box_xyxy=np.array([150, 200, 400, 400], np.float32))
    colours = dict(zip(chosen_tracks([near, far], key="a_48"), BOX_COLOURS, strict=False))
    for labels in ([near, far], [far, near]):
        picture = _frames(labels, width=1056, height=704)[0]
        assert tuple(picture[300, 200].tolist()) == colours[1] and tuple(picture[300, 350].tolist()) == colours[2]


def test_boxes_over_the_edge_are_cut_and_boxes_outside_vanish():
    assert np.any(_frames([car(right_m=-8, ahead_m=14, frame=48, track_id=1)])[0][:, 0])
    assert not np.any(_frames([car(right_m=-80, ahead_m=14, frame=48, track_id=1)])[0])


@pytest.mark.parametrize("wrong", [{"width": 0}, {"clip": SimpleNamespace(start=5, end=5)}])
def test_sizes_that_cannot_be_are_refused_at_once(wrong):
    with pytest.raises(ConfigError, match="positive size and span"):
        object_frames([], **{"clip": CLIP, "key": "k_0", **wrong})
