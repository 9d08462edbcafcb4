"""``animatic export coco``: keypoints as COCO JSON, so that tools that know no Parquet can read, show and judge them.

COCO's keypoint format (Lin et al. 2014, cocodataset.org/#format-data) with the ``videos`` and ``track_id`` that
video data sets add to it. A run is a video; the file is written as it grows, with one run's labels in memory at a time.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dataset.layout import parse_run_item, run_path
from dataset.receipts import atomic_write, make_folder, storage_errors
from dataset.tables import read_keypoints
from labeling.errors import ConfigError
from labeling.labels import Keypoints
from labeling.schemas import keypoint_schema
from labeling.skeleton_video import DEFAULT_STYLE
from labeling.timeline import FPS, Span
from labeling.video import read_frames
from pipelines.black_skeletons import print_black_skeletons
from pipelines.console import counted, make_console
from pipelines.export import refuse_job_folder
from pipelines.job import Job, open_job
from pipelines.stages_source import job_selection

COCO_IDS = {"coco17": 1, "wholebody133": 2, "openpose18": 3, "car66": 4, "car24": 5, "lane24": 6}
"""Category ids by schema, the same in every file so that files can be joined; 1 is COCO's own person."""

VISIBLE_SCORE = DEFAULT_STYLE.min_score
"""Points scored below are labelled but not visible: what the skeleton video does not draw."""

SPLITS = ("train", "val")
_JPEG_QUALITY = 95


@dataclass(frozen=True, slots=True, kw_only=True)
class CocoRun:
    """One run as COCO's ``video``, and which of its frames are images."""

    number: int
    """``video_id`` in the file, from 1."""
    video_id: str
    """Of the source."""
    run: Span
    frames: tuple[int, ...]
    """On the source's 24 fps grid, ascending: those that a kept clip of the split shows."""
    first_image: int
    """Image id of the first of ``frames``."""

    @property
    def name(self) -> str:
        """``<video_id>/run_<start>_<end>``."""
        return run_path(self.video_id, self.run, "").removeprefix("videos/")

    def image_name(self, frame: int) -> str:
        """Where an image lies, relative to the folder."""
        return f"images/{self.name}/{frame:08d}.jpg"


def export_coco(job_folder: Path, out: Path, *, split: str | None = None, images: bool = False) -> int:
    """Write ``<split>.coco.json`` for each split that has labelled runs, or for the one that is named; with ``images``
    the frames that it names as JPEG files too.

    Raises:
        ConfigError: no job, a split that is not known, none with labelled runs, or ``out`` is the job's own folder.
        NotReadyError: the job's clips are not selected yet.
        StorageError: no space left, or ``out`` cannot be written to.
    """
    if split not in (None, *SPLITS):
        raise ConfigError(f"--split {split!r} is not known; choose train or val, or leave it out for both")
    job = open_job(job_folder)
    refuse_job_folder(job_folder, out)
    wanted = SPLITS if split is None else (split,)
    planned = {name: runs for name in wanted if (runs := plan_runs_of(job, name))}
    if not planned:
        what = f"its {split} split has" if split else "it has"
        other = "export the other split, " if split else ""
        raise ConfigError(
            f"{job_folder}: {what} no labelled run; run `animatic label --out {job_folder}`, {other}or label more "
            "source videos"
        )
    print_black_skeletons(job_folder, make_console())
    for name, runs in planned.items():
        _export_split(job, out, name, runs, images=images)
    return 0


def _export_split(job: Job, out: Path, split: str, runs: list[CocoRun], *, images: bool) -> None:
    picture = job.config.picture
    table = out / f"{split}.coco.json"
    chunks = coco_chunks(
        runs, lambda run: _labels_of(job.root, run), width=picture.width, height=picture.height, split=split
    )
    atomic_write(table, chunks)
    if images:
        for run in runs:
            _write_images(job.root, run, out)
    count = counted(sum(len(run.frames) for run in runs), "image")
    pictures = f"their pictures in {out / 'images'}" if images else "without their pictures: --images writes them too"
    make_console().print(f"{count} of {counted(len(runs), 'run')} in {table}, {pictures}")


def plan_runs_of(job: Job, split: str) -> list[CocoRun]:
    """The labelled runs that show kept clips of a split, in the order of their names, with their frames and ids."""
    clips: dict[str, list[Span]] = {}
    for row in job_selection(job).kept:
        if (row.split or "train") == split:
            clips.setdefault(row.video_id, []).append(row.span)
    runs: list[CocoRun] = []
    first_image = 1
    for name in sorted(job.done("keypoints")):
        video_id, run = parse_run_item(name)
        shown = {
            frame for clip in clips.get(video_id, ()) if run.contains(clip) for frame in range(clip.start, clip.end)
        }
        if shown:
            frames = tuple(sorted(shown))
            runs.append(
                CocoRun(number=len(runs) + 1, video_id=video_id, run=run, frames=frames, first_image=first_image)
            )
            first_image += len(frames)
    return runs


