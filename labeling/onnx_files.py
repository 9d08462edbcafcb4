"""ONNX files, checked before any session opens them: what they are, whose they are, and what else they would read."""

import functools
import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import onnx
import onnx.utils

from labeling.errors import ModelError
from labeling.model_cards import ModelCard, file_sha256

MAX_EXTERNAL_BYTES = 8 << 30
"""No extractor's weights come near it."""

_NO_FILE_NAME = (OSError, ValueError, RuntimeError)
"""What ``pathlib`` raises of a name that is too long, holds a NUL, or links in a circle."""


def check_file(card: ModelCard, path: Path) -> None:
    """That ``path`` is the ONNX file that ``card`` means, and reads nothing outside its folder.

    Raises:
        ModelError: it is missing, a web page, a git-lfs pointer, an archive, another file, or names foreign files.
    """
    if not path.is_file():
        raise ModelError(f"{card.name}: no file {path}; {card.source}")
    with path.open("rb") as file:
        head = file.read(512).lstrip()
    lowered = head.lower()
    for start, what in (
        (b"<", "a web page (a download that failed)"),
        (b"version https://git-lfs", "a git-lfs pointer"),
        (b"pk\x03\x04", "a zip archive: unpack it and take the .onnx inside"),
    ):
        if lowered.startswith(start):
            raise ModelError(f"{card.name}: {path} is {what}, not ONNX; {card.source}")
    if card.sha256 is not None and file_sha256(path) != card.sha256:
        raise ModelError(
            f"{card.name}: {path} has sha256 {file_sha256(path)}, its card says {card.sha256}; "
            f"get that file ({card.source}), or write a card of another name for this one"
        )
    check_external_data(path)
    if card.sha256 is not None and (files := _external_files(path)):
        raise ModelError(
            f"{card.name}: {path} keeps weights in {', '.join(file.name for file in files)}, which its card's sha256 "
            "does not cover; save the model as one file, or leave sha256 out"
        )


def weights_sha256(path: Path) -> str:
    """Hex SHA-256 of an ONNX file, or, where it keeps tensors in files beside it, of the hashes of all of them."""
    files = _external_files(path)
    if not files:
        return file_sha256(path)
    return hashlib.sha256(" ".join(file_sha256(file) for file in (path, *files)).encode()).hexdigest()


def _external_files(path: Path) -> tuple[Path, ...]:
    """The files beside an ONNX file that hold some of its tensors, sorted."""
    status = path.stat()
    return _checked_external_files(path, status.st_size, status.st_mtime_ns)


@functools.lru_cache(maxsize=64)
def _checked_external_files(path: Path, size: int, modified_ns: int) -> tuple[Path, ...]:
    try:
        model = onnx.load(str(path), load_external_data=False)
    except Exception:  # protobuf's DecodeError has no stable home; what is no ONNX says so when it is opened
        return ()
    tensors = (tensor for tensor in _tensors(model) if tensor.data_location == onnx.TensorProto.EXTERNAL)
    names = {entry.value for tensor in tensors for entry in tensor.external_data if entry.key == "location"}
    folder = path.resolve().parent
    files = (_file_beside(folder, name) for name in sorted(names))
    return tuple(file for file in files if file is not None and file.is_relative_to(folder))


def _file_beside(folder: Path, name: str) -> Path | None:
    """The file of that name; None where there is none, or none can have such a name."""
    try:
        file = (folder / name).resolve()
        return file if file.is_file() else None
    except _NO_FILE_NAME:
        return None


def check_external_data(path: Path) -> None:
    """That every tensor kept outside the ONNX file lies in its folder, whole, and of a size that can be.

    Raises:
        ModelError: the file is no ONNX, or names a path outside, a missing file, or a range beyond its end.
    """
    try:
        model = onnx.load(str(path), load_external_data=False)
    except Exception as error:  # protobuf's DecodeError has no stable home
        raise ModelError(f"{path} is not ONNX: {first_line(error)}; download or export it again") from error
    if not model.graph.node:
        raise ModelError(f"{path} is not ONNX: it holds no graph; download or export it again")
    folder, total = path.resolve().parent, 0
    for tensor in _tensors(model):
        if tensor.data_location == onnx.TensorProto.EXTERNAL:
            total += _check_external_tensor(tensor, folder, path)
    if total > MAX_EXTERNAL_BYTES:
        raise ModelError(
            f"{path} names {total} bytes of external data, over {MAX_EXTERNAL_BYTES}; it is no extractor's"
        )


def _check_external_tensor(tensor: onnx.TensorProto, folder: Path, path: Path) -> int:
    entries = {entry.key: entry.value for entry in tensor.external_data}
    location = entries.get("location", "")
    try:
        target = (folder / location).resolve()
        there = target.is_file()
    except _NO_FILE_NAME as error:
        raise ModelError(
            f"{path}: tensor {tensor.name!r} is stored in {location[:60]!r}, which names no file "
            f"({first_line(error)}); export the model again"
        ) from error
    if not location or Path(location).is_absolute() or not target.is_relative_to(folder) or target == folder:
        raise ModelError(
            f"{path}: tensor {tensor.name!r} is stored in {location!r}, outside the model's folder; refused: "
            "keep external data beside the ONNX file"
        )
    if not there:
        raise ModelError(f"{path}: tensor {tensor.name!r} is stored in {location!r}, which is not there; copy it too")
    try:
        offset, size = int(entries.get("offset", 0)), target.stat().st_size
        length = int(entries.get("length", size - offset))
    except ValueError as error:
        raise ModelError(f"{path}: tensor {tensor.name!r} has offset or length that is no number: {error}") from error
    if offset < 0 or length < 0 or offset + length > size:
        raise ModelError(
            f"{path}: tensor {tensor.name!r} reads bytes {offset} to {offset + length} of {location!r}, "
            f"which has {size}; copy the whole file"
        )
    return length


def part_of_graph(path: Path, input_name: str, output_names: Sequence[str]) -> bytes:
    """An ONNX file that ``check_file`` has passed, without what only its other outputs need.

    Raises:
        ModelError: the graph does not come apart.
    """
    try:
        whole = onnx.load(str(path))
        return onnx.utils.Extractor(whole).extract_model([input_name], list(output_names)).SerializeToString()
    except Exception as error:  # onnx raises whatever its checker or protobuf do
        raise ModelError(
            f"{path}: {', '.join(output_names)} cannot be had alone: {first_line(error)}; export it again"
        ) from error


def _tensors(model: onnx.ModelProto) -> Iterator[onnx.TensorProto]:
    yield from _graph_tensors(model.graph)
    for function in model.functions:
        yield from _node_tensors(function.node)


def _graph_tensors(graph: onnx.GraphProto) -> Iterator[onnx.TensorProto]:
    yield from graph.initializer
    for sparse in graph.sparse_initializer:
        yield from (sparse.values, sparse.indices)
    yield from _node_tensors(graph.node)


def _node_tensors(nodes: Sequence[onnx.NodeProto]) -> Iterator[onnx.TensorProto]:
    for node in nodes:
        for attribute in node.attribute:
            yield attribute.t
            yield from attribute.tensors
            for sparse in (attribute.sparse_tensor, *attribute.sparse_tensors):
                yield from (sparse.values, sparse.indices)
            for graph in ([attribute.g] if attribute.HasField("g") else []) + list(attribute.graphs):
                yield from _graph_tensors(graph)


def first_line(error: Exception) -> str:
    """What a library's exception says, on one line of bounded length."""
    return (str(error).strip() or type(error).__name__).splitlines()[0][:300]
