"""The study's street clips: small pictures, few frames, exact truth; each is drawn when it is first asked for."""

from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from dataset.street import Scenario, Street, StreetConfig, StreetFrame
from dataset.street_labels import StreetObject
from dataset.street_segments import SEGMENTS
from labeling.errors import DataError
from labeling.labels import Keypoints
from training.study_plan import StudyScale

_TRAIN_SEED, _VAL_SEED = 61_000, 98_000
_SCENARIOS: tuple[Scenario, ...] = ("drive", "traffic", "stop_and_go", "cross_traffic", "parked")
_FOCAL_PER_WIDTH = 1.5
"""A long lens: few pixels show few cars, but those are large enough to be judged."""
_PALETTE = np.array([(120, 180, 255), (110, 110, 110), (60, 160, 60), (255, 60, 60), (255, 220, 0)], np.uint8)
"""Colour of each of ``SEGMENTS``."""
_BOX_COLOURS = {"car": (255, 60, 60), "person": (255, 220, 0)}
_CAPTION = "A drive through a town."


@dataclass(frozen=True, slots=True, kw_only=True)
class ClipPlan:
    """Which stretch of which street."""

    scenario: Scenario
    seed: int
    start: int

    @property
    def key(self) -> str:
        """The clip's key; all of one street begin alike."""
        return f"{self.scenario}-{self.seed}_{self.start}"


def plan_clips(count: int, *, split: str, per_street: int = 1) -> list[ClipPlan]:
    """``count`` clips, ``per_street`` of each street, scenarios in turn; the splits share no street."""
    first = _VAL_SEED if split == "val" else _TRAIN_SEED
    plans = []
    for number in range(count):
        street, turn = divmod(number, per_street)
        scenario = _SCENARIOS[street % len(_SCENARIOS)]
        plans.append(ClipPlan(scenario=scenario, seed=first + street, start=6 + 30 * turn))
    return plans


@dataclass(eq=False)
class StudyClip:
    """One clip, with the interface of ``dataset.loader.Sample`` that caching reads."""

    plan: ClipPlan
    scale: StudyScale
    caption: str = field(default=_CAPTION, init=False)

    @property
    def key(self) -> str:
        """The clip's key."""
        return self.plan.key

    @property
    def video_id(self) -> str:
        """The street: clips of one are alike."""
        return self.key.rpartition("_")[0]

    @cached_property
    def street(self) -> Street:
        """The street and its camera."""
        width = self.scale.label_width
        config = StreetConfig(
            seed=self.plan.seed, width=width, height=self.scale.label_height, fps=self.scale.clip_fps,
            frames=self.plan.start + self.scale.frames, scenario=self.plan.scenario, focal_px=_FOCAL_PER_WIDTH * width,
        )  # fmt: skip
        return Street(config)

    @cached_property
    def rendered(self) -> tuple[StreetFrame, ...]:
        """The frames with their truth."""
        span = range(self.plan.start, self.plan.start + self.scale.frames)
        return tuple(self.street.render(index, segments=True) for index in span)

    @property
    def meta(self) -> dict[str, Any]:
        """Size of the labels' picture, and the camera."""
        camera = asdict(self.street.intrinsics)
        return {"width": self.scale.label_width, "height": self.scale.label_height, "intrinsics": camera}

    @property
    def cam_to_world(self) -> np.ndarray:
        """(T, 4, 4), the first one the identity."""
        return self.street.trajectory.slice(self.plan.start, self.plan.start + self.scale.frames).cam_to_world

    def keypoints(self) -> list[Keypoints]:
        """The truth as labels, frames numbered from 0."""
        labels = [self.street.keypoints(frame) for frame in self.rendered]
        return [_renumbered(label, number) for number, frame in enumerate(labels) for label in frame]

    def cars(self) -> list[list[StreetObject]]:
        """The cars of each frame."""
        return [[thing for thing in frame.objects if thing.category == "car"] for frame in self.rendered]

    def frames(self, suffix: str) -> np.ndarray:
        """(T, H, W, 3) uint8 of ``rgb.mp4``, ``segmentation.mp4`` or ``boxes.mp4``, at the labels' size.

        Raises:
            DataError: no such video.
        """
        makers = {
            "rgb.mp4": lambda frame: frame.rgb, "segmentation.mp4": segmentation_picture, "boxes.mp4": box_picture,
        }  # fmt: skip
        if suffix not in makers:
            raise DataError(f"a street clip has no {suffix}; it has {', '.join(makers)}")
        return np.stack([makers[suffix](frame) for frame in self.rendered])


def segmentation_picture(frame: StreetFrame) -> np.ndarray:
    """(H, W, 3) uint8: each class in its colour, lane lines in white as the skeletons have them."""
    import cv2

    assert len(_PALETTE) == len(SEGMENTS)
    picture = _PALETTE[frame.segments]
    for thing in frame.objects:
        if thing.category == "lane" and np.isfinite(thing.points_xy).all():
            line = np.rint(thing.points_xy).astype(np.int32)
            cv2.polylines(picture, [line], isClosed=False, color=(255, 255, 255), thickness=2)
    # What stands in front of a lane line hides it.
    return np.where((frame.segments == SEGMENTS.index("ground"))[..., None], picture, _PALETTE[frame.segments])


def box_picture(frame: StreetFrame) -> np.ndarray:
    """(H, W, 3) uint8: cars and people as filled boxes on black, the near over the far, a colour per class."""
    picture = np.zeros((*frame.rgb.shape[:2], 3), np.uint8)
    bodies = [thing for thing in frame.objects if thing.category in _BOX_COLOURS]
    for thing in sorted(bodies, key=lambda thing: float(thing.box_xyxy[3])):
        left, top, right, bottom = np.rint(thing.box_xyxy + 0.5).astype(int).tolist()
        picture[max(0, top) : bottom, max(0, left) : right] = _BOX_COLOURS[thing.category]
        picture[max(0, bottom - 2) : bottom, max(0, left) : right] = (255, 255, 255)
    return picture


def study_clips(scale: StudyScale) -> dict[str, list[StudyClip]]:
    """The clips by split; nothing is drawn yet."""
    plans = {
        "train": plan_clips(scale.train_clips, split="train", per_street=2),
        "val": plan_clips(scale.val_clips, split="val"),
    }  # fmt: skip
    return {split: [StudyClip(plan, scale) for plan in these] for split, these in plans.items()}


def _renumbered(label: Keypoints, frame: int) -> Keypoints:
    from dataclasses import replace

    return replace(label, frame=frame)
