"""Batches for each street model: pool pictures, moved and disturbed, with the targets that belong to them."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from labeling.detection import LETTERBOX_GREY
from labeling.model_cards import IMAGENET_MEAN, ModelCard
from labeling.schemas import Category, KeypointSchema, keypoint_schema
from training.criteria import JUDGED_HEIGHT_PX, JUDGED_SHARE
from training.street_augment import AugmentSettings, disturb, map_boxes, map_points, put_board, random_map
from training.street_losses import MINOR
from training.street_networks import FIELD_STRIDE
from training.street_pool import PICTURE_SCALE, ObjectTruth, PoolCrop, PoolFrame, StreetPool, frames_with
from training.street_targets import FieldVotes, GridTargets, encode_boxes, encode_fields, encode_responses

CLASSES: tuple[Category, ...] = ("car", "person")
CROP_PADDING = 1.25
LEAST_SHARE = 0.15
"""Objects of which less is visible are left out of the detector's loss: neither asked for nor forbidden."""
_LEAST_WINDOW_PX = 9.0
"""Lower objects are left out of the detector's loss too: of all objects a tenth, and of no use."""
_NEARLY = 0.8
"""Of what is asked of an object that is judged: below it, a learner is asked less of, too."""
_HIDDEN_WEIGHT = 0.25
_MEAN_COLOUR = tuple(float(round(value)) for value in IMAGENET_MEAN)
_BOX_SLACK_PX = 2.0
_USUAL_CROP_PX = 40.0
"""Height of an object that is drawn as often as there are such: higher ones more often, lower ones less."""
_FOUND_WITHIN = 0.1
"""Of the box diagonal: what PCK@0.1 calls right."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """Pictures and whatever the loss needs beside them."""

    pictures: torch.Tensor
    """(N, H, W, 3) uint8 RGB: a quarter of what ``to_input`` makes of it, for the way to a device."""
    targets: tuple[torch.Tensor, ...]

    def to(self, device: torch.device) -> "Batch":
        """The same, there."""
        return self._each(lambda tensor: tensor.to(device, non_blocking=True))

    def pin_memory(self) -> "Batch":
        """The same, in memory that a GPU fetches by itself; ``DataLoader`` asks for it."""
        return self._each(torch.Tensor.pin_memory)

    def _each(self, change: Callable[[torch.Tensor], torch.Tensor]) -> "Batch":
        return Batch(pictures=change(self.pictures), targets=tuple(change(target) for target in self.targets))


def to_input(pictures: torch.Tensor, card: ModelCard) -> torch.Tensor:
    """(N, 3, H, W) float32 network input as ``card`` says, channels last in memory, from (N, H, W, 3) uint8 RGB."""
    batch = pictures.permute(0, 3, 1, 2)
    if card.channel_order == "bgr":
        batch = batch.flip(1)
    mean, std = (batch.new_tensor(values, dtype=torch.float32).view(1, 3, 1, 1) for values in (card.mean, card.std))
    return ((batch.float() - mean) / std).contiguous(memory_format=torch.channels_last)


def mirror_order(table: KeypointSchema) -> np.ndarray:
    """(K,) for each point the one that takes its place in a mirrored picture: left and right change their names."""

    def mirrored(name: str) -> str:
        swap = {"left": "right", "right": "left"}
        return "_".join(swap.get(part, part) for part in name.split("_"))

    return np.array([table.point_names.index(mirrored(name)) for name in table.point_names])


@dataclass(frozen=True, slots=True, kw_only=True)
class Windows:
    """Parts of frames that make a batch."""

    width: int
    """Of each, a multiple of 32, as is the height."""
    height: int
    count: int
    """In a batch."""
    share: float = 1.0
    """Of batches, beside those of other windows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorBatches:
    """Windows of frames, some plain, most moved and disturbed, with grid targets and objects for both looks."""

    pool: StreetPool
    windows: tuple[Windows, ...]
    """Each batch draws one of these."""
    augment: AugmentSettings
    scales: tuple[float, float] = (0.85, 1.2)
    plain_share: float = 0.0
    """Of windows as the camera took them."""
    person_share: float = 0.5
    """Of windows around a person: they are small and rare."""

    def __call__(self, rng: np.random.Generator) -> Batch:
        """One batch: targets are classes (N, A), boxes (N, A, 4) and weights (N, A) of the grid; then boxes (N, G, 4),
        classes (N, G), -1 where there are fewer than G objects, and their importance (N, G), as ``second_look_loss``
        takes them."""
        shares = np.array([windows.share for windows in self.windows])
        windows = self.windows[int(rng.choice(len(self.windows), p=shares / shares.sum()))]
        size = (windows.width, windows.height)
        pictures: list[np.ndarray] = []
        grids: list[GridTargets] = []
        objects: list[_Boxes] = []
        for _ in range(windows.count):
            frame, people = _draw_frame(self.pool, rng, self.person_share)
            height, width = frame.picture.shape[:2]
            plain = rng.random() < self.plain_share
            picture_to_window = random_map(
                rng, source=(width, height), target=size, scales=(1.0, 1.0) if plain else self.scales,
                flip=rng.random() < 0.5, focus_xy=self._focus(frame, rng, "person" if people else "car"),
            )  # fmt: skip
            grey = (LETTERBOX_GREY,) * 3
            window = cv2.warpAffine(frame.picture, picture_to_window, size, borderValue=grey)
            pictures.append(window if plain else disturb(window, rng, self.augment))
            found = _boxes_inside(frame, picture_to_window, size)
            objects.append(found)
            grids.append(encode_boxes(found.xyxy, found.classes, found.counted, width=size[0], height=size[1]))
        most = max(1, *(len(found.classes) for found in objects))
        parts = (
            [_padded(found.xyxy, most, 0) for found in objects],
            [_padded(found.classes, most, -1) for found in objects],
            [_padded(_importance(found), most, 0) for found in objects],
        )
        return Batch(pictures=_stack(pictures), targets=(*_stack_grids(grids), *map(_stack, parts)))

    def _focus(self, frame: PoolFrame, rng: np.random.Generator, category: Category) -> np.ndarray | None:
        """The middle of one object, picture pixels; one window in four lies anywhere."""
        boxes = [truth.box_xyxy for truth in frame.objects if truth.category == category and truth.visible_share > 0.2]
        if not boxes or rng.random() < 0.25:
            return None
        # Near objects are few, near people fewest: a crowd on the pavement would leave them no window.
        weights = np.array([box[3] - box[1] for box in boxes]) ** (1.0 if category == "person" else 0.5)
        box = boxes[int(rng.choice(len(boxes), p=weights / weights.sum()))]
        return (box[:2] + box[2:]) / 2 * frame.scale


