"""What the trainer notes in an adapter file; read without torch, and without the tensors."""

import contextlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from safetensors import SafetensorError, safe_open

from labeling.errors import ModelError

ADAPTER = "adapter.safetensors"
"""An adapter's file in its folder."""
OUR_METADATA = "animatic"
_SECTIONS = ("optimiser", "backbone", "conditions")
"""Of the settings, what is read again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """How far the training of an adapter has come."""

    step: int
    steps: int

    @property
    def finished(self) -> bool:
        """Whether all steps are done."""
        return self.step >= self.steps


def adapter_file(path: Path) -> Path:
    """The file of an adapter that is named by its folder or by itself."""
    return path / ADAPTER if path.is_dir() else path


def read_about(path: Path) -> dict[str, Any]:
    """What the trainer noted in an adapter file; empty for foreign files.

    Raises:
        ModelError: missing, not safetensors, or with notes that are none.
    """
    with open_adapter(adapter_file(path), framework="np") as file:
        return notes(path, file.metadata() or {})


def read_progress(path: Path) -> Progress | None:
    """How far an adapter's training has come; None where the file does not tell.

    Raises:
        ModelError: as ``read_about``.
    """
    about = read_about(path)
    step, steps = about.get("step"), about.get("config", {}).get("optimiser", {}).get("steps")
    return Progress(step=step, steps=steps) if isinstance(step, int) and isinstance(steps, int) else None


def notes(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """The trainer's notes among a file's metadata.

    Raises:
        ModelError: they are no JSON, or not what the trainer writes.
    """
    told = metadata_object(path, metadata, OUR_METADATA)
    config = told.get("config", {})
    sections = [config, *(config.get(name, {}) for name in _SECTIONS)] if isinstance(config, dict) else [config]
    plain = isinstance(told.get("stage", ""), str) and isinstance(told.get("frames", 0), int)
    if not plain or not all(isinstance(one, dict) for one in sections):
        raise ModelError(
            f"{path}: its metadata {OUR_METADATA!r} holds no settings of a training; take the file as training wrote "
            "it, or a checkpoint's"
        )
    return told


def metadata_object(path: Path, metadata: Mapping[str, str], name: str) -> dict[str, Any]:
    """A JSON object among a file's metadata; empty where there is none.

    Raises:
        ModelError: it is something else.
    """
    text = metadata.get(name, "{}")
    try:
        told = json.loads(text)
    except ValueError:
        told = None
    if not isinstance(told, dict):
        raise ModelError(
            f"{path}: its metadata {name!r} is no JSON object ({text[:40]!r}); take the file as it was written, or "
            "remove that entry"
        )
    return told


@contextlib.contextmanager
def open_adapter(path: Path, *, framework: Literal["pt", "np"]) -> Iterator[Any]:
    """An adapter file, opened; its tensors come as the framework's.

    Raises:
        ModelError: missing, or not safetensors.
    """
    try:
        with safe_open(path, framework=framework) as file:
            yield file
    except (OSError, SafetensorError) as error:
        raise ModelError(f"{path} is no adapter: {error}; give the .safetensors file that training wrote") from error
