"""Scores of generated clips: records of what was estimated in, figures out. Pure, without a file or a network.

A clip's truth stays on the job's 24 fps grid and in the job's picture. A sample keeps its own times and size: the truth
is brought to it (nearest frame, scaled to cover and centre-cropped), its trajectory is brought to the truth's times by
interpolation, and both are compared on the duration that the truth and all samples of the clip have in common.
What could not be estimated is a fault with its reason: counted, and never a number.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from labeling.camera import cover_map, rebased_trajectory, resample
from labeling.labels import Keypoints
from training.label_agreement import box_agreement, mapped_labels, point_agreement
from training.metrics import ade_m, apd_m, ate_m, drift_share, min_ade_m, rpe

Part = Literal["video", "ego", "labels", "skeleton", "picture"]
"""What is estimated of a sample; each may fail alone, and all fail with the video."""
PARTS: tuple[Part, ...] = ("video", "ego", "labels", "skeleton", "picture")

LEAST_HEIGHT_SHARE = 0.03
"""Wanted objects lower than this share of the picture's height are not asked for: no extractor finds them."""
_LEAST_SECONDS = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClipTruth:
    """What a clip of the job is known to show, and what its samples were conditioned on."""

    key: str
    video_id: str
    """Clips of one video are alike: intervals draw whole videos."""
    split: str = "val"
    times_s: np.ndarray
    """(T,) float64 from 0, the 24 fps grid."""
    cam_to_world: np.ndarray
    """(T, 4, 4) float64, the first one the identity."""
    ego_condition: np.ndarray | None = None
    """(T, 4, 4): the trajectory that was asked for; None stands for the clip's own."""
    labels: tuple[Keypoints, ...] = ()
    """Of all frames, in pixels of ``width`` x ``height``."""
    box_tracks: frozenset[int] = frozenset()
    """Tracks whose boxes the samples were conditioned on."""
    width: int
    height: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampleEstimate:
    """What the estimators found in one generated video; a part that is None is absent or has a fault."""

    name: str
    """The file's stem."""
    times_s: np.ndarray
    """(n,) float64 from 0, its own frame rate."""
    width: int
    height: int
    cam_to_world: np.ndarray | None = None
    """(n, 4, 4), the first one the identity."""
    labels: tuple[Keypoints, ...] | None = None
    """Of all frames, in pixels of ``width`` x ``height``."""
    skeletons: tuple[Keypoints, ...] | None = None
    """Cars that the sample's skeleton video shows, in the same pixels, in the frames of ``skeleton_frames``."""
    skeleton_frames: tuple[int, ...] = ()
    psnr_db: np.ndarray | None = None
    """(n,) against the truth at the same time; NaN after its end, and where they were not compared."""
    ssim: np.ndarray | None = None
    faults: Mapping[str, str] = field(default_factory=dict)
    """Reason by part."""

    @property
    def seconds(self) -> float:
        """From its first to its last frame."""
        return float(self.times_s[-1]) if len(self.times_s) else 0.0

    @property
    def readable(self) -> bool:
        """Whether there is a video at all."""
        return "video" not in self.faults


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipScore:
    """The figures of one clip's samples in one set."""

    key: str
    video_id: str
    values: Mapping[str, float]
    """By figure; means over the samples that have it, but for minADE and APD."""
    samples: Mapping[str, int]
    """How many samples each figure rests on."""
    of: int
    """Samples in the set, readable or not."""
    seconds: float
    """The duration that was compared."""
    points: int
    """Trajectory points in it; APD grows with their root."""


def score_clip(
    truth: ClipTruth, sets: Mapping[str, Sequence[SampleEstimate]], *, seconds: float | None = None,
    floor: str | None = None,
) -> dict[str, ClipScore]:  # fmt: skip
    """Figures of each set of samples of one clip, all on the duration that they have in common.

    Args:
        truth: the clip.
        sets: samples by the set's name (what is judged, its noise floor, baselines).
        seconds: compare no more than this.
        floor: the set that looks at the truth's own video; its APD is that of its one trajectory and the truth.

    Returns:
        By set. A set without samples has a score without values.
    """
    end_s = common_seconds(truth, [one for samples in sets.values() for one in samples], seconds=seconds)
    grid = truth.times_s[truth.times_s <= end_s + 1e-6]
    return {name: _score_set(truth, samples, grid, is_floor=name == floor) for name, samples in sets.items()}