def _draw_frame(pool: StreetPool, rng: np.random.Generator, person_share: float) -> tuple[PoolFrame, bool]:
    """A frame, and whether it was drawn among those with a person in them."""
    with_people = frames_with(pool, "person")
    people = bool(len(with_people)) and rng.random() < person_share
    return pool.frames[int(rng.choice(with_people) if people else rng.integers(len(pool.frames)))], people


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Boxes:
    """What touches a window."""

    xyxy: np.ndarray
    """(n, 4) float32, window pixels, inside it."""
    classes: np.ndarray
    """(n,) int64."""
    shares: np.ndarray
    """(n,) visible shares, of what lies within the window."""

    @property
    def heights(self) -> np.ndarray:
        """(n,) pixels."""
        return self.xyxy[:, 3] - self.xyxy[:, 1]

    @property
    def counted(self) -> np.ndarray:
        """(n,) bool: large and visible enough for the detector's loss."""
        return (self.shares >= LEAST_SHARE) & (self.heights >= _LEAST_WINDOW_PX)


def _boxes_inside(frame: PoolFrame, picture_to_window: np.ndarray, size: Sequence[int]) -> _Boxes:
    """Cars and people in a window of width and height ``size`` of a frame."""
    found = [truth for truth in frame.objects if truth.category in CLASSES]
    boxes = np.array([truth.box_xyxy for truth in found], np.float32).reshape(-1, 4)
    whole = map_boxes(boxes * frame.scale, picture_to_window)
    inside = np.clip(whole, 0, np.tile(size, 2))
    sides, whole_sides = inside[:, 2:] - inside[:, :2], whole[:, 2:] - whole[:, :2]
    left = np.prod(sides, axis=1) / np.maximum(np.prod(whole_sides, axis=1), 1e-6)
    touching = (sides > 1).all(axis=1)
    return _Boxes(
        xyxy=inside[touching].astype(np.float32),
        classes=np.array([CLASSES.index(truth.category) for truth in found], np.int64)[touching],
        shares=(left * np.array([truth.visible_share for truth in found], np.float64))[touching],
    )


def _importance(found: _Boxes) -> np.ndarray:
    """(n,) float32 1 where an object is judged, half of it where nearly, less where it counts at all, else nothing."""
    asked = (
        (MINOR, LEAST_SHARE, _LEAST_WINDOW_PX), (0.5, _NEARLY * JUDGED_SHARE, _NEARLY * JUDGED_HEIGHT_PX),
        (1.0, JUDGED_SHARE, JUDGED_HEIGHT_PX),
    )  # fmt: skip
    values = np.zeros(len(found.classes), np.float32)
    for importance, share, height in asked:
        values[(found.shares >= share) & (found.heights >= height * PICTURE_SCALE)] = importance
    return values


