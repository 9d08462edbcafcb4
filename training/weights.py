"""Finding weights, and naming them by content."""

import contextlib
import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save

from labeling.errors import ModelError

_HOW_IT_WAS_LOADED = ("dtype", "torch_dtype", "architectures")
_HUB_ID = re.compile(r"[\w-][\w.-]*/[\w.-]+")
_FILES = ("config.json", "*.safetensors")
TEXT_PARTS = ("tokenizer", "text_encoder")
"""Of a repository that holds its own text encoder."""
_WHERE = "`weights` or `text_weights` in a backbone's YAML, see README, Real weights"
_SINGLE_FILE_ADVICE = "set backbone.weights_config to a diffusers folder whose configurations fit it"


def load_pretrained(
    kind: Any, source: str, subfolder: str, *, dtype: torch.dtype, file_config: str | None = None,
    needed: Sequence[str] = (),
) -> Any:  # fmt: skip
    """A diffusers model from a folder or hub id (its ``subfolder``), or from a single-file checkpoint.

    Nothing is downloaded, here and below: a hub id is looked for in the hub's cache.

    Args:
        kind: the diffusers class.
        source: folder, ``.safetensors`` file, or hub id.
        subfolder: the model's part of a folder or hub repository.
        dtype: of the weights in memory.
        file_config: folder or hub id whose configuration a single file fits; None lets diffusers name it.
        needed: all parts of the repository that the backbone is made of, so that one download is advised.

    Raises:
        ModelError: nothing there, or not this class's weights.
    """
    what = kind.__name__
    if Path(source).is_file():
        told: dict[str, Any] = {}
        if file_config:
            told = {"config": str(_folder_with(file_config, f"{subfolder}/config.json")), "subfolder": subfolder}
        with _loading(what, source, _SINGLE_FILE_ADVICE):
            return kind.from_single_file(source, torch_dtype=dtype, local_files_only=True, **told)
    folder = _folder_with(source, *(f"{subfolder}/{name}" for name in _FILES), needed=needed)
    with _loading(what, source):
        return kind.from_pretrained(
            folder, subfolder=subfolder, torch_dtype=dtype, use_safetensors=True, local_files_only=True
        )


def load_text_encoder(
    source: str, *, dtype: torch.dtype, single_file: bool = False, needed: Sequence[str] = ()
) -> tuple[Any, torch.nn.Module]:
    """(tokenizer, T5 encoder) from the ``tokenizer`` and ``text_encoder`` parts of a folder or hub id, or its root.

    Raises:
        ModelError: a single file, which holds no text encoder, or nothing there.
    """
    from transformers import AutoTokenizer, T5EncoderModel

    if single_file and Path(source).is_file():
        raise ModelError(f"{source} holds no text encoder; set backbone.text_weights to a T5 folder or hub id")
    held = find_folder(source)
    if held is None:
        # Its own name must tell: google/t5-v1_1-large is a repository of nothing else.
        alone = "t5" in Path(source).name
    else:
        alone = (held / "config.json").is_file() and not (held / "text_encoder").is_dir()
    tokens, network = ("", "") if alone else TEXT_PARTS
    folder = _folder_with(
        source, str(Path(tokens, "tokenizer_config.json")), str(Path(network, "config.json")), needed=needed
    )
    with _loading("a T5 text encoder", source):
        tokenizer = AutoTokenizer.from_pretrained(folder, subfolder=tokens, local_files_only=True)
        encoder = T5EncoderModel.from_pretrained(folder, subfolder=network, dtype=dtype, local_files_only=True)
    return tokenizer, encoder


def load_image_encoder(source: str, *, dtype: torch.dtype, needed: Sequence[str] = ()) -> torch.nn.Module:
    """The CLIP image encoder from the ``image_encoder`` part of a folder or hub id.

    Raises:
        ModelError: nothing there.
    """
    from transformers import CLIPVisionModelWithProjection

    part = "image_encoder"
    folder = _folder_with(source, *(f"{part}/{name}" for name in _FILES), needed=needed)
    with _loading("a CLIP image encoder", source):
        return CLIPVisionModelWithProjection.from_pretrained(folder, subfolder=part, dtype=dtype, local_files_only=True)


def find_folder(source: str) -> Path | None:
    """A folder as it is, a hub id's folder in the hub's cache, where an earlier download left one; else None."""
    if Path(source).is_dir():
        return Path(source)
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(source, local_files_only=True))
    except (OSError, ValueError):
        return None


def _folder_with(source: str, *wanted: str, needed: Sequence[str] = ()) -> Path:
    """The folder of ``source``, which holds the files (glob patterns) that are wanted; advice is to get all ``needed``.

    Raises:
        ModelError: some of them are not there; they are named, and where they may lie.
    """
    folder = find_folder(source)
    lacking = [one for one in wanted if folder is None or not any(folder.glob(one))]
    if folder is not None and not lacking:
        return folder
    names = ", ".join(lacking)
    if Path(source).is_dir():
        raise ModelError(f"{source} lacks {names}; copy them there, or name another folder ({_WHERE})")
    if not _HUB_ID.fullmatch(source):
        raise ModelError(f"weights {source!r} are no folder and no file; name one that holds {names} ({_WHERE})")
    from huggingface_hub import constants

    parts = dict.fromkeys([*needed, *(one.rpartition("/")[0] for one in lacking)])
    chosen = "".join(f" --include '{part}/*'" for part in parts if part)
    raise ModelError(
        f"weights {source!r} are not on this machine, and nothing is downloaded: the hub's cache "
        f"{constants.HF_HUB_CACHE} lacks {names} of them; put them there (`hf download {source}{chosen}`), or name a "
        f"local folder that has them ({_WHERE})"
    )


@contextlib.contextmanager
def _loading(what: str, source: str, advice: str = "name weights of that class") -> Iterator[None]:
    """The libraries' errors as one line."""
    try:
        yield
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise ModelError(f"{what} could not be loaded from {source!r} ({_first_line(error)}); {advice}") from error


def tensor_bytes(tensors: Mapping[str, torch.Tensor], *, metadata: Mapping[str, str] | None = None) -> bytes:
    """A safetensors file; the same tensors and metadata give the same bytes.

    The library writes metadata in the order of a hash map, which changes from call to call: the header is put in order.
    """
    data = save(dict(tensors), metadata=dict(metadata) if metadata else None)
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    if "__metadata__" in header:
        header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    # Tensors start at a multiple of 8, as the format asks.
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + data[8 + length :]


def digest_tensors(tensors: Mapping[str, torch.Tensor], *, extra: Any = None) -> str:
    """sha256 over names, types, shapes and bytes of tensors, and over ``extra`` as JSON."""
    digest = hashlib.sha256(json.dumps(extra, sort_keys=True, default=str).encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name}:{tensor.dtype}:{tuple(tensor.shape)}".encode())
        data: Any = tensor.reshape(-1).view(torch.uint8).numpy()
        digest.update(data)
    return digest.hexdigest()


def digest_module(module: torch.nn.Module, *, extra: Mapping[str, Any] | None = None) -> str:
    """sha256 of a network's weights and its configuration; where it was loaded from does not count."""
    config: Any = getattr(module, "config", {})
    settings = config.to_dict() if hasattr(config, "to_dict") else dict(config)
    settings = {
        key: value
        for key, value in settings.items()
        if not key.startswith("_") and "version" not in key and key not in _HOW_IT_WAS_LOADED
    }
    return digest_tensors(module.state_dict(), extra={"config": settings, **(extra or {})})


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
