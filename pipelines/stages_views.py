"""Stages that draw the labels: the skeleton video of a run, and each clip's ego and object videos and caption."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dataset.layout import clip_path, parse_run_item, run_item, run_path
from dataset.receipts import Output
from dataset.selection import ClipRow
from dataset.tables import EgoTable, read_ego, read_frames_table, read_keypoints
from labeling.camera import Trajectory
from labeling.captions import read_caption_table, template_caption
from labeling.ego_import import MISSING
from labeling.ego_video import ego_frames
from labeling.encoding import EncoderSettings, VideoWriter
from labeling.errors import DataError
from labeling.labels import Keypoints
from labeling.object_video import object_frames
from labeling.skeleton_video import draw_skeletons
from labeling.timeline import FPS, Span, clip_fault
from labeling.video import frame_count
from pipelines.config import PictureSettings, ViewSettings
from pipelines.job import Job
from pipelines.stage import DroppedError, WorkItem
from pipelines.stages_source import job_selection


class SkeletonStage:
    """Draws each run's skeletons once; clips are cut from the video by copying packets."""

    name = "skeleton"

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per run that has keypoints; none where packed samples hold no views."""
        if job.config.pack.videos == "rgb":
            return []
        views = job.config.views
        settings = {
            "width": views.width, "height": views.height, "picture": job.config.picture.model_dump(mode="json"),
            "encoder": views.skeleton_encoder.model_dump(mode="json"),
        }  # fmt: skip
        items = []
        for name, receipt in job.done("keypoints").items():
            video_id, run = parse_run_item(name)
            items.append(
                WorkItem(
                    stage=self.name, name=name, owner=video_id, version=1, settings=settings,
                    inputs={output.path: output.sha256 for output in receipt.outputs},
                    outputs=(run_path(video_id, run, ".skeleton.mp4"),), weight=float(len(run)),
                )
            )  # fmt: skip
        return items

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write the run's skeleton video."""
        video_id, run = parse_run_item(item.name)
        labels = by_frame(read_keypoints(root / run_path(video_id, run, ".keypoints.parquet")), run)
        settings = item.settings
        picture = PictureSettings.model_validate(settings["picture"])
        width, height = settings["width"], settings["height"]
        drawn = (
            draw_skeletons(found, width=width, height=height, label_width=picture.width, label_height=picture.height)
            for found in labels
        )
        encoder = EncoderSettings.model_validate(settings["encoder"])
        _write_video(staging / Path(item.outputs[0]).name, drawn, width, height, encoder, frames=len(run))
        return {"frames": len(run)}


class RenderStage:
    """Draws each clip's ego and object videos and writes its caption; drops clips that touch a hole or a hard cut."""

    name = "render"

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per kept clip whose run is labelled."""
        runs = _labelled_runs(job)
        captions = read_caption_table(Path(job.config.views.captions)) if job.config.views.captions else {}
        settings = {
            "views": job.config.views.model_dump(mode="json", exclude={"captions", "skeleton_encoder"}),
            "picture": job.config.picture.model_dump(mode="json"), "videos": job.config.pack.videos,
        }  # fmt: skip
        items = []
        for row in job_selection(job).kept:
            found = find_run(runs.get(row.video_id, ()), row.span)
            if found is not None:
                items.append(self._item(row, *found, settings=settings, caption=captions.get(row.key)))
        return items

    def _item(
        self, row: ClipRow, run: Span, inputs: tuple[Output, ...], *, settings: dict[str, Any], caption: str | None
    ) -> WorkItem:
        suffixes = (".txt",) if settings["videos"] == "rgb" else (".ego.mp4", ".objects.mp4", ".txt")
        return WorkItem(
            stage=self.name, name=row.key, owner=row.video_id, version=1, settings=settings,
            inputs={**{output.path: output.sha256 for output in inputs}, "clip": [row.start, row.end],
                    "caption": caption},
            outputs=tuple(clip_path(row.video_id, row.key, suffix) for suffix in suffixes),
            payload={"run": run_item(row.video_id, run)}, weight=float(len(row.span)),
        )  # fmt: skip

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write the clip's views.

        Raises:
            DroppedError: the clip touches a hole, holds a hard cut, or goes where an imported trajectory does not.
        """
        video_id, run = parse_run_item(item.payload["run"])
        start, end = item.inputs["clip"]
        clip = Span(start=start, end=end)
        fault = clip_fault(read_frames_table(root / run_path(video_id, run, ".frames.parquet")), clip)
        ego = read_ego(root / run_path(video_id, run, ".ego.parquet"))
        fault = fault or trajectory_fault(ego, clip)
        if fault is not None:
            raise DroppedError(fault)
        labels = clip_labels(root, video_id, run, clip)
        trajectory = clip_trajectory(ego, clip)
        if item.settings["videos"] == "all":
            _draw_views(item, staging, clip, labels, ego, trajectory)
        caption = item.inputs["caption"] or template_caption(labels, trajectory)
        (staging / f"{item.name}.txt").write_text(caption, encoding="utf-8")
        objects = {(label.category, label.track_id) for label in labels}
        return {"objects": len(objects), "metres": round(trajectory.path_length_m, 3)}


