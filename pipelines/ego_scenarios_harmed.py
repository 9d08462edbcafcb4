"""Scenarios of ``animatic stability ego`` in which pictures are harmed: traffic, night, rain, overlays, compression."""

from dataclasses import replace

import numpy as np

from dataset.conditions import compress_frames
from pipelines.ego_clips import highway_clip, rolling_clip, street_clip
from pipelines.ego_errors import path_m, typical_turn_deg, worst_turn_deg, yaw_deg
from pipelines.ego_harm import in_condition, with_movers
from pipelines.ego_methods import EgoClip, default_and_stock, default_motion, stock_opencv
from pipelines.ego_scenarios import mode_share
from pipelines.stability import StabilityRow, judged


def movers(name: str) -> list[StabilityRow]:
    """Boards that move by themselves carry a share of the tracks."""
    clip = highway_clip()
    clean = typical_turn_deg(default_motion(clip).trajectory.cam_to_world, clip.truth)
    stock_clean = typical_turn_deg(stock_opencv(clip), clip.truth)
    rows = []
    for share in (20, 40, 60, 70):
        busy = with_movers(clip, share / 100)
        motion = default_motion(busy)
        label = f"{name}, {share} %"
        if share < 50:
            ratio = typical_turn_deg(motion.trajectory.cam_to_world, clip.truth) / clean
            rows.append(judged(label, ratio, unit="times clean", at_most=2.0))
            stock = typical_turn_deg(stock_opencv(busy), clip.truth) / stock_clean
            rows.append(_stock_row(label, stock, unit="times clean", at_most=2.0))
        else:
            rows.append(judged(label, float(np.median(motion.confidence)), unit="confidence", at_most=0.5))
    return rows


def night(name: str) -> list[StabilityRow]:
    """Gain 0.15, noise, lamps."""
    clip = highway_clip()
    return _against_clean(name, clip, in_condition(clip, "night"), times=3.0, least_confidence=0.5)


def rain(name: str) -> list[StabilityRow]:
    """Streaks of rain; a wiper each second."""
    clip = highway_clip()
    return [
        judged(
            f"{name}, {condition}",
            worst_turn_deg(poses, clip.truth),
            unit="deg a frame, worst",
            at_most=0.5,
            method=method,
        )
        for condition in ("rain", "wiper")
        for method, poses in default_and_stock(in_condition(clip, condition))
    ]


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
    """Frames in the middle that show nothing."""
    clip = highway_clip()
    rows = []
    for label, picture in (("black", np.zeros_like(clip.frames[0])), ("sky", np.full_like(clip.frames[0], 190))):
        frames = [picture if 50 <= index < 70 else frame for index, frame in enumerate(clip.frames)]
        motion = default_motion(replace(clip, frames=frames))
        blind = slice(51, 70)
        speed = np.linalg.norm(np.diff(motion.trajectory.positions, axis=0), axis=1)
        held = 100 * abs(float(np.median(speed[51:69]) / np.median(speed[30:49])) - 1)
        rows.append(judged(f"{name}, {label}", float(motion.confidence[blind].max()), unit="confidence", at_most=0.1))
        rows.append(judged(f"{name}, {label}", held, unit="% from the last speed", at_most=20.0))
        finite = float(np.isfinite(motion.trajectory.cam_to_world).all())
        rows.append(judged(f"{name}, {label}", finite, unit="all finite", at_least=1.0))
    return rows


def compressed(name: str) -> list[StabilityRow]:
    """Compression, and brightness that changes."""
    clip = highway_clip()
    squeezed = replace(clip, frames=list(compress_frames(iter(clip.frames), crf=40)))
    return [
        *_against_clean(f"{name}, crf 40", clip, squeezed, times=1.5),
        *_against_clean(f"{name}, ramp", clip, in_condition(clip, "brightness_ramp"), times=1.5),
    ]


def _against_clean(
    name: str, clip: EgoClip, harmed: EgoClip, *, times: float, least_confidence: float | None = None
) -> list[StabilityRow]:
    """The typical rotation error over that of the clean clip; low confidence excuses where the scenario says so."""
    motion = default_motion(harmed)
    clean = typical_turn_deg(default_motion(clip).trajectory.cam_to_world, clip.truth)
    ratio = typical_turn_deg(motion.trajectory.cam_to_world, clip.truth) / clean
    row = judged(name, ratio, unit="times clean", at_most=times)
    confidence = float(np.median(motion.confidence))
    note = f"confidence {confidence:.2f}"
    if row.verdict == "not held" and least_confidence is not None and confidence < least_confidence:
        row = replace(row, verdict="held", note=f"{note}: it says so")
    else:
        row = replace(row, note=note)
    stock = typical_turn_deg(stock_opencv(harmed), clip.truth) / typical_turn_deg(stock_opencv(clip), clip.truth)
    return [row, _stock_row(name, stock, unit="times clean", at_most=times)]


def _stock_row(scenario: str, figure: float, *, unit: str, at_most: float) -> StabilityRow:
    return judged(scenario, figure, unit=unit, at_most=at_most, method="stock OpenCV")
