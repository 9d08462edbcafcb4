"""A job whose skeleton videos show nothing, since no network gives keypoints."""

import contextlib
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from dataset.layout import JOB_FILE
from labeling.errors import AnimaticError
from pipelines.job import Job, open_job
from pipelines.stages_select import job_extractors


def black_skeletons(job: Job) -> str:
    """What to know of a job without keypoints; empty where some network gives some."""
    # Cards that cannot be had any more have been told of elsewhere.
    with contextlib.suppress(AnimaticError):
        if job_extractors(job).draws_nothing:
            return (
                "skeletons are black, and nothing is learnt from them: no keypoint network's weights are there; "
                "`animatic models` says how to get some"
            )
    return ""


def print_black_skeletons(root: Path, console: Console) -> None:
    """A line, where a folder is a job's and its skeletons show nothing."""
    if (root / JOB_FILE).is_file() and (note := black_skeletons(open_job(root))):
        console.print(f"[yellow]note[/] {escape(note)}")
