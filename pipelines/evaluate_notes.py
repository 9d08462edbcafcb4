"""What a reader of an evaluation has to know beside its figures: what was left out, and what rests on what."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from labeling.extractors import ExtractorChoice
from training.evaluation_files import SampleFolder
from training.evaluation_report import (
    FIGURES,
    FLOOR,
    SAMPLES,
    TRUE_SKELETONS,
    VELOCITY,
    ClipResult,
    Report,
)

_FEW_VIDEOS = 5


def clip_notes(splits: Mapping[str, str], folders: Mapping[str, SampleFolder], most: int) -> list[str]:
    """Which clips and files count.

    Args:
        splits: split of each clip of the job, by key.
        folders: what was found, by set.
        most: samples of a clip that count.
    """
    judged = folders[SAMPLES].by_key
    held_out = [key for key, split in splits.items() if split == "val"]
    notes = [f"{sum(key in judged for key in held_out)} of {len(held_out)} held-out clips have samples"]
    seen = [key for key in judged if splits[key] != "val"]
    if seen:
        notes.append(f"{len(seen)} clips are of the training split, such as {seen[0]}: the generator may know them")
    for name, folder in folders.items():
        if folder.strangers:
            some = ", ".join(folder.strangers[:3])
            notes.append(f"{name}: {len(folder.strangers)} files name no clip of the job and were left out: {some}")
        if folder.beyond:
            notes.append(f"{name}: {folder.beyond} samples beyond {most} of a clip were left out")
    if TRUE_SKELETONS in folders:
        shared = [key for key in judged if key in folders[TRUE_SKELETONS].by_key]
        notes.append(f"{len(shared)} of {len(judged)} clips have samples painted over the true skeletons too")
    return notes


def ruler_notes(choice: ExtractorChoice, trajectories: Path | None) -> list[str]:
    """What could not be looked for, and whose trajectories are judged."""
    notes = []
    if not choice.cards:
        notes.append(
            "no extractor's weights are there, so neither boxes nor points are judged (--models, --extractors)"
        )
    else:
        blind = [category for category in choice.missing_categories if category != "lane"]
        notes += [f"no keypoint network for {' and '.join(blind)}: these are judged by boxes alone"] if blind else []
    if trajectories is not None:
        notes.append("the samples' trajectories are imported; the truth video's is the project's own estimate")
    return notes


def record_notes(keys: Sequence[str], unrecorded: Sequence[str], choice: ExtractorChoice) -> list[str]:
    """Which objects the samples are taken to have been given, where no record tells.

    Args:
        keys: of the clips that are judged.
        unrecorded: those without a record.
        choice: the extractors; without any, boxes are not judged.
    """
    if not unrecorded or not choice.cards:
        return []
    return [
        f"{len(unrecorded)} of {len(keys)} clips have no record of what was generated (<key>.json), such as "
        f"{unrecorded[0]}: their samples are taken to have been given the objects of the whole clip"
    ]


def result_notes(report: Report, results: Sequence[ClipResult], *, longest_s: float) -> list[str]:
    """How long the comparison is, in which geometry, and how far intervals can be trusted.

    Args:
        report: the figures.
        results: by clip.
        longest_s: duration of the longest clip, seconds.
    """
    judged = report.sets[SAMPLES]
    notes = []
    if judged.seconds[0] < longest_s - 1e-3:
        span = " to ".join(f"{one:.2f}" for one in dict.fromkeys(judged.seconds))
        notes.append(f"compared over {span} s, which truth and samples share; clips last up to {longest_s:.2f} s")
    used = [result.sets[SAMPLES].score.samples.get("min_ade_m", 0) for result in results]
    if sum(used) < judged.samples:
        rest = f"minADE and APD rest on {sum(used) / len(used):.1f} samples of a clip, and fewer make minADE larger"
        some = f"trajectories were found in {sum(used)} of {judged.samples} samples"
        notes.append(f"{some}: {rest if any(used) else 'nothing can be said of how the camera moves'}")
    notes += blind_ruler(report)
    if len(judged.geometries) > 1:
        notes.append(
            f"samples are of {len(judged.geometries)} frame rates, sizes or lengths; each is judged at its own"
        )
    if report.videos < _FEW_VIDEOS:
        what = (
            "one source video, so they are the range over its clips"
            if report.videos == 1
            else (f"{report.videos} source videos: wide, and not to be relied on")
        )
        notes.append(f"intervals rest on {what}")
    return notes


def blind_ruler(report: Report) -> list[str]:
    """Figures in which the truth itself is worse than a guess that looks at nothing: such videos cannot be read."""
    floor, guess = (report.sets[name].figures if name in report.sets else {} for name in (FLOOR, VELOCITY))
    worse = [
        figure.label.format(k="")
        for figure in FIGURES
        if figure.name in floor and figure.name in guess and figure.better != "neither"
        and (floor[figure.name].mean - guess[figure.name].mean) * (1 if figure.better == "lower" else -1) > 0
    ]  # fmt: skip
    if not worse:
        return []
    return [
        f"the truth's own video is worse than constant velocity in {', '.join(worse)}: at this size videos are read "
        "too badly for these figures to say much"
    ]
