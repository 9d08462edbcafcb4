"""What the files of a job are called, relative to its folder."""

import re

from labeling.errors import DataError
from labeling.timeline import Span, run_name

JOB_FILE = "job.yaml"
SELECTION = "selection.parquet"
RECEIPTS = "receipts"
SHARDS = "shards"
INDEX_NAME = "index.parquet"
"""In whatever folder shards lie."""
SHARD_INDEX = f"{SHARDS}/{INDEX_NAME}"
LATENTS = "latents"
"""A folder per backbone."""
REPORT = "report.html"


def index_path(video_id: str) -> str:
    """Packet times of a source."""
    return f"videos/{video_id}/index.parquet"


def counts_path(video_id: str) -> str:
    """What the detector saw on a source's keyframes."""
    return f"videos/{video_id}/counts.parquet"


def camera_path(video_id: str) -> str:
    """The one camera of a video."""
    return f"videos/{video_id}/camera.json"


def trajectory_path(video_id: str) -> str:
    """A video's imported trajectory."""
    return f"trajectories/{video_id}.txt"


def run_item(video_id: str, run: Span) -> str:
    """A run's item name."""
    return f"{video_id}/{run_name(run)}"


def run_path(video_id: str, run: Span, suffix: str) -> str:
    """A run's file: ``.mp4``, ``.skeleton.mp4``, ``.frames.parquet``, ``.keypoints.parquet``, ``.corners.npz`` or
    ``.ego.parquet``."""
    return f"videos/{video_id}/{run_name(run)}{suffix}"


def clip_path(video_id: str, key: str, suffix: str) -> str:
    """A clip's own file: ``.ego.mp4``, ``.objects.mp4`` or ``.txt``."""
    return f"videos/{video_id}/clips/{key}{suffix}"


def shard_path(name: str) -> str:
    """A shard's tar, or its rows of the index."""
    return f"{SHARDS}/{name}"


def parse_run_item(item: str) -> tuple[str, Span]:
    """Video id and span of a run's item name.

    Raises:
        DataError: it is no run's name.
    """
    match = re.fullmatch(r"([^/]+)/run_(\d+)_(\d+)", item)
    if match is None:
        raise DataError(f"{item!r} is no run; runs are called <video_id>/run_<start>_<end>")
    return match[1], Span(start=int(match[2]), end=int(match[3]))
