"""Street frames rendered once and kept in memory: smaller pictures for detector and fields, crops for the heads."""

import functools
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import cv2
import numpy as np

from dataset.street import Street, StreetConfig, StreetFrame
from labeling.schemas import Category

PICTURE_SIZE = (864, 576)
"""Width and height at which frames are kept: the detector's input; 9/11 of 1056x704."""
PICTURE_SCALE = 9 / 11
"""Picture pixels per frame pixel."""
CROP_MARGIN = 1.8
"""Side of a stored crop relative to the object's box, so that it can still be moved, turned and scaled."""
CROP_LIMIT_PX = 360
"""Larger crops are scaled down to it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderPlan:
    """Which frames of which street are rendered."""

    config: StreetConfig
    frames: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectTruth:
    """One object of a frame, in pixels of the full frame (or of the crop that it is stored with)."""

    category: Category
    box_xyxy: np.ndarray
    """(4,) float32: of what is visible in the picture."""
    points_xy: np.ndarray
    """(K, 2) float32; NaN behind the camera."""
    visible: np.ndarray
    """(K,) bool."""
    visible_share: float
    """0 to 1."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoolFrame:
    """One frame, scaled down, with its truth at full size."""

    picture: np.ndarray
    """(576, 864, 3) uint8 RGB."""
    scale: float
    """Picture pixels per frame pixel."""
    objects: tuple[ObjectTruth, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoolCrop:
    """The surroundings of one object."""

    picture: np.ndarray
    """(h, w, 3) uint8 RGB, black beyond the frame."""
    truth: ObjectTruth
    """In the crop's pixels."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreetPool:
    """Everything that the networks learn from."""

    frames: tuple[PoolFrame, ...]
    crops: dict[Category, tuple[PoolCrop, ...]]


@functools.lru_cache(maxsize=8)
def frames_with(pool: StreetPool, category: Category, *, least_px: float = 20.0) -> np.ndarray:
    """Indices of the pool's frames with an object of a category that is at least ``least_px`` high."""
    found = [
        index
        for index, frame in enumerate(pool.frames)
        if any(t.category == category and t.box_xyxy[3] - t.box_xyxy[1] >= least_px for t in frame.objects)
    ]
    return np.array(found, dtype=np.int64)


def truths_of(frame: StreetFrame) -> tuple[ObjectTruth, ...]:
    """The labels of a rendered frame."""
    return tuple(
        ObjectTruth(
            category=thing.category,
            box_xyxy=np.asarray(thing.box_xyxy, np.float32),
            points_xy=np.asarray(thing.points_xy, np.float32),
            visible=np.asarray(thing.visible, bool),
            visible_share=float(thing.visible_share),
        )
        for thing in frame.objects
    )


def render_pool(
    plans: Sequence[RenderPlan], *, least_crop_px: float = 20.0, least_share: float = 0.2, workers: int = 2
) -> StreetPool:
    """Render all planned frames, streets in parallel, results in the order of the plans.

    Args:
        plans: the streets.
        least_crop_px: height from which an object's crop is kept.
        least_share: visible share from which it is kept.
        workers: processes.
    """
    frames: list[PoolFrame] = []
    crops: dict[Category, list[PoolCrop]] = {"car": [], "person": [], "lane": []}
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for part_frames, part_crops in pool.map(
            _render_street, plans, [least_crop_px] * len(plans), [least_share] * len(plans)
        ):
            frames += part_frames
            for crop in part_crops:
                crops[crop.truth.category].append(crop)
    return StreetPool(frames=tuple(frames), crops={name: tuple(found) for name, found in crops.items()})


def _render_street(
    plan: RenderPlan, least_crop_px: float, least_share: float
) -> tuple[list[PoolFrame], list[PoolCrop]]:
    cv2.setNumThreads(1)
    street = Street(plan.config)
    frames, crops = [], []
    for index in plan.frames:
        frame = street.render(index)
        objects = truths_of(frame)
        picture = cv2.resize(frame.rgb, PICTURE_SIZE, interpolation=cv2.INTER_LINEAR)
        frames.append(PoolFrame(picture=picture, scale=PICTURE_SIZE[0] / frame.rgb.shape[1], objects=objects))
        crops += _crops_of(frame.rgb, objects, least_crop_px, least_share)
    return frames, crops


def _crops_of(
    rgb: np.ndarray, objects: Iterable[ObjectTruth], least_px: float, least_share: float
) -> Iterable[PoolCrop]:
    for truth in objects:
        size = truth.box_xyxy[2:] - truth.box_xyxy[:2]
        if truth.category == "lane" or size[1] < least_px or truth.visible_share < least_share:
            continue
        side = CROP_MARGIN * float(size.max())
        scale = min(1.0, CROP_LIMIT_PX / side)
        middle = (truth.box_xyxy[:2] + truth.box_xyxy[2:]) / 2
        pixels = int(np.ceil(side * scale))
        offset = pixels / 2 - scale * middle
        frame_to_crop = np.array([[scale, 0, offset[0]], [0, scale, offset[1]]], np.float64)
        picture = cv2.warpAffine(rgb, frame_to_crop, (pixels, pixels), flags=cv2.INTER_LINEAR)
        shifted = ObjectTruth(
            category=truth.category, visible=truth.visible, visible_share=truth.visible_share,
            box_xyxy=(truth.box_xyxy * scale + np.tile(offset, 2)).astype(np.float32),
            points_xy=(truth.points_xy * scale + offset).astype(np.float32),
        )  # fmt: skip
        yield PoolCrop(picture=picture, truth=shifted)
