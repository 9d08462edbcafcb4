"""ONNX sessions that keep their card's contract: file, hash, shapes and numbers are checked, never trusted."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

from labeling.errors import ModelError
from labeling.model_cards import Dimensions, ModelCard
from labeling.onnx_files import check_file, first_line, part_of_graph, weights_sha256

DEFAULT_PROVIDERS = ("CPUExecutionProvider",)
PROVIDER_NAMES = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}
"""Short names of settings to onnxruntime's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Graph:
    """What a session says of itself."""

    input_name: str
    batch: int | None
    """Fixed batch size, or None where it is dynamic."""
    output_names: tuple[str, ...]
    """The graph's names of the card's outputs, in the card's order."""


class OnnxModel:
    """A session whose graph agrees with its card.

    Args:
        card: what the graph must take and give.
        path: the ONNX file.
        providers: execution providers in order, onnxruntime's names or ``cpu``, ``cuda``, ``tensorrt``. The first must
            be there: nothing falls back silently.
        threads: threads inside one operator; part of what makes results repeatable.
        max_batch: crops or frames per call, where the graph's batch is dynamic.

    Raises:
        ModelError: no such file, not ONNX, another hash, another contract, a provider that is not there.
    """

    def __init__(
        self,
        card: ModelCard,
        path: Path,
        *,
        providers: Sequence[str] = DEFAULT_PROVIDERS,
        threads: int = 1,
        max_batch: int = 8,
    ) -> None:
        self.card = card
        self.path = path
        self.max_batch = max_batch
        check_file(card, path)
        self._open = functools.partial(_open_session, path, resolve_providers(providers), threads)
        whole = self._open()
        self.providers: tuple[str, ...] = tuple(whole.get_providers())
        self._graph = _check_graph(whole, card, path)
        self._shapes = dict(zip(self._graph.output_names, card.output_shapes().values(), strict=True))
        self._sessions = {self._graph.output_names: whole}
        """By the outputs that each computes."""

    @property
    def weights_sha256(self) -> str:
        """Hex SHA-256 of the weights, for receipts."""
        return weights_sha256(self.path)

    def run(self, batch: np.ndarray, *, outputs: Sequence[int] | None = None) -> list[np.ndarray]:
        """The card's outputs, in its order, for any number of inputs.

        Args:
            batch: (N, 3, input_height, input_width) float32, normalised as the card says. A graph with a fixed batch is
                called as often as it takes.
            outputs: which of them, by place; all by default. What only the others need is not computed.

        Raises:
            ModelError: the shape is not the card's, the network fails, or its output is not finite or not of the
                shape that it states, one row for each input.
        """
        wanted = (3, self.card.input_height, self.card.input_width)
        if batch.ndim != 4 or batch.shape[1:] != wanted or batch.dtype != np.float32:
            raise ModelError(
                f"{self.card.name} takes float32 (N, {wanted}), got {batch.dtype} {batch.shape}; resize first"
            )
        chosen = range(len(self._graph.output_names)) if outputs is None else outputs
        names = tuple(self._graph.output_names[i] for i in chosen)
        parts = [self._run_chunk(chunk, names) for chunk in self._chunks(batch)]
        if not parts:
            shapes = list(self.card.output_shapes().values())
            return [np.zeros((0, *(size or 0 for size in shapes[i][1:])), np.float32) for i in chosen]
        return parts[0] if len(parts) == 1 else [np.concatenate(column) for column in zip(*parts, strict=True)]

    def _chunks(self, batch: np.ndarray) -> Iterator[np.ndarray]:
        size = self._graph.batch or self.max_batch
        for start in range(0, len(batch), size):
            yield batch[start : start + size]

    def _session(self, names: tuple[str, ...]) -> onnxruntime.InferenceSession:
        """One that computes these outputs alone: a session asked for some of its outputs computes all of them."""
        if names not in self._sessions:
            self._sessions[names] = self._open(part=part_of_graph(self.path, self._graph.input_name, names))
        return self._sessions[names]

    def _run_chunk(self, chunk: np.ndarray, names: tuple[str, ...]) -> list[np.ndarray]:
        fixed, count = self._graph.batch, len(chunk)
        if fixed and count < fixed:
            chunk = np.concatenate([chunk, np.repeat(chunk[-1:], fixed - count, axis=0)])
        try:
            results = self._session(names).run(names, {self._graph.input_name: chunk})
        except Exception as error:  # onnxruntime raises a dozen private types
            raise ModelError(
                f"{self.card.name} failed on {chunk.shape}: {first_line(error)}; check {self.path}"
            ) from error
        outputs = [np.asarray(result) for result in results]
        for name, output in zip(names, outputs, strict=True):
            wanted = (len(chunk), *self._shapes[name][1:])
            if output.shape != wanted:
                raise ModelError(
                    f"{self.card.name} gave {_show(output.shape)} in {name!r} for a batch of {len(chunk)}, not "
                    f"{_show(wanted)}; export {self.path} with the shapes that it states, or with a fixed batch of 1"
                )
            if not _all_finite(output):
                raise ModelError(
                    f"{self.card.name} gave NaN or infinity in {name!r}; check the file {self.path} and its precision "
                    "(fp16 overflows)"
                )
        return [output[:count] for output in outputs]


