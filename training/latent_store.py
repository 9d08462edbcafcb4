"""A folder of cached latents and how it is read: one safetensors file per clip, text embeddings once per caption.

latents/<backbone>/cache.json             fingerprint, its parts, sizes
                   clips-<i>of<n>.jsonl   one line per finished or retired clip, appended by part i
                   clips/<video>/<key>.safetensors   rgb image skeleton ego objects_<v> <control>, mask_<control>
                   text/<xx>/<sha256 of the caption>.safetensors
"""

import functools
import hashlib
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open

from labeling.errors import DataError
from training.backbone import TextEmbedding
from training.config import BACKBONES
from training.stages import OBJECTS

MANIFEST = "cache.json"
IMAGE_EMBEDDING = "image_embedding"


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipRecord:
    """One finished clip."""

    key: str
    split: str
    caption: str
    file: str
    """Relative to the store's folder."""
    size: int
    """Bytes."""
    source: str
    """sha256 over all that the clip is made of, its caption too."""
    encoded: str = ""
    """sha256 over what the latents are made of; empty where an older version wrote the record."""
    object_variants: int = 1
    turn: int = 0
    """Counts a clip's records over all parts: the one with the highest turn holds."""
    retired: bool = False
    """The clip left the shards: its file may lie there still, but it is not offered."""

    def line(self) -> str:
        """As one line of JSON."""
        return json.dumps(asdict(self), sort_keys=True) + "\n"


@dataclass(frozen=True, slots=True, kw_only=True)
class CacheManifest:
    """What a cache was made with."""

    parts: dict[str, str]
    """sha256 or value by part: vae, text, picture, style, code."""
    frames: int
    """Video frames per clip, after ``frame_step``."""
    fps: float
    backbone: dict[str, Any]
    """Its configuration."""

    @property
    def fingerprint(self) -> str:
        """sha256 over the parts."""
        return hashlib.sha256(json.dumps(self.parts, sort_keys=True).encode()).hexdigest()

    def to_json(self) -> str:
        """The file's text."""
        return json.dumps({"fingerprint": self.fingerprint, **asdict(self)}, sort_keys=True, indent=1) + "\n"


_MANIFEST_TYPES = {"parts": dict, "frames": int, "fps": int | float, "backbone": dict}
_RECORD_TYPES = {"key": str, "split": str, "caption": str, "file": str, "size": int, "source": str, "turn": int}


def _of_types(tree: Any, types: Mapping[str, Any]) -> dict[str, Any]:
    """The named values of a JSON object; TypeError or KeyError where they are absent or of another kind."""
    if not isinstance(tree, dict):
        raise TypeError(f"it holds a {type(tree).__name__}")
    for name, kind in types.items():
        if not isinstance(tree[name], kind):
            raise TypeError(f"{name} is {tree[name]!r}")
    return {name: tree[name] for name in types}


def read_manifest(folder: Path) -> CacheManifest | None:
    """The manifest of a store, or None where there is none.

    Raises:
        DataError: a file that is no manifest.
    """
    path = folder / MANIFEST
    if not path.is_file():
        return None
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        return CacheManifest(**_of_types(tree, _MANIFEST_TYPES))
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is no manifest of latents ({error}); remove {folder} and cache again") from error


def check_fresh(folder: Path, held: CacheManifest, parts: Mapping[str, str]) -> None:
    """Refuse latents that were made with something else; only the parts given are compared.

    Raises:
        DataError: parts differ; both fingerprints and the parts are named.
    """
    changed = sorted(name for name, value in parts.items() if held.parts.get(name) != value)
    if changed:
        now = CacheManifest(parts={**held.parts, **parts}, frames=held.frames, fps=held.fps, backbone=held.backbone)
        raise DataError(
            f"latents in {folder} are stale: they have fingerprint {held.fingerprint[:16]}, this run needs "
            f"{now.fingerprint[:16]} (changed: {', '.join(changed)}); cache again with `animatic cache --refresh`, or "
            "go back to the settings they were made with"
        )


