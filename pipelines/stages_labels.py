"""Stages that label runs: keypoints with tracks, and the camera's motion."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dataset.receipts import digest
from dataset.tables import (
    VideoIndex,
    read_ego,
    read_frames_table,
    read_index,
    read_keypoints,
    write_ego,
    write_keypoints,
)
from labeling.camera import Intrinsics, prior_intrinsics
from labeling.ego_motion import estimate_ego_motion
from labeling.errors import DataError
from labeling.extraction import label_frames
from labeling.extractors import Extractors, choose_extractors
from labeling.labels import Keypoints
from labeling.timeline import RunFrames
from labeling.video import read_frames
from pipelines.config import CameraSettings, EgoStageSettings, KeypointSettings, PictureSettings
from pipelines.job import Job
from pipelines.layout import index_path, parse_run_item, run_path
from pipelines.stage import WorkItem
from pipelines.stages_select import job_extractors, weights_hashes
from pipelines.stages_source import picture_map

_MOVERS = frozenset({"car", "person"})


class KeypointsStage:
    """Detects, takes keypoints and tracks, once per frame of a run."""

    name = "keypoints"

    def __init__(self) -> None:
        self._extractors: tuple[str, Extractors] | None = None

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per run that is cut."""
        cards = [card.name for card in job_extractors(job).cards]
        models = weights_hashes(job, cards)
        settings = {"keypoints": job.config.keypoints.model_dump(mode="json"), "cards": cards}
        items = []
        for name, receipt in job.done("cut").items():
            video_id, run = parse_run_item(name)
            items.append(
                WorkItem(
                    stage=self.name, name=name, owner=video_id, version=1, settings=settings, models=models,
                    inputs={output.path: output.sha256 for output in receipt.outputs},
                    outputs=(run_path(video_id, run, ".keypoints.parquet"),), weight=float(len(run)),
                    payload={"models_dir": str(job.models_dir) if job.models_dir else None},
                )
            )  # fmt: skip
        return items

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write the run's labels.

        Raises:
            ModelError: a network breaks its contract.
        """
        video_id, run = parse_run_item(item.name)
        frames = read_frames_table(root / run_path(video_id, run, ".frames.parquet"))
        labels: list[Keypoints] = []
        if item.settings["cards"]:
            labels = label_frames(
                read_frames(root / run_path(video_id, run, ".mp4")), first_frame=run.start,
                extractors=self._open(item), effort=item.settings["keypoints"]["effort"], breaks=run_breaks(frames),
            )  # fmt: skip
        outside = [label.frame for label in labels if not run.start <= label.frame < run.end]
        if outside:
            raise DataError(f"{item.name}: has labels of frame {outside[0]}, which is not its own; please report it")
        target = staging / Path(item.outputs[0]).name
        write_keypoints(target, labels, metadata={"models": item.models})
        tracks = {(label.category, label.track_id) for label in labels}
        return {"frames": len(run), "labels": len(labels), "tracks": len(tracks)}

    def _open(self, item: WorkItem) -> Extractors:
        """The networks, opened once in each process."""
        key = digest([item.settings, item.models, item.payload])
        if self._extractors is None or self._extractors[0] != key:
            settings = KeypointSettings.model_validate(item.settings["keypoints"])
            folder = Path(item.payload["models_dir"]) if item.payload["models_dir"] else None
            choice = choose_extractors(item.settings["cards"], models_dir=folder)
            opened = Extractors(choice, models_dir=folder, providers=settings.providers, threads=settings.threads)
            self._extractors = (key, opened)
        return self._extractors[1]


class EgoStage:
    """Estimates the camera's motion over each run, away from cars and people."""

    name = "ego"

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per run that has keypoints."""
        cut, camera = job.done("cut"), job.config.camera
        settings = {
            "ego": job.config.ego.model_dump(mode="json"),
            "camera": camera.model_dump(mode="json") if camera else None,
            "picture": job.config.picture.model_dump(mode="json"),
        }
        items = []
        for name, receipt in job.done("keypoints").items():
            video_id, run = parse_run_item(name)
            outputs = (*cut[name].outputs, *receipt.outputs)
            items.append(
                WorkItem(
                    stage=self.name, name=name, owner=video_id, version=1, settings=settings,
                    inputs={output.path: output.sha256 for output in outputs},
                    outputs=(run_path(video_id, run, ".ego.parquet"),), weight=float(len(run)),
                )
            )  # fmt: skip
        return items

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write the run's trajectory."""
        video_id, run = parse_run_item(item.name)
        settings = EgoStageSettings.model_validate(item.settings["ego"])
        frames = read_frames_table(root / run_path(video_id, run, ".frames.parquet"))
        labels = read_keypoints(root / run_path(video_id, run, ".keypoints.parquet"))
        motion = estimate_ego_motion(
            read_frames(root / run_path(video_id, run, ".mp4")), frames.source_time_s,
            intrinsics=run_intrinsics(read_index(root / index_path(video_id)), item.settings),
            boxes=boxes_by_frame(labels, first_frame=run.start, count=len(run)),
            camera_height_m=settings.camera_height_m, settings=settings.motion,
            breaks=frozenset(frame - run.start for frame in run_breaks(frames)),
        )  # fmt: skip
        target = staging / Path(item.outputs[0]).name
        write_ego(target, motion, first_frame=run.start)
        return {"frames": len(run), "metres": round(read_ego(target).trajectory.path_length_m, 3)}


def run_breaks(frames: RunFrames) -> frozenset[int]:
    """Grid frames before which nothing may be carried over: first frames of a shot, holes, and what follows a hole."""
    after_hole = np.concatenate([[False], frames.hole[:-1]])
    return frozenset(int(frame) for frame in frames.frame[frames.cut | frames.hole | after_hole])


def run_intrinsics(index: VideoIndex, settings: Mapping[str, Any]) -> Intrinsics:
    """The camera in pixels of the working picture: the calibrated one, else what is assumed of an unknown one."""
    width, height = index.info["width"], index.info["height"]
    camera = prior_intrinsics(width, height)
    if settings["camera"] is not None:
        given = CameraSettings.model_validate(settings["camera"])
        camera = Intrinsics(width=width, height=height, source="given", **given.model_dump())
    return camera.mapped(picture_map(index, PictureSettings.model_validate(settings["picture"])))


def boxes_by_frame(labels: list[Keypoints], *, first_frame: int, count: int) -> list[np.ndarray]:
    """(n, 4) boxes of cars and people for each of ``count`` frames."""
    boxes: list[list[np.ndarray]] = [[] for _ in range(count)]
    for label in labels:
        if label.category in _MOVERS:
            boxes[label.frame - first_frame].append(label.box_xyxy)
    return [np.array(found, dtype=np.float32).reshape(-1, 4) for found in boxes]
