"""Stages of ego-motion: each run's corners, the one camera of each video, and each run's trajectory.

The camera is pooled over all runs of a video, so it comes between two looks at a run; the second look needs the corners
of the first, not its pictures.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from dataset.cameras import read_camera, road_record, write_camera
from dataset.layout import camera_path, index_path, parse_run_item, run_path
from dataset.receipts import Output, Receipt, sha256_file
from dataset.tables import VideoIndex, read_ego, read_frames_table, read_index, read_keypoints, write_ego
from labeling.camera import Intrinsics, metadata_intrinsics, prior_intrinsics
from labeling.ego_calibration import CameraCalibration, KnownMounting, calibrate_camera, known_camera
from labeling.ego_chain import output_times
from labeling.ego_corners import TrackSettings
from labeling.ego_import import FileClock, motion_at, read_drive
from labeling.ego_motion import EgoMotion, solve_run
from labeling.ego_settings import EgoSettings
from labeling.ego_tracks import StoredTracks, load_tracks, track_run
from labeling.errors import DataError
from labeling.labels import Keypoints
from labeling.timeline import Span
from labeling.video import read_frames
from pipelines.config import CameraSettings, EgoStageSettings, PictureSettings, video_camera
from pipelines.job import Job
from pipelines.sources import ImportedTrajectory
from pipelines.stage import WorkItem
from pipelines.stages_labels import run_breaks
from pipelines.stages_source import picture_map

_MOVERS = frozenset({"car", "person"})


class CornersStage:
    """Follows corners through each run, away from cars and people: all that ego-motion wants of its pictures."""

    name = "corners"

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per run that has keypoints; none where the video's trajectory was imported."""
        cut = job.done("cut")
        settings = {"tracks": job.config.ego.motion.tracks.model_dump(mode="json")}
        items = []
        for name, receipt in job.done("keypoints").items():
            video_id, run = parse_run_item(name)
            if job.sources[video_id].trajectory is not None:
                continue
            items.append(
                WorkItem(
                    stage=self.name, name=name, owner=video_id, version=2, settings=settings,
                    inputs=_hashes(*cut[name].outputs, *receipt.outputs),
                    outputs=(run_path(video_id, run, ".corners.npz"),), weight=float(len(run)),
                )
            )  # fmt: skip
        return items

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write the run's corners."""
        video_id, run = parse_run_item(item.name)
        frames = read_frames_table(root / run_path(video_id, run, ".frames.parquet"))
        labels = read_keypoints(root / run_path(video_id, run, ".keypoints.parquet"))
        tracks = track_run(
            read_frames(root / run_path(video_id, run, ".mp4")), frames.source_time_s,
            boxes=boxes_by_frame(labels, first_frame=run.start, count=len(run)),
            breaks=frozenset(frame - run.start for frame in run_breaks(frames)),
            settings=TrackSettings.model_validate(item.settings["tracks"]),
        )  # fmt: skip
        tracks.save(staging / Path(item.outputs[0]).name)
        return {"frames": len(run), "corners": sum(len(frame.ids) for frame in tracks.frames)}


class CameraStage:
    """Finds the one camera of each video: given, else from metadata, else estimated from all runs, else assumed."""

    name = "camera"

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per video all of whose runs are settled and some of whose corners are there, and one per video
        whose trajectory was imported."""
        index = job.done("index")
        items = []
        for video_id, receipts in _whole_videos(job).items():
            runs = sorted(receipts)
            settings = {
                "ego": job.config.ego.model_dump(mode="json"),
                "camera": video_camera(job.config, video_id).model_dump(mode="json"),
                "picture": job.config.picture.model_dump(mode="json"),
            }
            files = [output for run in runs for output in receipts[run].outputs]
            items.append(
                WorkItem(
                    stage=self.name, name=video_id, owner=video_id, version=2, settings=settings,
                    inputs=_hashes(index[video_id].output("index.parquet"), *files),
                    outputs=(camera_path(video_id),), payload={"corners": [output.path for output in files]},
                    weight=1.0 + sum(receipts[run].facts["frames"] for run in runs),
                )
            )  # fmt: skip
        return items

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write the video's camera.

        Raises:
            TrajectoryError: given intrinsics that do not fit the picture.
        """
        settings = EgoStageSettings.model_validate(item.settings["ego"])
        given = CameraSettings.model_validate(item.settings["camera"])
        index = read_index(root / index_path(item.name))
        intrinsics = source_intrinsics(index, given).mapped(
            picture_map(index, PictureSettings.model_validate(item.settings["picture"]))
        )
        mounting = KnownMounting(
            height_m=given.height_m, assumed_height_m=settings.camera_height_m,
            pitch_rad=None if given.pitch_deg is None else math.radians(given.pitch_deg),
        )  # fmt: skip
        runs = StoredTracks([root / name for name in item.payload["corners"]])
        if runs:
            camera = calibrate_camera(runs, intrinsics=intrinsics, mounting=mounting, settings=settings.motion)
        else:
            camera = known_camera(intrinsics, mounting)
        write_camera(staging / "camera.json", camera)
        return {
            "turns": camera.turns, "focal_source": camera.intrinsics.source, "pitch_source": camera.pitch_source,
        }  # fmt: skip


