"""Packing: clips cut from runs by packet copy, with their views and labels, into shards; and the shards' index."""

import io
import json
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from dataset.layout import INDEX_NAME, SHARD_INDEX, SHARDS, clip_path, index_path, parse_run_item, run_path, shard_path
from dataset.receipts import Output, check_unaltered, digest
from dataset.selection import ClipRow
from dataset.shards import (
    ClipSize,
    Member,
    SampleMembers,
    ShardPlan,
    check_shard,
    plan_shards,
    read_shard_index,
    write_shard,
    write_shard_index,
)
from dataset.tables import EgoTable, read_ego, read_frames_table, read_index, write_keypoints
from labeling.labels import Keypoints
from labeling.timeline import FPS, RunFrames, Span, copy_clip
from pipelines.config import PictureSettings
from pipelines.job import Job
from pipelines.stage import NotReadyError, WorkItem
from pipelines.stages_source import job_selection, picture_map
from pipelines.stages_views import clip_labels, clip_trajectory, find_run

_BEFORE = ("cut", "keypoints", "corners", "camera", "ego", "skeleton", "render")


class PackStage:
    """Fills shards with samples; a shard depends on its own clips only."""

    name = "pack"

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per shard.

        Raises:
            NotReadyError: some clip is neither rendered, nor dropped, nor failed.
        """
        waiting = [item.name for stage in _BEFORE for item in job.pending(stage)]
        if waiting:
            raise NotReadyError(
                f"{job.root}: {len(waiting)} runs or clips are not labelled yet (such as {waiting[0]}); run "
                "`animatic label`, or cut, keypoints, ego and render, on every part"
            )
        clips = _packable(job)
        shards = plan_shards([clip["size"] for clip in clips.values()], target_bytes=job.config.pack.shard_bytes)
        settings = {
            "videos": job.config.pack.videos, "picture": job.config.picture.model_dump(mode="json"),
            "views": job.config.views.model_dump(mode="json", include={"width", "height", "ego_style"}),
        }  # fmt: skip
        return [
            WorkItem(
                stage=self.name, name=shard.name, owner=shard.name, version=1, settings=settings,
                inputs={"split": shard.split, "clips": {key: clips[key]["digest"] for key in shard.keys}},
                outputs=(shard_path(shard.name), _rows_path(shard.name)),
                payload={"clips": {key: clips[key]["payload"] for key in shard.keys}},
                weight=float(sum(clips[key]["size"].size for key in shard.keys)),
            )
            for shard in shards
        ]  # fmt: skip

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write one tar and its rows of the index.

        Raises:
            AlteredError: a clip's run or view is not as it was written.
        """
        keys = tuple(item.inputs["clips"])
        plan = ShardPlan(name=item.name, split=item.inputs["split"], keys=keys)
        samples = ((key, _members(root, staging, item, key)) for key in keys)
        rows = write_shard(staging / item.name, plan, samples)
        check_shard(staging / item.name, rows)
        write_shard_index(staging / Path(item.outputs[1]).name, rows)
        sizes: Counter[str] = Counter()
        for row in rows:
            sizes[row.member] += row.size
        return {"clips": len(keys), "bytes": dict(sorted(sizes.items()))}


class ShardIndexStage:
    """Joins the shards' rows into ``shards/index.parquet``, and takes away shards that no plan names any more."""

    name = "shards"

    def plan(self, job: Job) -> list[WorkItem]:
        """One item for the whole job.

        Raises:
            NotReadyError: a shard is still to be packed.
        """
        waiting = [item.name for item in job.pending("pack")]
        if waiting:
            raise NotReadyError(f"{job.root}: {len(waiting)} shards are not packed yet (such as {waiting[0]})")
        rows = {name: receipt.output(".parquet") for name, receipt in sorted(job.done("pack").items())}
        return [
            WorkItem(
                stage=self.name, name="index", owner="", version=1, settings={},
                inputs={name: output.sha256 for name, output in rows.items()}, outputs=(SHARD_INDEX,),
                payload={name: output.path for name, output in rows.items()},
            )
        ]  # fmt: skip

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write the index."""
        rows: list[Member] = []
        for name in item.inputs:
            rows += read_shard_index(root / _rows_path(name))
        write_shard_index(staging / INDEX_NAME, rows)
        for path in (root / SHARDS).glob("*.tar"):
            if path.name not in item.inputs:
                path.unlink(missing_ok=True)
                (root / _rows_path(path.name)).unlink(missing_ok=True)
        return {"members": len(rows), "clips": len({row.key for row in rows})}


def _rows_path(shard: str) -> str:
    return shard_path(f"rows/{shard.removesuffix('.tar')}.parquet")


def _packable(job: Job) -> dict[str, dict[str, Any]]:
    """By key: what a clip's sample depends on, its estimated size, and where its parts lie."""
    rows = {row.key: row for row in job_selection(job).kept}
    rendered, done = job.done("render"), {stage: job.done(stage) for stage in ("cut", "keypoints", "ego", "skeleton")}
    skeletons = job.config.pack.videos == "all"
    runs: dict[str, list[tuple[Span, str]]] = {}
    for name in done["ego"]:
        if not skeletons or name in done["skeleton"]:
            video_id, run = parse_run_item(name)
            runs.setdefault(video_id, []).append((run, name))
    clips = {}
    for key, receipt in rendered.items():
        row = rows[key]
        found = find_run(runs.get(row.video_id, ()), row.span)
        if found is None:
            continue
        run, name = found
        whole = [output for stage in done for output in (done[stage][name].outputs if name in done[stage] else ())]
        share = len(row.span) / len(run)
        size = sum(round(output.size * share) for output in whole) + sum(output.size for output in receipt.outputs)
        files = [job.done("index")[row.video_id].output("index.parquet"), *whole, *receipt.outputs]
        clips[key] = {
            "size": ClipSize(key=key, split=row.split or "train", round=row.round, size=size),
            "digest": _clip_digest(job, row, [*whole, *receipt.outputs]),
            "payload": {
                "run": name,
                "clip": [row.start, row.end],
                "objects": row.objects,
                "files": {output.path: output.sha256 for output in files},
            },
        }
    return clips


