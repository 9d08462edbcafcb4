"""``animatic chart track``: milliseconds a frame against identities lost, and against points that shake.

All methods get the same looks at the same streets (people that cross behind a column, dense traffic, turns), so that
only what makes tracks of them is timed and judged.
"""

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from dataset.street import Scenario
from labeling.box_tracker import TrackerSettings
from labeling.boxes import iou
from labeling.efforts import EFFORTS, EffortSettings
from labeling.extraction import label_with
from labeling.labels import UNTRACKED, Keypoints
from labeling.observation import Look, looks_of
from labeling.picture_turn import TurnMeter
from labeling.schemas import Category
from labeling.smoothing import smooth_tracks
from labeling.tracking import RunTracker
from pipelines.charts import Chart, ChartPoint, Cost, Error, machine_name
from pipelines.charts_keypoints import fixed_rhythm
from pipelines.keypoint_clips import (
    HEIGHT,
    HELD_OUT_SEED,
    WIDTH,
    KeypointClip,
    pooled_names,
    street_extractors,
    street_frames,
)
from pipelines.keypoint_errors import match_frames
from pipelines.track_errors import NO_TRACKS, PointSeries, TrackScore, jitter_px, lag_frames, point_series, track_score

SCENARIOS: tuple[Scenario, ...] = ("crossing", "traffic", "turn", "sharp_turn", "stop_and_go", "parked")
_FRAMES = 48
_STARTS: dict[Scenario, int] = {"stop_and_go": 24}
"""Frames to skip: everybody brakes from the second second on."""
_SEED = HELD_OUT_SEED + 200
_GREEDY_IOU = 0.3
_LEG_POINTS = (13, 14, 15, 16)
"""Knees and ankles of ``coco17``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackClip:
    """A street, and what looks at each of its frames saw of cars and people."""

    clip: KeypointClip
    looks: tuple[tuple[Keypoints, ...], ...]
    sure_scores: Mapping[str, float]
    """Of the detector that looked."""
    decided: Collection[str]
    """As ``Look.decided``."""

    def look(self) -> Look:
        """The same looks again, at no cost."""
        return Remembered(self.looks, self.sure_scores, decided=self.decided)


class Remembered:
    """A ``Look`` that tells what was seen in each frame again, at no cost."""

    carries = True

    def __init__(
        self, looks: Sequence[Sequence[Keypoints]], sure_scores: Mapping[str, float], *, decided: Collection[str]
    ) -> None:
        self.looks, self.sure_scores, self.decided = looks, sure_scores, decided

    def see(self, frame: np.ndarray, number: int) -> list[Keypoints]:
        """As ``Look.see``."""
        return list(self.looks[number])


Method = Callable[[TrackClip], list[Keypoints]]


def chart(name: str, *, quick: bool = False) -> Chart:
    """1 - IDF1, id switches and the jitter of points against processor time of one thread.

    An error's upper end is its worst clip.

    Raises:
        ModelError: the street models' weights are not there.
    """
    clips = track_clips(quick=quick)
    runs = 1 if quick else 2
    found: dict[str, list[list[Keypoints]]] = {}
    spent: dict[str, list[float]] = {method: [] for method in METHODS}
    for _ in range(runs):
        for method, track in METHODS.items():
            start = time.process_time()
            found[method] = [track(clip) for clip in clips]
            taken = time.process_time() - start
            spent[method].append(taken * 1000 / sum(len(clip.clip) for clip in clips))
    points = tuple(_point(method, found[method], clips, spent[method]) for method in METHODS)
    data = f"the same looks at {WIDTH}x{HEIGHT}: {pooled_names([clip.clip for clip in clips])}"
    return Chart(stage=name, data=data, points=points, machine=machine_name())


def track_clips(*, quick: bool = False) -> list[TrackClip]:
    """The streets with what the shipped models see in every frame."""
    if quick:
        return [look_at(street_frames("crossing", _SEED, 13, width=WIDTH // 2, height=HEIGHT // 2))]
    return [
        look_at(street_frames(scenario, _SEED + n, _FRAMES, start=_STARTS.get(scenario, 0)))
        for n, scenario in enumerate(SCENARIOS)
    ]


def look_at(clip: KeypointClip) -> TrackClip:
    """Cars and people as the shipped models see them in every frame."""
    look = looks_of(street_extractors())[0]
    looks = tuple(tuple(look.see(frame, n)) for n, frame in enumerate(clip.frames))
    return TrackClip(clip=clip, looks=looks, sure_scores=look.sure_scores, decided=look.decided)


def without_ids(clip: TrackClip) -> list[Keypoints]:
    """Everything seen is somebody new."""
    seen = (label for labels in clip.looks for label in labels if label.score >= clip.sure_scores[label.category])
    return [replace(label, track_id=n) for n, label in enumerate(seen)]


def greedy_overlap(clip: TrackClip) -> list[Keypoints]:
    """The id of whatever box of the last frame overlaps most, best pairs first; no prediction, no memory."""
    out: list[Keypoints] = []
    before: list[Keypoints] = []
    next_id = 0
    for labels in clip.looks:
        seen = [label for label in labels if label.score >= clip.sure_scores[label.category]]
        boxes = [np.array([one.box_xyxy for one in group]).reshape(-1, 4) for group in (before, seen)]
        overlap = iou(boxes[0], boxes[1])
        for row, old in enumerate(before):
            overlap[row, [one.category != old.category for one in seen]] = 0
        ids: dict[int, int] = {}
        while overlap.size and overlap.max() >= _GREEDY_IOU:
            row, column = np.unravel_index(int(overlap.argmax()), overlap.shape)
            ids[int(column)] = before[row].track_id
            overlap[row], overlap[:, column] = 0, 0
        before = []
        for column, label in enumerate(seen):
            next_id += column not in ids
            before.append(replace(label, track_id=ids.get(column, next_id - 1)))
        out += before
    return out


def tracked(clip: TrackClip, *, turns: bool = True, settings: TrackerSettings | None = None) -> list[Keypoints]:
    """Our tracker at every frame, with or without the camera's turn; raw points."""
    tracker, meter, found = RunTracker(settings, start_scores=clip.sure_scores), TurnMeter(), []
    for number, (frame, labels) in enumerate(zip(clip.clip.frames, clip.looks, strict=True)):
        if turns:
            meter.reach(frame, number)
        turn = meter.since(number - 1) if turns else None
        named = tracker.update(labels, frame=number, previous_to_current=turn)
        found += [label for label in named if label.track_id != UNTRACKED]
    return found


