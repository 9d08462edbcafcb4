"""Scenarios of ``animatic stability ego`` that differ in how the camera moves, and in what is assumed of it."""

from dataclasses import replace

import numpy as np

from labeling.ego_calibration import calibrate_camera
from labeling.ego_motion import EgoMotion, solve_run
from labeling.ego_tracks import track_run
from pipelines.ego_clips import highway_clip, street_clip
from pipelines.ego_errors import (
    direction_errors_deg,
    end_yaw_error_deg,
    farthest_m,
    longest_step_m,
    most_yaw_deg,
    path_m,
    worst_turn_deg,
    yaw_deg,
)
from pipelines.ego_harm import noisy
from pipelines.ego_methods import STOCK, UNCALIBRATED, default_and_stock, default_motion, stock_opencv
from pipelines.stability import StabilityRow, judged


def still_noise(name: str) -> list[StabilityRow]:
    """A camera that stands still, in noise."""
    clip = street_clip("still")
    rows = []
    for sigma in (2, 5, 8):
        harmed = noisy(clip, sigma)
        motion = default_motion(harmed)
        label = f"{name}, noise {sigma}"
        rows.append(judged(label, mode_share(motion, "still"), unit="share still", at_least=0.95))
        rows.append(judged(label, farthest_m(motion.trajectory.cam_to_world), unit="m drift", at_most=0.05))
        stock = farthest_m(stock_opencv(harmed))
        rows.append(judged(label, stock, unit="m drift", at_most=0.05, method=STOCK))
    return rows


def still_traffic(name: str) -> list[StabilityRow]:
    """A camera that stands still while others move."""
    rows = []
    for scenario, label in (("lead_leaves", "a lead car leaves"), ("cross_traffic", "cross traffic")):
        clip = street_clip(scenario)
        for method, poses in default_and_stock(clip):
            rows.append(judged(f"{name}, {label}", farthest_m(poses), unit="m drift", at_most=0.2, method=method))
            rows.append(
                judged(f"{name}, {label}", most_yaw_deg(poses), unit="deg yaw", at_most=0.3, method=method)
            )  # fmt: skip
    return rows


def pure_turn(name: str) -> list[StabilityRow]:
    """30 degrees a second on the spot."""
    clip = street_clip("turn")
    motion = default_motion(clip)
    poses, true_yaw = motion.trajectory.cam_to_world, yaw_deg(clip.truth)[-1]
    rows = [
        judged(name, mode_share(motion, "turning"), unit="share turning", at_least=0.9),
        judged(name, longest_step_m(poses), unit="m a frame", at_most=0.02),
    ]
    for method, found in (("default", poses), (STOCK, stock_opencv(clip))):
        off = 100 * abs(yaw_deg(found)[-1] / true_yaw - 1)
        rows.append(judged(name, off, unit="% of yaw", at_most=2.0, method=method))
    return rows


def crawl(name: str) -> list[StabilityRow]:
    """Half a metre a second."""
    clip = street_clip("crawl")
    rows = []
    for method, poses in default_and_stock(clip):
        flips = float((np.diff(poses[:, 2, 3]) < 0).sum())
        rows.append(judged(name, flips, unit="flips of direction", at_most=0, method=method))
        rows.append(
            judged(name, worst_turn_deg(poses, clip.truth), unit="deg a frame, worst", at_most=0.1, method=method)
        )
    return rows


def stop_and_go(name: str) -> list[StabilityRow]:
    """Modes follow, and do not flicker."""
    clip = street_clip("stop_and_go", frames=24 * 10)
    motion = default_motion(clip)
    speed = np.linalg.norm(np.diff(clip.truth[:, :3, 3], axis=0), axis=1) * 24
    # Below this nobody sees a 480-pixel picture move between two frames.
    true = np.flatnonzero(np.diff((speed > 0.1).astype(int))) + 2
    ours = np.flatnonzero(motion.mode[1:] != motion.mode[:-1]) + 1
    late = max(float(np.abs(ours - change).min()) if len(ours) else 240.0 for change in true)
    return [
        judged(name, late, unit="frames late, worst", at_most=5),
        judged(name, float(abs(len(ours) - len(true))), unit="changes too many or few", at_most=0),
    ]


def fast(name: str) -> list[StabilityRow]:
    """Straight on at 30 m/s."""
    clip = street_clip("fast")
    rows = []
    for method, poses in default_and_stock(clip):
        direction = float(np.median(direction_errors_deg(poses, clip.truth)))
        drift = float(abs(yaw_deg(poses)[-1] - yaw_deg(clip.truth)[-1]))
        rows.append(judged(name, direction, unit="deg direction", at_most=1.0, method=method))
        rows.append(judged(name, drift, unit="deg yaw after 5 s", at_most=1.0, method=method))
    return rows


def sharp_turn(name: str) -> list[StabilityRow]:
    """About 90 degrees in five seconds."""
    clip = street_clip("sharp_turn")
    return [
        judged(name, end_yaw_error_deg(poses, clip.truth), unit="deg end yaw", at_most=1.5, method=method)
        for method, poses in default_and_stock(clip)
    ]


def planes(name: str) -> list[StabilityRow]:
    """Nothing but road, nothing but a wall: an epipolar geometry twice over."""
    return [
        judged(
            f"{name}, {label}", worst_turn_deg(poses, clip.truth), unit="deg a frame, worst", at_most=0.1, method=method
        )
        for clip, label in ((street_clip("road_only"), "road"), (street_clip("wall"), "wall"))
        for method, poses in default_and_stock(clip)
    ]


