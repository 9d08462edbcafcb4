"""Counting objects on keyframes, and the one barrier: which clips are kept."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dataset.layout import JOB_FILE, SELECTION, counts_path, index_path
from dataset.receipts import check_unaltered, digest, reason_counts
from dataset.selection import (
    ClipRow,
    SelectionRule,
    candidate_rows,
    check_extendable,
    count_objects,
    plan_looks,
    read_selection,
    select_clips,
    write_selection,
)
from dataset.tables import COUNTS_SCHEMA, VideoIndex, read_index, read_table, table_of, write_table
from labeling.detection import Detector
from labeling.errors import ConfigError, DataError, VideoError
from labeling.extractors import ExtractorChoice, choose_extractors
from labeling.model_cards import find_weights, load_cards
from labeling.onnx_files import weights_sha256
from labeling.settings_files import parse_settings
from labeling.timeline import ClipPlan, ClipSettings, Timeline, plan_clips, plan_timeline
from labeling.video import decode_at
from pipelines.config import CountSettings, PictureSettings, SelectSettings
from pipelines.job import Job
from pipelines.stage import NotReadyError, WorkItem
from pipelines.stages_source import picture_map

NO_DETECTOR = (
    "no detector's weights are there, so clips cannot be ranked by what they show; `animatic models` says how to get "
    "one, `--models DIR` where it lies, and `--keep-share 1` keeps every clip without one"
)

_TOLD_ONLY = {"licence", "source", "notes", "accuracy"}
"""Of a card: what no label depends on."""


def job_extractors(job: Job) -> ExtractorChoice:
    """The model cards that a job uses."""
    return choose_extractors(job.config.keypoints.extractors, models_dir=job.models_dir)


def model_hashes(job: Job, names: list[str]) -> dict[str, str]:
    """What each card's network is, by card name: sha256 of its weights as they lie there, then a digest of how its card
    says that they are used."""
    cards = load_cards(job.models_dir)
    found = {name: find_weights(cards[name], job.models_dir) for name in sorted(names)}
    used = {name: digest(cards[name].model_dump(mode="json", exclude=_TOLD_ONLY)) for name in found}
    return {name: f"{weights_sha256(path)} {used[name]}" for name, path in found.items() if path is not None}


class CountStage:
    """Detects objects on the source's own keyframes, at least two of each clip. Not needed where every clip is kept."""

    name = "count"

    def __init__(self) -> None:
        self._detector: tuple[str, Detector] | None = None

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per indexed video.

        Raises:
            ConfigError: no detector.
        """
        if job.config.select.keep_share >= 1:
            return []
        detector = job.config.count.detector or getattr(job_extractors(job).detector, "name", None)
        if detector is None:
            raise ConfigError(NO_DETECTOR)
        models = model_hashes(job, [detector])
        settings = {
            "count": job.config.count.model_dump(mode="json"), "detector": detector,
            "picture": job.config.picture.model_dump(mode="json"),
            "clip": job.config.clip.model_dump(mode="json", exclude={"run_frames"}),
        }  # fmt: skip
        return [
            WorkItem(
                stage=self.name, name=video_id, owner=video_id, version=1, settings=settings, models=models,
                inputs={
                    "index": receipt.output("index.parquet").sha256, "leave_out_s": job.sources[video_id].leave_out_s
                },
                outputs=(counts_path(video_id),), weight=float(receipt.facts["seconds"]),
                payload={"path": str(job.sources[video_id].path), "index": index_path(video_id),
                         "models_dir": str(job.models_dir) if job.models_dir else None},
            )
            for video_id, receipt in job.done("index").items()
        ]  # fmt: skip

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write ``counts.parquet``.

        Raises:
            VideoError: no frame could be decoded.
        """
        index = read_index(root / item.payload["index"])
        clip = ClipSettings.model_validate(item.settings["clip"])
        timeline, plan = clip_plan(index, clip, tuple(item.inputs["leave_out_s"]))
        looks = plan_looks(
            timeline, plan.kept, index.times_s[index.is_keyframe],
            looks_per_clip=item.settings["count"]["looks_per_clip"],
        )  # fmt: skip
        detector = self._open(item)
        picture = picture_map(index, PictureSettings.model_validate(item.settings["picture"]))
        rows, before = [], detector.left_out
        for frame in decode_at(Path(item.payload["path"]), list(looks), picture=picture):
            found = detector.detect([frame.rgb])[0].distinct()
            rows.append({"time_s": frame.time_s, "classes": found.classes.tolist(), "scores": found.scores.tolist()})
        if len(looks) and not rows:
            raise VideoError(f"{item.payload['path']}: none of {len(looks)} frames decodes; get the file again")
        write_table(staging / "counts.parquet", table_of(COUNTS_SCHEMA, rows))
        crowd = detector.left_out - before
        return {
            "looks": len(rows), "clips": len(plan.kept), "objects": sum(len(row["classes"]) for row in rows),
            "left_out": {detector.card.name: crowd} if crowd else {},
        }  # fmt: skip

    def _open(self, item: WorkItem) -> Detector:
        """The detector, opened once in each process."""
        name, models_dir = item.settings["detector"], item.payload["models_dir"]
        folder = Path(models_dir) if models_dir else None
        card = load_cards(folder)[name]
        path = find_weights(card, folder)
        if path is None or card.kind != "yolox":
            raise ConfigError(f"{name}: is no detector whose weights are there; `animatic models` lists what is")
        key = f"{path} {item.models} {item.settings['count']}"
        if self._detector is None or self._detector[0] != key:
            settings = CountSettings.model_validate(item.settings["count"])
            self._detector = (key, Detector(card, path, providers=settings.providers, threads=settings.threads))
        return self._detector[1]


