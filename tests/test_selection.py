from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset.selection import (
    ClipRow,
    SelectionRule,
    candidate_rows,
    count_objects,
    object_threshold,
    plan_looks,
    read_selection,
    select_clips,
    twin_holders,
    video_splits,
    write_selection,
)
from labeling.errors import ConfigError, DataError
from labeling.timeline import plan_clips, plan_timeline


def rows(video_id, objects):
    return [
        ClipRow(key=f"{video_id}_{48 * n}", video_id=video_id, start=48 * n, end=48 * n + 121, objects=count)
        for n, count in enumerate(objects)
    ]


def select(candidates, rule=None, **options):
    options.setdefault("rule_digest", "r")
    options.setdefault("digests", dict.fromkeys(candidates, "d"))
    return select_clips(candidates, rule or SelectionRule(), **options)


VIDEOS = {f"v{n}": rows(f"v{n}", np.random.default_rng(n).integers(0, 9, 20).astype(float)) for n in range(12)}


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 6), min_size=1, max_size=40), st.floats(0.05, 0.95))
def test_the_kept_share_is_the_one_with_the_most_objects_and_ties_are_kept(counts, share):
    selection = select({"v": rows("v", [float(c) for c in counts])}, SelectionRule(keep_share=share))
    kept = sorted(row.objects or 0.0 for row in selection.kept)
    dropped = [row.objects or 0.0 for row in selection.rows if not row.kept]
    assert len(kept) >= share * len(counts) - 1e-6
    assert not dropped or max(dropped) < kept[0] == selection.threshold
    assert len([count for count in kept if count > kept[0]]) < share * len(counts) + 1e-6


def test_a_dropped_clip_says_why_with_its_numbers():
    selection = select({"v": rows("v", [1.0, 4.0])})
    assert selection.rows[0].reason == "objects=1 < threshold=4"
    assert selection.rows[1].reason is None


def test_every_clip_is_kept_without_counts():
    selection = select({"v": rows("v", [None, None])}, SelectionRule(keep_share=1.0))
    assert selection.threshold is None
    assert all(row.kept and row.split == "train" for row in selection.rows)
    assert object_threshold([], 0.5) is None


def test_one_source_goes_all_to_train_and_a_split_keeps_sources_whole():
    assert set(video_splits(["only"], SelectionRule(val_share=0.99)).values()) == {"train"}
    selection = select(VIDEOS, SelectionRule(val_share=0.4))
    by_video = {row.video_id: {r.split for r in selection.kept if r.video_id == row.video_id} for row in selection.kept}
    assert all(len(splits) == 1 for splits in by_video.values())
    assert {split for splits in by_video.values() for split in splits} == {"train", "val"}


@pytest.mark.parametrize(
    "beside", [[], [ClipRow(key="t_0", video_id="t", start=0, end=121, kept=False, reason="cut=1")]]
)
def test_a_video_without_a_kept_clip_does_not_fill_train(beside):
    names = [f"v{n}" for n in range(40)]
    by_hash = video_splits(names, SelectionRule())
    val, train = (next(name for name in names if by_hash[name] == split) for split in ("val", "train"))
    candidates = {val: rows(val, [5.0] * 4), train: [replace(row, video_id=train) for row in beside]}
    for previous in (None, select({train: candidates[train]})):
        assert {row.split for row in select(candidates, previous=previous).kept} == {"train"}


TWINS = {"a": ["a", "b"], "b": ["a", "b"]}


def test_videos_of_the_same_bytes_count_once_and_stand_in_one_split():
    candidates = {name: rows(name, [5.0, 1.0]) for name in ("a", "b", "c")}
    selection = select(candidates, SelectionRule(keep_share=0.5, val_share=0.5), twins=TWINS)
    alone = select({name: candidates[name] for name in "ac"}, SelectionRule(keep_share=0.5, val_share=0.5))
    assert [row for row in selection.rows if row.video_id != "b"] == list(alone.rows)
    assert {row.reason for row in selection.rows if row.video_id == "b"} == {"same_as=a"}
    assert twin_holders(selection) == {"b": "a"}


