"""Checkpoints: staged in a hidden folder, synced, the manifest last, then renamed. One that is torn is never loaded.

<out>/checkpoints/step_00000020/  adapter.safetensors  optimiser.safetensors  state.json  manifest.json
"""

import contextlib
import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import torch
from safetensors.torch import save_file

from dataset.receipts import make_folder, storage_errors, sync_folder
from labeling.errors import DataError, StorageError
from training.claims import owner, sweep

MANIFEST = "manifest.json"
_ASIDE = ".old"
"""Of a checkpoint that another of the same step takes the place of: a kill in between leaves one or both."""


def checkpoint_folder(root: Path, step: int) -> Path:
    """Where the checkpoint of a step lies."""
    return root / f"step_{step:08d}"


def save_checkpoint(root: Path, step: int, files: Mapping[str, bytes | dict[str, torch.Tensor]], *, keep: int) -> Path:
    """Write a checkpoint and drop all but the newest ``keep``, this one always among them.

    Args:
        root: folder of the checkpoints.
        step: optimiser steps done.
        files: contents by name; tensors go to safetensors without a copy of them all in memory.
        keep: how many to keep.

    Raises:
        StorageError: no space left, or the folder cannot be written to; earlier checkpoints are untouched.
    """
    goal, staged = checkpoint_folder(root, step), root / f".step_{step:08d}.{owner()}"
    aside = goal.with_suffix(_ASIDE)
    with _kept_alone(root), storage_errors(root):
        shutil.rmtree(staged, ignore_errors=True)
        make_folder(staged)
        try:
            for name, data in files.items():
                _write_synced(staged / name, data)
            listed = {
                name: {"size": (staged / name).stat().st_size, "sha256": _digest(staged / name)} for name in files
            }
            _write_synced(staged / MANIFEST, json.dumps({"step": step, "files": listed}, sort_keys=True).encode())
            sync_folder(staged)
            # An earlier one of that step stays until this one is in its place: it may be the only one.
            if goal.exists():
                shutil.rmtree(aside, ignore_errors=True)
                goal.rename(aside)
            staged.rename(goal)
            sync_folder(root)
        finally:
            shutil.rmtree(staged, ignore_errors=True)
        _prune(root, keep=keep, written=goal)
    return goal


@contextlib.contextmanager
def _kept_alone(root: Path) -> Iterator[None]:
    """A folder that vanishes while it is written to is another's doing, and no fault of ours."""
    try:
        yield
    except FileNotFoundError as error:
        raise StorageError(
            f"{root}: {error.filename} was taken away while a checkpoint was written; let nothing else change that "
            "folder, and run the command again"
        ) from error


def _write_synced(path: Path, data: bytes | dict[str, torch.Tensor]) -> None:
    if isinstance(data, dict):
        save_file(data, path)
    with path.open("ab" if isinstance(data, dict) else "wb") as file:
        if isinstance(data, bytes):
            file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _digest(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _prune(root: Path, *, keep: int, written: Path) -> None:
    for aside in root.glob(f"step_*{_ASIDE}"):
        shutil.rmtree(aside, ignore_errors=True)
    # A run that went on from an older checkpoint has written one that is not the newest by its step.
    others = [path for path in list_checkpoints(root) if path != written]
    for path in others[: max(0, len(others) + 1 - keep)]:
        shutil.rmtree(path, ignore_errors=True)
    sweep(root.glob(".step_*"))


def list_checkpoints(root: Path) -> list[Path]:
    """Checkpoint folders by step, oldest first; whether they are whole is not looked at."""
    found = [path for path in root.glob("step_*") if path.is_dir()]
    return sorted(found, key=lambda path: (path.name.removesuffix(_ASIDE), path.suffix != _ASIDE))


def check_checkpoint(path: Path, *, wanted: Collection[str] = ()) -> int:
    """The step of a whole checkpoint, which holds the files that are wanted and all others that its manifest lists.

    Raises:
        DataError: a file is missing, cut short or changed.
    """
    try:
        manifest = json.loads((path / MANIFEST).read_text(encoding="utf-8"))
        step = int(manifest["step"])
        files = {name: (told["size"], told["sha256"]) for name, told in manifest["files"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path} has no whole manifest ({type(error).__name__}); it was not finished") from error
    unlisted = sorted(set(wanted) - set(files))
    if unlisted:
        raise DataError(f"{path}: its manifest does not list {', '.join(unlisted)}; take an earlier checkpoint")
    for name, (size, digest) in files.items():
        file = path / name
        if not file.is_file() or file.stat().st_size != size:
            raise DataError(f"{path}: {name} is missing or cut short; take an earlier checkpoint")
        if _digest(file) != digest:
            raise DataError(f"{path}: {name} does not match its manifest; take an earlier checkpoint")
    return step


def newest_checkpoint(root: Path, *, wanted: Collection[str] = ()) -> Path | None:
    """The newest whole checkpoint; torn ones are skipped with a warning. None where there is none."""
    for path in reversed(list_checkpoints(root)):
        try:
            check_checkpoint(path, wanted=wanted)
        except DataError as error:
            warnings.warn(f"skipping a torn checkpoint: {error}", stacklevel=2)
            continue
        return path
    return None
