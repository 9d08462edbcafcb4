"""Other people's software on the same ONNX files, to be charted beside ours (development extra only)."""

import contextlib
import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime

from labeling.errors import ModelError
from labeling.extractors import ExtractorChoice
from labeling.labels import POINT_ABSENT, POINT_DETECTED, Keypoints
from labeling.model_cards import ModelCard, SimccCard, YoloxCard, find_weights
from labeling.onnx_model import level_table
from labeling.schemas import Category
from pipelines.keypoint_clips import KeypointClip


class RtmlibStreet:
    """rtmlib (Apache-2.0) with the street's detector and heads: every frame alone, no lanes.

    Its own defaults are set to the cards' (input size, thresholds, of which it knows one for all classes), and it is
    given the channel order that each card asks for; see ``tests/test_parity_rtmlib.py`` for where it departs from us.
    """

    def __init__(self, choice: ExtractorChoice) -> None:
        from rtmlib import RTMPose

        assert choice.detector is not None
        self.card = choice.detector
        self.detect: Callable[[np.ndarray], Any] = rtmlib_detector(choice.detector)
        self.heads: dict[Category, tuple[SimccCard, Callable[..., Any]]] = {
            card.category: (
                card,
                _one_thread(partial(RTMPose, model_input_size=(card.input_width, card.input_height)), card),
            )
            for card in choice.heads
        }

    def label(self, clip: KeypointClip) -> list[Keypoints]:
        """Untracked labels of all frames."""
        return [label for number, frame in enumerate(clip.frames) for label in self._frame(frame, number)]

    def _frame(self, frame: np.ndarray, number: int) -> list[Keypoints]:
        boxes, classes = self.detect(np.ascontiguousarray(frame[:, :, ::-1]))
        boxes = np.clip(np.asarray(boxes).reshape(-1, 4), 0, [frame.shape[1], frame.shape[0]] * 2)
        labels = []
        for category, (card, head) in self.heads.items():
            mine = boxes[[self.card.categories[self.card.class_names[i]] == category for i in classes]]
            if not len(mine):
                continue  # it would take the whole picture for one
            points, scores = head(frame, list(mine))
            for box, spots, marks in zip(mine, points, scores, strict=True):
                labels.append(_label(number, category, card.schema_name, box, spots, marks))
        return labels


def rtmlib_detector(card: YoloxCard, path: Path | None = None) -> Callable[[np.ndarray], Any]:
    """rtmlib's YOLOX on a card's file, called with a BGR frame: boxes and class numbers.

    Args:
        card: input size, thresholds.
        path: the weights; by default where ``find_weights`` finds them.

    Raises:
        ModelError: the weights are not there.
    """
    from rtmlib import YOLOX

    size = (card.input_height, card.input_width)
    settings = {"det_mode": "multiclass", "nms_thr": card.nms_threshold, "score_thr": card.score_threshold}
    peer: Any = _one_thread(partial(YOLOX, model_input_size=size, **settings), card, path)
    if card.mean != (0, 0, 0) or card.std != (1, 1, 1):
        # It knows no normalisation for YOLOX.
        table, infer = level_table(card.mean, card.std).T[None], peer.inference
        peer.inference = lambda picture: infer(cv2.LUT(picture, table))
    return peer


def _one_thread(open_peer: Callable[..., Any], card: ModelCard, path: Path | None = None) -> Callable[..., Any]:
    """A peer whose session runs on one thread as ours does; it offers no setting for that, and prints what it loads."""
    weights = str(path) if path else _weights(card)
    with contextlib.redirect_stdout(io.StringIO()):
        peer = open_peer(weights, backend="onnxruntime")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    peer.session = onnxruntime.InferenceSession(weights, options, providers=["CPUExecutionProvider"])
    return peer


def _weights(card: ModelCard) -> str:
    path = find_weights(card)
    if path is None:
        raise ModelError(f"{card.name}: its weights {card.file} are not there; {card.source}")
    return str(path)


def _label(
    frame: int, category: Category, schema: str, box: np.ndarray, spots: np.ndarray, marks: np.ndarray
) -> Keypoints:
    points = np.concatenate([spots, np.clip(marks, 0, 1)[:, None]], axis=1).astype(np.float32)
    points[points[:, 2] <= 0] = 0
    return Keypoints(
        frame=frame, category=category, schema=schema, score=1.0, box_xyxy=box.astype(np.float32), points=points,
        point_source=np.where(points[:, 2] > 0, POINT_DETECTED, POINT_ABSENT).astype(np.int8),
    )  # fmt: skip