class LatentStore:
    """Cached latents of a job.

    Raises:
        DataError: nothing cached there.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)
        manifest = read_manifest(self.folder)
        if manifest is None:
            raise DataError(_none_there(self.folder))
        self.manifest = manifest
        self._records = {record.key: record for record in read_records(self.folder) if not record.retired}

    @property
    def fps(self) -> float:
        """Frame rate of the cached videos."""
        return self.manifest.fps

    def keys(self, split: str) -> list[str]:
        """Keys of a split, sorted."""
        return sorted(key for key, record in self._records.items() if record.split == split)

    def data_digest(self, split: str) -> str:
        """sha256 over what a training on a split learns from: its clips, what each was made from, and how."""
        clips = [(key, self._records[key].source, self._records[key].caption) for key in self.keys(split)]
        return hashlib.sha256(json.dumps([self.manifest.fingerprint, clips]).encode()).hexdigest()

    def record(self, key: str) -> ClipRecord:
        """The clip's record.

        Raises:
            DataError: the clip is not cached.
        """
        if key not in self._records:
            raise DataError(f"no latents of clip {key} in {self.folder}; run `animatic cache` again, it goes on")
        return self._records[key]

    def read(self, key: str, names: Iterable[str], *, object_variant: int = 0) -> dict[str, torch.Tensor]:
        """Latents (C, F, H, W) by name, in the type they are stored in; ``objects`` is the variant asked for.

        Raises:
            DataError: the clip is not cached, its file is damaged, or a name was not cached.
        """
        path = self.folder / self.record(key).file
        stored = {name: f"{OBJECTS}_{object_variant}" if name == OBJECTS else name for name in names}
        try:
            with safe_open(path, framework="pt") as file:
                known = set(file.keys())
                absent = [name for name in stored.values() if name not in known]
                if absent:
                    raise DataError(
                        f"{path} holds {', '.join(sorted(known))}, but not {', '.join(absent)}; cache again with "
                        f"controls={absent}"
                    )
                return {name: file.get_tensor(inside) for name, inside in stored.items()}
        except (OSError, SafetensorError) as error:
            raise DataError(f"{path} cannot be read ({error}); remove it and run `animatic cache` again") from error

    def mask(self, key: str, control: str) -> torch.Tensor:
        """(F, H, W) bool: lit latent cells of a control video."""
        return self.read(key, [f"mask_{control}"])[f"mask_{control}"].bool()

    def image_embedding(self, key: str) -> torch.Tensor | None:
        """(1, D) of the first RGB frame, where the backbone has an image encoder."""
        return self.read(key, [IMAGE_EMBEDDING])[IMAGE_EMBEDDING] if "image" in self.manifest.parts else None

    def text(self, caption: str) -> TextEmbedding:
        """The embedding of a caption that was cached; the empty one always is.

        Raises:
            DataError: it was not.
        """
        return _read_text(self.folder, caption)


def _none_there(folder: Path) -> str:
    """What to do where ``latents/<backbone>`` of a job is not there."""
    job, backbone = folder.parent.parent, folder.name if folder.name in BACKBONES else "FILE"
    named = shlex.quote(str(job))
    advice = f"`animatic cache {named} --backbone {backbone}`"
    if backbone == "FILE":
        advice += f", FILE being the YAML that says what {folder.name} is"
    if not job.is_dir() or not any((job / one).exists() for one in ("job.yaml", "shards")):
        what = "holds no shards of clips" if job.is_dir() else "is not there"
        return f"{job} is no job: it {what}; label videos first (`animatic label VIDEOS --out {named}`), then {advice}"
    return f"{job} has no latents for backbone {folder.name}; make them with {advice}"


@functools.lru_cache(maxsize=32)
def _read_text(folder: Path, caption: str) -> TextEmbedding:
    path = text_path(folder, caption)
    try:
        with safe_open(path, framework="pt") as file:
            return TextEmbedding(tokens_LD=file.get_tensor("tokens"))
    except (OSError, SafetensorError) as error:
        raise DataError(f"no embedding of caption {caption!r} in {folder} ({error}); cache again") from error


def text_path(folder: Path, caption: str) -> Path:
    """Where a caption's embedding lies."""
    name = hashlib.sha256(caption.encode()).hexdigest()
    return folder / "text" / name[:2] / f"{name}.safetensors"


def read_records(folder: Path) -> Sequence[ClipRecord]:
    """The newest record of each clip over all parts, retired ones too; a torn last line is ignored.

    Turns tell which is newest, not the order of files: a clip's part changes with the number of parts.

    Raises:
        DataError: a whole line is no record.
    """
    latest: dict[str, ClipRecord] = {}
    for path in sorted(folder.glob("clips-*.jsonl")):
        *whole, _torn = path.read_bytes().split(b"\n")
        for number, line in enumerate(whole, start=1):
            record = _read_record(path, number, line)
            known = latest.get(record.key)
            if known is None or record.turn >= known.turn:
                latest[record.key] = record
    return [latest[key] for key in sorted(latest)]


def _read_record(path: Path, number: int, line: bytes) -> ClipRecord:
    try:
        tree = json.loads(line)
        # Older records tell no turn.
        _of_types({"turn": 0, **tree}, _RECORD_TYPES)
        return ClipRecord(**tree)
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path}:{number}: is no record of a clip's latents ({error}); take the line away and run `animatic cache` "
            "again, which makes what is missing"
        ) from error