def _clip_digest(job: Job, row: ClipRow, files: list[Output]) -> str:
    index = job.done("index")[row.video_id].output("index.parquet")
    values = {name: value for name, value in asdict(row).items() if name not in ("kept", "reason", "round")}
    return digest([values, index.sha256, {output.path: output.sha256 for output in files}])


def _members(root: Path, staging: Path, item: WorkItem, key: str) -> SampleMembers:
    """A sample's members, each made when its turn comes.

    Raises:
        AlteredError: a file that they are made from is not as it was written.
    """
    payload = item.payload["clips"][key]
    for path, sha256 in payload["files"].items():
        check_unaltered(root / path, sha256)
    video_id, run = parse_run_item(payload["run"])
    clip = Span(start=payload["clip"][0], end=payload["clip"][1])
    labels = clip_labels(root, video_id, run, clip)
    ego = read_ego(root / run_path(video_id, run, ".ego.parquet"))
    poses = clip_trajectory(ego, clip).cam_to_world

    def copied(suffix: str) -> Callable[[], bytes]:
        return lambda: _copied(root / run_path(video_id, run, suffix), run, clip, staging / "clip.mp4")

    def stored(suffix: str) -> Callable[[], bytes]:
        return lambda: (root / clip_path(video_id, key, suffix)).read_bytes()

    views: dict[str, Callable[[], bytes]] = {
        "skeleton.mp4": copied(".skeleton.mp4"), "ego.mp4": stored(".ego.mp4"), "objects.mp4": stored(".objects.mp4"),
    }  # fmt: skip
    return {
        "rgb.mp4": copied(".mp4"),
        **(views if item.settings["videos"] == "all" else {}),
        "labels.parquet": lambda: _labels_bytes(labels, clip, staging / "labels.parquet"),
        "cam_to_world.npy": lambda: _array_bytes(poses),
        "txt": stored(".txt"),
        "json": lambda: _record(root, item, key, video_id, run, clip, labels, ego),
    }


def _copied(video: Path, run: Span, clip: Span, scratch: Path) -> bytes:
    copy_clip(video, run, clip, scratch)
    data = scratch.read_bytes()
    scratch.unlink()
    return data


def _labels_bytes(labels: list[Keypoints], clip: Span, scratch: Path) -> bytes:
    write_keypoints(scratch, [replace(label, frame=label.frame - clip.start) for label in labels])
    data = scratch.read_bytes()
    scratch.unlink()
    return data


def _array_bytes(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=False)
    return stream.getvalue()


def _record(
    root: Path, item: WorkItem, key: str, video_id: str, run: Span, clip: Span, labels: list[Keypoints], ego: EgoTable
) -> bytes:
    """A sample's JSON: where it comes from and what was used."""
    index = read_index(root / index_path(video_id))
    frames = read_frames_table(root / run_path(video_id, run, ".frames.parquet"))
    picture = PictureSettings.model_validate(item.settings["picture"])
    tracks = Counter(category for category, _ in {(label.category, label.track_id) for label in labels})
    record = {
        "key": key, "video_id": video_id, "start": clip.start, "end": clip.end, "fps": FPS,
        "split": item.inputs["split"],
        "source": {"sha256": index.sha256, **index.info},
        "picture": asdict(picture_map(index, picture)),
        "views": item.settings["views"] if item.settings["videos"] == "all" else None,
        "intrinsics": asdict(ego.intrinsics),
        "objects": item.payload["clips"][key]["objects"], "tracks": dict(sorted(tracks.items())),
        "schemas": sorted({label.schema for label in labels}),
        **_times(frames, run, clip),
        "ego": _ego_record(ego, run, clip),
    }  # fmt: skip
    return json.dumps(record, sort_keys=True, indent=1).encode()


def _times(frames: RunFrames, run: Span, clip: Span) -> dict[str, Any]:
    rows = slice(clip.start - run.start, clip.end - run.start)
    shown = frames.source_time_s[rows]
    return {
        "source_start_s": round(float(shown[0]), 6), "source_end_s": round(float(shown[-1]), 6),
        "duplicates": int(frames.duplicate[rows].sum()),
    }  # fmt: skip


def _ego_record(ego: EgoTable, run: Span, clip: Span) -> dict[str, Any]:
    rows = slice(clip.start - run.start, clip.end - run.start)
    return {
        "road": ego.road,
        "modes": dict(sorted(Counter(ego.mode[rows]).items())),
        "scale_sources": dict(sorted(Counter(ego.scale_source[rows]).items())),
        "confidence": round(float(np.mean(ego.confidence[rows])), 6),
        "path_length_m": round(clip_trajectory(ego, clip).path_length_m, 6),
    }
