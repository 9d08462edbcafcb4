"""What a command changes in a job that is there, said in a line before work starts."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pipelines.console import counted
from pipelines.job import Job

_TABLES = frozenset({"cameras", "select.split"})
"""Settings by video id: told of, not spelt out."""
_MOST = 4


def job_changes(before: Job, after: Job) -> str:
    """In words: ``adds 2 videos to 13; effort balanced -> fast: what depends on it is done again``; empty of none."""
    words = []
    added = after.sources.keys() - before.sources.keys()
    if added:
        words.append(f"adds {counted(len(added), 'video')} to {len(before.sources)}")
    others = [name for name in before.sources if before.sources[name] != after.sources[name]]
    if others:
        words.append(f"{counted(len(others), 'video')} with another path or other seconds left out ({_some(others)})")
    settings = list(_setting_changes(before, after))
    if settings:
        words.append(f"{_some(settings)}: what depends on {'it' if len(settings) == 1 else 'them'} is done again")
    return "; ".join(words)


def _some(words: list[str]) -> str:
    return ", ".join(words[:_MOST]) + f" and {len(words) - _MOST} more" * (len(words) > _MOST)


def _setting_changes(before: Job, after: Job) -> Iterator[str]:
    old, new = (dict(_leaves(job.config.model_dump(mode="json"))) for job in (before, after))
    told: set[str] = set()
    if old["keypoints.effort"] != new["keypoints.effort"]:
        told = {"keypoints.effort", "count.looks_per_clip"}
        yield f"effort {old['keypoints.effort']} -> {new['keypoints.effort']}"
    for name in dict.fromkeys((*old, *new)):
        if name not in told and old.get(name) != new.get(name):
            yield f"{name} changes" if name in _TABLES else f"{name} {_word(old.get(name))} -> {_word(new.get(name))}"
    if _folder(before.models_dir) != _folder(after.models_dir):
        yield f"models {_folder(before.models_dir)} -> {_folder(after.models_dir)}"


def _leaves(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        name = f"{above}{key}"
        if isinstance(value, Mapping) and name not in _TABLES:
            yield from _leaves(value, f"{name}.")
        else:
            yield name, value


def _word(value: Any) -> str:
    return ",".join(map(str, value)) or "none" if isinstance(value, list) else "none" if value is None else str(value)


def _folder(path: Path | None) -> str:
    return str(path) if path else "none"
