"""Who judges the study's little pictures: networks taught on street truth, at this size and through this VAE.

The extractors that label videos were made for pictures ten times as wide; the study reports what they make of these.

A detector finds cars in single frames (the shipped street detector's network and loss, at twice the picture's size); a
second network reads how the camera moved between two frames from how their features correlate. Both learn from the
training streets, as they are and as the VAE gives them back, and never see a street that is judged.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import nn
from torch.nn import functional

from labeling.camera import invert, rigid
from labeling.detection import decode_yolox, grid_cells
from labeling.model_cards import SoftSuppression, YoloxCard, load_cards
from training.street_fitting import FitSettings, fit
from training.street_losses import detector_loss
from training.street_networks import DetectorGraph, StreetDetector, conv_unit
from training.street_targets import encode_boxes
from training.tiny import seeded

PAIR_FRAMES = 4
"""Native frames between the two that the camera's motion is read from."""
_LEAST_HEIGHT, _LEAST_SHARE = 14.0, 0.3
"""Pixels of the labels' picture, and share: what the detector must find."""
_RADIUS = 1.0
"""Strides from a car's middle to its cells: the study's figures were measured so."""
_BATCH, _PAIR_BATCH = 12, 16
_REACH = (2, 4)
_YAW_SCALE = 10.0
"""A tenth of a radian weighs as much as a metre."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JudgeClip:
    """One clip to learn from or to test on."""

    videos: tuple[np.ndarray, ...]
    """Each (T, H, W, 3) uint8: as it is, as the VAE gives it back."""
    boxes: tuple[np.ndarray, ...]
    """(n, 4) per frame: cars, in pixels of twice the picture."""
    counted: tuple[np.ndarray, ...]
    """(n,) bool per frame: high and visible enough to be found."""
    cam_to_world: np.ndarray
    """(T, 4, 4)."""
    frame_step: int = 1
    """Native frames per frame."""

    @property
    def pair_gap(self) -> int:
        """Frames between the two of a pair."""
        return PAIR_FRAMES // self.frame_step


def is_counted(box_xyxy: np.ndarray, visible_share: float) -> bool:
    """Whether the judge is asked for a car."""
    return bool(box_xyxy[3] - box_xyxy[1] >= _LEAST_HEIGHT and visible_share >= _LEAST_SHARE)


class PairNetwork(nn.Module):
    """Two pictures to (right m, forward m, 10 yaw rad): features of both, how they correlate near by, a regression."""

    def __init__(self, width: int, height: int, *, channels: int = 32) -> None:
        super().__init__()
        self.features = nn.Sequential(
            conv_unit(3, 16, stride=2), conv_unit(16, channels, stride=2), conv_unit(channels, channels)
        )
        shifts = (2 * _REACH[0] + 1) * (2 * _REACH[1] + 1)
        self.reading = nn.Sequential(
            conv_unit(shifts + channels, 48), conv_unit(48, 48, stride=2), conv_unit(48, 48, stride=2), nn.Flatten()
        )
        cells = -(-width // 16) * -(-height // 16)
        self.head = nn.Sequential(nn.Linear(48 * cells, 64), nn.ReLU(), nn.Linear(64, 3))

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        """(N, 2, 3, H, W) RGB 0 to 255 to (N, 3)."""
        first, second = (self.features(pictures[:, place] / 64.0 - 2.0) for place in (0, 1))
        padded = functional.pad(second, (_REACH[1], _REACH[1], _REACH[0], _REACH[0]))
        height, width = first.shape[2:]
        alike = [
            (first * padded[:, :, y : y + height, x : x + width]).mean(dim=1)
            for y in range(2 * _REACH[0] + 1)
            for x in range(2 * _REACH[1] + 1)
        ]
        return self.head(self.reading(torch.cat([torch.stack(alike, dim=1), first], dim=1)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reading:
    """What the judge sees in one video, at the judged frames."""

    boxes: tuple[np.ndarray, ...]
    """(n, 4) per frame, pixels of twice the picture."""
    cam_to_world: np.ndarray
    """(P, 4, 4): in the ground plane, at every ``PAIR_FRAMES``-th native frame."""


class Judge:
    """Both networks, trained."""

    def __init__(self, detector: StreetDetector, pair: PairNetwork, *, width: int, height: int) -> None:
        self.detector, self.pair = detector.eval(), pair.eval()
        self.graph = DetectorGraph(self.detector).eval()
        card = load_cards()["street_detector"]
        assert isinstance(card, YoloxCard)
        self.card = card.model_copy(
            update={
                "input_width": 2 * width, "input_height": 2 * height, "classes": ("car",), "categories": {"car": "car"},
                "score_thresholds": {}, "score_threshold": 0.3, "soft_nms": SoftSuppression(sigma=0.4, part_cost=0.4),
            }
        )  # fmt: skip

    @torch.no_grad()
    def read(self, frames: np.ndarray, *, pair_step: int) -> Reading:
        """Cars of each frame and the camera's way.

        Args:
            frames: (n, H, W, 3) uint8, the judged frames only.
            pair_step: judged frames from one pose to the next.
        """
        rows = self.graph(_network_pictures(frames)).float().numpy()
        size = {"width": self.card.input_width, "height": self.card.input_height}
        boxes = tuple(decode_yolox(row, self.card, ratio=1.0, **size).boxes_xyxy for row in rows)
        chosen = frames[::pair_step]
        pairs = torch.from_numpy(np.stack([chosen[:-1], chosen[1:]], axis=1)).permute(0, 1, 4, 2, 3).float()
        return Reading(boxes=boxes, cam_to_world=chained(self.pair(pairs).float().numpy()))

    def save(self, path: Path) -> None:
        """Both networks' weights."""
        tensors = {f"detector.{name}": value for name, value in self.detector.state_dict().items()}
        tensors |= {f"pair.{name}": value for name, value in self.pair.state_dict().items()}
        save_file({name: value.contiguous() for name, value in tensors.items()}, str(path))


