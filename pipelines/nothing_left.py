"""A job that is through and holds no clip: why, with counts, and what to change."""

from pathlib import Path

from dataset.inspection import drop_reasons
from dataset.receipts import reason_counts
from pipelines.job import Job

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
    """One line: how many clips were dropped for what, an example of each, and what to do about the commonest.

    Raises:
        DataError: the folder holds no selection.
    """
    reasons = drop_reasons(root)
    if not reasons:
        return "no clip is left: no video could be read and labelled; `animatic status` says what failed"
    counts = sorted(reason_counts(reasons.values()).items(), key=lambda item: -item[1])
    words = ", ".join(f"{count} {kind} ({_example(reasons, kind)})" for kind, count in counts[:_MOST_REASONS])
    advice = _ADVICE.get(counts[0][0], "`animatic inspect JOB` lists the reasons")
    return f"no clip is left of {len(reasons)}: {words}; {advice}"


def _example(reasons: dict[str, str], kind: str) -> str:
    return next(f"{key}: {reason}" for key, reason in reasons.items() if kind in reason_counts([reason]))
