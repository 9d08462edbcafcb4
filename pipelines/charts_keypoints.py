"""``animatic chart keypoints``: milliseconds a frame against wrong points, from one look to a look at every frame.

Streets from empty to dense traffic, with the shipped models; rendering is not timed. Methods take turns, clip by clip.
"""

import importlib.util
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dataset.street import Scenario
from labeling.carrying import carry, small_grey
from labeling.efforts import EFFORTS, EffortSettings
from labeling.extraction import label_frames
from labeling.extractors import Extractors
from labeling.labels import UNTRACKED, Keypoints
from labeling.observation import looks_of
from pipelines.charts import Chart, ChartPoint, Cost, Error, machine_name
from pipelines.keypoint_clips import (
    HEIGHT,
    HELD_OUT_SEED,
    WIDTH,
    KeypointClip,
    pooled_names,
    street_extractors,
    street_frames,
)
from pipelines.keypoint_errors import lane_score, match_frames, phantom_frames, point_score
from pipelines.model_variants import int8_choice
from pipelines.peers import RtmlibStreet
from pipelines.track_errors import track_score

SCENARIOS: tuple[Scenario, ...] = ("empty", "parked", "drive", "crossing", "traffic")
_FRAMES = 121
"""As long as the clips that jobs cut: what a run's first look and its last cost weighs more in less."""
_SEED = HELD_OUT_SEED + 100
_DRAWS = 400
_TURNS = 3
"""Of the efforts, whose costs are compared: machines are noisy. Everything else has one."""
_ALONE, _PEER = "every frame alone", "rtmlib (no lanes)"
_STRIDES = {_ALONE: 3, _PEER: 3}
"""Methods that know no other frame are measured on every third one: the same figures in a third of the time."""

Method = Callable[[KeypointClip], list[Keypoints]]


@dataclass(slots=True, kw_only=True)
class _Result:
    """What one method made of one clip, and its cost."""

    right: int
    shown: int
    figures: dict[str, Any]
    cpu_ms: float


def chart(name: str, *, quick: bool = False) -> Chart:
    """Share of visible points that are wrong (PCK@0.1 of the box diagonal) against processor time of one thread.

    A point's ``settings`` hold each clip's figures: PCK, id switches, IDF1, MOTA, frames with a phantom,
    lanes, and milliseconds. A cost is the mean over all frames, its upper end the dearest clip; the error's spread is
    over drawings of the clips with replacement.

    Raises:
        ModelError: the street models' weights are not there.
    """
    clips = keypoint_clips(quick=quick)
    results: dict[str, list[_Result]] = {}
    with _methods(clips) as (methods, left_out):
        short = replace(clips[-1], frames=clips[-1].frames[:2])
        for label in methods.values():
            label(short)  # what opens late, opens now
        for clip in clips:
            turns: dict[str, list[_Result]] = {}
            for method in [name for turn in range(_TURNS) for name in methods if turn == 0 or name in EFFORTS]:
                measured = _measure(methods[method], _strided(clip, _STRIDES.get(method, 1)))
                turns.setdefault(method, []).append(measured)
            for method, measures in turns.items():
                results.setdefault(method, []).append(_of_turns(measures))
    points = tuple(_point(method, found, clips) for method, found in results.items())
    data = f"{sum(map(len, clips))} street frames of {WIDTH}x{HEIGHT}: {pooled_names(clips)}"
    return Chart(stage=name, data=data, points=points, machine=machine_name(), left_out=left_out)


def _of_turns(measures: Sequence[_Result]) -> _Result:
    """What was found, which is always the same, at the median of its costs."""
    cost = float(np.median([one.cpu_ms for one in measures]))
    first = measures[0]
    return _Result(right=first.right, shown=first.shown, figures=first.figures | {"ms": cost}, cpu_ms=cost)


