"""Clips with exact truth for the ego-motion chart and stability table: KITTI 03 and rendered street drives."""

import os
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from dataset.street import Scenario, Street, StreetConfig
from labeling.camera import Intrinsics, Trajectory, read_kitti, read_tum, resample
from labeling.errors import DataError
from labeling.video import read_frames
from pipelines.ego_methods import EgoClip

WIDTH, HEIGHT = 480, 320
SECONDS = 5
TURNING_FRAME = 36
"""Of the street's sharp turn: it is well under way."""


def real_folder() -> Path:
    """Where the real material lies: ``$ANIMATIC_REAL_DATA``, else ``../shared/real`` beside the project."""
    given = os.environ.get("ANIMATIC_REAL_DATA")
    return Path(given) if given else Path(__file__).resolve().parents[2] / "shared" / "real"


def kitti_clip(*, scale: float = 0.5, frames: int = 300) -> EgoClip:
    """KITTI odometry 03 at its own 10 fps.

    Raises:
        DataError: the real material is not there.
    """
    folder = real_folder() / "kitti_03"
    if not folder.is_dir():
        raise DataError(f"{folder} is not there; set ANIMATIC_REAL_DATA to the folder of real material")
    width, height = round(1242 * scale), round(375 * scale)
    intrinsics = Intrinsics(width=1242, height=375, fx=721.5377, fy=721.5377, cx=609.5593, cy=172.854, source="given")
    pictures = []
    for picture in islice(read_frames(folder / "left_gray_10fps.mp4"), frames):
        # The video's last row is padding.
        cropped = picture[:375]
        pictures.append(
            cv2.resize(cropped, (width, height), interpolation=cv2.INTER_AREA) if scale != 1 else cropped.copy()
        )
    truth = read_kitti(folder / "poses.txt", fps=10).cam_to_world[: len(pictures)]
    return EgoClip(
        name="KITTI 03", frames=pictures, times_s=np.arange(len(pictures)) / 10,
        intrinsics=intrinsics.resized(width, height), truth=truth, camera_height_m=1.65,
    )  # fmt: skip


@cache
def kitti_part() -> EgoClip | None:
    """The first 12 s of KITTI 03 at half size, cut to even sides; None where it is absent."""
    try:
        clip = kitti_clip(frames=120)
    except DataError:
        return None
    width, height = clip.intrinsics.width // 2 * 2, clip.intrinsics.height // 2 * 2
    return replace(
        clip, frames=[frame[:height, :width].copy() for frame in clip.frames],
        intrinsics=replace(clip.intrinsics, width=width, height=height),
    )  # fmt: skip


@cache
def street_clip(
    scenario: Scenario, *, frames: int = 24 * SECONDS, seed: int = 1, pitch_deg: float = 0.0, fps: float = 24.0,
    start: int = 0,
) -> EgoClip:  # fmt: skip
    """A rendered street drive, from its frame ``start`` on."""
    config = StreetConfig(
        seed=seed, width=WIDTH, height=HEIGHT, frames=start + frames, scenario=scenario, camera_pitch_deg=pitch_deg,
        fps=fps,
    )  # fmt: skip
    return _rendered(config, scenario, start=start)


@cache
def highway_clip(*, frames: int = 24 * SECONDS, start_s: float = 20.0) -> EgoClip:
    """A street under a real highway drive (comma2k19), at 24 fps; a made-up drive where the real one is absent."""
    path = real_folder() / "trajectories" / "comma2k19.tum"
    if not path.is_file():
        return street_clip("drive", frames=frames)
    times = start_s + np.arange(frames) / 24
    given = resample(read_tum(path), times)
    trajectory = Trajectory(timestamps_s=np.arange(frames) / 24, cam_to_world=given.cam_to_world)
    config = StreetConfig(seed=3, width=WIDTH, height=HEIGHT, frames=frames, scenario="drive", trajectory=trajectory)
    return _rendered(config, "highway")


def _rendered(config: StreetConfig, name: str, *, start: int = 0) -> EgoClip:
    street = Street(config)
    return EgoClip(
        name=name, frames=[street.render(index).rgb for index in range(start, config.frames)],
        times_s=np.arange(config.frames - start) / config.fps, intrinsics=street.intrinsics,
        truth=street.trajectory.cam_to_world[start:], camera_height_m=config.camera_height_m,
    )  # fmt: skip


def rolling_clip(*, start: int = TURNING_FRAME, frames: int = 40, readout_s: float = 0.03) -> EgoClip:
    """The middle of a sharp turn through a rolling shutter.

    While a turn begins, half a readout is a share of the yaw so far.
    """
    config = StreetConfig(
        seed=1, width=WIDTH, height=HEIGHT, frames=start + frames, scenario="sharp_turn", rolling_shutter_s=readout_s
    )
    return _rendered(config, "rolling shutter", start=start)
