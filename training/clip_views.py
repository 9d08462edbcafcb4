"""A clip's videos as the backbone sees them: drawn afresh from labels wherever there are labels.

A decoded 4:2:0 video has lost the skeletons' colours, so only RGB, and controls that have no labels, are decoded.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np

from labeling.camera import Intrinsics, Trajectory, rebased_trajectory
from labeling.errors import ConfigError, DataError
from labeling.labels import Keypoints
from labeling.object_video import object_frames
from labeling.skeleton_video import draw_skeletons, lit_cells
from labeling.timeline import Span
from training.backbone import LatentGeometry
from training.config import PictureConfig
from training.sampling_inputs import ego_clip
from training.stages import RGB
from training.targeted_noise import latent_mask


class ClipSample(Protocol):
    """What is read of ``dataset.loader.Sample``."""

    key: str

    @property
    def caption(self) -> str: ...
    @property
    def meta(self) -> dict[str, Any]: ...
    @property
    def cam_to_world(self) -> np.ndarray: ...
    def keypoints(self) -> list[Keypoints]: ...
    def frames(self, suffix: str) -> np.ndarray: ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClipViews:
    """One clip's labels on the frames that the backbone sees."""

    sample: ClipSample
    picture: PictureConfig
    indices: np.ndarray
    """(T,) frames of the clip."""
    label_width: int
    label_height: int
    intrinsics: Intrinsics | None = None
    """The camera's; without them the ego video takes the prior's."""

    def per_frame(self) -> list[list[Keypoints]]:
        """The labels of each frame that is kept."""
        by_frame: dict[int, list[Keypoints]] = {}
        for one in self.sample.keypoints():
            by_frame.setdefault(one.frame, []).append(one)
        return [by_frame.get(int(index), []) for index in self.indices]

    def rgb(self) -> np.ndarray:
        """(T, H, W, 3) at the RGB size."""
        return resized(self._decoded(RGB), self.picture.rgb_width, self.picture.rgb_height)

    def image(self, rgb: np.ndarray) -> np.ndarray:
        """(1, H, W, 3): the first RGB frame at the controls' size."""
        return resized(rgb[:1], self.picture.control_width, self.picture.control_height)

    def skeleton(self) -> np.ndarray:
        """(T, H, W, 3), drawn afresh."""
        size = self._sizes()
        return np.stack([draw_skeletons(labels, **size) for labels in self.per_frame()])

    def skeleton_cells(self, geometry: LatentGeometry) -> np.ndarray:
        """(F, H, W) bool: latent cells that hold skeleton."""
        return latent_mask(lit_cells(self.per_frame(), cell=geometry.spatial, **self._sizes()), geometry=geometry)

    def ego(self) -> np.ndarray:
        """(T, H, W, 3), rendered afresh."""
        trajectory = clip_trajectory(self.sample.cam_to_world[self.indices], fps=self.picture.fps)
        return ego_clip(trajectory, picture=self.picture, intrinsics=self.intrinsics)

    def objects(self, variant: int) -> np.ndarray:
        """(T, H, W, 3), drawn afresh."""
        span = Span(start=0, end=int(self.indices[-1]) + 1)
        frames = list(
            object_frames(self.sample.keypoints(), clip=span, key=self.sample.key, variant=variant, **self._sizes())
        )
        return np.stack([frames[index] for index in self.indices])

    def control(self, name: str) -> np.ndarray:
        """(T, H, W, 3): any other control video of the shards, decoded."""
        return resized(self._decoded(name), self.picture.control_width, self.picture.control_height, nearest=True)

    def _decoded(self, name: str) -> np.ndarray:
        frames = self.sample.frames(f"{name}.mp4")
        if len(frames) <= self.indices[-1]:
            raise DataError(f"{self.sample.key}.{name}.mp4 has {len(frames)} frames, {self.indices[-1] + 1} are needed")
        return frames[self.indices]

    def _sizes(self) -> dict[str, Any]:
        return {
            "width": self.picture.control_width, "height": self.picture.control_height,
            "label_width": self.label_width, "label_height": self.label_height,
        }  # fmt: skip


def clip_trajectory(cam_to_world: np.ndarray, *, fps: float) -> Trajectory:
    """Poses at a constant frame rate, re-based to the first."""
    return rebased_trajectory(np.arange(len(cam_to_world)) / fps, cam_to_world)


def frame_indices(clip_frames: int, picture: PictureConfig) -> np.ndarray:
    """(T,) frames of a clip that the backbone sees.

    Raises:
        ConfigError: the clip is too short.
    """
    available = -(-clip_frames // picture.frame_step)
    frames = picture.frames or available
    if frames > available:
        raise ConfigError(
            f"a clip of {clip_frames} frames gives {available} at every {picture.frame_step}., but picture.frames asks "
            f"for {frames}; set it lower or cut longer clips"
        )
    return np.arange(frames) * picture.frame_step


def resized(frames: np.ndarray, width: int, height: int, *, nearest: bool = False) -> np.ndarray:
    """(T, height, width, 3) uint8 from (T, H, W, 3): by area, or by the nearest pixel where colours must stay exact."""
    if frames.shape[1:3] == (height, width):
        return frames
    method = cv2.INTER_NEAREST if nearest else cv2.INTER_AREA
    return np.stack([cv2.resize(frame, (width, height), interpolation=method) for frame in frames])
