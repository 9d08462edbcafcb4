"""From clips' scores to the figures of whole sets of samples: means with intervals, differences, and coverage. Pure."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from training.criteria import PCK_SHARE
from training.evaluation import PARTS, ClipScore, Part, SampleEstimate
from training.evaluation_files import video_rate
from training.metrics import Interval, mean_interval, paired_interval

SAMPLES, TRUE_SKELETONS = "samples", "true skeletons"
FLOOR, VELOCITY, HELD = "truth video", "constant velocity", "first frame"
"""The sets of a report: what is judged, the same painted over true skeletons, the noise floor, and two baselines."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """One figure that samples are judged by."""

    name: str
    label: str
    """What a person reads; ``{k}`` stands for the samples of a clip."""
    unit: str
    better: Literal["lower", "higher", "neither"]
    part: Part
    """What has to be estimated for it."""
    digits: int = 2


_PCK = f"PCK@{PCK_SHARE:g}"

FIGURES = (
    Figure(name="min_ade_m", label="minADE{k}", unit="m", better="lower", part="ego"),
    Figure(name="ade_m", label="ADE, mean of samples", unit="m", better="lower", part="ego"),
    Figure(name="apd_m", label="APD{k}", unit="m", better="neither", part="ego"),
    Figure(name="ate_m", label="ego control: ATE, unaligned", unit="m", better="lower", part="ego"),
    Figure(name="ate_se3_m", label="ego control: ATE, SE(3)", unit="m", better="lower", part="ego"),
    Figure(name="ate_sim3_m", label="ego control: ATE, Sim(3)", unit="m", better="lower", part="ego"),
    Figure(name="rpe_m", label="ego control: RPE over 1 s", unit="m", better="lower", part="ego"),
    Figure(name="rpe_deg", label="ego control: RPE over 1 s", unit="deg", better="lower", part="ego"),
    Figure(name="drift_share", label="ego control: drift", unit="of the path", better="lower", part="ego", digits=3),
    Figure(name="box_iou", label="object control: box IoU, a miss is 0", unit="", better="higher", part="labels"),
    Figure(name="box_recall", label="object control: boxes found", unit="", better="higher", part="labels"),
    Figure(name="truth_pck", label="points: RGB against truth", unit=_PCK, better="higher", part="labels"),
    Figure(name="truth_recall", label="objects: RGB against truth", unit="found", better="higher", part="labels"),
    Figure(name="motion_pck", label="points: skeletons against truth", unit=_PCK, better="higher", part="skeleton"),
    Figure(name="skeleton_pck", label="points: RGB against skeletons", unit=_PCK, better="higher", part="skeleton"),
    Figure(
        name="skeleton_recall", label="objects: RGB against skeletons", unit="found", better="higher", part="skeleton"
    ),
    Figure(name="psnr_db", label="PSNR", unit="dB", better="higher", part="picture"),
    Figure(name="ssim", label="SSIM", unit="", better="higher", part="picture", digits=3),
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class SetOutcome:
    """One clip in one set: its score, and what could not be estimated."""

    score: ClipScore
    estimated: Mapping[str, int]
    """How many samples have each part."""
    faults: tuple[tuple[str, str, str], ...]
    """(sample, part, reason)."""
    geometries: tuple[str, ...]
    """Frame rate, size and length of each readable sample, in words."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipResult:
    """One clip in all sets."""

    key: str
    video_id: str
    split: str
    sets: Mapping[str, SetOutcome]


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """How many samples gave a part, and why the others did not."""

    estimated: int
    of: int
    reasons: Mapping[str, int]
    """How often each; alike ones stand under the first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SetSummary:
    """One set over all clips."""

    figures: Mapping[str, Interval]
    """By figure; those that no clip has are left out."""
    clips: Mapping[str, int]
    """Clips that each figure rests on."""
    samples: int
    samples_per_clip: tuple[int, int]
    """Least and most."""
    seconds: tuple[float, float]
    """Least and most of the compared durations."""
    points: tuple[int, int]
    """Least and most trajectory points; APD grows with their root."""
    coverage: Mapping[str, Coverage]
    """By part."""
    geometries: Mapping[str, int]
    """Samples of each frame rate, size and length."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """What ``animatic evaluate`` found."""

    sets: Mapping[str, SetSummary]
    differences: Mapping[str, Mapping[str, Interval]]
    """The judged samples less another set, clip by clip: by that set, then by figure."""
    clips: int
    videos: int

    def as_json(self) -> dict[str, Any]:
        """Plain values; intervals are of 95 %, over source videos."""
        return asdict(self)


def outcome(score: ClipScore, samples: Sequence[SampleEstimate]) -> SetOutcome:
    """What becomes of one clip's samples in one set."""
    has = {
        "video": [one.readable for one in samples], "ego": [one.cam_to_world is not None for one in samples],
        "labels": [one.labels is not None for one in samples],
        "skeleton": [one.skeletons is not None for one in samples],
        "picture": [one.psnr_db is not None for one in samples],
    }  # fmt: skip
    faults = tuple((one.name, part, one.faults[part]) for one in samples for part in PARTS if part in one.faults)
    return SetOutcome(
        score=score, estimated={part: sum(found) for part, found in has.items()}, faults=faults,
        geometries=tuple(geometry(one) for one in samples if one.readable),
    )  # fmt: skip