def _all_finite(values: np.ndarray) -> bool:
    """Whether there is no NaN and no infinity, which a sum would not survive; one that overflows says nothing."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum()) or np.isfinite(values).all())


def resolve_providers(providers: Sequence[str]) -> list[str]:
    """onnxruntime's names of ``providers``, in order.

    Raises:
        ModelError: one is not built into the onnxruntime that is installed, or none is given.
    """
    names = [PROVIDER_NAMES.get(name.lower(), name) for name in providers]
    available = onnxruntime.get_available_providers()
    missing = [name for name in names if name not in available]
    if missing or not names:
        raise ModelError(
            f"execution provider {', '.join(missing) or '(none given)'} is not there; this onnxruntime has "
            f"{', '.join(available)}: install onnxruntime-gpu for CUDA and TensorRT, or set providers to cpu"
        )
    return names


def check_frame(frame: np.ndarray) -> None:
    """That ``frame`` is a picture.

    Raises:
        ModelError: it is not (H, W, 3) uint8, or empty.
    """
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8 or 0 in frame.shape:
        raise ModelError(f"a frame must be (H, W, 3) uint8 RGB, got {frame.dtype} {frame.shape}; decode it first")


def network_input(picture: np.ndarray, card: ModelCard, *, out: np.ndarray | None = None) -> np.ndarray:
    """(H, W, 3) uint8 RGB to (3, H, W) float32 in the card's channel order and normalisation; into ``out`` if given."""
    planes = np.empty((3, *picture.shape[:2]), np.float32) if out is None else out
    channels = cv2.split(picture)
    order = channels[::-1] if card.channel_order == "bgr" else channels
    for i, levels in enumerate(level_table(card.mean, card.std)):
        cv2.LUT(order[i], levels, planes[i])
    return planes


@functools.lru_cache(maxsize=16)
def level_table(mean: tuple[float, float, float], std: tuple[float, float, float]) -> np.ndarray:
    """(3, 256) float32: what each level of each channel becomes, rounded once."""
    values = (np.arange(256) - np.array(mean)[:, None]) / np.array(std)[:, None]
    return values.astype(np.float32)


def _open_session(
    path: Path, providers: list[str], threads: int, *, part: bytes | None = None
) -> onnxruntime.InferenceSession:
    """Of an ONNX file, or of a part of its graph."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # Spinning threads starve the other worker processes of a job.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(part or str(path), options, providers=providers)
    except Exception as error:  # onnxruntime raises a dozen private types
        raise ModelError(f"{path} cannot be opened: {first_line(error)}; download or export it again") from error
    if session.get_providers()[0] != providers[0]:
        raise ModelError(
            f"{path}: asked for {providers[0]}, onnxruntime gave {session.get_providers()[0]}; "
            "its libraries (CUDA, cuDNN, TensorRT) do not load: mend them, or set providers to cpu"
        )
    return session


def _check_graph(session: onnxruntime.InferenceSession, card: ModelCard, path: Path) -> _Graph:
    inputs = session.get_inputs()
    wanted: Dimensions = (None, 3, card.input_height, card.input_width)
    given = _dimensions(inputs[0].shape) if inputs else ()
    if len(inputs) != 1 or inputs[0].type != "tensor(float)" or (given and not _agree(given, wanted)):
        shown = ", ".join(f"{one.name} {one.type} {one.shape}" for one in inputs) or "nothing"
        raise ModelError(
            f"{card.name}: {path} takes {shown}; its card says one float32 {_show(wanted)}: wrong file or card"
        )
    batch = given[0] if given else None
    shapes = {output.name: _dimensions(output.shape) for output in session.get_outputs()}
    if any(not shape or None in shape[1:] for shape in shapes.values()):
        shapes = _probe_outputs(session, card, path, batch=batch or 1)
    names = _match_outputs(shapes, card, path)
    return _Graph(input_name=inputs[0].name, batch=batch, output_names=names)


def _probe_outputs(
    session: onnxruntime.InferenceSession, card: ModelCard, path: Path, *, batch: int
) -> dict[str, Dimensions]:
    """Shapes of the outputs for a black picture, where the graph does not state them."""
    blank = np.zeros((batch, 3, card.input_height, card.input_width), np.float32)
    try:
        results = session.run(None, {session.get_inputs()[0].name: blank})
    except Exception as error:  # onnxruntime raises a dozen private types
        raise ModelError(f"{card.name}: {path} fails on {blank.shape}: {first_line(error)}; export it again") from error
    pairs = zip(session.get_outputs(), results, strict=True)
    return {output.name: tuple(np.asarray(result).shape) for output, result in pairs}


def _match_outputs(shapes: dict[str, Dimensions], card: ModelCard, path: Path) -> tuple[str, ...]:
    """The graph's name of each of the card's outputs: by name, else the first left of the right shape."""
    free, names = dict(shapes), []
    wanted = card.output_shapes()
    for name, shape in wanted.items():
        fits = [other for other in free if _agree(free[other], shape)]
        if (name in shapes and name not in fits) or not fits:
            shown = ", ".join(f"{other} {_show(dims)}" for other, dims in shapes.items())
            said = ", ".join(f"{other} {_show(dims)}" for other, dims in wanted.items())
            raise ModelError(f"{card.name}: {path} gives {shown}; its card says {said}: wrong file or card")
        names.append(name if name in fits else next((other for other in fits if other not in wanted), fits[0]))
        free.pop(names[-1])
    return tuple(names)


def _dimensions(shape: Sequence[int | str | None] | None) -> Dimensions:
    return tuple(size if isinstance(size, int) and size > 0 else None for size in shape or ())


def _agree(given: Dimensions, wanted: Dimensions) -> bool:
    pairs = zip(given, wanted, strict=False)
    return len(given) == len(wanted) and all(a is None or b is None or a == b for a, b in pairs)


def _show(shape: Dimensions) -> str:
    return "[" + ", ".join("N" if size is None else str(size) for size in shape) + "]"