def keypoint_clips(*, quick: bool = False) -> list[KeypointClip]:
    """The streets of the chart, from empty to dense traffic."""
    if quick:
        return [street_frames("crossing", _SEED, 13, width=WIDTH // 2, height=HEIGHT // 2)]
    return [street_frames(scenario, _SEED + n, _FRAMES) for n, scenario in enumerate(SCENARIOS)]


@contextmanager
def _methods(clips: Sequence[KeypointClip]) -> Iterator[tuple[dict[str, Method], tuple[str, ...]]]:
    """Every method by name, and what is left out with its reason."""
    ours = street_extractors()
    with tempfile.TemporaryDirectory() as folder:
        small = int8_choice(ours.choice, clips[-1:], Path(folder))
        integer = Extractors(small, models_dir=Path(folder))
        methods: dict[str, Method] = {
            "first look kept": partial(_first_look, extractors=ours),
            "flow only": partial(flow_only, extractors=ours),
            "fast": partial(_label, extractors=ours, effort=EFFORTS["fast"]),
            "every 8th frame": partial(_label, extractors=ours, effort=fixed_rhythm(8)),
            "balanced": partial(_label, extractors=ours, effort=EFFORTS["balanced"]),
            "every 4th frame": partial(_label, extractors=ours, effort=fixed_rhythm(4)),
            "every 2nd frame": partial(_label, extractors=ours, effort=fixed_rhythm(2)),
            "exact": partial(_label, extractors=ours, effort=EFFORTS["exact"]),
            "balanced, int8": partial(_label, extractors=integer, effort=EFFORTS["balanced"]),
            "balanced, 2 threads": partial(_label, extractors=street_extractors(threads=2), effort=EFFORTS["balanced"]),
            _ALONE: partial(_alone, extractors=ours),
        }
        left_out = ["133 joints against 17: no whole-body weights ship, and random ones have no error to chart"]
        if importlib.util.find_spec("rtmlib"):
            methods[_PEER] = RtmlibStreet(ours.choice).label
        else:
            left_out.append("rtmlib: not installed (pip install --no-deps rtmlib==0.0.16)")
        yield methods, tuple(left_out)


def fixed_rhythm(gap: int) -> EffortSettings:
    """Looks at every ``gap``-th frame whatever happens, points straight between."""
    return EffortSettings(
        max_gap=gap, max_person_gap=gap, max_lane_gap=gap, news_gap=gap, flow_step=0, max_bend=np.inf, quiet_gap=gap
    )


def _label(clip: KeypointClip, *, extractors: Extractors, effort: EffortSettings) -> list[Keypoints]:
    return label_frames(clip.frames, first_frame=0, extractors=extractors, effort=effort)


def _alone(clip: KeypointClip, *, extractors: Extractors) -> list[Keypoints]:
    """Every frame looked at, without tracks and smoothing."""
    looks = looks_of(extractors)
    return [label for n, frame in enumerate(clip.frames) for look in looks for label in look.see(frame, n)]


def _first_look(clip: KeypointClip, *, extractors: Extractors) -> list[Keypoints]:
    """What the first frame shows, shown in every frame."""
    seen = [label for look in looks_of(extractors) for label in look.see(clip.frames[0], 0)]
    tracked = [replace(label, track_id=n) for n, label in enumerate(seen)]
    return [replace(label, frame=n) for n in range(len(clip)) for label in tracked]


def flow_only(clip: KeypointClip, *, extractors: Extractors) -> list[Keypoints]:
    """One look, then flow alone for as long as it holds an object."""
    labels = [label for label in _first_look(clip, extractors=extractors) if label.frame == 0]
    found, previous = list(labels), small_grey(clip.frames[0])
    for n, frame in enumerate(clip.frames[1:], start=1):
        grey = small_grey(frame)
        labels = [moved.label for moved in carry(previous, grey, labels, frame=n) if moved.followed]
        found += labels
        previous = grey
    return found


def _strided(clip: KeypointClip, stride: int) -> KeypointClip:
    return replace(clip, frames=clip.frames[::stride], truth=clip.truth[::stride], labels=clip.labels[::stride])


def _measure(label: Method, clip: KeypointClip) -> _Result:
    cv2.setNumThreads(1)
    cpu, wall = time.process_time(), time.perf_counter()
    found = label(clip)
    cpu_ms, wall_ms = (
        1000 * (t - t0) / len(clip) for t, t0 in ((time.process_time(), cpu), (time.perf_counter(), wall))
    )
    matched = match_frames(found, clip.truth)
    score, lanes = point_score(matched), lane_score(found, clip.truth)
    figures: dict[str, Any] = {
        "pck": score.pck,
        "car_pck": point_score(matched, category="car").pck,
        "person_pck": point_score(matched, category="person").pck,
        "phantom_frames": phantom_frames(matched),
        "lane_error_px": lanes.error_px, "lane_recall": lanes.recall,
        "ms": cpu_ms, "wall_ms": wall_ms,
    }  # fmt: skip
    if any(label.track_id != UNTRACKED for label in found):
        tracks = track_score(found, clip.truth)
        figures |= {"switches": tracks.switches, "idf1": tracks.idf1, "mota": tracks.mota}
    return _Result(right=score.right, shown=score.shown, figures=figures, cpu_ms=cpu_ms)


def _point(method: str, results: Sequence[_Result], clips: Sequence[KeypointClip]) -> ChartPoint:
    sizes, spent = [len(clip) for clip in clips], [result.cpu_ms for result in results]
    rng = np.random.default_rng(0)
    draws = [rng.integers(0, len(results), len(results)) for _ in range(_DRAWS)]
    wrong = [_wrong([results[n] for n in draw]) for draw in draws]
    figures = {
        clip.name: {key: _rounded(value) for key, value in result.figures.items()}
        for clip, result in zip(clips, results, strict=True)
    }
    return ChartPoint(
        method=method, settings=figures, reference=method in ("first look kept", "exact"),
        ms_per_frame=Cost(
            median=float(np.average(spent, weights=sizes)), p95=float(np.max(spent)), runs=len(clips),
            over="clips",
        ),
        error=Error(
            metric="visible points not within 0.1 of the box diagonal", unit="%", median=_wrong(results),
            p95=float(np.nanpercentile(wrong, 95)),
        ),
    )  # fmt: skip


def _wrong(results: Sequence[_Result]) -> float:
    shown = sum(result.shown for result in results)
    return 100 * (1 - sum(result.right for result in results) / shown) if shown else float("nan")


def _rounded(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
