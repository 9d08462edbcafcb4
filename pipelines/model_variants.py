"""The shipped street models made otherwise, in a temporary folder, for the charts: in int8, at another input size."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from labeling.detection import letterbox
from labeling.errors import ModelError
from labeling.extractors import AnyCard, ExtractorChoice
from labeling.fields import padded_input
from labeling.keypoints import crop_input, plan_crop
from labeling.model_cards import CifcafCard, SimccCard, YoloxCard, find_weights
from pipelines.keypoint_clips import KeypointClip

_INTEGER_OPERATORS = ["Conv", "Gemm", "MatMul"]
_LEAST_CROP_PX = 24.0


def int8_choice(choice: ExtractorChoice, clips: Sequence[KeypointClip], folder: Path) -> ExtractorChoice:
    """The same models with 8-bit weights and activations, calibrated on a few frames (onnxruntime, static, QDQ).

    Args:
        choice: what to quantise.
        clips: pictures to calibrate with; a frame in 24 of each is used.
        folder: where the graphs are written; ``Extractors`` finds them there as its ``models_dir``.
    """

    def changed(card: AnyCard) -> AnyCard:
        return _int8_card(card, clips, folder)

    return replace(
        choice, detector=_int8_detector(choice.detector, clips, folder) if choice.detector else None,
        heads=tuple(card for card in map(changed, choice.heads) if isinstance(card, SimccCard)),
        fields=tuple(card for card in map(changed, choice.fields) if isinstance(card, CifcafCard)),
    )  # fmt: skip


def _int8_detector(card: YoloxCard, clips: Sequence[KeypointClip], folder: Path) -> YoloxCard:
    changed = _int8_card(card, clips, folder)
    assert isinstance(changed, YoloxCard)
    return changed


def _int8_card(card: AnyCard, clips: Sequence[KeypointClip], folder: Path) -> AnyCard:
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, quantize_static

    class Reader(CalibrationDataReader):
        def __init__(self) -> None:
            self._inputs = _inputs(card, clips)

        def get_next(self) -> dict[str, np.ndarray] | None:  # type: ignore[override]
            picture = next(self._inputs, None)
            return None if picture is None else {_input_name(path): picture[None]}

    path = _weights(card)
    file = f"{card.name}_int8.onnx"
    quantize_static(
        str(path), str(folder / file), Reader(), quant_format=QuantFormat.QDQ, per_channel=True,
        op_types_to_quantize=_INTEGER_OPERATORS,
    )  # fmt: skip
    return card.model_copy(update={"name": f"{card.name}_int8", "file": file, "sha256": None})


def resized_detector(card: YoloxCard, folder: Path, *, width: int, height: int) -> YoloxCard:
    """The detector's graph for another input size: it is fully convolutional, so only its input's axes change.

    Args:
        card: of the shipped detector.
        folder: where the graph is written.
        width: pixels, a multiple of 32.
        height: pixels, a multiple of 32.
    """
    import onnx

    model = onnx.load(str(_weights(card)))
    for axis, size in ((2, height), (3, width)):
        model.graph.input[0].type.tensor_type.shape.dim[axis].dim_value = size
    for output in model.graph.output:
        output.type.tensor_type.shape.dim[1].dim_param = "cells"
    del model.graph.value_info[:]
    file = f"{card.name}_{width}x{height}.onnx"
    (folder / file).write_bytes(model.SerializeToString())
    update = {"name": file.removesuffix(".onnx"), "file": file, "sha256": None}
    return card.model_copy(update={**update, "input_width": width, "input_height": height})


def _inputs(card: AnyCard, clips: Sequence[KeypointClip]) -> Iterator[np.ndarray]:
    for clip in clips:
        for frame, things in zip(clip.frames[::24], clip.truth[::24], strict=True):
            if isinstance(card, YoloxCard):
                yield letterbox(frame, card)[0]
            elif isinstance(card, CifcafCard):
                yield padded_input(frame, card)[0]
            else:
                for thing in things:
                    crop = plan_crop(thing.box_xyxy, card)
                    tall = thing.box_xyxy[3] - thing.box_xyxy[1] >= _LEAST_CROP_PX
                    if thing.category == card.category and tall and crop:
                        yield crop_input(frame, crop, card)


def _weights(card: AnyCard) -> Path:
    path = find_weights(card)
    if path is None:
        raise ModelError(f"{card.name}: its weights {card.file} are not there; {card.source}")
    return path


def _input_name(path: Path) -> str:
    import onnx

    return onnx.load(str(path), load_external_data=False).graph.input[0].name
