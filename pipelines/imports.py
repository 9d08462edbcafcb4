"""``animatic ego --import``: trajectories from elsewhere, checked, copied into the job, and named in its settings."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from dataset.layout import index_path, trajectory_path
from dataset.receipts import atomic_write, sha256_file
from dataset.tables import read_index
from labeling.ego_import import FileClock, read_drive, trajectory_format
from labeling.errors import ConfigError, TrajectoryError
from pipelines.job import Job
from pipelines.sources import ImportedTrajectory

SUFFIXES = (".tum", ".kitti", ".txt")


def import_trajectories(job: Job, path: Path, *, clock: FileClock | None = None) -> tuple[str, ...]:
    """Take a file, or all of a folder's, as the trajectories of a job's videos; the ids of those videos.

    Nothing is taken unless every file can be.

    Raises:
        ConfigError: no file belongs to a video of the job.
        TrajectoryError: a file that cannot be what it claims, or of another length than its video.
        StorageError: the job's folder cannot be written to.
    """
    clock = clock or FileClock()
    files = match_files(path, tuple(job.sources))
    for video_id, file in files.items():
        _check(job, video_id, file, clock)
    for video_id, file in files.items():
        name = trajectory_path(video_id)
        atomic_write(job.root / name, file.read_bytes())
        given = ImportedTrajectory(
            file=name, sha256=sha256_file(job.root / name), offset_s=clock.offset_s, fps=clock.fps
        )
        job.sources[video_id] = replace(job.sources[video_id], trajectory=given)
    job.save()
    job.refresh()
    return tuple(files)


def match_files(path: Path, video_ids: tuple[str, ...]) -> Mapping[str, Path]:
    """The files that belong to videos: by their name without its ending; a single file may have any name where the job
    has a single video.

    Raises:
        ConfigError: none belongs to one, or two belong to the same.
    """
    if path.is_dir():
        matched: dict[str, Path] = {}
        for file in sorted(path.iterdir()):
            if file.suffix.lower() not in SUFFIXES or file.stem not in video_ids:
                continue
            if file.stem in matched:
                both = f"{matched[file.stem].name} and {file.name}"
                raise ConfigError(f"{path}: holds two trajectories of {file.stem}, {both}; keep one")
            matched[file.stem] = file
        if not matched:
            raise ConfigError(
                f"{path}: holds no trajectory of a video of this job; call the files <video_id>.tum or .txt, as "
                f"{_some(video_ids)}.tum"
            )
        return matched
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; check the path")
    if path.stem in video_ids:
        return {path.stem: path}
    if len(video_ids) == 1:
        return {video_ids[0]: path}
    raise ConfigError(
        f"{path}: {path.stem!r} is none of the job's {len(video_ids)} videos; call the file <video_id>.tum or .txt, as "
        f"{_some(video_ids)}.tum"
    )


def _some(video_ids: tuple[str, ...]) -> str:
    return min(video_ids, default="<video_id>")


def _check(job: Job, video_id: str, file: Path, clock: FileClock) -> None:
    times: np.ndarray | None = None
    if video_id in job.done("index"):
        times = read_index(job.root / index_path(video_id)).times_s
        times = times - times[0]
    elif trajectory_format(file) == "kitti" and clock.fps is None:
        raise TrajectoryError(
            f"{file}: carries no times and {video_id} is not indexed yet; run `animatic index`, or give --fps"
        )
    read_drive(file, video_times_s=times, clock=clock)
