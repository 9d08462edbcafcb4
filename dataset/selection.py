"""Which clips are kept: the share with the most objects, split by source video, sampled by rank of a hash.

The threshold and the sampling cut-off are frozen with the selection, so that a video added later is judged as the
others were and changes nothing for them. Dropped clips stay in the table with their reason.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dataset.receipts import hashed_share
from dataset.tables import SELECTION_SCHEMA, read_table, table_of, write_table
from labeling.errors import ConfigError, DataError
from labeling.timeline import ClipPlan, Span, Timeline, clip_key

SelectionMode = Literal["auto", "extend", "refreeze"]

_LEAST_GAP_S = 1.0
_SAME_AS = "same_as="
"""The reason of clips whose video has the bytes of another: its id follows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipRow:
    """One clip of the selection."""

    key: str
    video_id: str
    start: int
    """First frame on the video's grid."""
    end: int
    """One past the last."""
    objects: float | None = None
    """Mean number of counted objects in the frames looked at; None where nothing was counted."""
    kept: bool = True
    split: str | None = None
    reason: str | None = None
    """Why it is dropped: a slug with its numbers."""
    round: int = 0
    """How often the selection had been extended when this clip's video came in."""

    @property
    def span(self) -> Span:
        """Its frames on the video's grid."""
        return Span(start=self.start, end=self.end)


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectionRule:
    """What decides; a change of any of it is a new selection."""

    keep_share: float = 0.5
    seed: int = 0
    sample_clips: int | None = None
    val_share: float = 0.1
    split: Mapping[str, str] | None = None
    """Split by video id, instead of the hash; videos that it does not name are an error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """All clips of all videos, with a verdict each, and what was frozen."""

    rows: tuple[ClipRow, ...]
    """Sorted by video id and start."""
    threshold: float | None
    """Least number of objects; None where every clip is kept."""
    sample_cutoff: float | None
    """Clips whose hash lies above it are not sampled; None where all are."""
    rounds: int = 0
    """How often it was extended."""
    digests: Mapping[str, str]
    """What each video's verdicts rest on: a digest of its index, counts and what is left out."""
    rule_digest: str = ""
    """Of the rule and of how objects were counted."""

    @property
    def kept(self) -> list[ClipRow]:
        """The clips that go on."""
        return [row for row in self.rows if row.kept]


def plan_looks(
    timeline: Timeline, clips: Sequence[Span], keyframe_times_s: np.ndarray, *, looks_per_clip: int
) -> np.ndarray:
    """At which source frames to count: keyframes a second apart, and where a clip has too few, others spread over it.

    Args:
        timeline: the video's grid.
        clips: half-open spans on it.
        keyframe_times_s: (M,) float64, sorted.
        looks_per_clip: frames to look at in each clip, at least.

    Returns:
        (L,) float64, presentation times, strictly increasing.
    """
    chosen = _spaced(keyframe_times_s, _LEAST_GAP_S)
    looks: set[float] = set()
    for clip in clips:
        shown = timeline.source_time_s[clip.start : clip.end]
        inside = chosen[(chosen >= shown[0]) & (chosen <= shown[-1])]
        looks.update(float(time) for time in inside)
        if len(inside) < looks_per_clip:
            middles = (np.arange(looks_per_clip) + 0.5) / looks_per_clip * len(shown)
            looks.update(float(time) for time in shown[middles.astype(int)])
    return np.array(sorted(looks), dtype=np.float64)


def _spaced(times_s: np.ndarray, gap_s: float) -> np.ndarray:
    kept: list[float] = []
    for time in times_s:
        if not kept or time - kept[-1] >= gap_s - 1e-6:
            kept.append(float(time))
    return np.array(kept, dtype=np.float64)


def count_objects(
    timeline: Timeline,
    clips: Sequence[Span],
    *,
    look_times_s: np.ndarray,
    classes: Sequence[Sequence[str]],
    scores: Sequence[Sequence[float]],
    counted: Collection[str],
    min_score: float,
) -> list[float | None]:
    """Mean number of counted objects over the frames looked at in each clip; None where no look fell into it."""
    wanted = set(counted)
    per_look = np.array(
        [
            sum(name in wanted and score >= min_score for name, score in zip(names, values, strict=True))
            for names, values in zip(classes, scores, strict=True)
        ],
        dtype=np.float64,
    )
    means: list[float | None] = []
    for clip in clips:
        shown = timeline.source_time_s[clip.start : clip.end]
        first, last = np.searchsorted(look_times_s, [shown[0] - 1e-6, shown[-1] + 1e-6])
        means.append(float(np.float32(per_look[first:last].mean())) if last > first else None)
    return means


