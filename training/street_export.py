"""Trained networks to ONNX files and model cards: folded, weights halved, compared with torch."""

import copy
import tempfile
import warnings
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from labeling.errors import ModelError
from labeling.model_cards import ModelCard, file_sha256, write_card

OPSET = 17
_HALVED_FROM = 256
"""Smaller tensors stay float32: they hold shapes, constants and biases."""


def export_model(graph: nn.Module, card: ModelCard, folder: Path, *, tolerance: float = 0.001) -> ModelCard:
    """Write ``folder/card.file`` and its card with the file's hash.

    Args:
        graph: a ``...Graph`` module; its outputs are named and ordered as ``card.output_shapes()``.
        card: everything but the hash.
        folder: where both files go.
        tolerance: largest difference from torch with the same halved weights, relative to the output's largest value.

    Raises:
        ModelError: onnxruntime's outputs are not torch's.
    """
    folded = round_weights(fold_norms(graph))
    pictures = _probe_pictures(card)
    names = list(card.output_shapes())
    path = folder / card.file
    with tempfile.TemporaryDirectory() as scratch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        raw = Path(scratch) / "raw.onnx"
        torch.onnx.export(
            folded, (pictures[:1],), str(raw), dynamo=False, opset_version=OPSET, input_names=["input"],
            output_names=names, dynamic_axes={name: {0: "batch"} for name in ("input", *names)},
        )  # fmt: skip
        model = shorten_names(halve_weights(onnx.load(str(raw))))
    for output, shape in zip(model.graph.output, card.output_shapes().values(), strict=True):
        for dimension, size in zip(output.type.tensor_type.shape.dim[1:], shape[1:], strict=True):
            dimension.dim_value = int(size or 0)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString(deterministic=True))
    _compare(folded, path, pictures, tolerance)
    written = card.model_copy(update={"sha256": file_sha256(path)})
    write_card(written, path.with_suffix(".toml"))
    return written


def fold_norms(network: nn.Module) -> nn.Module:
    """A copy for inference whose batch norms have become part of the convolutions before them."""
    folded = copy.deepcopy(network).eval().to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    for module in list(folded.modules()):
        if not isinstance(module, nn.Sequential):
            continue
        for index in range(len(module) - 1):
            convolution, norm = module[index], module[index + 1]
            if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                module[index], module[index + 1] = fuse_conv_bn_eval(convolution, norm), nn.Identity()
    return folded


def round_weights(network: nn.Module) -> nn.Module:
    """The network, in place, with the weights that ``halve_weights`` will leave of it: what is compared is the graph
    alone. Where candidates are cleared by others, a weight's last digit may make all the difference."""
    with torch.no_grad():
        for weight in network.parameters():
            if weight.numel() >= _HALVED_FROM:
                weight.copy_(weight.half())
    return network


def halve_weights(model: onnx.ModelProto) -> onnx.ModelProto:
    """The same graph with large float32 weights stored as float16 behind a cast, which sessions fold when they open."""
    casts = []
    for tensor in model.graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size < _HALVED_FROM:
            continue
        name = tensor.name
        tensor.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}.half"))
        casts.append(helper.make_node("Cast", [f"{name}.half"], [name], to=TensorProto.FLOAT, name=f"{name}.cast"))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    return model


def shorten_names(model: onnx.ModelProto) -> onnx.ModelProto:
    """The same graph with its inner tensors numbered: their paths through the modules are a good part of a small file.

    Inputs, outputs and weights keep their names.
    """
    kept = {value.name for value in (*model.graph.input, *model.graph.output, *model.graph.initializer)}
    short: dict[str, str] = {}
    for node in model.graph.node:
        node.name = ""
        is_weight = node.op_type == "Cast" and node.input[0] in kept
        for name in node.output:
            short[name] = name if name in kept or is_weight else f"t{len(short)}"
        node.output[:] = [short[name] for name in node.output]
        node.input[:] = [short.get(name, name) for name in node.input]
    del model.graph.value_info[:]
    return model


def _probe_pictures(card: ModelCard) -> torch.Tensor:
    noise = np.random.default_rng(0).integers(0, 256, (2, 3, card.input_height, card.input_width))
    mean, std = (np.array(values, np.float32)[:, None, None] for values in (card.mean, card.std))
    return torch.from_numpy(((noise - mean) / std).astype(np.float32))


def _compare(graph: nn.Module, path: Path, pictures: torch.Tensor, tolerance: float) -> None:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    with torch.no_grad():
        expected = graph(pictures)
    expected = [expected] if isinstance(expected, torch.Tensor) else list(expected)
    for wanted, given in zip(expected, session.run(None, {"input": pictures.numpy()}), strict=True):
        error = np.abs(wanted.numpy() - np.asarray(given)).max() / max(1.0, float(wanted.abs().max()))
        if error > tolerance:
            raise ModelError(f"{path}: onnxruntime differs from torch by {error:.4f} of the largest value; raise OPSET")
