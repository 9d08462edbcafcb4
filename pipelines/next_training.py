"""What to type next in a job that is packed: its latents, then its adapters, then a sample.

Read from names and headers of files alone, since the modules that write them load torch.
"""

import shlex
from pathlib import Path

from dataset.layout import LATENTS, SHARD_INDEX
from dataset.shards import read_shard_index
from labeling.errors import ModelError
from pipelines.console import counted
from training.adapter_notes import adapter_file, read_progress
from training.config import BACKBONES, config_names

_ADAPTERS = ("motion", "appearance")
_NOT_HERE = "its weights are not on this machine, `--backbone tiny` tries all steps without any; "


def next_training(root: Path) -> tuple[str, str]:
    """The next command, and why."""
    keys = {row.key for row in read_shard_index(root / SHARD_INDEX)}
    stores = sorted(path.parent for path in (root / LATENTS).glob("*/cache.json"))
    if not stores:
        others = ", ".join(name for name in BACKBONES if name != "ltx-2b")
        return (
            f"animatic cache {_quoted(root)} --backbone ltx-2b",
            f"{counted(len(keys), 'clip')} packed, which `animatic inspect {_quoted(root)}` shows; "
            f"{'' if _weights_are_here('ltx-2b') else _NOT_HERE}other backbones: {others}",
        )
    # Of several backbones the one that has come furthest.
    return max((_next_of(root, store, keys) for store in stores), key=lambda step: step[0])[1:]


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))


def _weights_are_here(backbone: str) -> bool:
    """Whether the hub's cache holds a preset's weights, or some of them."""
    try:
        from huggingface_hub import constants
    except ImportError:  # a base install labels, and trains nothing
        return False
    name = f"models--{BACKBONES[backbone]['weights'].replace('/', '--')}"
    return any((Path(constants.HF_HUB_CACHE) / name / "snapshots").glob("*/*"))


def _next_of(root: Path, store: Path, keys: set[str]) -> tuple[int, str, str]:
    """How far a backbone has come, the next command, and why."""
    cached = {path.stem for path in store.glob("clips/*/*.safetensors")}
    missing = len(keys - cached)
    if missing:
        command = f"animatic cache {_quoted(root)} --backbone"
        reason = f"{missing} of {len(keys)} clips have no latents"
        if store.name in BACKBONES:
            return 0, f"{command} {store.name}", reason
        return 0, f"{command} BACKBONE.yaml", f"{reason} of {store.name}, whose file BACKBONE.yaml stands for"
    made: list[Path] = []
    for stage in _ADAPTERS:
        recipe = _recipe(stage, store.name)
        adapter = root / "adapters" / f"{recipe}_{stage}"
        command = f"animatic train {stage} --data {_quoted(root)} --config {recipe}"
        if lacking := _lacking(adapter):
            return 1 + len(made), command, f"latents of {store.name} are cached; {lacking}"
        made.append(adapter)
    motion, appearance = made
    given = f"--motion {_quoted(motion)} --appearance {_quoted(appearance)} --out {_quoted(root / 'samples')}"
    command = f"animatic generate --data {_quoted(root)} {given}"
    return 1 + len(made), command, "both adapters are there"


def _lacking(adapter: Path) -> str:
    """What an adapter's folder lacks; empty where its training has ended."""
    if not adapter_file(adapter).is_file():
        return f"no adapter is in {adapter}"
    try:
        progress = read_progress(adapter)
    except ModelError as error:
        return str(error)
    if progress is None or progress.finished:
        return ""
    return f"{adapter} has done {progress.step} of {progress.steps} steps"


def _recipe(stage: str, backbone: str) -> str:
    """The shipped recipe for a backbone, or where to put one of one's own."""
    names = (f"{stage}_{backbone.replace('-', '_')}", backbone)
    return next((name for name in names if name in config_names()), "RECIPE.yaml")
