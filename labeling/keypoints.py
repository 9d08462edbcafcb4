"""Top-down keypoints: crops around boxes, one 1-D response per point and axis (SimCC), decoded back into the frame.

SimCC: Li et al. 2022; RTMPose: Jiang et al. 2023; DWPose: Yang et al. 2023.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from labeling.model_cards import SimccCard
from labeling.onnx_model import DEFAULT_PROVIDERS, OnnxModel, check_frame, network_input

SMALL_PERSON_PX = 100.0
"""A person lower than this shows no fingers and no face: 17 joints are all there is to see."""
BODY_JOINTS = 17
"""The first points of ``wholebody133`` are ``coco17``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Crop:
    """The part of a frame that the network sees, as an axis-aligned affine map."""

    centre_xy: tuple[float, float]
    """Frame pixels."""
    size_xy: tuple[float, float]
    """Frame pixels, at the network's aspect."""
    input_xy: tuple[int, int]
    """Width and height of the network's input."""

    @property
    def frame_to_input(self) -> np.ndarray:
        """(2, 3) float64 affine map from frame pixels to input pixels.

        From three points in float32, as MMPose makes it: ``cv2.warpAffine`` rounds places to 1/32 px, and another
        rounding of the same map would turn one pixel in ten thousand.
        """
        corners = [
            _corner(centre, width) for centre, width in
            ((self.centre_xy, self.size_xy[0]), (np.multiply(self.input_xy, 0.5), self.input_xy[0]))
        ]  # fmt: skip
        return cv2.getAffineTransform(*corners)

    def to_frame(self, points_xy: np.ndarray) -> np.ndarray:
        """(..., 2) input pixels to frame pixels: the inverse of ``frame_to_input``."""
        scale = np.divide(self.size_xy, self.input_xy)
        return (points_xy - np.multiply(self.input_xy, 0.5)) * scale + self.centre_xy


def plan_crop(box_xyxy: np.ndarray, card: SimccCard) -> Crop | None:
    """The crop for one box: its size times ``crop_padding``, then widened to the network's aspect.

    None for a box without area, of which nothing can be seen.
    """
    left, top, right, bottom = box_xyxy
    if not np.isfinite(box_xyxy).all() or right - left <= 0 or bottom - top <= 0:
        return None
    width, height = (right - left) * card.crop_padding, (bottom - top) * card.crop_padding
    aspect = card.input_width / card.input_height
    width, height = max(width, height * aspect), max(height, width / aspect)
    return Crop(
        centre_xy=((left + right) / 2, (top + bottom) / 2), size_xy=(width, height),
        input_xy=(card.input_width, card.input_height),
    )  # fmt: skip


def decode_simcc(simcc_x: np.ndarray, simcc_y: np.ndarray, *, split: float) -> np.ndarray:
    """Points in input pixels: the places of the maxima, scored by the lesser of the two.

    Args:
        simcc_x: (..., K, split * width) float32.
        simcc_y: (..., K, split * height) float32.
        split: bins per pixel.

    Returns:
        (..., K, 3) float32: x, y, score as the network gives it; x = y = score = 0 where it is not positive.
    """
    columns, rows = simcc_x.argmax(axis=-1), simcc_y.argmax(axis=-1)
    scores = np.minimum(simcc_x.max(axis=-1), simcc_y.max(axis=-1))
    points = np.stack([columns / split, rows / split, scores], axis=-1).astype(np.float32)
    points[scores <= 0] = 0
    return points


