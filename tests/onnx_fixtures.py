"""Small ONNX graphs for tests: constant outputs, a random-weight SimCC head, a toy YOLOX."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from labeling.model_cards import ModelCard, SimccCard

Batch = int | str | None


def simcc_card(**changes: object) -> SimccCard:
    """The card of ``random_simcc``'s head for 17 joints."""
    values = {
        "name": "head", "file": "head.onnx", "schema": "coco17", "input_width": 64, "input_height": 96,
        "licence": "none", "source": "make it with a test", **changes,
    }  # fmt: skip
    return SimccCard.model_validate(values)


def save_graph(
    path: Path,
    nodes: Sequence[onnx.NodeProto],
    *,
    inputs: Mapping[str, Sequence[Batch]],
    outputs: Mapping[str, Sequence[Batch] | None],
    weights: Mapping[str, np.ndarray],
) -> Path:
    """Write a float32 graph; a shape of None leaves the output's axes out, a string makes an axis dynamic."""
    graph = helper.make_graph(
        list(nodes), "toy",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in inputs.items()],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in outputs.items()],
        [numpy_helper.from_array(value, name) for name, value in weights.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    path.write_bytes(model.SerializeToString())
    return path


def constant_model(
    path: Path,
    card: ModelCard,
    outputs: Mapping[str, np.ndarray],
    *,
    batch: Batch = "batch",
    state_shapes: bool = True,
) -> Path:
    """A graph that gives the same ``outputs`` (each without its batch axis) for every picture of a batch.

    Args:
        path: where to write it.
        card: its input size is the graph's.
        outputs: arrays by output name.
        batch: a number fixes the batch, a string makes it dynamic.
        state_shapes: whether the graph says its outputs' shapes.
    """
    nodes = [
        helper.make_node("ReduceSum", ["images", "axes"], ["sum"], keepdims=0),
        helper.make_node("Mul", ["sum", "nothing"], ["zero"]),
    ]
    weights = {"axes": np.array([1, 2, 3]), "nothing": np.zeros(1, np.float32)}
    for name, value in outputs.items():
        weights[f"{name}_value"] = value[None].astype(np.float32)
        weights[f"{name}_shape"] = np.array([-1, *(1 for _ in value.shape)])
        nodes.append(helper.make_node("Reshape", ["zero", f"{name}_shape"], [f"{name}_zero"]))
        nodes.append(helper.make_node("Add", [f"{name}_zero", f"{name}_value"], [name]))
    shapes = {name: [batch, *value.shape] if state_shapes else None for name, value in outputs.items()}
    inputs = {"images": [batch, 3, card.input_height, card.input_width]}
    return save_graph(path, nodes, inputs=inputs, outputs=shapes, weights=weights)


def deaf_model(path: Path, card: ModelCard, output: np.ndarray) -> Path:
    """A graph that gives one row, ``output``, for a batch of any size, and states another."""
    node = helper.make_node("Identity", ["rows"], ["output"])
    inputs = {"images": ["batch", 3, card.input_height, card.input_width]}
    outputs = {"output": ["rows", *output.shape]}
    return save_graph(path, [node], inputs=inputs, outputs=outputs, weights={"rows": output[None].astype(np.float32)})


def random_simcc(path: Path, *, points: int, width: int, height: int, seed: int = 0, batch: Batch = "batch") -> Path:
    """A SimCC head of random weights: one strided convolution, then a linear layer per axis."""
    rng = np.random.default_rng(seed)
    cells = (height // 32) * (width // 32)
    weights = {
        "kernel": rng.normal(0, 0.03, (points, 3, 32, 32)).astype(np.float32),
        "flat": np.array([0, points, cells]),
        "along_x": rng.normal(0, 0.3, (cells, 2 * width)).astype(np.float32),
        "along_y": rng.normal(0, 0.3, (cells, 2 * height)).astype(np.float32),
    }
    nodes = [
        helper.make_node("Conv", ["input", "kernel"], ["features"], strides=[32, 32]),
        helper.make_node("Reshape", ["features", "flat"], ["rows"]),
        helper.make_node("MatMul", ["rows", "along_x"], ["simcc_x"]),
        helper.make_node("MatMul", ["rows", "along_y"], ["simcc_y"]),
    ]
    outputs = {"simcc_x": [batch, points, 2 * width], "simcc_y": [batch, points, 2 * height]}
    return save_graph(path, nodes, inputs={"input": [batch, 3, height, width]}, outputs=outputs, weights=weights)


def random_yolox(path: Path, *, classes: int, width: int, height: int, seed: int = 0, batch: Batch = "batch") -> Path:
    """A detector of random weights with YOLOX's output: a strided convolution per stride, sigmoid scores."""
    rng = np.random.default_rng(seed)
    nodes, weights, rows = [], {"rows_shape": np.array([0, 5 + classes, -1])}, []
    for stride in (8, 16, 32):
        weights[f"kernel{stride}"] = (rng.normal(size=(5 + classes, 3, stride, stride)) / 2000).astype(np.float32)
        nodes += [
            helper.make_node("Conv", ["images", f"kernel{stride}"], [f"map{stride}"], strides=[stride, stride]),
            helper.make_node("Reshape", [f"map{stride}", "rows_shape"], [f"flat{stride}"]),
            helper.make_node("Transpose", [f"flat{stride}"], [f"rows{stride}"], perm=[0, 2, 1]),
        ]
        rows.append(f"rows{stride}")
    nodes += [
        helper.make_node("Concat", rows, ["raw"], axis=1),
        helper.make_node("Split", ["raw", "split"], ["boxes", "logits"], axis=2),
        helper.make_node("Sigmoid", ["logits"], ["scores"]),
        helper.make_node("Concat", ["boxes", "scores"], ["output"], axis=2),
    ]
    weights["split"] = np.array([4, 1 + classes])
    cells = sum((width // stride) * (height // stride) for stride in (8, 16, 32))
    inputs = {"images": [batch, 3, height, width]}
    return save_graph(path, nodes, inputs=inputs, outputs={"output": [batch, cells, 5 + classes]}, weights=weights)
