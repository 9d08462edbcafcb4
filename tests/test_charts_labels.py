"""The charts of detection, keypoints and tracks: that they run, and their trivial methods on truth."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from labeling.efforts import EFFORTS
from labeling.observation import looks_of
from pipelines import charts_detect, charts_track
from pipelines.charts import run_chart
from pipelines.charts_keypoints import fixed_rhythm, flow_only
from pipelines.charts_track import TrackClip, greedy_overlap, labelled, tracked, without_ids
from pipelines.keypoint_clips import HELD_OUT_SEED, street_extractors, street_frames
from pipelines.keypoint_errors import by_frame, match_frames, point_score
from pipelines.track_errors import track_score
from training.label_agreement import point_agreement


@pytest.fixture(scope="module")
def seen_as_it_is() -> TrackClip:
    """A street whose looks are the truth."""
    clip = street_frames("crossing", HELD_OUT_SEED + 3, 16, width=352, height=234)
    looks = tuple(tuple(one for one in labels if one.category != "lane") for labels in clip.labels)
    return TrackClip(clip=clip, looks=looks, sure_scores={"car": 0.5, "person": 0.5}, decided=())


def test_trackers_on_the_truth(seen_as_it_is: TrackClip) -> None:
    truth = seen_as_it_is.clip.truth
    scores = {
        method.__name__: track_score(method(seen_as_it_is), truth) for method in (without_ids, greedy_overlap, tracked)
    }
    assert scores["tracked"].idf1 == 1.0 and scores["tracked"].switches == 0
    assert scores["without_ids"].idf1 < 0.2 and scores["without_ids"].missed == 0
    assert scores["greedy_overlap"].mota > 0.9


def test_fewer_looks_keep_the_points_of_the_truth(seen_as_it_is: TrackClip) -> None:
    for effort in (EFFORTS["balanced"], fixed_rhythm(4)):
        found = labelled(seen_as_it_is, effort=effort)
        assert point_score(match_frames(found, seen_as_it_is.clip.truth)).pck > 0.9


def test_flow_alone_carries_on_what_one_look_saw() -> None:
    clip, extractors = street_frames("drive", HELD_OUT_SEED + 3, 8, width=352, height=234), street_extractors()
    found = by_frame(flow_only(clip, extractors=extractors), len(clip))
    seen = [label for look in looks_of(extractors) for label in look.see(clip.frames[0], 0)]
    assert [label.points.tolist() for label in found[0]] == [label.points.tolist() for label in seen]
    names = [{label.track_id for label in labels} for labels in found]
    assert len(names[0]) == len(seen) and names[-1]
    assert all(later <= earlier for earlier, later in pairwise(names)), "something was seen after the first frame"
    held = [replace(label, frame=7) for label in found[0] if label.track_id in names[-1]]
    assert point_agreement(found[-1], clip.labels[7]).right > 1.5 * point_agreement(held, clip.labels[7]).right


@pytest.mark.parametrize("name", ["detect", "track"])
def test_charts_run(name: str, tmp_path: Path) -> None:
    chart = run_chart(name, out=tmp_path, quick=True)
    stored = json.loads((tmp_path / f"chart-{name}.json").read_text())
    methods = [point["method"] for point in stored["points"]]
    assert methods == [point.method for point in chart.points]
    wanted = charts_track.METHODS if name == "track" else {charts_detect.TRIVIAL}
    assert set(wanted) <= set(methods)
    assert (tmp_path / f"chart-{name}.png").is_file()