def test_a_twin_that_comes_later_takes_nothing_over_and_one_that_is_left_keeps_the_split():
    rule = SelectionRule(keep_share=1.0, val_share=0.5)
    both = {name: rows(name, [5.0]) for name in ("a", "b", "c")}
    for split in ("train", "val"):
        first = select({name: both[name] for name in "bc"}, rule)
        first = replace(first, rows=tuple(replace(row, split=split) for row in first.rows))
        second = select(both, rule, previous=first, twins=TWINS, digests={"a": "t", "b": "t", "c": "d"})
        assert [(row.key, row.split, row.reason) for row in second.rows] == [
            ("a_0", None, "same_as=b"), ("b_0", split, None), ("c_0", split, None)
        ]  # fmt: skip
        assert select(both, rule, previous=second, twins=TWINS, digests={"a": "t", "b": "t", "c": "d"}) == second
        third = select({name: both[name] for name in "ac"}, rule, previous=second)
        assert [(row.key, row.split) for row in third.kept] == [("a_0", split), ("c_0", split)]


def test_a_split_file_decides_and_must_name_every_video():
    rule = SelectionRule(split={"a": "val", "b": "train"})
    assert video_splits(["a", "b"], rule) == {"a": "val", "b": "train"}
    with pytest.raises(ConfigError, match="names no split for video 'c'"):
        video_splits(["a", "c"], rule)


def test_the_sample_has_its_size_and_says_who_was_left_out():
    selection = select(VIDEOS, SelectionRule(keep_share=0.5, sample_clips=7))
    assert len(selection.kept) == 7
    left = [row.reason for row in selection.rows if row.reason and row.reason.startswith("sample=")]
    assert left and all("> cutoff=" in reason for reason in left)


@pytest.mark.parametrize("sample", [None, 30])
def test_adding_a_video_changes_nothing_for_the_others(sample):
    rule = SelectionRule(sample_clips=sample, val_share=0.3)
    first = select({name: VIDEOS[name] for name in list(VIDEOS)[:8]}, rule)
    second = select(VIDEOS, rule, previous=first, mode="extend")
    assert [row for row in second.rows if row.video_id in first.digests] == list(first.rows)
    added = [row for row in second.rows if row.video_id not in first.digests]
    assert second.threshold == first.threshold
    assert all(
        ((row.objects or 0.0) >= (first.threshold or 0.0)) == (not (row.reason or "").startswith("objects"))
        for row in added
    )
    assert {row.round for row in added} == {1} and {row.round for row in first.rows} == {0}


def test_a_sample_rank_does_not_depend_on_other_videos():
    rule = SelectionRule(keep_share=1.0, sample_clips=30)
    few = select({name: VIDEOS[name] for name in list(VIDEOS)[:8]}, rule)
    many = select(VIDEOS, rule)
    assert few.sample_cutoff and many.sample_cutoff and many.sample_cutoff < few.sample_cutoff
    assert {row.key for row in many.kept if row.video_id in few.digests} <= {row.key for row in few.kept}


def test_extending_again_with_nothing_new_changes_nothing():
    first = select(VIDEOS)
    assert select(VIDEOS, previous=first, mode="extend") == first


def test_a_changed_rule_makes_a_new_selection_and_cannot_be_extended():
    first = select(VIDEOS)
    rule = SelectionRule(keep_share=0.25)
    assert select(VIDEOS, rule, previous=first, rule_digest="other") == select(VIDEOS, rule, rule_digest="other")
    with pytest.raises(ConfigError, match="its rule has changed"):
        select(VIDEOS, rule, previous=first, rule_digest="other", mode="extend")
    with pytest.raises(ConfigError, match="no selection to extend"):
        select(VIDEOS, mode="extend")


