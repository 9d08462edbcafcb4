"""The object control: at most five random tracks of a clip as filled boxes on black.

The paper's object conditioning shows where a few chosen objects go and nothing of what they are. Which tracks, and in
which colours, follows from the clip's key and a variant number alone, so each variant is another view of the labels.
"""

import hashlib
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

from labeling.errors import ConfigError
from labeling.labels import UNTRACKED, Keypoints
from labeling.skeleton_video import LABEL_HEIGHT, LABEL_WIDTH

MOST_TRACKS = 5
BOX_COLOURS = ((255, 64, 64), (64, 200, 64), (72, 120, 255), (255, 208, 48), (224, 72, 224))
"""RGB, one per chosen track, far apart in hue."""

_CATEGORIES = ("car", "person")


class FrameSpan(Protocol):
    """Half-open frames ``[start, end)`` on the video's grid."""

    @property
    def start(self) -> int:
        """First frame."""
        ...

    @property
    def end(self) -> int:
        """One past the last frame."""
        ...


def chosen_tracks(labels: Sequence[Keypoints], *, key: str, variant: int = 0, most: int = MOST_TRACKS) -> list[int]:
    """Up to ``most`` track ids of cars and people, drawn without replacement by ``(key, variant)``.

    Ranks by a hash of (key, variant, track), so that a track added to the labels never reshuffles the others.
    """
    return sorted(tracks_of(labels), key=lambda track: (_rank(key, variant, track), track))[:most]


def tracks_of(labels: Sequence[Keypoints]) -> set[int]:
    """Ids of the cars and people that there are to choose from."""
    return {one.track_id for one in labels if one.category in _CATEGORIES and one.track_id != UNTRACKED}


def object_frames(
    labels: Sequence[Keypoints], *, clip: FrameSpan, key: str, variant: int = 0, width: int = 768, height: int = 512,
    label_width: int = LABEL_WIDTH, label_height: int = LABEL_HEIGHT,
) -> Iterator[np.ndarray]:  # fmt: skip
    """The object video of a clip, frame by frame.

    Args:
        labels: any labels whose frames are on the same grid as ``clip``; those outside it are ignored.
        clip: the clip's frames.
        key: the clip's key, which seeds the choice with ``variant``.
        variant: number of the view.
        width: of the picture, pixels.
        height: of the picture, pixels.
        label_width: width of the picture that the labels are in.
        label_height: height of that picture.

    Yields:
        (height, width, 3) uint8, RGB; ``clip.end - clip.start`` frames, near boxes over far ones.

    Raises:
        ConfigError: a size is not positive, or ``clip`` is empty.
    """
    if min(width, height, label_width, label_height) <= 0 or clip.end <= clip.start:
        raise ConfigError(
            f"cannot draw frames [{clip.start}, {clip.end}) at {width}x{height}; give a positive size and span"
        )
    inside = [one for one in labels if clip.start <= one.frame < clip.end]
    colours = dict(zip(chosen_tracks(inside, key=key, variant=variant), BOX_COLOURS, strict=False))
    per_frame: dict[int, list[Keypoints]] = {}
    for one in inside:
        if one.track_id in colours and one.category in _CATEGORIES:
            per_frame.setdefault(one.frame, []).append(one)
    scale = np.array([width / label_width, height / label_height] * 2)
    return (_draw(per_frame.get(frame, []), colours, scale, width, height) for frame in range(clip.start, clip.end))


def _draw(
    labels: list[Keypoints], colours: dict[int, tuple[int, int, int]], scale: np.ndarray, width: int, height: int
) -> np.ndarray:
    picture = np.zeros((height, width, 3), np.uint8)
    for one in sorted(labels, key=lambda one: (float(one.box_xyxy[3]), one.track_id)):
        # Pixel centres lie on integers, so a picture scales about -0.5.
        left, top, right, bottom = np.rint((one.box_xyxy.astype(np.float64) + 0.5) * scale - 0.5).astype(np.int64)
        picture[max(top, 0) : max(bottom + 1, 0), max(left, 0) : max(right + 1, 0)] = colours[one.track_id]
    return picture


def _rank(key: str, variant: int, track: int) -> bytes:
    return hashlib.sha256(f"{key}/{variant}/{track}".encode()).digest()