class SelectStage:
    """Judges every clip of every video at once: the one barrier of the job."""

    name = "select"

    def plan(self, job: Job) -> list[WorkItem]:
        """One item for the whole job.

        Raises:
            NotReadyError: some video is neither indexed and counted, nor known to be broken.
        """
        waiting = {item.name for stage in ("source", "index", "count") for item in job.pending(stage)}
        if waiting:
            raise NotReadyError(
                f"{job.root}: {len(waiting)} of {len(job.sources)} videos are not counted yet (such as "
                f"{min(waiting)}); run `animatic label` or `animatic index` and `animatic count`, on every part"
            )
        _refuse_passing_failures(job)
        every = job.config.select.keep_share >= 1
        index, counts = job.done("index"), job.done("count")
        videos = {
            video_id: {
                "index": index[video_id].output("index.parquet").sha256,
                "counts": None if every else counts[video_id].output("counts.parquet").sha256,
                "leave_out_s": job.sources[video_id].leave_out_s,
            }
            for video_id in index
            if every or video_id in counts
        }
        for video_id, same in _twins(job, videos).items():
            videos[video_id]["twins"] = same
        settings = {
            "select": job.config.select.model_dump(mode="json"),
            "clip": job.config.clip.model_dump(mode="json", exclude={"run_frames"}),
            "counted": None if every else _counting(job),
        }
        return [
            WorkItem(
                stage=self.name, name="selection", owner="", version=1, settings=settings,
                inputs={"videos": videos}, outputs=(SELECTION,),
                payload={"mode": job.selection_mode, "previous": _previous_sha256(job)},
            )
        ]  # fmt: skip

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write ``selection.parquet``.

        Raises:
            AlteredError: a video's index or counts, or the selection so far, are not as they were written.
            ConfigError: the mode or the split does not fit.
        """
        if item.payload["previous"] and (root / SELECTION).is_file():
            check_unaltered(root / SELECTION, item.payload["previous"])
        settings = parse_settings(SelectSettings, item.settings["select"], "select")
        clip = ClipSettings.model_validate(item.settings["clip"])
        videos = item.inputs["videos"]
        candidates = {
            video_id: _candidates(root, video_id, facts, settings, clip) for video_id, facts in videos.items()
        }
        split = settings.split
        rule = SelectionRule(
            keep_share=settings.keep_share, seed=settings.seed, sample_clips=settings.sample_clips,
            val_share=settings.val_share, split=split,
        )  # fmt: skip
        selection = select_clips(
            candidates, rule, digests={video_id: digest(facts) for video_id, facts in videos.items()},
            rule_digest=_rule_digest(item), previous=_previous(root), mode=item.payload["mode"],
            twins={video_id: facts["twins"] for video_id, facts in videos.items() if "twins" in facts},
        )  # fmt: skip
        write_selection(staging / SELECTION, selection)
        return {
            "clips": len(selection.rows), "kept": len(selection.kept), "threshold": selection.threshold,
            "dropped": reason_counts(row.reason or "" for row in selection.rows if not row.kept),
        }  # fmt: skip


def refuse_extend(job: Job) -> None:
    """Say before anything runs that a selection cannot be extended: a receipt of that would stand in the way of others.

    Raises:
        ConfigError: there is no selection, or its rule has changed.
        NotReadyError: some video is not counted yet.
    """
    for item in job.plan(SelectStage.name):
        check_extendable(_previous(job.root), _rule_digest(item))


def _rule_digest(item: WorkItem) -> str:
    """What a frozen selection rests on besides the videos; a split that names more of them is no other rule."""
    rule = {**item.settings["select"], "split": item.settings["select"]["split"] is not None}
    return digest([item.version, {**item.settings, "select": rule}])


def clip_plan(index: VideoIndex, clip: ClipSettings, leave_out_s: tuple[float, float]) -> tuple[Timeline, ClipPlan]:
    """A source's grid and the clips on it."""
    timeline = plan_timeline(index.times_s)
    plan = plan_clips(timeline, clip_frames=clip.clip_frames, stride_frames=clip.stride_frames, leave_out_s=leave_out_s)
    return timeline, plan


