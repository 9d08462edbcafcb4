"""Objects in a frame: YOLOX networks run on batches of frames, decoded, and cleared of doubles.

Boxes are left, top, right, bottom in pixels of the frame given, cut at its borders.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from labeling.boxes import inside, iou
from labeling.model_cards import DETECTOR_STRIDES, SoftSuppression, YoloxCard
from labeling.onnx_model import DEFAULT_PROVIDERS, OnnxModel, check_frame, network_input
from labeling.schemas import Category

LETTERBOX_GREY = 114
_MAX_CANDIDATES = 2000
"""Pairs of box and class that enter the suppression, best first: it bounds the time of the worst frame."""
_DOUBLE_IOU = 0.45
"""Two boxes of one category, but different classes, that overlap by more are one object (YOLOX's own threshold)."""
_MIN_SIDE_PX = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detections:
    """What a detector saw in one frame, best first."""

    boxes_xyxy: np.ndarray
    """(N, 4) float32, inside the frame, none of zero area."""
    scores: np.ndarray
    """(N,) float32, 0 to 1, descending."""
    classes: np.ndarray
    """(N,) str: the detector's name of each, such as ``truck``."""
    categories: np.ndarray
    """(N,) str: ``car`` or ``person``, or empty where the class is counted but not labelled."""
    left_out: int = 0
    """How many more there were than the card's ``max_detections``, at least: of more than some thousands the worst are
    not counted."""

    def __len__(self) -> int:
        return len(self.scores)

    def select(self, keep: np.ndarray) -> "Detections":
        """Those that ``keep`` (a mask or indices) names, in its order."""
        return Detections(
            boxes_xyxy=self.boxes_xyxy[keep], scores=self.scores[keep], classes=self.classes[keep],
            categories=self.categories[keep], left_out=self.left_out,
        )  # fmt: skip

    def distinct(self, iou_threshold: float = _DOUBLE_IOU) -> "Detections":
        """Without those that a better one of the same category, but of another class, overlaps: a van seen as car and
        as truck is one object.

        Boxes of one class are left to the detector's own suppression, and classes without a category as they are.
        """
        keep: list[int] = []
        for index, (category, name) in enumerate(zip(self.categories, self.classes, strict=True)):
            rivals = [i for i in keep if category and self.categories[i] == category and self.classes[i] != name]
            if not len(rivals) or iou(self.boxes_xyxy[[index]], self.boxes_xyxy[rivals]).max() <= iou_threshold:
                keep.append(index)
        return self.select(np.array(keep, dtype=np.intp))

    def of_category(self, category: Category) -> "Detections":
        """The distinct objects of one category."""
        chosen = self.select(self.categories == category)
        return chosen.distinct()


class Detector:
    """A YOLOX network behind its card.

    Attributes:
        left_out: objects beyond the card's ``max_detections``, over all frames so far.

    Raises:
        ModelError: as ``OnnxModel``.
    """

    def __init__(
        self,
        card: YoloxCard,
        path: Path,
        *,
        providers: Sequence[str] = DEFAULT_PROVIDERS,
        threads: int = 1,
        max_batch: int = 8,
    ) -> None:
        self.card = card
        self.model = OnnxModel(card, path, providers=providers, threads=threads, max_batch=max_batch)
        self.left_out = 0

    def detect(self, frames: Sequence[np.ndarray]) -> list[Detections]:
        """Detections of each frame, (H, W, 3) uint8 RGB; sizes may differ.

        Raises:
            ModelError: a frame that is no RGB picture, or a network's output that is not finite.
        """
        if not len(frames):
            return []
        batch = np.empty((len(frames), 3, self.card.input_height, self.card.input_width), np.float32)
        ratios = [letterbox(frame, self.card, out=planes)[1] for frame, planes in zip(frames, batch, strict=True)]
        (outputs,) = self.model.run(batch)
        found = []
        for output, frame, ratio in zip(outputs, frames, ratios, strict=True):
            found.append(decode_yolox(output, self.card, ratio=ratio, width=frame.shape[1], height=frame.shape[0]))
            self.left_out += found[-1].left_out
        return found


def letterbox(frame: np.ndarray, card: YoloxCard, *, out: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """The network's input for one frame, and its scale relative to the frame.

    The frame is scaled to fit (linear), put at the top left, and padded with grey 114.

    Args:
        frame: (H, W, 3) uint8 RGB.
        card: size, channel order and normalisation.
        out: where the input goes; a new array by default.

    Returns:
        (3, input_height, input_width) float32 in the card's channel order and normalisation, and the scale.

    Raises:
        ModelError: the frame is not (H, W, 3) uint8, or empty.
    """
    check_frame(frame)
    height, width = frame.shape[:2]
    ratio = min(card.input_height / height, card.input_width / width)
    inner = (max(1, int(width * ratio)), max(1, int(height * ratio)))
    picture = cv2.resize(frame, inner, interpolation=cv2.INTER_LINEAR)
    right, below = card.input_width - inner[0], card.input_height - inner[1]
    if right or below:
        picture = cv2.copyMakeBorder(picture, 0, below, 0, right, cv2.BORDER_CONSTANT, value=(LETTERBOX_GREY,) * 3)
    return network_input(picture, card, out=out), ratio


def decode_yolox(output: np.ndarray, card: YoloxCard, *, ratio: float, width: int, height: int) -> Detections:
    """Boxes of one frame from raw grid outputs (Ge et al. 2021, YOLOX): ``xy = (p + grid) s``, ``wh = exp(p) s``.

    Doubles are cleared as the card says; with ``soft_nms``, scores are what is left of the network's.

    Args:
        output: (sum(hw/s^2), 5 + C) float32; objectness and class scores are sigmoid already.
        card: classes and thresholds.
        ratio: network pixels per frame pixel.
        width: of the frame; boxes are cut there, and those of no area left out.
        height: of the frame.
    """
    scores, least = output[:, 4:5] * output[:, 5:], np.array(card.class_thresholds, np.float32)
    rows, class_ids = np.nonzero(scores > least)
    values = scores[rows, class_ids]
    order = np.argsort(-values, kind="stable")[:_MAX_CANDIDATES]
    rows, class_ids, values = rows[order], class_ids[order], values[order]
    boxes = _decode_boxes(output[rows, :4], rows, card) / np.float32(ratio)
    # Doubles are cleared before boxes are cut: two objects that leave the picture must not become one.
    if card.soft_nms:
        keep, values = soften_overlaps(boxes, values, class_ids, card.soft_nms, least[class_ids])
    else:
        keep = suppress_overlaps(boxes, class_ids, card.nms_threshold)
    boxes = np.clip(boxes, 0, np.array([width, height, width, height], np.float32))
    sides = boxes[keep, 2:] - boxes[keep, :2]
    keep = keep[(sides > _MIN_SIDE_PX).all(axis=1)]
    best = keep[: card.max_detections]
    names = np.array(card.class_names)
    categories = np.array([card.categories.get(name, "") for name in card.class_names])
    return Detections(
        boxes_xyxy=boxes[best], scores=values[best], classes=names[class_ids[best]],
        categories=categories[class_ids[best]], left_out=len(keep) - len(best),
    )  # fmt: skip


def suppress_overlaps(boxes_xyxy: np.ndarray, labels: np.ndarray, iou_threshold: float) -> np.ndarray:
    """Greedy non-maximum suppression within each label.

    Args:
        boxes_xyxy: (N, 4), best first.
        labels: (N,) integers; boxes of different labels never suppress each other.
        iou_threshold: a box goes if a better one of its label overlaps it by more.

    Returns:
        Indices of the boxes that stay, best first.
    """
    double = np.triu((iou(boxes_xyxy, boxes_xyxy) > iou_threshold) & (labels[:, None] == labels), 1)
    alive = np.ones(len(boxes_xyxy), bool)
    for i in np.flatnonzero(double.any(axis=1)):
        if alive[i]:
            alive &= ~double[i]
    return np.flatnonzero(alive)


def soften_overlaps(
    boxes_xyxy: np.ndarray, scores: np.ndarray, labels: np.ndarray, soft: SoftSuppression, least: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Soft non-maximum suppression within each label (Bodla et al. 2017, equation 3), and of parts.

    A box that overlaps a better one keeps a share of its score, and goes where too little is left: of two that overlap
    by half, a confident second one is an object that stands before or behind the first, a timid one its double. Overlap
    says little of a small box in a large one, which may be a part of it: there what counts is how much of it is inside.

    Args:
        boxes_xyxy: (N, 4).
        scores: (N,) descending.
        labels: (N,) integers; boxes of different labels leave each other alone.
        soft: how much is left.
        least: (N,) what must be left of each.

    Returns:
        Indices of the boxes that stay, best first by what is left, and (N,) what is left of all scores.
    """
    left, kept = scores.copy(), []
    for label in np.unique(labels):
        mine = np.flatnonzero(labels == label)
        boxes, rest, limits, alive = boxes_xyxy[mine], left[mine], least[mine], np.ones(len(mine), bool)
        share = np.minimum(np.exp(-(iou(boxes, boxes) ** 2) / soft.sigma), 1 - soft.part_cost * inside(boxes, boxes))
        while alive.any():
            best = int(np.where(alive, rest, -1).argmax())
            kept.append(mine[best])
            alive[best] = False
            rest[alive] *= share[best, alive]
            alive &= rest > limits
        left[mine] = rest
    found = np.array(kept, dtype=np.intp)
    return found[np.lexsort((found, -left[found]))], left


def _decode_boxes(raw: np.ndarray, rows: np.ndarray, card: YoloxCard) -> np.ndarray:
    cells, strides = grid_cells(card.input_width, card.input_height)
    centres = (raw[:, :2] + cells[rows]) * strides[rows, None]
    # exp(20) cells is beyond any picture, and finite.
    halves = np.exp(np.minimum(raw[:, 2:], 20)) * (strides[rows, None] / 2)
    return np.concatenate([centres - halves, centres + halves], axis=1)


@functools.lru_cache(maxsize=8)
def grid_cells(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Column and row (A, 2) and stride (A,) of every cell, both float32, in the order of the network's output. They are
    shared between calls: never written to."""
    cells, strides = [], []
    for stride in DETECTOR_STRIDES:
        columns, rows = np.meshgrid(np.arange(width // stride), np.arange(height // stride))
        cells.append(np.stack([columns, rows], axis=2).reshape(-1, 2))
        strides.append(np.full(columns.size, stride))
    return np.concatenate(cells).astype(np.float32), np.concatenate(strides).astype(np.float32)
