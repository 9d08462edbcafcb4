"""Scenarios of ``animatic stability ego`` in which pictures are harmed: traffic, night, rain, overlays, compression."""

from dataclasses import replace
from functools import cache

import numpy as np

from dataset.conditions import Condition, compress_frames
from pipelines.ego_clips import highway_clip, kitti_part, rolling_clip, street_clip
from pipelines.ego_errors import path_m, typical_turn_deg, worst_turn_deg, yaw_deg
from pipelines.ego_harm import in_condition, with_movers
from pipelines.ego_methods import STOCK, EgoClip, default_and_stock, default_motion, stock_opencv
from pipelines.ego_scenarios import mode_share
from pipelines.stability import StabilityRow, judged


def movers(name: str) -> list[StabilityRow]:
    """Boards that move by themselves carry a share of the tracks."""
    clip = highway_clip()
    rows = []
    for share in (20, 40, 60, 70):
        busy, label = with_movers(clip, share / 100), f"{name}, {share} %"
        if share < 50:
            rows += _against_clean(label, clip, busy, times=2.0)
        else:
            confidence = float(np.median(default_motion(busy).confidence))
            rows.append(judged(label, confidence, unit="confidence", at_most=0.5))
    return rows


def night(name: str) -> list[StabilityRow]:
    """Gain 0.15, noise, lamps."""
    return [
        row
        for clip in _clips()
        for row in _against_clean(
            f"{name}, {clip.name}", clip, in_condition(clip, "night"), times=3.0, least_confidence=0.5
        )
    ]


def rain(name: str) -> list[StabilityRow]:
    """Streaks of rain; a wiper each second."""
    conditions: tuple[Condition, ...] = ("rain", "wiper")
    return [
        judged(
            f"{name}, {condition}, {clip.name}", worst_turn_deg(poses, clip.truth), unit="deg a frame, worst",
            at_most=0.5, method=method,
        )
        for condition in conditions
        for clip in _clips()
        for method, poses in default_and_stock(in_condition(clip, condition))
    ]  # fmt: skip


def rolling(name: str) -> list[StabilityRow]:
    """A shutter that takes 30 ms from top to bottom."""
    clip = rolling_clip()
    true = yaw_deg(clip.truth)[-1]
    return [
        judged(name, 100 * abs(yaw_deg(poses)[-1] / true - 1), unit="% of yaw rate", at_most=3.0, method=method)
        for method, poses in default_and_stock(clip)
    ]


def overlay(name: str) -> list[StabilityRow]:
    """15 % of the picture rests."""
    clip = street_clip("empty", frames=96)
    rows = []
    for condition in ("bonnet", "overlay"):
        motion = default_motion(in_condition(clip, condition))
        label = f"{name}, {condition}"
        rows.append(judged(label, mode_share(motion, "still"), unit="share still", at_most=0.0))
        off = 100 * abs(motion.trajectory.path_length_m / path_m(clip.truth) - 1)
        rows.append(judged(label, off, unit="% of length", at_most=5.0))
    return rows


def nothing(name: str) -> list[StabilityRow]:
    """Twenty frames in the middle that show nothing."""
    return [
        row
        for clip in _clips()
        for label, level in (("black", 0), ("sky", 190))
        for row in _blinded(f"{name}, {label}, {clip.name}", clip, level)
    ]


def _blinded(label: str, clip: EgoClip, level: int) -> list[StabilityRow]:
    blank = np.full_like(clip.frames[0], level)
    frames = [blank if 50 <= index < 70 else frame for index, frame in enumerate(clip.frames)]
    motion = default_motion(replace(clip, frames=frames))
    speed = np.linalg.norm(np.diff(motion.trajectory.positions, axis=0), axis=1)
    # A car goes on as it pleases while nothing is seen: between the speeds before and after lies what can be held.
    around = np.sqrt(np.median(speed[40:49]) * np.median(speed[71:80]))
    held = 100 * abs(float(np.median(speed[51:69]) / around) - 1)
    finite = float(np.isfinite(motion.trajectory.cam_to_world).all())
    return [
        judged(label, float(motion.confidence[51:70].max()), unit="confidence", at_most=0.1),
        judged(label, held, unit="% from the speeds around", at_most=20.0),
        judged(label, finite, unit="all finite", at_least=1.0),
    ]


def compressed(name: str) -> list[StabilityRow]:
    """Compression, and brightness that changes."""
    rows = []
    for clip in _clips():
        squeezed = replace(clip, frames=list(compress_frames(iter(clip.frames), crf=40)))
        ramp = in_condition(clip, "brightness_ramp")
        rows += _against_clean(f"{name}, crf 40, {clip.name}", clip, squeezed, times=1.5)
        rows += _against_clean(f"{name}, ramp, {clip.name}", clip, ramp, times=1.5)
    return rows


def _clips() -> list[EgoClip]:
    """A street drive, and a real one where it is there."""
    real = kitti_part()
    return [highway_clip(), *([real] if real else [])]


@cache
def _clean_turns(clip: EgoClip) -> tuple[float, float]:
    """Typical rotation errors of the default and of stock OpenCV on an unharmed clip, degrees a frame."""
    default, stock = (typical_turn_deg(poses, clip.truth) for _, poses in default_and_stock(clip))
    return default, stock


def _against_clean(
    name: str, clip: EgoClip, harmed: EgoClip, *, times: float, least_confidence: float | None = None
) -> list[StabilityRow]:
    """The typical rotation error over that of the clean clip; low confidence excuses where the scenario says so."""
    motion = default_motion(harmed)
    clean, stock_clean = _clean_turns(clip)
    error, stock = (
        typical_turn_deg(poses, clip.truth) for poses in (motion.trajectory.cam_to_world, stock_opencv(harmed))
    )
    confidence = float(np.median(motion.confidence))
    note = f"{error:.3f} deg a frame against {clean:.3f}, confidence {confidence:.2f}"
    row = judged(name, error / clean, unit="times clean", at_most=times, note=note)
    if row.verdict == "not held" and least_confidence is not None and confidence < least_confidence:
        row = replace(row, verdict="held", note=f"{note}: it says so")
    stock_note = f"{stock:.3f} deg a frame against {stock_clean:.3f}"
    return [row, _stock_row(name, stock / stock_clean, unit="times clean", at_most=times, note=stock_note)]


def _stock_row(scenario: str, figure: float, *, unit: str, at_most: float, note: str = "") -> StabilityRow:
    return judged(scenario, figure, unit=unit, at_most=at_most, method=STOCK, note=note)