def new_networks(width: int, height: int, *, seed: int) -> tuple[StreetDetector, PairNetwork]:
    """Untrained."""
    shape = {"widths": (24, 32, 48, 64), "depths": (1, 1, 1), "width": 32, "towers": (True, True, True)}
    detector = seeded(lambda: StreetDetector(1, **shape), seed=seed)
    return detector, seeded(lambda: PairNetwork(width, height), seed=seed)


def load_judge(path: Path, *, width: int, height: int) -> Judge:
    """A judge that was saved."""
    detector, pair = new_networks(width, height, seed=0)
    tensors = load_file(str(path))
    for name, network in (("detector.", detector), ("pair.", pair)):
        network.load_state_dict({k.removeprefix(name): v for k, v in tensors.items() if k.startswith(name)})
    return Judge(detector, pair, width=width, height=height)


def train_judge(clips: Sequence[JudgeClip], *, detector_steps: int, pair_steps: int, seed: int = 0) -> Judge:
    """A judge taught on clips of one size."""
    height, width = clips[0].videos[0].shape[1:3]
    detector, pair = new_networks(width, height, seed=seed)
    cells, strides = (torch.from_numpy(array) for array in grid_cells(2 * width, 2 * height))
    fit_detector = FitSettings(seed=seed, steps=detector_steps, learning_rate=3e-3, average_decay=0.98, name="detector")
    fitted = fit(
        detector, lambda rng: detector_batch(clips, rng),
        lambda network, batch: detector_loss(
            network(batch[0]).float(), batch[1], batch[2], batch[3], cells, strides
        ),
        fit_detector,
    )  # fmt: skip
    fit_pair = FitSettings(
        seed=seed, steps=pair_steps, learning_rate=2e-3, average_decay=0.98, channels_last=False, name="pair"
    )
    read = fit(
        pair, lambda rng: pair_batch(clips, rng),
        lambda network, batch: functional.smooth_l1_loss(network(batch[0]).float(), batch[1], beta=0.3), fit_pair,
    )  # fmt: skip
    assert isinstance(fitted, StreetDetector)
    assert isinstance(read, PairNetwork)
    return Judge(fitted, read, width=width, height=height)