def smoothed(clip: TrackClip) -> list[Keypoints]:
    """Our tracker, then the smoothing of points."""
    return smooth_tracks(tracked(clip))


def labelled(clip: TrackClip, *, effort: EffortSettings) -> list[Keypoints]:
    """All that ``label_frames`` does but for the networks."""
    return label_with([clip.look()], clip.clip.frames, first_frame=0, effort=effort)


_SINGLE = TrackerSettings(buffer=0.0, lost_buffer=0.0)
_FORGETFUL = TrackerSettings(max_lost_frames=1)
METHODS: dict[str, Method] = {
    "no ids": without_ids,
    "greedy overlap": greedy_overlap,
    "tracker that forgets at once": partial(tracked, settings=_FORGETFUL),
    "tracker, boxes not grown": partial(tracked, settings=_SINGLE),
    "tracker without the turn": partial(tracked, turns=False),
    "tracker": tracked,
    "tracker + smoothing": smoothed,
    "exact": partial(labelled, effort=EFFORTS["exact"]),
    "balanced": partial(labelled, effort=EFFORTS["balanced"]),
    "fast": partial(labelled, effort=EFFORTS["fast"]),
    "every 4th frame, no flow": partial(labelled, effort=fixed_rhythm(4)),
    "every 8th frame, no flow": partial(labelled, effort=fixed_rhythm(8)),
}


def _point(method: str, found: list[list[Keypoints]], clips: Sequence[TrackClip], spent: list[float]) -> ChartPoint:
    scores = [track_score(labels, clip.clip.truth) for labels, clip in zip(found, clips, strict=True)]
    total = sum(scores, NO_TRACKS)
    by_clip = [point_series(match_frames(labels, one.clip.truth)) for labels, one in zip(found, clips, strict=True)]
    series = [one for part in by_clip for one in part]
    shaking = [jitter_px(part) for part in by_clip]
    by_name = {clip.clip.name: part for clip, part in zip(clips, by_clip, strict=True)}
    settings = {
        clip.clip.name: _figures(score) for score, clip in zip(scores, clips, strict=True)
    } | {
        "all": _figures(total),
        "lag_of_legs_frames": _rounded(lag_frames(_of("person", series), points=_LEG_POINTS)),
        "lag_of_braking_cars_frames": _rounded(lag_frames(_of("car", by_name.get("stop_and_go", [])))),
        "jitter_of_parked_cars_px": _rounded(jitter_px(by_name.get("parked", []))),
    }  # fmt: skip
    return ChartPoint(
        method=method, settings=settings, reference=method == "no ids",
        ms_per_frame=Cost(median=float(np.median(spent)), p95=float(np.percentile(spent, 95)), runs=len(spent)),
        error=Error(
            metric="1 - IDF1", unit="%", median=100 * (1 - total.idf1),
            p95=float(np.nanmax([100 * (1 - score.idf1) for score in scores])),
        ),
        more_errors=(
            Error(
                metric="jitter of points", unit="px", median=jitter_px(series),
                p95=float(np.nanmax(shaking)) if np.isfinite(shaking).any() else 0.0,
            ),
        ),
    )  # fmt: skip


def _of(category: Category, series: Sequence[PointSeries]) -> list[PointSeries]:
    return [one for one in series if one.category == category]


def _figures(score: TrackScore) -> dict[str, float | None]:
    return {"idf1": _rounded(score.idf1), "mota": _rounded(score.mota), "switches": score.switches}


def _rounded(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
