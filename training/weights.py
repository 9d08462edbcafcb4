"""Finding weights, and naming them by content."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save

from labeling.errors import ModelError

_HOW_IT_WAS_LOADED = ("dtype", "torch_dtype", "architectures")
_ADVICE = "give a local diffusers folder, a .safetensors file, or a hub id that this machine can reach"


def load_pretrained(
    kind: Any, source: str, subfolder: str, *, dtype: torch.dtype, file_config: str | None = None
) -> Any:
    """A diffusers model from a folder or hub id (its ``subfolder``), or from a single-file checkpoint.

    Args:
        kind: the diffusers class.
        source: folder, ``.safetensors`` file, or hub id.
        subfolder: the model's part of a folder or hub repository.
        dtype: of the weights in memory.
        file_config: folder or hub id whose configuration a single file fits; None lets diffusers fetch it.

    Raises:
        ModelError: nothing there, or not this class's weights.
    """
    try:
        if Path(source).is_file():
            where = {"config": file_config, "subfolder": subfolder} if file_config else {}
            return kind.from_single_file(source, torch_dtype=dtype, **where)
        return kind.from_pretrained(source, subfolder=subfolder, torch_dtype=dtype, use_safetensors=True)
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise ModelError(
            f"{kind.__name__} could not be loaded from {source!r} ({_first_line(error)}); {_ADVICE}"
        ) from error


def load_text_encoder(source: str, *, dtype: torch.dtype, single_file: bool = False) -> tuple[Any, torch.nn.Module]:
    """(tokenizer, T5 encoder) from the ``tokenizer`` and ``text_encoder`` parts of a folder or hub id, or its root.

    Raises:
        ModelError: a single file, which holds no text encoder, or nothing there.
    """
    from transformers import AutoTokenizer, T5EncoderModel

    if single_file and Path(source).is_file():
        raise ModelError(f"{source} holds no text encoder; set backbone.text_weights to a T5 folder or hub id")
    folder = Path(source)
    split = not folder.is_dir() or (folder / "text_encoder").is_dir()
    parts = ("tokenizer", "text_encoder") if split and "t5" not in folder.name else ("", "")
    try:
        tokenizer = AutoTokenizer.from_pretrained(source, subfolder=parts[0])
        encoder = T5EncoderModel.from_pretrained(source, subfolder=parts[1], dtype=dtype)
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise ModelError(f"no T5 text encoder in {source!r} ({_first_line(error)}); {_ADVICE}") from error
    return tokenizer, encoder


def load_image_encoder(source: str, *, dtype: torch.dtype) -> torch.nn.Module:
    """The CLIP image encoder from the ``image_encoder`` part of a folder or hub id.

    Raises:
        ModelError: nothing there.
    """
    from transformers import CLIPVisionModelWithProjection

    try:
        return CLIPVisionModelWithProjection.from_pretrained(source, subfolder="image_encoder", dtype=dtype)
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise ModelError(f"no CLIP image encoder in {source!r} ({_first_line(error)}); {_ADVICE}") from error


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