def detector_batch(
    clips: Sequence[JudgeClip], rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Pictures (N, 3, 2H, 2W), classes (N, A), boxes (N, A, 4) and weights (N, A); half of them mirrored."""
    pictures, classes, boxes, weights = [], [], [], []
    for _ in range(_BATCH):
        clip = clips[int(rng.integers(len(clips)))]
        video = clip.videos[int(rng.integers(len(clip.videos)))]
        index = int(rng.integers(len(video)))
        picture, truth = video[index], clip.boxes[index].astype(np.float32)
        height, width = 2 * picture.shape[0], 2 * picture.shape[1]
        if rng.random() < 0.5:
            picture = picture[:, ::-1]
            truth = np.stack([width - 1 - truth[:, 2], truth[:, 1], width - 1 - truth[:, 0], truth[:, 3]], axis=1)
        inside = np.clip(truth, 0, np.array([width, height, width, height], np.float32))
        goal = encode_boxes(
            inside,
            np.zeros(len(truth), np.int64),
            clip.counted[index],
            width=width,
            height=height,
            radius=_RADIUS,
            soften=False,
        )
        pictures.append(np.clip(picture * rng.uniform(0.85, 1.15) + rng.uniform(-12, 12), 0, 255).astype(np.uint8))
        # There is one class alone: what an uncounted object is need not be said.
        classes.append(np.maximum(goal.classes, -1))
        boxes.append(goal.boxes_xyxy)
        weights.append(goal.weights)
    classes_at, boxes_at, weights_at = (torch.from_numpy(np.stack(part)) for part in (classes, boxes, weights))
    return _network_pictures(np.stack(pictures)), classes_at, boxes_at, weights_at


def pair_batch(clips: Sequence[JudgeClip], rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Pairs (N, 2, 3, H, W) and their motions (N, 3); some mirrored, some backwards."""
    pairs, motions = [], []
    for _ in range(_PAIR_BATCH):
        clip = clips[int(rng.integers(len(clips)))]
        video = clip.videos[int(rng.integers(len(clip.videos)))]
        start = int(rng.integers(len(video) - clip.pair_gap))
        places = [start, start + clip.pair_gap] if rng.random() < 0.7 else [start + clip.pair_gap, start]
        motion = motion_of(invert(clip.cam_to_world[places[0]]) @ clip.cam_to_world[places[1]])
        pair = video[places]
        if rng.random() < 0.5:
            pair, motion = pair[:, :, ::-1], motion * np.array([-1, 1, -1])
        pairs.append(np.clip(pair * rng.uniform(0.85, 1.15) + rng.uniform(-12, 12), 0, 255))
        motions.append(motion)
    pictures = torch.from_numpy(np.stack(pairs).astype(np.float32)).permute(0, 1, 4, 2, 3)
    return pictures, torch.from_numpy(np.stack(motions).astype(np.float32))


def motion_of(relative: np.ndarray) -> np.ndarray:
    """(3,) right m, forward m, 10 yaw rad of a relative camera motion (4, 4)."""
    yaw = np.arctan2(relative[0, 2], relative[2, 2])
    return np.array([relative[0, 3], relative[2, 3], _YAW_SCALE * yaw])


def chained(motions: np.ndarray) -> np.ndarray:
    """(P + 1, 4, 4) cam_to_world in the ground plane from P motions (P, 3), the first one the identity."""
    poses = [np.eye(4)]
    for right, forward, turn in np.asarray(motions, np.float64):
        yaw = turn / _YAW_SCALE
        rotation = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
        poses.append(poses[-1] @ rigid(rotation, np.array([right, 0.0, forward])))
    return np.stack(poses)


def _network_pictures(frames: np.ndarray) -> torch.Tensor:
    """(N, H, W, 3) uint8 RGB to (N, 3, 2H, 2W) float32 BGR, 0 to 255."""
    size = (2 * frames.shape[2], 2 * frames.shape[1])
    large = np.stack([cv2.resize(np.ascontiguousarray(one), size, interpolation=cv2.INTER_LINEAR) for one in frames])
    return torch.from_numpy(np.ascontiguousarray(large[..., ::-1].transpose(0, 3, 1, 2)).astype(np.float32))