def geometry(sample: SampleEstimate) -> str:
    """A sample's frame rate, size and length in words."""
    rate = f"{video_rate(sample.times_s):.3f}".rstrip("0").rstrip(".")
    return f"{sample.width}x{sample.height} at {rate} fps, {len(sample.times_s)} frames"


def build_report(results: Sequence[ClipResult]) -> Report:
    """Figures of every set over the clips.

    Args:
        results: at least one.
    """
    names = dict.fromkeys(name for result in results for name in result.sets)
    sets = {name: _summary([result.sets[name] for result in results if name in result.sets]) for name in names}
    videos = {result.key: result.video_id for result in results}
    differences = {name: _differences(results, name, videos) for name in names if name != SAMPLES and SAMPLES in names}
    return Report(sets=sets, differences=differences, clips=len(results), videos=len(set(videos.values())))


def _summary(outcomes: Sequence[SetOutcome]) -> SetSummary:
    scores = [one.score for one in outcomes]
    figures, clips = {}, {}
    for figure in FIGURES:
        having = [score for score in scores if figure.name in score.values]
        if having:
            values = [score.values[figure.name] for score in having]
            figures[figure.name] = mean_interval(values, [score.video_id for score in having])
            clips[figure.name] = len(having)
    there = [score for score in scores if score.of]
    return SetSummary(
        figures=figures, clips=clips, samples=sum(score.of for score in scores),
        samples_per_clip=_range([score.of for score in there]), seconds=_range([score.seconds for score in there]),
        points=_range([score.points for score in there]), coverage=_coverage(outcomes),
        geometries=dict(Counter(words for one in outcomes for words in one.geometries).most_common()),
    )  # fmt: skip


def _coverage(outcomes: Sequence[SetOutcome]) -> dict[str, Coverage]:
    """By part; a part that was never tried (no skeleton videos, no extractors) is left out."""
    of = sum(one.score.of for one in outcomes)
    found = {}
    for part in PARTS:
        estimated = sum(one.estimated[part] for one in outcomes)
        reasons = _counted([reason for one in outcomes for _, where, reason in one.faults if where == part])
        if estimated or reasons:
            found[part] = Coverage(estimated=estimated, of=of, reasons=reasons)
    return found


def _differences(results: Sequence[ClipResult], name: str, videos: Mapping[str, str]) -> dict[str, Interval]:
    """Samples less another set, paired by clip."""
    differences = {}
    for figure in FIGURES:
        ours, theirs = (
            {
                result.key: result.sets[which].score.values[figure.name]
                for result in results
                if which in result.sets and figure.name in result.sets[which].score.values
            }
            for which in (SAMPLES, name)
        )
        if set(ours) & set(theirs):
            differences[figure.name] = paired_interval(theirs, ours, videos)
    return differences


def _counted(reasons: Sequence[str]) -> dict[str, int]:
    """How often each reason occurs; those that differ in numbers and file names only are counted as the first."""
    first: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for reason in reasons:
        kind = re.sub(r"\d+(\.\d+)?", "#", re.sub(r"^\S+\.(mp4|tum): ", "", reason))
        counts[first.setdefault(kind, reason)] += 1
    return dict(counts.most_common())


def _range(values: Sequence[Any]) -> tuple[Any, Any]:
    return (min(values), max(values)) if values else (0, 0)


def result_from_json(values: Mapping[str, Any]) -> ClipResult:
    """A clip's result from the plain values that ``dataclasses.asdict`` made of it."""
    sets = {
        name: SetOutcome(
            score=ClipScore(**one["score"]), estimated=one["estimated"],
            faults=tuple((str(a), str(b), str(c)) for a, b, c in one["faults"]), geometries=tuple(one["geometries"]),
        )
        for name, one in values["sets"].items()
    }  # fmt: skip
    return ClipResult(key=values["key"], video_id=values["video_id"], split=values["split"], sets=sets)


def finite_or_none(values: Any) -> Any:
    """Nested plain values with None for what is no number: JSON knows no NaN."""
    if isinstance(values, Mapping):
        return {name: finite_or_none(value) for name, value in values.items()}
    if isinstance(values, list | tuple):
        return [finite_or_none(value) for value in values]
    return None if isinstance(values, float) and not np.isfinite(values) else values
