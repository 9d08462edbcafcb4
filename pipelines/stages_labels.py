"""The stage that labels runs: keypoints with tracks."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dataset.layout import parse_run_item, run_path
from dataset.receipts import digest
from dataset.tables import read_frames_table, write_keypoints
from labeling.errors import DataError
from labeling.extraction import label_frames
from labeling.extractors import Extractors, choose_extractors
from labeling.labels import Keypoints
from labeling.timeline import RunFrames
from labeling.video import read_frames
from pipelines.config import KeypointSettings
from pipelines.job import Job
from pipelines.stage import WorkItem
from pipelines.stages_select import job_extractors, model_hashes


class KeypointsStage:
    """Detects, takes keypoints and tracks, once per frame of a run."""

    name = "keypoints"

    def __init__(self) -> None:
        self._extractors: tuple[str, Extractors] | None = None

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per run that is cut."""
        cards = [card.name for card in job_extractors(job).cards]
        models = model_hashes(job, cards)
        settings = {"keypoints": job.config.keypoints.model_dump(mode="json"), "cards": cards}
        items = []
        for name, receipt in job.done("cut").items():
            video_id, run = parse_run_item(name)
            items.append(
                WorkItem(
                    stage=self.name, name=name, owner=video_id, version=4, settings=settings, models=models,
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
        left_out: dict[str, int] = {}
        if item.settings["cards"]:
            extractors = self._open(item)
            before = extractors.left_out
            labels = label_frames(
                read_frames(root / run_path(video_id, run, ".mp4")), first_frame=run.start,
                extractors=extractors, effort=item.settings["keypoints"]["effort"], breaks=run_breaks(frames),
                repeats=frozenset(frames.frame[frames.duplicate].tolist()),
            )  # fmt: skip
            left_out = {name: count - before[name] for name, count in extractors.left_out.items()}
        outside = [label.frame for label in labels if not run.start <= label.frame < run.end]
        if outside:
            raise DataError(f"{item.name}: has labels of frame {outside[0]}, which is not its own; please report it")
        target = staging / Path(item.outputs[0]).name
        write_keypoints(target, labels, metadata={"models": item.models})
        tracks = {(label.category, label.track_id) for label in labels}
        crowd = {name: count for name, count in left_out.items() if count}
        return {"frames": len(run), "labels": len(labels), "tracks": len(tracks), "left_out": crowd}

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


def run_breaks(frames: RunFrames) -> frozenset[int]:
    """Grid frames before which nothing may be carried over: first frames of a shot, holes, and what follows a hole."""
    after_hole = np.concatenate([[False], frames.hole[:-1]])
    return frozenset(int(frame) for frame in frames.frame[frames.cut | frames.hole | after_hole])