def coco_chunks(
    runs: Iterable[CocoRun], labels_of: Callable[[CocoRun], list[Keypoints]], *, width: int, height: int, split: str
) -> Iterator[bytes]:
    """The file, piece by piece: images first, then annotations, then the categories that occurred.

    Args:
        runs: what to write.
        labels_of: a run's labels; called once for each run, when its turn comes.
        width: of every image, pixels.
        height: of every image.
        split: for the description.
    """
    runs = list(runs)
    about = {"description": f"Animatic keypoints, {split} split", "version": "1.0", "fps": FPS}
    yield f'{{"info": {_text(about)},\n"licenses": [],\n"videos": ['.encode()
    yield from _joined({"id": run.number, "name": run.name, "width": width, "height": height} for run in runs)
    yield b'],\n"images": ['
    yield from _joined(image for run in runs for image in _images(run, width, height))
    yield b'],\n"annotations": ['
    schemas: set[str] = set()
    yield from _joined(_annotations(runs, labels_of, schemas))
    yield b'],\n"categories": ['
    yield from _joined(coco_category(name) for name in sorted(schemas, key=COCO_IDS.__getitem__))
    yield b"]}\n"


def coco_category(schema_name: str) -> dict[str, Any]:
    """A schema as COCO's category: names of its points, edges from 1 as COCO counts."""
    table = keypoint_schema(schema_name)
    return {
        "id": COCO_IDS[schema_name], "name": table.category, "supercategory": "street", "schema": schema_name,
        "keypoints": list(table.point_names), "skeleton": [[a + 1, b + 1] for a, b in table.edges],
    }  # fmt: skip


def coco_annotation(label: Keypoints, *, number: int, image: int) -> dict[str, Any]:
    """One label as COCO's annotation.

    Coordinates stay as they are in the tables (pixel centres on integers), to a hundredth of a pixel. A point's flag is
    0 (absent: x and y are 0 too), 1 (scored below 0.3: hidden) or 2 (visible); its score and source stand beside.
    COCO's area is that of an outline; here there is none, and it is the box's.
    """
    left, top, right, bottom = (float(value) for value in label.box_xyxy)
    width, height = max(0.0, right - left), max(0.0, bottom - top)
    score = label.points[:, 2]
    flags = np.where(score >= VISIBLE_SCORE, 2, np.where(score > 0, 1, 0))
    points: list[float] = []
    for (x, y), flag in zip(label.points[:, :2].tolist(), flags.tolist(), strict=True):
        points += [round(x, 2), round(y, 2), flag] if flag else [0, 0, 0]
    return {
        "id": number, "image_id": image, "category_id": COCO_IDS[label.schema], "track_id": label.track_id,
        "score": round(label.score, 4), "bbox": [round(value, 2) for value in (left, top, width, height)],
        "area": round(width * height, 2), "iscrowd": 0, "segmentation": [],
        "num_keypoints": int((flags > 0).sum()), "keypoints": points,
        "keypoint_scores": [round(value, 4) for value in score.tolist()],
        "keypoint_sources": label.point_source.tolist(),
    }  # fmt: skip


def _annotations(
    runs: Iterable[CocoRun], labels_of: Callable[[CocoRun], list[Keypoints]], schemas: set[str]
) -> Iterator[dict[str, Any]]:
    number = 0
    for run in runs:
        image_of = {frame: run.first_image + place for place, frame in enumerate(run.frames)}
        for label in labels_of(run):
            if label.frame in image_of:
                number += 1
                schemas.add(label.schema)
                yield coco_annotation(label, number=number, image=image_of[label.frame])


def _images(run: CocoRun, width: int, height: int) -> Iterator[dict[str, Any]]:
    for place, frame in enumerate(run.frames):
        yield {
            "id": run.first_image + place, "video_id": run.number, "frame_id": frame - run.run.start,
            "source_frame": frame, "file_name": run.image_name(frame), "width": width, "height": height,
        }  # fmt: skip


def _labels_of(root: Path, run: CocoRun) -> list[Keypoints]:
    return read_keypoints(root / run_path(run.video_id, run.run, ".keypoints.parquet"))


def _write_images(root: Path, run: CocoRun, out: Path) -> None:
    wanted = set(run.frames)
    video = root / run_path(run.video_id, run.run, ".mp4")
    for frame, picture in enumerate(read_frames(video), start=run.run.start):
        if frame in wanted:
            path = out / run.image_name(frame)
            options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
            data = cv2.imencode(".jpg", picture[..., ::-1], options)[1].tobytes()
            with storage_errors(path):
                make_folder(path.parent)
                path.write_bytes(data)


def _joined(records: Iterable[dict[str, Any]]) -> Iterator[bytes]:
    for number, record in enumerate(records):
        yield (",\n" if number else "\n").encode() + _text(record).encode()


def _text(value: dict[str, Any]) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)