def test_a_split_that_is_given_holds_whenever_it_is_said():
    videos = {name: VIDEOS[name] for name in ("v0", "v1")}
    first = select(videos, SelectionRule(split={"v0": "train", "v1": "train"}))
    second = select(videos, SelectionRule(split={"v0": "train", "v1": "val"}), previous=first)
    assert {row.split for row in second.kept if row.video_id == "v1"} == {"val"}
    assert second.threshold == first.threshold and second.rounds == 0


def test_refreezing_computes_the_threshold_anew():
    low = {name: rows(name, [0.0, 1.0]) for name in ("a", "b")}
    high = {**low, **{name: rows(name, [8.0, 9.0]) for name in ("c", "d", "e", "f")}}
    first = select(low)
    assert select(high, previous=first).threshold == first.threshold == 1.0
    assert select(high, previous=first, mode="refreeze").threshold == 8.0


def test_a_changed_video_is_judged_again_by_the_frozen_threshold():
    first = select(VIDEOS)
    changed = {**VIDEOS, "v3": rows("v3", [99.0] * 20)}
    digests = {**first.digests, "v3": "changed"}
    second = select(changed, digests=digests, previous=first)
    assert second.threshold == first.threshold and second.rounds == 0
    assert all(row.kept for row in second.rows if row.video_id == "v3")
    assert [r for r in second.rows if r.video_id != "v3"] == [r for r in first.rows if r.video_id != "v3"]


def test_a_selection_is_read_back_as_it_was_written(tmp_path):
    selection = select(VIDEOS, SelectionRule(sample_clips=5))
    write_selection(tmp_path / "s.parquet", selection)
    assert read_selection(tmp_path / "s.parquet") == selection
    with pytest.raises(DataError, match="is not there"):
        read_selection(tmp_path / "none.parquet")


def test_holes_and_short_videos_stay_in_the_table_with_their_reason():
    times = np.concatenate([np.arange(0, 10, 1 / 24), np.arange(11, 21, 1 / 24)])
    timeline = plan_timeline(times)
    found = candidate_rows("v", plan_clips(timeline), None)
    assert {(row.reason or "").split("=")[0] for row in found if not row.kept} == {"hole"}
    assert all(row.kept == (row.reason is None) for row in found)
    short = candidate_rows("v", plan_clips(plan_timeline(times[:40])), None)
    assert [row.reason for row in short] == ["too_short: frames=40 < clip_frames=121"]


@pytest.mark.parametrize("gap", [0.2, 1.0, 4.0, 30.0], ids=lambda gap: f"keyframe every {gap} s")
def test_every_clip_is_looked_at_twice_and_keyframes_are_preferred(gap):
    times = np.arange(0, 60, 1 / 25)
    timeline = plan_timeline(times)
    clips = plan_clips(timeline).kept
    keyframes = times[:: round(gap * 25)]
    looks = plan_looks(timeline, clips, keyframes, looks_per_clip=2)
    assert (np.diff(looks) > 0).all() and np.isin(looks, times).all()
    for clip in clips:
        shown = timeline.source_time_s[clip.start : clip.end]
        assert ((looks >= shown[0]) & (looks <= shown[-1])).sum() >= 2
    if gap <= 1:
        assert np.isin(looks, keyframes).all() and len(looks) <= 61


def test_objects_are_the_mean_over_looks_of_counted_classes_that_are_sure():
    timeline = plan_timeline(np.arange(0, 11, 1 / 24))
    clips = plan_clips(timeline).kept[:2]
    counts = count_objects(
        timeline, clips, look_times_s=np.array([1.0, 2.5, 6.0]),
        classes=[["car", "dog", "car"], ["person"], []], scores=[[0.9, 0.9, 0.2], [0.5], []],
        counted={"car", "person"}, min_score=0.3,
    )  # fmt: skip
    assert counts == [1.0, 0.5]
    none = count_objects(timeline, clips, look_times_s=np.zeros(0), classes=[], scores=[], counted={"car"}, min_score=0)
    assert none == [None, None]
    found = candidate_rows("v", plan_clips(timeline), [None] * len(plan_clips(timeline).kept))
    assert all(not row.kept and (row.reason or "").startswith("uncounted") for row in found)
