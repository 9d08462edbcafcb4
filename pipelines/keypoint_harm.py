"""What is done to street clips before they are labelled: picture conditions, boards before cars, cuts, a freeze."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from dataset.conditions import Condition, apply_condition, compress_frames
from dataset.street_labels import StreetObject
from labeling.extraction import Effort, label_frames
from labeling.extractors import Extractors
from labeling.hard_cuts import find_hard_cuts, thumbnail
from labeling.labels import Keypoints
from labeling.model_cards import SimccCard, YoloxCard, load_cards
from pipelines.keypoint_clips import KeypointClip, street_extractors

_BOARD_RGB = (122.0, 112.0, 100.0)
_MARGIN_PX = 4.0
_TARGET_PX, _TARGET_SHARE = 48.0, 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """A board that covers part of one object in every frame."""

    track_id: int
    share: float
    """Of the width of the object's box."""
    from_left: bool


def body_extractors() -> Extractors:
    """The street's detector with its heads for cars and people: lanes cost time and are judged elsewhere."""
    cards = load_cards().values()
    names = [card.name for card in cards if isinstance(card, YoloxCard | SimccCard) and card.name.startswith("street_")]
    return street_extractors(names=tuple(names))


def label_clip(
    frames: Iterable[np.ndarray], *, effort: Effort, breaks: frozenset[int] = frozenset(),
    repeats: frozenset[int] = frozenset(),
) -> list[Keypoints]:  # fmt: skip
    """Labels of consecutive frames, numbered from 0, as a job makes them."""
    return label_frames(
        frames, first_frame=0, extractors=body_extractors(), effort=effort, breaks=breaks, repeats=repeats
    )


def in_condition(clip: KeypointClip, condition: Condition, *, seed: int, amount: float | None = None) -> KeypointClip:
    """The clip in a picture condition; H.264 is coded as one stream."""
    if condition == "h264":
        frames = tuple(compress_frames(iter(clip.frames), crf=round(amount or 40)))
    else:
        frames = tuple(
            apply_condition(frame, condition, seed=seed, frame=number, amount=amount)
            for number, frame in enumerate(clip.frames)
        )
    return replace(clip, frames=frames)


def board_targets(clip: KeypointClip, *, most: int) -> list[int]:
    """Tracks of the cars that fill most of the clip's pictures while they are at least 48 px high and in full view."""
    height, width = clip.frames[0].shape[:2]
    areas: dict[int, float] = {}
    for things in clip.truth:
        for thing in things:
            if thing.category == "car" and is_target(thing, width=width, height=height):
                size = thing.box_xyxy[2:] - thing.box_xyxy[:2]
                areas[thing.track_id] = areas.get(thing.track_id, 0.0) + float(size.prod())
    return sorted(sorted(areas), key=lambda track: -areas[track])[:most]


def is_target(thing: StreetObject, *, width: int, height: int) -> bool:
    """Whether a board can hide a known share of it: high enough, and nothing hides it yet."""
    left, top, right, bottom = thing.box_xyxy
    inside = min(left, top) > _MARGIN_PX and right < width - _MARGIN_PX and bottom < height - _MARGIN_PX
    return bool(inside and bottom - top >= _TARGET_PX and thing.visible_share >= _TARGET_SHARE)


def behind_board(clip: KeypointClip, board: Board) -> KeypointClip:
    """The clip with the board in its pictures, and its truth told of it.

    Only the covered object's own truth is true afterwards: judge no other. Its visible share is left as it was, so that
    it stays judged.
    """
    frames, truth = [], []
    height, width = clip.frames[0].shape[:2]
    for picture, things in zip(clip.frames, clip.truth, strict=True):
        mine = next((thing for thing in things if thing.track_id == board.track_id), None)
        if mine is None or mine.category == "lane" or not is_target(mine, width=width, height=height):
            frames.append(picture)
            truth.append(tuple(thing for thing in things if thing is not mine))
            continue
        cover, rest = _split(mine.box_xyxy, board)
        x = mine.points_xy[:, 0]
        hidden = (x >= cover[0]) & (x <= cover[2])
        covered = replace(mine, visible=mine.visible & ~hidden, box_xyxy=rest)
        frames.append(_with_board(picture, cover, seed=board.track_id))
        truth.append(tuple(covered if thing is mine else thing for thing in things))
    return replace(clip, frames=tuple(frames), truth=tuple(truth))


def spliced(first: KeypointClip, second: KeypointClip, *, at: int) -> tuple[KeypointClip, frozenset[int]]:
    """``at`` frames of one clip, then the rest of the other; and the cuts that the cutting stage would find."""
    frames = (*first.frames[:at], *second.frames[at:])
    clip = replace(
        first,
        frames=frames,
        truth=(*first.truth[:at], *second.truth[at:]),
        labels=(*first.labels[:at], *second.labels[at:]),
    )
    grey = np.stack([thumbnail(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)) for frame in frames])
    return clip, frozenset(np.flatnonzero(find_hard_cuts(grey)).tolist())


def frozen(clip: KeypointClip, *, at: int, frames: int) -> KeypointClip:
    """The clip with frame ``at`` shown ``frames`` times more, truth and all."""
    order = [*range(at + 1), *[at] * frames, *range(at + 1, len(clip))]
    return replace(
        clip, frames=tuple(clip.frames[i] for i in order), truth=tuple(clip.truth[i] for i in order),
        labels=tuple(clip.labels[i] for i in order),
    )  # fmt: skip


def _split(box_xyxy: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray]:
    """The board's place, and the box of what it leaves."""
    left, top, right, bottom = (float(value) for value in box_xyxy)
    edge = left + board.share * (right - left) if board.from_left else right - board.share * (right - left)
    margin = 0.15 * (bottom - top)
    sides = (left - margin, edge, edge, right) if board.from_left else (edge, right + margin, left, edge)
    cover = np.array([sides[0], top - margin, sides[1], bottom + margin])
    return cover, np.array([sides[2], top, sides[3], bottom], np.float32)


def _with_board(picture: np.ndarray, cover: np.ndarray, *, seed: int) -> np.ndarray:
    """The picture with a weathered board, darker towards its edges."""
    height, width = picture.shape[:2]
    left, top, right, bottom = np.clip(np.rint(cover).astype(int), 0, (width, height, width, height)).tolist()
    if right <= left or bottom <= top:
        return picture
    coarse = np.random.default_rng([seed, 17]).normal(0, 9, (12, 8)).astype(np.float32)
    shade = cv2.resize(coarse, (right - left, bottom - top), interpolation=cv2.INTER_CUBIC)
    shade[:, :2] -= 40
    shade[:, -2:] -= 40
    shade[:2] -= 40
    out = picture.copy()
    out[top:bottom, left:right] = np.clip(np.array(_BOARD_RGB) + shade[..., None], 0, 255)
    return out