class EgoStage:
    """Estimates the camera's motion over each run, seen through its video's camera, or takes it from an import."""

    name = "ego"

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per run whose corners and whose video's camera are there."""
        camera, cut, index = job.done("camera"), job.done("cut"), job.done("index")
        settings = {"motion": job.config.ego.motion.model_dump(mode="json", exclude={"tracks"})}
        items = []
        for name, receipt in {**cut, **job.done("corners")}.items():
            video_id, run = parse_run_item(name)
            given = job.sources[video_id].trajectory
            if video_id not in camera or (given is None and receipt.stage != "corners"):
                continue
            files = receipt.outputs
            if given is not None:
                files = (receipt.output(".frames.parquet"), index[video_id].output("index.parquet"))
            imported = asdict(given) if given is not None else None
            items.append(
                WorkItem(
                    stage=self.name, name=name, owner=video_id, version=3, settings={} if imported else settings,
                    inputs={**_hashes(*files, *camera[video_id].outputs), "imported": imported},
                    outputs=(run_path(video_id, run, ".ego.parquet"),), weight=float(len(run)),
                )
            )  # fmt: skip
        return items

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write the run's trajectory.

        Raises:
            TrajectoryError: an imported file that cannot be what it claims.
        """
        video_id, run = parse_run_item(item.name)
        camera = read_camera(root / camera_path(video_id))
        if item.inputs["imported"] is not None:
            motion = _imported(root, video_id, run, ImportedTrajectory(**item.inputs["imported"]), camera)
        else:
            motion = solve_run(
                load_tracks(root / run_path(video_id, run, ".corners.npz")), intrinsics=camera.intrinsics,
                camera_height_m=camera.road.height_m, pitch_rad=camera.pitch_rad,
                settings=EgoSettings.model_validate(item.settings["motion"]),
            )  # fmt: skip
            # Metric scale is no surer than the camera's height.
            motion = replace(motion, scale_sigma=np.hypot(motion.scale_sigma, np.float32(camera.height_sigma)))
        target = staging / Path(item.outputs[0]).name
        write_ego(target, motion, first_frame=run.start, mounting=_mounting(camera, motion))
        return {"frames": len(run), "metres": round(read_ego(target).trajectory.path_length_m, 3)}


def _imported(root: Path, video_id: str, run: Span, given: ImportedTrajectory, camera: CameraCalibration) -> EgoMotion:
    if sha256_file(root / given.file) != given.sha256:
        raise DataError(f"{root / given.file}: is not the file that was imported; import it again")
    times = read_index(root / index_path(video_id)).times_s
    drive = read_drive(
        root / given.file, video_times_s=times - times[0], clock=FileClock(offset_s=given.offset_s, fps=given.fps)
    )
    frames = read_frames_table(root / run_path(video_id, run, ".frames.parquet"))
    shown = output_times(frames.source_time_s)
    motion = motion_at(drive, shown - times[0], intrinsics=camera.intrinsics, road=camera.road)
    return replace(motion, trajectory=replace(motion.trajectory, timestamps_s=shown))


def _hashes(*outputs: Output) -> dict[str, str]:
    return {output.path: output.sha256 for output in outputs}


def _whole_videos(job: Job) -> dict[str, dict[str, Receipt]]:
    """By video of which no run waits for its cut, keypoints or corners: the receipts of its corners (none where its
    trajectory was imported)."""
    waiting = {item.owner for stage in ("cut", "keypoints", "corners") for item in job.pending(stage)}
    imported = {name for name, source in job.sources.items() if source.trajectory is not None}
    videos: dict[str, dict[str, Receipt]] = {
        video_id: {} for video_id, _ in map(parse_run_item, job.done("cut")) if video_id in imported
    }
    for name, receipt in job.done("corners").items():
        video_id, _ = parse_run_item(name)
        if video_id not in waiting:
            videos.setdefault(video_id, {})[name] = receipt
    return videos


def _mounting(camera: CameraCalibration, motion: EgoMotion) -> dict[str, Any]:
    """What the video knows of how its camera is mounted; where it knows no pitch, the run's own stays."""
    record = road_record(camera)
    if camera.pitch_source != "prior":
        return record
    own = "estimated" if math.isfinite(motion.road.pitch_sigma_rad) else "prior"
    kept = {name: value for name, value in record.items() if not name.startswith("pitch_")}
    return {**kept, "pitch_source": own}


def source_intrinsics(index: VideoIndex, given: CameraSettings) -> Intrinsics:
    """The camera in pixels of the source before anything is estimated: given, else from metadata, else the prior.

    Raises:
        TrajectoryError: what is given does not fit the picture.
    """
    width, height, focal_35mm = index.info["width"], index.info["height"], index.info.get("focal_35mm")
    camera = prior_intrinsics(width, height)
    if focal_35mm is not None and given.fx is None:
        camera = metadata_intrinsics(width, height, focal_35mm=focal_35mm)
    if given.cx is not None and given.cy is not None:
        camera = replace(camera, cx=given.cx, cy=given.cy)
    if given.fx is not None:
        fy = given.fx if given.fy is None else given.fy
        camera = replace(camera, fx=given.fx, fy=fy, source="given", focal_sigma=given.focal_sigma)
    return camera


def boxes_by_frame(labels: list[Keypoints], *, first_frame: int, count: int) -> list[np.ndarray]:
    """(n, 4) boxes of cars and people for each of ``count`` frames."""
    boxes: list[list[np.ndarray]] = [[] for _ in range(count)]
    for label in labels:
        if label.category in _MOVERS:
            boxes[label.frame - first_frame].append(label.box_xyxy)
    return [np.array(found, dtype=np.float32).reshape(-1, 4) for found in boxes]