class KeypointHead:
    """A SimCC network behind its card.

    Raises:
        ModelError: as ``OnnxModel``.
    """

    def __init__(
        self,
        card: SimccCard,
        path: Path,
        *,
        providers: Sequence[str] = DEFAULT_PROVIDERS,
        threads: int = 1,
        max_batch: int = 8,
    ) -> None:
        self.card = card
        self.model = OnnxModel(card, path, providers=providers, threads=threads, max_batch=max_batch)

    @property
    def schema_name(self) -> str:
        """Of the points that ``estimate`` gives."""
        return self.card.schema_name

    def estimate(self, frames: Sequence[np.ndarray], boxes_xyxy: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Keypoints in every box of every frame; crops are batched across frames.

        Args:
            frames: (H, W, 3) uint8 RGB each.
            boxes_xyxy: (n, 4) for each frame. A box without area, or wholly outside, gets absent points.

        Returns:
            For each frame (n, K, 3) float32: x, y in frame pixels, score 0 to 1; absent points are all 0.

        Raises:
            ModelError: a frame that is no RGB picture, or a network's output that is not finite.
        """
        points = [np.zeros((len(boxes), self.card.schema_table.point_count, 3), np.float32) for boxes in boxes_xyxy]
        places = [
            (index, row, crop)
            for index, boxes in enumerate(boxes_xyxy)
            for row, box in enumerate(boxes)
            if (crop := plan_crop(box, self.card)) is not None and _touches(box, frames[index])
        ]
        for start in range(0, len(places), self.model.max_batch):
            chunk = places[start : start + self.model.max_batch]
            batch = np.stack([crop_input(frames[index], crop, self.card) for index, _, crop in chunk])
            simcc_x, simcc_y = self.model.run(batch)
            decoded = decode_simcc(simcc_x, simcc_y, split=self.card.simcc_split)
            for (index, row, crop), found in zip(chunk, decoded, strict=True):
                points[index][row] = _in_frame(found, crop)
        return points


class PersonHead:
    """Whole bodies for people who are large enough, 17 joints for the others.

    Args:
        full: a ``wholebody133`` head.
        small: a ``coco17`` head for people under ``small_below_px`` (a far cheaper network); without it ``full``
            runs for all and its feet, face and hands are left out.
        small_below_px: height of the box; 0 gives everyone 133 points.
    """

    def __init__(
        self, full: KeypointHead, *, small: KeypointHead | None = None, small_below_px: float = SMALL_PERSON_PX
    ) -> None:
        self.card = full.card
        self.full, self.small, self.small_below_px = full, small, small_below_px

    @property
    def schema_name(self) -> str:
        """``wholebody133``, for small people too: what they lack is absent."""
        return self.full.schema_name

    def estimate(self, frames: Sequence[np.ndarray], boxes_xyxy: Sequence[np.ndarray]) -> list[np.ndarray]:
        """As ``KeypointHead.estimate``."""
        low = [boxes[:, 3] - boxes[:, 1] < self.small_below_px for boxes in boxes_xyxy]
        if self.small is None:
            points = self.full.estimate(frames, boxes_xyxy)
            for found, mask in zip(points, low, strict=True):
                found[mask, BODY_JOINTS:] = 0
            return points
        large = self.full.estimate(frames, [boxes[~mask] for boxes, mask in zip(boxes_xyxy, low, strict=True)])
        small = self.small.estimate(frames, [boxes[mask] for boxes, mask in zip(boxes_xyxy, low, strict=True)])
        points = [np.zeros((len(mask), *bodies.shape[1:]), np.float32) for mask, bodies in zip(low, large, strict=True)]
        for merged, mask, bodies, joints in zip(points, low, large, small, strict=True):
            merged[~mask] = bodies
            merged[mask, :BODY_JOINTS] = joints
        return points


def crop_input(frame: np.ndarray, crop: Crop, card: SimccCard) -> np.ndarray:
    """The network's input for one crop, (3, input_height, input_width) float32; black beyond the frame.

    Raises:
        ModelError: the frame is not (H, W, 3) uint8.
    """
    check_frame(frame)
    picture = cv2.warpAffine(frame, crop.frame_to_input, crop.input_xy, flags=cv2.INTER_LINEAR)
    return network_input(picture, card)


def _in_frame(decoded: np.ndarray, crop: Crop) -> np.ndarray:
    points = decoded.copy()
    present = points[:, 2] > 0
    points[present, :2] = crop.to_frame(points[present, :2])
    points[:, 2] = np.minimum(points[:, 2], 1)
    return points


def _corner(centre_xy: Sequence[float] | np.ndarray, width: float) -> np.ndarray:
    """(3, 2) float32: the centre, the point half a width above it, and the one half a width left of that."""
    x, y = centre_xy
    points = np.array([[x, y], [x, y - width * 0.5], [x, y - width * 0.5]], np.float32)
    points[2, 0] -= points[0, 1] - points[1, 1]
    return points


def _touches(box_xyxy: np.ndarray, frame: np.ndarray) -> bool:
    height, width = frame.shape[:2]
    left, top, right, bottom = box_xyxy
    return bool(right > 0 and bottom > 0 and left < width and top < height)