def candidate_rows(video_id: str, plan: ClipPlan, objects: Sequence[float | None] | None) -> list[ClipRow]:
    """A video's clips before selection: its whole ones with their counts, the others with the reason they are not."""
    counts = objects if objects is not None else [None] * len(plan.kept)
    rows = [_row(video_id, span, objects=count) for span, count in zip(plan.kept, counts, strict=True)]
    if objects is not None:
        rows = [
            row if row.objects is not None else replace(row, kept=False, reason="uncounted: no frame decodes")
            for row in rows
        ]
    rows += [replace(_row(video_id, drop.span), kept=False, reason=drop.reason) for drop in plan.dropped]
    return sorted(rows, key=lambda row: row.start)


def _row(video_id: str, span: Span, *, objects: float | None = None) -> ClipRow:
    return ClipRow(
        key=clip_key(video_id, span.start), video_id=video_id, start=span.start, end=span.end, objects=objects
    )


def select_clips(
    candidates: Mapping[str, Sequence[ClipRow]],
    rule: SelectionRule,
    *,
    digests: Mapping[str, str],
    rule_digest: str,
    previous: Selection | None = None,
    mode: SelectionMode = "auto",
    twins: Mapping[str, Sequence[str]] | None = None,
) -> Selection:
    """Judge every clip.

    Args:
        candidates: rows by video id, from ``candidate_rows``.
        rule: what decides.
        digests: what each video's rows rest on.
        rule_digest: of the rule and of how objects were counted.
        previous: the selection so far.
        mode: ``auto`` extends a selection that was made by the same rule and makes a new one otherwise; ``extend``
            does the former or fails; ``refreeze`` makes a new one.
        twins: by video id, all ids of the same content, that one among them. One of them is judged, the first or the
            one that a selection which is extended holds already; the clips of the others are dropped, since the same
            footage must neither count twice nor stand in both splits.

    Raises:
        ConfigError: ``extend`` without a selection or after the rule has changed, or a split that lacks a video.
    """
    if mode == "extend":
        check_extendable(previous, rule_digest)
    if previous is not None and mode != "refreeze" and previous.rule_digest == rule_digest:
        return _extended(_without_twins(candidates, twins, previous), rule, previous, digests)
    candidates = _without_twins(candidates, twins, None)
    free = [row for rows in candidates.values() for row in rows if row.kept]
    threshold = object_threshold([row.objects for row in free if row.objects is not None], rule.keep_share)
    cutoff = _sample_cutoff([row for row in free if _enough(row, threshold)], rule)
    rows = [_judged(row, threshold, cutoff, rule.seed) for rows in candidates.values() for row in rows]
    splits = video_splits(list(candidates), rule, kept={row.video_id for row in rows if row.kept})
    return Selection(
        rows=_ordered(_split(rows, splits)),
        threshold=threshold,
        sample_cutoff=cutoff,
        digests=dict(digests),
        rule_digest=rule_digest,
    )


def twin_holders(selection: Selection) -> dict[str, str]:
    """By video id, the one that stands for it: of videos whose clips are dropped because another has the same bytes."""
    return {row.video_id: row.reason.removeprefix(_SAME_AS) for row in selection.rows if _is_twin(row) and row.reason}


def _is_twin(row: ClipRow) -> bool:
    return (row.reason or "").startswith(_SAME_AS)


def _without_twins(
    candidates: Mapping[str, Sequence[ClipRow]], twins: Mapping[str, Sequence[str]] | None, previous: Selection | None
) -> dict[str, Sequence[ClipRow]]:
    """The candidates, with whole clips of all but one of the videos of the same content dropped."""
    judged = set(previous.digests) - set(twin_holders(previous)) if previous else set()
    result = dict(candidates)
    for name, same in (twins or {}).items():
        there = [other for other in same if other in candidates]
        holder = min(there, key=lambda other: (other not in judged, other), default=name)
        if holder != name and name in candidates:
            dropped = f"{_SAME_AS}{holder}"
            result[name] = [replace(row, kept=False, reason=dropped) if row.kept else row for row in candidates[name]]
    return result


def check_extendable(previous: Selection | None, rule_digest: str) -> None:
    """Raise ``ConfigError`` where there is no selection so far, or it was made by another rule."""
    if previous is None or previous.rule_digest != rule_digest:
        raise ConfigError(
            "there is no selection to extend" + (", or its rule has changed" if previous else "")
            + "; run `animatic select` or `animatic select --refreeze`"
        )  # fmt: skip