def _twins(job: Job, video_ids: Collection[str]) -> dict[str, list[str]]:
    """By video id, all ids of files with the same bytes, of those that have any."""
    alike: dict[str, list[str]] = {}
    for video_id, receipt in job.done("source").items():
        if video_id in video_ids:
            alike.setdefault(receipt.facts["sha256"], []).append(video_id)
    return {video_id: same for same in alike.values() if len(same) > 1 for video_id in same}


def _counting(job: Job) -> dict[str, Any]:
    """What counts rest on besides the videos: another detector's counts have nothing to do with a frozen threshold."""
    items = job.plan("count")
    return {"settings": items[0].settings, "models": items[0].models} if items else {}


def _candidates(
    root: Path, video_id: str, facts: Mapping[str, Any], settings: SelectSettings, clip: ClipSettings
) -> list[ClipRow]:
    check_unaltered(root / index_path(video_id), facts["index"])
    index = read_index(root / index_path(video_id))
    timeline, plan = clip_plan(index, clip, tuple(facts["leave_out_s"]))
    if facts["counts"] is None:
        return candidate_rows(video_id, plan, None)
    check_unaltered(root / counts_path(video_id), facts["counts"])
    counts, _ = read_table(root / counts_path(video_id), COUNTS_SCHEMA)
    objects = count_objects(
        timeline, plan.kept, look_times_s=np.array(counts["time_s"].to_pylist(), dtype=np.float64),
        classes=counts["classes"].to_pylist(), scores=counts["scores"].to_pylist(),
        counted=settings.counted_classes, min_score=settings.min_score,
    )  # fmt: skip
    return candidate_rows(video_id, plan, objects)


def _refuse_passing_failures(job: Job) -> None:
    """A threshold frozen without the videos that failed for the moment (no space, no memory) would be another one.

    A fault of the program is retried too, but as a rule fails again: one such video must not stop all the others.
    """
    for stage in ("source", "index", "count"):
        for receipt in job.settled(stage).values():
            if receipt.state == "failed" and receipt.retryable and receipt.reason != "fault":
                raise NotReadyError(
                    f"{receipt.item} is not counted: {receipt.message}; run the command again, or take the video out "
                    f"of {job.root / JOB_FILE} to go on without it"
                )


def _previous_sha256(job: Job) -> str | None:
    """Of the selection so far, whose threshold, sample and split hold on."""
    receipt = job.receipts(SelectStage.name).get("selection")
    return receipt.outputs[0].sha256 if receipt is not None and receipt.outputs else None


def _previous(root: Path) -> Any:
    """The selection so far; one that cannot be read is as none, since it is about to be made."""
    try:
        return read_selection(root / SELECTION)
    except DataError:
        return None