def common_seconds(truth: ClipTruth, samples: Sequence[SampleEstimate], *, seconds: float | None = None) -> float:
    """The duration that the truth and all readable samples share, and no more than ``seconds``."""
    ends = [float(truth.times_s[-1]), *(sample.seconds for sample in samples if sample.readable)]
    return min(ends if seconds is None else [*ends, seconds])


def too_short(samples: Sequence[SampleEstimate], *, share: float = 0.5) -> dict[str, str]:
    """Samples that a broken-off run left behind, by name, with the reason: shorter than ``share`` of the median.

    They are faults, so that one of them does not cut all others down to its duration.
    """
    lengths = [sample.seconds for sample in samples if sample.readable]
    least = max(_LEAST_SECONDS, share * float(np.median(lengths))) if lengths else 0.0
    return {
        sample.name: f"too short: {sample.seconds:.2f} s, at least {least:.2f} s are needed"
        for sample in samples
        if sample.readable and sample.seconds < least
    }


def with_fault(sample: SampleEstimate, part: Part, reason: str) -> SampleEstimate:
    """The sample with a part that failed; with its video, all of it."""
    faults = {**sample.faults, part: reason}
    if part == "video":
        return replace(sample, faults=faults, cam_to_world=None, labels=None, skeletons=None, psnr_db=None, ssim=None)
    gone = {"ego": ["cam_to_world"], "labels": ["labels"], "skeleton": ["skeletons"], "picture": ["psnr_db", "ssim"]}
    return replace(sample, faults=faults, **dict.fromkeys(gone[part]))


def trajectory_scores(samples: Sequence[np.ndarray], truth: np.ndarray) -> dict[str, float]:
    """``min_ade_m`` and ``ade_m`` of samples (T, 4, 4) against the truth, and ``apd_m`` where there are two or more.

    Raises:
        DataError: no sample, or lengths that differ.
    """
    scores = {"min_ade_m": min_ade_m(samples, truth)}
    scores["ade_m"] = float(np.mean([ade_m(sample, truth, alignment="none") for sample in samples]))
    if len(samples) > 1:
        scores["apd_m"] = apd_m(samples)
    return scores


def control_scores(sample: np.ndarray, asked: np.ndarray) -> dict[str, float]:
    """How far a trajectory (T, 4, 4) is from the one that was asked for; ``rpe`` is over a second, or all of it.

    Raises:
        DataError: lengths that differ, or a single pose.
    """
    scores = {
        "ate_m": ate_m(sample, asked, alignment="none"), "ate_se3_m": ate_m(sample, asked, alignment="se3"),
        "ate_sim3_m": ate_m(sample, asked, alignment="sim3"),
    }  # fmt: skip
    scores["rpe_m"], scores["rpe_deg"] = rpe(sample, asked, frames=min(24, len(asked) - 1))
    drift = drift_share(sample, asked)
    return scores if np.isnan(drift) else scores | {"drift_share": drift}


def label_scores(truth: ClipTruth, sample: SampleEstimate, *, end_s: float) -> dict[str, float]:
    """Boxes against those conditioned on; keypoints of RGB, skeleton video and truth against one another.

    Figures for which the truth, or the skeleton video, shows nothing are left out.

    Raises:
        DataError: the sides know objects by different points.
    """
    wanted = truth_at(truth, sample, end_s=end_s)
    scores: dict[str, float] = {}
    if sample.labels is not None:
        found = _until(sample.labels, sample, end_s)
        boxes = box_agreement(found, [one for one in wanted if one.track_id in truth.box_tracks])
        points = point_agreement(found, wanted)
        scores |= {"box_iou": boxes.mean_iou, "box_recall": boxes.recall}
        scores |= {"truth_pck": points.pck, "truth_recall": points.recall}
    if sample.skeletons is not None:
        drawn = _until(sample.skeletons, sample, end_s)
        looked = frozenset(sample.skeleton_frames)
        cars = [one for one in wanted if one.category == "car" and one.frame in looked]
        scores["motion_pck"] = point_agreement(drawn, cars).pck
        if sample.labels is not None:
            seen = [one for one in _until(sample.labels, sample, end_s) if one.category == "car"]
            own = point_agreement([one for one in seen if one.frame in looked], drawn)
            scores |= {"skeleton_pck": own.pck, "skeleton_recall": own.recall}
    return {name: value for name, value in scores.items() if np.isfinite(value)}


