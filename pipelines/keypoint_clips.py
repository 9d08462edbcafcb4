"""Street clips with exact truth for the charts and stability tables of keypoints, detection and tracks.

Rendering costs more than labelling: each clip is rendered once in a process and kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dataset.street import Scenario, Street, StreetConfig
from dataset.street_labels import StreetObject
from labeling.camera import Intrinsics, Trajectory
from labeling.extractors import Extractors, choose_extractors
from labeling.labels import Keypoints
from labeling.skeleton_video import LABEL_HEIGHT, LABEL_WIDTH

WIDTH, HEIGHT = LABEL_WIDTH, LABEL_HEIGHT
HELD_OUT_SEED = 97_000
"""Streets from here on are used neither for training nor for thresholds nor for the cards' figures."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeypointClip:
    """Consecutive frames of one street, numbered from 0, with the truth of each."""

    name: str
    frames: tuple[np.ndarray, ...]
    """(H, W, 3) uint8 RGB each; not to be written to."""
    truth: tuple[tuple[StreetObject, ...], ...]
    """Everything with a visible pixel, frame by frame."""
    labels: tuple[tuple[Keypoints, ...], ...]
    """The same as label records: score 1 where a point is visible, 0 (absent) where it is hidden."""
    intrinsics: Intrinsics
    trajectory: Trajectory

    def __len__(self) -> int:
        return len(self.frames)


@lru_cache(maxsize=16)
def street_frames(
    scenario: Scenario, seed: int, frames: int, *, width: int = WIDTH, height: int = HEIGHT, start: int = 0
) -> KeypointClip:
    """A rendered stretch of a street, kept in memory (2.2 MB a frame at full size).

    Args:
        scenario: what happens.
        seed: of the street; from ``HELD_OUT_SEED`` on nothing was learnt from it.
        frames: how many.
        width: pixels.
        height: pixels.
        start: the street's frame to begin with.

    Raises:
        ConfigError: as ``StreetConfig``.
    """
    street = Street(StreetConfig(seed=seed, scenario=scenario, frames=start + frames, width=width, height=height))
    rendered = [street.render(index) for index in range(start, start + frames)]
    for frame in rendered:
        frame.rgb.flags.writeable = False
    return KeypointClip(
        name=scenario, frames=tuple(frame.rgb for frame in rendered), truth=tuple(frame.objects for frame in rendered),
        labels=tuple(tuple(street.keypoints(frame)) for frame in rendered),
        intrinsics=street.intrinsics, trajectory=street.trajectory.slice(start, start + frames),
    )  # fmt: skip


@lru_cache(maxsize=4)
def street_extractors(*, names: tuple[str, ...] = ("street",), threads: int = 1) -> Extractors:
    """The shipped street models, opened once in a process as the pipeline opens them.

    Raises:
        ModelError: weights that are absent or break their card's contract.
    """
    return Extractors(choose_extractors(names), threads=threads)


def pooled_names(clips: Sequence[KeypointClip]) -> str:
    """Scenarios and lengths of several clips, for a chart's heading."""
    return ", ".join(f"{clip.name} {len(clip)}" for clip in clips)