def _padded(values: np.ndarray, length: int, fill: float) -> np.ndarray:
    """Values (n, ...) made ``length`` long."""
    return np.pad(values, [(0, length - len(values)), *[(0, 0)] * (values.ndim - 1)], constant_values=fill)


def _stack_grids(targets: Sequence[GridTargets]) -> tuple[torch.Tensor, ...]:
    """Classes (N, A), boxes (N, A, 4) and weights (N, A)."""
    parts = zip(*((one.classes, one.boxes_xyxy, one.weights) for one in targets), strict=True)
    return tuple(_stack(part) for part in parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class CropBatches:
    """Crops around jittered boxes with SimCC targets."""

    crops: tuple[PoolCrop, ...]
    schema: str
    size: tuple[int, int]
    """Width and height of the network's input."""
    count: int
    augment: AugmentSettings
    board_share: float = 0.15
    """Of crops with a board before the object: nothing else hides a part of it so sharply."""

    def __call__(self, rng: np.random.Generator) -> Batch:
        """One batch: targets are responses along x and y, weights, visibility, and the tolerance in bins."""
        order = mirror_order(keypoint_schema(self.schema))
        pictures, points, visible, tolerances = [], [], [], []
        for index in np.searchsorted(_running_shares(self.crops), rng.random(self.count), side="right"):
            crop, flip = self.crops[index], bool(rng.random() < 0.5)
            if rng.random() < self.board_share:
                crop = behind_board(crop, rng)
            crop_to_input, scale = self._map(crop, rng, flip)
            picture = cv2.warpAffine(crop.picture, crop_to_input, self.size, flags=cv2.INTER_LINEAR)
            pictures.append(disturb(picture, rng, self.augment))
            chosen = order if flip else slice(None)
            points.append(map_points(crop.truth.points_xy[chosen], crop_to_input))
            visible.append(crop.truth.visible[chosen])
            sides = crop.truth.box_xyxy[2:] - crop.truth.box_xyxy[:2]
            tolerances.append(_FOUND_WITHIN * 2 * scale * float(np.hypot(*sides)))
        return Batch(pictures=_stack(pictures), targets=self._targets(points, visible, tolerances))

    def _map(self, crop: PoolCrop, rng: np.random.Generator, flip: bool) -> tuple[np.ndarray, float]:
        box = crop.truth.box_xyxy
        # A detector is off by a share of the box, and by a pixel or two however small that is.
        sides = (box[2:] - box[:2]) * rng.uniform(0.9, 1.12, 2) + rng.uniform(-1, 1, 2) * _BOX_SLACK_PX
        centre = (box[:2] + box[2:]) / 2 + (box[2:] - box[:2]) * rng.uniform(-0.07, 0.07, 2)
        centre += rng.uniform(-0.5, 0.5, 2) * _BOX_SLACK_PX
        aspect = self.size[0] / self.size[1]
        width = CROP_PADDING * max(sides[0], sides[1] * aspect)
        scale = self.size[0] / width
        angle = np.radians(rng.uniform(-4, 4))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        linear = scale * turn @ np.diag([-1.0 if flip else 1.0, 1.0])
        return np.column_stack([linear, np.array(self.size) / 2 - linear @ centre]), scale

    def _targets(
        self, points: list[np.ndarray], visible: list[np.ndarray], tolerances: list[float]
    ) -> tuple[torch.Tensor, ...]:
        places, seen = np.stack(points), np.stack(visible)
        inside = ((places >= 0) & (places < np.array(self.size))).all(axis=2)
        seen &= inside
        # A point behind the camera is nowhere; its weight is 0.
        along_x, along_y = encode_responses(np.nan_to_num(places), self.size)
        weights = np.where(seen, 1.0, _HIDDEN_WEIGHT * inside).astype(np.float32)
        arrays = (along_x, along_y, weights, seen.astype(np.float32), np.array(tolerances, np.float32))
        return tuple(torch.from_numpy(array) for array in arrays)


@functools.lru_cache(maxsize=4)
def _running_shares(crops: tuple[PoolCrop, ...]) -> np.ndarray:
    """(n,) where each crop's share of the draws ends: far objects are many and small, near ones few."""
    heights = np.array([crop.truth.box_xyxy[3] - crop.truth.box_xyxy[1] for crop in crops])
    shares = np.clip(heights / _USUAL_CROP_PX, 0.5, 3)
    ends = np.cumsum(shares) / shares.sum()
    ends[-1] = 1.0
    return ends


def behind_board(crop: PoolCrop, rng: np.random.Generator) -> PoolCrop:
    """A crop whose object is partly behind a board: its box is what is left, its points there are hidden."""
    picture, cover, rest = put_board(crop.picture, crop.truth.box_xyxy, rng)
    points = crop.truth.points_xy
    covered = ((points >= cover[:2]) & (points <= cover[2:])).all(axis=1)
    truth = replace(crop.truth, box_xyxy=rest, visible=crop.truth.visible & ~covered)
    return PoolCrop(picture=picture, truth=truth)


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldBatches:
    """Whole frames with composite fields of one or more schemas."""

    pool: StreetPool
    schemas: tuple[str, ...]
    size: tuple[int, int]
    """Width and height of the network's input, multiples of the stride plus 1."""
    count: int
    augment: AugmentSettings
    scales: tuple[float, float] = (0.55, 0.73)
    """Around the 11/18 that takes a kept picture to half a frame."""

    def __call__(self, rng: np.random.Generator) -> Batch:
        """One batch: targets are places and values of cif, then of caf, of each schema in turn."""
        pictures: list[np.ndarray] = []
        targets: list[list[FieldVotes]] = []
        for index in rng.integers(0, len(self.pool.frames), self.count):
            frame, flip = self.pool.frames[index], bool(rng.random() < 0.5)
            height, width = frame.picture.shape[:2]
            picture_to_input = random_map(
                rng, source=(width, height), target=self.size, scales=self.scales, flip=flip, rotation_deg=2.0
            )
            moved = cv2.warpAffine(frame.picture, picture_to_input, self.size, borderValue=_MEAN_COLOUR)
            pictures.append(disturb(moved, rng, self.augment))
            targets.append(self._fields(frame, picture_to_input, flip))
        stacked = [tensor for votes in zip(*targets, strict=True) for tensor in _stack_votes(votes)]
        return Batch(pictures=_stack(pictures), targets=tuple(stacked))

    def _fields(self, frame: PoolFrame, picture_to_input: np.ndarray, flip: bool) -> list[FieldVotes]:
        fields: list[FieldVotes] = []
        for name in self.schemas:
            table = keypoint_schema(name)
            placed = [
                field_object(truth, table, frame.scale, picture_to_input, size=self.size, flip=flip)
                for truth in sorted(frame.objects, key=lambda truth: truth.box_xyxy[3])
                if truth.category == table.category
            ]
            columns, rows = ((side - 1) // FIELD_STRIDE + 1 for side in self.size)
            encoded = encode_fields(placed, table, columns=columns, rows=rows, stride=FIELD_STRIDE)
            fields += [encoded.cif, encoded.caf]
        return fields


def _stack(pictures: Sequence[np.ndarray]) -> torch.Tensor:
    return torch.from_numpy(np.stack(pictures))


def _stack_votes(votes: Sequence[FieldVotes]) -> tuple[torch.Tensor, torch.Tensor]:
    places = [np.insert(one.places, 0, index, axis=1) for index, one in enumerate(votes)]
    return torch.from_numpy(np.concatenate(places)), torch.from_numpy(np.concatenate([one.values for one in votes]))


def field_object(
    truth: ObjectTruth,
    table: KeypointSchema,
    scale: float,
    picture_to_input: np.ndarray,
    *,
    size: tuple[int, int],
    flip: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points in input pixels, which of them are there, and their scales, as ``encode_fields`` takes them.

    A lane goes on behind a car: its hidden points are asked for. A car's are not. How far along a lane a point lies is
    never sure, so that a lane's points are as wide as their spacing.
    """
    # Pixel centres lie on integers in both pictures.
    points = map_points((truth.points_xy + 0.5) * scale - 0.5, picture_to_input)
    there = truth.visible
    if table.category == "lane":
        steps = np.hypot(*np.diff(points, axis=0).T)
        scales = np.clip(np.minimum(np.append(steps, steps[-1]), np.append(steps[0], steps)), 10, 32)
        there = np.isfinite(points).all(axis=1)
    else:
        order = mirror_order(table) if flip else slice(None)
        points, there = points[order], there[order]
        sides = truth.box_xyxy[2:] - truth.box_xyxy[:2]
        scales = np.full(len(points), np.clip(0.04 * float(np.hypot(*sides)) / 2, 2, 12))
    inside = ((points >= 0) & (points < np.array(size))).all(axis=1)
    return points, np.logical_and(there, inside), scales