def _extended(
    candidates: Mapping[str, Sequence[ClipRow]], rule: SelectionRule, previous: Selection, digests: Mapping[str, str]
) -> Selection:
    """Videos that are new or changed are judged by what was frozen; the others stay as they are."""
    same = {name for name in candidates if previous.digests.get(name) == digests[name]}
    new = [name for name in candidates if name not in same]
    rounds = previous.rounds + any(name not in previous.digests for name in new)
    known = {row.video_id: row.split for row in previous.rows if row.split}
    rows = [row for row in previous.rows if row.video_id in same]
    old_round = {row.video_id: row.round for row in previous.rows}
    for name in new:
        for row in candidates[name]:
            judged = _judged(row, previous.threshold, previous.sample_cutoff, rule.seed)
            rows.append(replace(judged, round=old_round.get(name, rounds)))
    # What a person says of a video holds whenever it is said; the hash's word is kept.
    if rule.split or not known:
        splits = video_splits(list(candidates), rule, kept={row.video_id for row in rows if row.kept})
    else:
        # Footage keeps its split when its video is taken out and one of the same bytes stands in.
        heirs = {name: known[gone] for name, gone in twin_holders(previous).items() if gone in known}
        splits = {**_hashed_splits(new, rule), **heirs, **known}
    return replace(previous, rows=_ordered(_split(rows, splits)), rounds=rounds, digests=dict(digests))


def object_threshold(objects: Sequence[float], keep_share: float) -> float | None:
    """The least count among the ``keep_share`` of clips with the most; clips that tie with it are kept too."""
    if keep_share >= 1 or not objects:
        return None
    keep = max(1, math.ceil(keep_share * len(objects) - 1e-9))
    return float(sorted(objects, reverse=True)[keep - 1])


def video_splits(
    video_ids: Sequence[str], rule: SelectionRule, *, kept: Collection[str] | None = None
) -> dict[str, str]:
    """The split of each source video; unless a person gives it, train is never empty, and one source goes all to train.

    Args:
        video_ids: all source videos.
        rule: what decides.
        kept: those with a clip that is kept, for the others fill no split; None takes all.

    Raises:
        ConfigError: the rule names splits, and not for every video.
    """
    splits = _hashed_splits(video_ids, rule)
    filling = [name for name in video_ids if kept is None or name in kept]
    if filling and rule.split is None and all(splits[name] != "train" for name in filling):
        splits[max(filling, key=lambda name: hashed_share(rule.seed, "split", name))] = "train"
    return splits


def _hashed_splits(video_ids: Sequence[str], rule: SelectionRule) -> dict[str, str]:
    if rule.split is None:
        return {
            name: "val" if hashed_share(rule.seed, "split", name) < rule.val_share else "train" for name in video_ids
        }
    check_split(rule.split, video_ids)
    return {name: rule.split[name] for name in video_ids}


def check_split(split: Collection[str], video_ids: Collection[str]) -> None:
    """Raise ``ConfigError`` unless a split that a person gives names every video."""
    missing = sorted(set(video_ids) - set(split))
    if missing:
        raise ConfigError(f"the split names no split for video {missing[0]!r}; give train or val for every video")


def _judged(row: ClipRow, threshold: float | None, cutoff: float | None, seed: int) -> ClipRow:
    if not row.kept:
        return row
    if not _enough(row, threshold):
        return replace(row, kept=False, reason=f"objects={row.objects:.3g} < threshold={threshold:.3g}")
    share = hashed_share(seed, "sample", row.key)
    if cutoff is not None and share > cutoff:
        return replace(row, kept=False, reason=f"sample={share:.6f} > cutoff={cutoff:.6f}")
    return row


def _split(rows: Sequence[ClipRow], splits: Mapping[str, str]) -> list[ClipRow]:
    return [replace(row, split=splits[row.video_id]) if row.kept else row for row in rows]


def _enough(row: ClipRow, threshold: float | None) -> bool:
    return threshold is None or (row.objects is not None and row.objects >= threshold)


def _sample_cutoff(rows: Sequence[ClipRow], rule: SelectionRule) -> float | None:
    if rule.sample_clips is None or rule.sample_clips >= len(rows):
        return None
    return sorted(hashed_share(rule.seed, "sample", row.key) for row in rows)[rule.sample_clips - 1]


def _ordered(rows: Sequence[ClipRow]) -> tuple[ClipRow, ...]:
    return tuple(sorted(rows, key=lambda row: (row.video_id, row.start)))


def write_selection(path: Path, selection: Selection) -> None:
    """Write ``selection.parquet``; what is frozen goes into its metadata."""
    frozen: dict[str, Any] = {
        "threshold": selection.threshold, "sample_cutoff": selection.sample_cutoff, "rounds": selection.rounds,
        "digests": dict(selection.digests), "rule_digest": selection.rule_digest,
    }  # fmt: skip
    write_table(path, table_of(SELECTION_SCHEMA, [asdict(row) for row in selection.rows]), metadata=frozen)


def read_selection(path: Path) -> Selection:
    """The selection of a job.

    Raises:
        DataError: it is missing or not what it claims.
    """
    table, frozen = read_table(path, SELECTION_SCHEMA)
    try:
        return Selection(rows=tuple(ClipRow(**row) for row in table.to_pylist()), **frozen)
    except TypeError as error:
        raise DataError(
            f"{path}: lacks what a selection freezes ({error}); run `animatic select --refreeze`"
        ) from error
