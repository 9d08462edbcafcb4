"""A job whose shards are older than its settings or videos: what is learnt from is not what it says."""

import contextlib
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from dataset.layout import JOB_FILE, SHARD_INDEX
from labeling.errors import AnimaticError
from pipelines.job import open_job
from pipelines.nothing_left import clips_packed
from pipelines.stage import NotReadyError


def stale_shards(root: Path) -> str:
    """What to know of a job that is packed, but not as it would be now; empty where its shards are up to date.

    Read from plans and receipts, as ``animatic status`` does; nothing is opened but tables.
    """
    if not ((root / JOB_FILE).is_file() and (root / SHARD_INDEX).is_file()):
        return ""
    told = (
        "shards are older than the job's settings, videos or models as they are here; "
        f"`animatic label --out {root}` packs them anew"
    )
    # What cannot be planned at all (a network that is gone) has been told of elsewhere.
    with contextlib.suppress(AnimaticError):
        try:
            return told if clips_packed(open_job(root)) is None else ""
        except NotReadyError:
            return told
    return ""


def print_stale_shards(root: Path, console: Console) -> None:
    """A line, where a job's shards are out of date."""
    if note := stale_shards(root):
        console.print(f"[yellow]note[/] {escape(note)}")