def reversing(name: str) -> list[StabilityRow]:
    """Backwards."""
    clip = street_clip("reverse")
    return [
        judged(
            name, float((np.diff(poses[:, 2, 3]) < 0).mean()), unit="share of steps backwards", at_least=0.99,
            method=method,
        )
        for method, poses in default_and_stock(clip)
    ]  # fmt: skip


def focal(name: str) -> list[StabilityRow]:
    """Another focal length assumed than there is, as a prior that may be mended and as a camera that is believed."""
    clip = street_clip("sharp_turn")
    tracks = track_run(clip.frames, clip.times_s)
    true = yaw_deg(clip.truth)[-1]
    rows = []
    slope: dict[str, list[float]] = {}
    for factor in (0.8, 1.2):
        camera = replace(clip.intrinsics, fx=clip.intrinsics.fx * factor, fy=clip.intrinsics.fy * factor)
        prior = replace(camera, source="prior", focal_sigma=0.25)
        mended = calibrate_camera([tracks], intrinsics=prior).intrinsics
        found = {
            "default": solve_run(tracks, intrinsics=mended).trajectory.cam_to_world,
            UNCALIBRATED: solve_run(tracks, intrinsics=camera).trajectory.cam_to_world,
            STOCK: stock_opencv(replace(clip, intrinsics=camera)),
        }
        for method, poses in found.items():
            ratio = yaw_deg(poses)[-1] / true
            slope.setdefault(method, []).append(float(np.log(ratio)))
            note = "geometry alone: 25 % too much at 0.8 f, 17 % too little at 1.2 f" if method != "default" else ""
            off = 100 * abs(ratio - 1)
            rows.append(judged(f"{name}, {factor:g} f", off, unit="% of yaw", at_most=20.0, method=method, note=note))
    for method, (low, high) in slope.items():
        gain = (high - low) / np.log(1.2 / 0.8)
        rows.append(judged(f"{name}, slope", gain, unit="% of yaw per % of f", method=method))
    return rows


def pitch_and_height(name: str) -> list[StabilityRow]:
    """A pitch that nobody told, and a height told wrong."""
    rows = []
    for pitch in (-2.0, 2.0):
        clip = street_clip("empty", frames=72, pitch_deg=pitch)
        off = 100 * abs(path_m(default_motion(clip).trajectory.cam_to_world) / path_m(clip.truth) - 1)
        rows.append(judged(f"{name}, pitch {pitch:+g} deg", off, unit="% of scale", at_most=5.0))
    clip = street_clip("empty", frames=72)
    right, high = (
        path_m(default_motion(replace(clip, camera_height_m=height)).trajectory.cam_to_world) for height in (1.5, 1.8)
    )
    rows.append(judged(f"{name}, height 20 %", 100 * abs(high / right / 1.2 - 1), unit="% from linear", at_most=1.0))
    return rows


def repeated(name: str) -> list[StabilityRow]:
    """20 pictures a second shown as 24."""
    clip = street_clip("empty", frames=100, fps=20.0)
    shown = np.minimum(np.round(np.arange(120) * 20 / 24).astype(int), 99)
    stretched = replace(clip, frames=[clip.frames[index] for index in shown], times_s=np.arange(120) / 24)
    true = np.linalg.norm(np.diff(clip.truth[:, :3, 3], axis=0), axis=1) * 20
    wanted = np.interp((np.arange(119) + 0.5) / 24, (np.arange(99) + 0.5) / 20, true)
    rows = []
    for method, poses in default_and_stock(stretched):
        found = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * 24
        off = 100 * float(np.sqrt(np.mean((found - wanted) ** 2)) / wanted.mean())
        rows.append(judged(name, off, unit="% speed RMSE", at_most=10.0, method=method))
    return rows


def cut_in_the_middle(name: str) -> list[StabilityRow]:
    """Two drives one after the other."""
    one, other = highway_clip(), street_clip("sharp_turn")
    frames = [*one.frames[:40], *other.frames[40:80]]
    motion = default_motion(replace(one, frames=frames, times_s=np.arange(80) / 24))
    found = np.flatnonzero(motion.mode == "cut")
    late = float(np.abs(found - 40).min()) if len(found) else 40.0
    steps = np.linalg.norm(np.diff(motion.trajectory.positions, axis=0), axis=1)
    return [
        judged(name, late, unit="frames off", at_most=1),
        judged(name, float(len(found)), unit="cuts found", at_most=1),
        judged(name, float(steps[39]), unit="m bridged", at_most=0.0),
    ]


def same_again(name: str) -> list[StabilityRow]:
    """The same input twice, every second frame, time reversed."""
    clip = street_clip("sharp_turn")
    one, other = default_motion(clip), default_motion(clip)
    same = one.trajectory.cam_to_world.tobytes() == other.trajectory.cam_to_world.tobytes()
    half = replace(clip, frames=clip.frames[:-1:2], times_s=clip.times_s[:-1:2])
    last = yaw_deg(one.trajectory.cam_to_world)[(len(clip.frames) - 2) // 2 * 2]
    back = default_motion(replace(clip, frames=clip.frames[::-1])).trajectory.cam_to_world
    whole = yaw_deg(one.trajectory.cam_to_world)[-1]
    return [
        judged(f"{name}, same bytes", float(same), unit="same", at_least=1.0),
        judged(
            f"{name}, every second frame", abs(yaw_deg(default_motion(half).trajectory.cam_to_world)[-1] - last),
            unit="deg", at_most=0.2,
        ),
        judged(f"{name}, time reversed", abs(yaw_deg(back)[-1] + whole), unit="deg", at_most=0.2),
    ]  # fmt: skip


def mode_share(motion: EgoMotion, mode: str) -> float:
    """Share of frames reached in this mode."""
    return float((motion.mode == mode).mean())