def picture_scores(sample: SampleEstimate, *, end_s: float) -> dict[str, float]:
    """``psnr_db`` and ``ssim``, means over the frames that were compared and that the truth has too."""
    inside = sample.times_s <= end_s + 1e-6
    scores = {}
    for name, values in (("psnr_db", sample.psnr_db), ("ssim", sample.ssim)):
        if values is not None and np.isfinite(values[inside]).any():
            scores[name] = float(np.nanmean(values[inside]))
    return scores


def truth_at(truth: ClipTruth, sample: SampleEstimate, *, end_s: float) -> list[Keypoints]:
    """The truth's labels at the frames of a sample, in its picture; objects too low to be found are left out."""
    picture = cover_map(truth.width, truth.height, width=sample.width, height=sample.height)
    by_frame: dict[int, list[Keypoints]] = {}
    for label in truth.labels:
        by_frame.setdefault(label.frame, []).append(label)
    labels = []
    for frame, index in enumerate(nearest_frames(truth.times_s, sample.times_s)):
        if sample.times_s[frame] <= end_s + 1e-6:
            here = mapped_labels(by_frame.get(int(index), []), picture)
            labels += [replace(one, frame=frame) for one in here if _is_high(one, sample.height)]
    return labels


def nearest_frames(truth_times_s: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """(n,) int: the truth's frame that is shown nearest to each time; ties go to the earlier."""
    right = np.clip(np.searchsorted(truth_times_s, times_s), 1, max(1, len(truth_times_s) - 1))
    right = np.minimum(right, len(truth_times_s) - 1)
    left = np.maximum(right - 1, 0)
    nearer = times_s - truth_times_s[left] <= truth_times_s[right] - times_s + 1e-9
    return np.where(nearer, left, right)


def poses_at(times_s: np.ndarray, cam_to_world: np.ndarray, grid_s: np.ndarray) -> np.ndarray:
    """(len(grid_s), 4, 4): a trajectory interpolated at other times, which lie inside its own."""
    if len(times_s) == len(grid_s) and np.allclose(times_s, grid_s, atol=1e-6):
        return cam_to_world
    inside = np.clip(grid_s, times_s[0], times_s[-1])
    return resample(rebased_trajectory(times_s, cam_to_world), inside).cam_to_world


def _score_set(truth: ClipTruth, samples: Sequence[SampleEstimate], grid: np.ndarray, *, is_floor: bool) -> ClipScore:
    end_s = float(grid[-1])
    asked = truth.cam_to_world if truth.ego_condition is None else truth.ego_condition
    rows: list[dict[str, float]] = []
    paths = []
    for sample in samples:
        row = picture_scores(sample, end_s=end_s) | label_scores(truth, sample, end_s=end_s)
        if sample.cam_to_world is not None and len(grid) > 1:
            paths.append(poses_at(sample.times_s, sample.cam_to_world, grid))
            row |= control_scores(paths[-1], asked[: len(grid)])
        rows.append(row)
    values, counts = _means(rows)
    if paths:
        true = truth.cam_to_world[: len(grid)]
        together = trajectory_scores(paths, true)
        if is_floor:
            together["apd_m"] = apd_m([paths[0], true])
        values |= together
        counts |= dict.fromkeys(together, len(paths))
    return ClipScore(
        key=truth.key, video_id=truth.video_id, values=values, samples=counts, of=len(samples), seconds=end_s,
        points=len(grid),
    )  # fmt: skip


def _means(rows: Sequence[Mapping[str, float]]) -> tuple[dict[str, float], dict[str, int]]:
    names = dict.fromkeys(name for row in rows for name in row)
    values = {name: [row[name] for row in rows if name in row] for name in names}
    return {name: float(np.mean(these)) for name, these in values.items()}, {n: len(v) for n, v in values.items()}


def _until(labels: Sequence[Keypoints], sample: SampleEstimate, end_s: float) -> list[Keypoints]:
    return [label for label in labels if sample.times_s[label.frame] <= end_s + 1e-6]


def _is_high(label: Keypoints, height: int) -> bool:
    return bool(label.box_xyxy[3] - label.box_xyxy[1] >= LEAST_HEIGHT_SHARE * height)
