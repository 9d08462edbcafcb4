"""A job that is through and holds no clip: why, with counts, and what to change."""

from pathlib import Path

from dataset.inspection import drop_reasons
from dataset.layout import SELECTION
from dataset.receipts import Receipt, reason_counts
from dataset.selection import read_selection
from labeling.errors import AnimaticError, StorageError
from pipelines.job import Job, open_job
from pipelines.stage import STAGES

_MOST_REASONS = 3

_ADVICE = {
    "too_short": "give longer videos, or a smaller clip.clip_frames with --config",
    "hole": "give recordings without gaps, or a smaller clip.clip_frames with --config",
    "cut": "give videos of longer shots, or a smaller clip.clip_frames with --config",
    "left_out": "leave out less with --leave-out",
    "objects": "keep more with --keep-share, or judge anew with `animatic select --refreeze`",
    "sample": "take more with select.sample_clips in --config, or judge anew with `animatic select --refreeze`",
    "same_as": "give each video once",
    "uncounted": "get the files again",
    "no_trajectory": "import trajectories that cover the videos",
}
"""What to change, by the kind of reason."""


def clips_packed(job: Job) -> int | None:
    """How many clips the shards of a job that is through hold; None while they are not up to date.

    Raises:
        NotReadyError: an earlier stage has not ended.
    """
    return next((int(receipt.facts["clips"]) for receipt in job.done("shards").values()), None)


def why_nothing_is_left(root: Path) -> str:
    """One line: how many clips were dropped for what, an example of each, and what to do about the commonest; or, where
    some were kept, what failed, want of storage before all else.

    Raises:
        DataError: the folder holds no selection.
    """
    reasons = drop_reasons(root)
    failed = _failures(root) if len(reasons) < len(read_selection(root / SELECTION).rows) else []
    if failed:
        worst = min(failed, key=lambda receipt: receipt.reason != StorageError.reason)
        more = f" ({len(failed)} items failed in all)" if len(failed) > 1 else ""
        return f"no clip is packed: {worst.stage} of {worst.item} failed: {worst.message}{more}"
    if not reasons:
        return "no clip is left: no video could be read and labelled; `animatic status` says what failed"
    counts = sorted(reason_counts(reasons.values()).items(), key=lambda item: -item[1])
    words = ", ".join(f"{count} {kind} ({_example(reasons, kind)})" for kind, count in counts[:_MOST_REASONS])
    advice = _ADVICE.get(counts[0][0], "`animatic inspect JOB` lists the reasons")
    return f"no clip is left of {len(reasons)}: {words}; {advice}"


def _example(reasons: dict[str, str], kind: str) -> str:
    return next(f"{key}: {reason}" for key, reason in reasons.items() if kind in reason_counts([reason]))


def _failures(root: Path) -> list[Receipt]:
    """Of the items that the job plans, in the order of stages."""
    if not (root / "job.yaml").is_file():
        return []
    job, failed = open_job(root), []
    for stage in STAGES:
        try:
            settled = job.settled(stage)
        except AnimaticError:  # a stage that cannot begin has failed at nothing
            continue
        failed += [receipt for receipt in settled.values() if receipt.state == "failed"]
    return failed