def _draw_views(
    item: WorkItem, staging: Path, clip: Span, labels: list[Keypoints], ego: EgoTable, trajectory: Trajectory
) -> None:
    views = ViewSettings.model_validate(item.settings["views"])
    picture = PictureSettings.model_validate(item.settings["picture"])
    width, height = views.width, views.height
    seen = ego_frames(
        trajectory, width=width, height=height, intrinsics=ego.intrinsics, style=views.ego_style,
        seed=views.ego_seed, renderer=views.ego_renderer,
    )  # fmt: skip
    boxes = object_frames(
        labels, clip=clip, key=item.name, variant=views.object_variant, width=width, height=height,
        label_width=picture.width, label_height=picture.height,
    )  # fmt: skip
    for name, frames in ((f"{item.name}.ego.mp4", seen), (f"{item.name}.objects.mp4", boxes)):
        _write_video(staging / name, frames, width, height, views.view_encoder, frames=len(clip))


def _write_video(
    path: Path, pictures: Iterable[np.ndarray], width: int, height: int, encoder: EncoderSettings, *, frames: int
) -> None:
    with VideoWriter(path, width=width, height=height, fps=FPS, settings=encoder) as writer:
        for picture in pictures:
            writer.write(picture)
    if frame_count(path) != frames:
        raise DataError(f"{path.name}: holds {frame_count(path)} of {frames} frames; please report it")


def _labelled_runs(job: Job) -> dict[str, list[tuple[Span, tuple[Output, ...]]]]:
    """By video: each run that has a frame table, labels and a trajectory, with those files."""
    cut, keypoints = job.done("cut"), job.done("keypoints")
    runs: dict[str, list[tuple[Span, tuple[Output, ...]]]] = {}
    for name, receipt in job.done("ego").items():
        # An imported trajectory needs no labels, so its run may have none, yet or for good.
        if name not in cut or name not in keypoints:
            continue
        video_id, run = parse_run_item(name)
        files = (cut[name].output(".frames.parquet"), *keypoints[name].outputs, *receipt.outputs)
        runs.setdefault(video_id, []).append((run, files))
    return runs


def find_run(runs: Iterable[tuple[Span, Any]], clip: Span) -> tuple[Span, Any] | None:
    """The run that holds a clip: the longest where two do, so that the choice is one."""
    found = [entry for entry in runs if entry[0].contains(clip)]
    return max(found, key=lambda entry: (len(entry[0]), -entry[0].start)) if found else None


def by_frame(labels: list[Keypoints], run: Span) -> list[list[Keypoints]]:
    """Labels of each frame of a run, in their order."""
    frames: list[list[Keypoints]] = [[] for _ in range(len(run))]
    for label in labels:
        frames[label.frame - run.start].append(label)
    return frames


def clip_labels(root: Path, video_id: str, run: Span, clip: Span) -> list[Keypoints]:
    """A run's labels inside a clip; frames stay those of the video's grid."""
    path = root / run_path(video_id, run, ".keypoints.parquet")
    return read_keypoints(path, start=clip.start, end=clip.end)


def trajectory_fault(ego: EgoTable, clip: Span) -> str | None:
    """Why a clip has no trajectory: an imported file says nothing about some of its frames; None where it has one."""
    first = clip.start - int(ego.frame[0])
    gone = [index for index, mode in enumerate(ego.mode[first : first + len(clip)]) if mode == MISSING]
    if not gone:
        return None
    return f"no_trajectory={len(gone)} of {len(clip)} frames from {(clip.start + gone[0]) / FPS:.3f} s"


def clip_trajectory(ego: EgoTable, clip: Span) -> Trajectory:
    """A run's trajectory inside a clip, in the clip's first camera."""
    first = clip.start - int(ego.frame[0])
    return ego.trajectory.slice(first, first + len(clip))
