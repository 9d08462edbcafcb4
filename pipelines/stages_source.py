"""Stages that read the source videos: their content's hash, their packets, and the runs cut from them."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dataset.layout import SELECTION, index_path, run_item, run_path
from dataset.receipts import Receipt, sha256_file
from dataset.selection import Selection, read_selection
from dataset.tables import VideoIndex, read_index, write_frames, write_index
from labeling.camera import PictureMap, cover_map
from labeling.encoding import EncoderSettings
from labeling.errors import VideoError
from labeling.timeline import Span, cut_run, plan_runs, plan_timeline
from labeling.video import PacketTimes, VideoInfo, frame_count, probe, read_packet_times
from pipelines.config import PictureSettings
from pipelines.job import Job
from pipelines.sources import Source
from pipelines.stage import NotReadyError, WorkItem


class SourceStage:
    """Hashes each source's content: what everything made from it depends on. No output but the receipt."""

    name = "source"

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per video, out of date when the file's size or time changes."""
        known = job.receipts(self.name)
        return [self._item(source, known.get(name)) for name, source in job.sources.items()]

    def _item(self, source: Source, known: Receipt | None) -> WorkItem:
        try:
            status = source.path.stat()
            seen: dict[str, Any] = {"size": status.st_size, "mtime_ns": status.st_mtime_ns}
        except OSError:
            # What was made from a source outlives it: the last look still holds.
            seen = dict(known.facts["seen"]) if known and "seen" in known.facts else {"missing": str(source.path)}
        return WorkItem(
            stage=self.name, name=source.video_id, owner=source.video_id, version=1, settings={}, inputs=seen,
            payload={"path": str(source.path)}, weight=float(seen.get("size", 1)),
        )  # fmt: skip

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Read the file once.

        Raises:
            VideoError: there is no such file, or it cannot be read.
        """
        path = Path(item.payload["path"])
        if not path.exists():
            raise VideoError(f"{path}: no such file; check the path")
        try:
            return {"sha256": sha256_file(path), "seen": dict(item.inputs)}
        except OSError as error:
            raise VideoError(f"{path}: cannot be read ({error.strerror}); check what it is") from error


class IndexStage:
    """Reads each source's packets: presentation times and keyframes. Nothing is decoded but a frame or two."""

    name = "index"

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per video whose content is known."""
        return [
            WorkItem(
                stage=self.name, name=name, owner=name, version=2, settings={},
                inputs={"source": receipt.facts["sha256"]}, outputs=(index_path(name),),
                payload={"path": str(job.sources[name].path)}, weight=float(receipt.facts["seen"].get("size", 1)),
            )
            for name, receipt in job.done("source").items()
        ]  # fmt: skip

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write ``index.parquet``.

        Raises:
            VideoError: it is no video that can be used; the message says why.
        """
        path = Path(item.payload["path"])
        info, packets = probe(path), read_packet_times(path)
        facts = {name: value for name, value in asdict(info).items() if name != "path"}
        facts["broken_packets"] = packets.broken_packets
        index = VideoIndex(
            times_s=packets.times_s, is_keyframe=packets.is_keyframe, info=facts, sha256=item.inputs["source"]
        )
        write_index(staging / "index.parquet", index)
        return {
            **packet_facts(info, packets), "frames": len(packets.times_s), "keyframes": int(packets.is_keyframe.sum()),
            "width": info.width, "height": info.height,
        }  # fmt: skip


def packet_facts(info: VideoInfo, packets: PacketTimes) -> dict[str, Any]:
    """What a video's packets hold, and what its header promises: facts of the index."""
    return {
        "seconds": round(float(packets.times_s[-1] - packets.times_s[0]), 6), "promised_s": round(info.duration_s, 6),
        "broken_packets": packets.broken_packets,
    }  # fmt: skip


class CutStage:
    """Cuts the runs around kept clips: every needed frame decoded and encoded once."""

    name = "cut"

    def plan(self, job: Job) -> list[WorkItem]:
        """One item per run.

        Raises:
            NotReadyError: there is no selection that fits the job's videos and settings.
        """
        index = job.done("index")
        settings = {
            "picture": job.config.picture.model_dump(mode="json"), "encoder": job.config.encoder.model_dump(mode="json")
        }  # fmt: skip
        items = []
        for video_id, runs in selected_runs(job).items():
            if video_id not in index:
                continue
            for run in runs:
                items.append(
                    WorkItem(
                        stage=self.name, name=run_item(video_id, run), owner=video_id, version=2, settings=settings,
                        inputs={"index": index[video_id].output("index.parquet").sha256, "run": [run.start, run.end]},
                        outputs=(run_path(video_id, run, ".mp4"), run_path(video_id, run, ".frames.parquet")),
                        payload={"path": str(job.sources[video_id].path), "index": index_path(video_id)},
                        weight=float(len(run)),
                    )
                )  # fmt: skip
        return items

    def work(self, root: Path, item: WorkItem, staging: Path) -> Mapping[str, Any]:
        """Write the run's video and frame table.

        Raises:
            VideoError: the source has changed, or no frame of the run decodes.
        """
        index = read_index(root / item.payload["index"])
        start, end = item.inputs["run"]
        picture = PictureSettings.model_validate(item.settings["picture"])
        video, frames_table = (staging / Path(name).name for name in item.outputs)
        frames = cut_run(
            Path(item.payload["path"]), plan_timeline(index.times_s), Span(start=start, end=end), video,
            picture=picture_map(index, picture), encoder=EncoderSettings.model_validate(item.settings["encoder"]),
        )  # fmt: skip
        if frame_count(video) != end - start:
            raise VideoError(f"{item.name}: holds {frame_count(video)} of {end - start} frames; please report it")
        write_frames(frames_table, frames)
        return {
            "frames": end - start, "holes": int(frames.hole.sum()), "cuts": int(frames.cut.sum()),
            "duplicates": int(frames.duplicate.sum()),
        }  # fmt: skip


def picture_map(index: VideoIndex, picture: PictureSettings) -> PictureMap:
    """How a source's upright picture becomes the working picture."""
    return cover_map(index.info["width"], index.info["height"], width=picture.width, height=picture.height)


def job_selection(job: Job) -> Selection:
    """The job's selection, if it fits its videos and settings.

    Raises:
        NotReadyError: it does not, or there is none yet.
    """
    if not job.done("select"):
        raise NotReadyError(f"{job.root}: the clips are not selected yet; run `animatic select --out {job.root}`")
    return read_selection(job.root / SELECTION)


def selected_runs(job: Job) -> dict[str, list[Span]]:
    """The runs around kept clips, by video id."""
    spans: dict[str, list[Span]] = {}
    for row in job_selection(job).kept:
        spans.setdefault(row.video_id, []).append(row.span)
    return {
        video_id: plan_runs(clips, run_frames=job.config.clip.run_frames) for video_id, clips in sorted(spans.items())
    }
