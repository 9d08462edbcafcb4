"""From what the judge reads in a video to figures against the street's exact truth. Pure.

The judge's keypoints of a car are the four corners of its box. A car is asked for from the first frame on, for as long
as the truth shows it well enough; one that is not found (IoU below 0.3) counts with the cap.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from labeling.boxes import best_pairs
from training.criteria import MATCH_IOU
from training.evaluation import trajectory_scores
from training.study_judge import Reading

CAP_PX = 12.0
"""The most that one car in one frame can count, pixels of the study's picture."""
LABEL_SCALE = 2.0
"""Boxes are in pixels of twice the picture."""
FIGURES: dict[str, tuple[str, bool]] = {
    "keypoint_error": ("px", False), "track_survival": ("share of the clip", True), "min_ade": ("m", False),
    "apd": ("m", True),
}  # fmt: skip
"""Unit of each figure, and whether more is better. APD is spread: more is richer, not nearer to the truth."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrueTrack:
    """One car over the judged frames."""

    boxes_xyxy: np.ndarray
    """(n, 4) float, pixels of twice the picture."""
    asked: np.ndarray
    """(n,) bool: shown well enough, from the first frame on without a gap."""


def true_tracks(frames: Sequence[Mapping[int, tuple[np.ndarray, bool]]]) -> list[TrueTrack]:
    """The cars that the first frame shows, followed until the truth shows them badly.

    Args:
        frames: by track id, the box (4,) and whether it is shown well enough, for every judged frame.
    """
    tracks = []
    for track, (_, first) in sorted(frames[0].items()):
        if not first:
            continue
        boxes, asked = np.zeros((len(frames), 4)), np.zeros(len(frames), bool)
        for number, frame in enumerate(frames):
            box, shown = frame.get(track, (np.zeros(4), False))
            if not shown:
                break
            boxes[number], asked[number] = box, True
        tracks.append(TrueTrack(boxes_xyxy=boxes, asked=asked))
    return tracks


def track_scores(found: Sequence[np.ndarray], tracks: Sequence[TrueTrack]) -> dict[str, float]:
    """``keypoint_error`` in pixels, ``track_survival`` and ``recall`` of one video; empty without a car to ask for.

    The first frame is given to every arm and is not judged.
    """
    errors, hits = np.full((len(tracks), len(found)), np.nan), np.zeros((len(tracks), len(found)), bool)
    for number, boxes in enumerate(found):
        wanted = [row for row, track in enumerate(tracks) if track.asked[number]]
        for row in wanted:
            errors[row, number] = CAP_PX
        truth = np.array([tracks[row].boxes_xyxy[number] for row in wanted]).reshape(-1, 4)
        for row, error in _matched(truth, np.asarray(boxes, np.float64).reshape(-1, 4)):
            errors[wanted[row], number], hits[wanted[row], number] = min(error, CAP_PX), True
    asked = np.isfinite(errors)
    asked[:, 0] = False
    if not asked.any():
        return {}
    survivals = []
    for row in range(len(tracks)):
        wanted = asked[row]
        if wanted.any():
            alive = np.cumprod(hits[row, wanted])
            survivals.append(float(alive.mean()))
    return {
        "keypoint_error": float(errors[asked].mean()), "track_survival": float(np.mean(survivals)),
        "recall": float(hits[asked].mean()),
    }  # fmt: skip


def _matched(truth: np.ndarray, found: np.ndarray) -> list[tuple[int, float]]:
    """Rows of the truth that were found, each with the mean distance of the corners, pixels of the picture."""
    return [
        (row, corner_distance(truth[row], found[column]) / LABEL_SCALE)
        for row, column, _ in best_pairs(truth, found, least_iou=MATCH_IOU)
    ]


def corner_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Mean distance of the four corners of two boxes (4,)."""
    step = np.abs(first - second)
    return float(np.mean([np.hypot(step[x], step[y]) for x in (0, 2) for y in (1, 3)]))


def clip_scores(readings: Sequence[Reading], tracks: Sequence[TrueTrack], truth_path: np.ndarray) -> dict[str, float]:
    """Figures of one clip: means over its samples, and what the samples' trajectories are together.

    Args:
        readings: one per sample.
        tracks: the cars to ask for.
        truth_path: (P, 4, 4) at the poses that were read.
    """
    rows = [track_scores(reading.boxes, tracks) for reading in readings]
    scores = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    together = trajectory_scores([reading.cam_to_world for reading in readings], truth_path)
    scores |= {"min_ade": together["min_ade_m"], "ade": together["ade_m"]}
    return scores | ({"apd": together["apd_m"]} if "apd_m" in together else {})
