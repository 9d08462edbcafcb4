"""Clips made harder, their truth unchanged: noise, weather, things in the way, boards that move by themselves."""

from dataclasses import replace

import numpy as np

from dataset.conditions import Condition, apply_condition
from labeling.ego_tracks import matched, track_run
from pipelines.ego_methods import EgoClip

_ROWS, _COLUMNS = 8, 12


def noisy(clip: EgoClip, sigma: float) -> EgoClip:
    """Independent noise of this many grey levels on every pixel."""
    rng = np.random.default_rng(round(sigma * 10))
    frames = [np.clip(frame + rng.normal(0, sigma, frame.shape), 0, 255).astype(np.uint8) for frame in clip.frames]
    return replace(clip, frames=frames)


def in_condition(clip: EgoClip, condition: Condition) -> EgoClip:
    """Every frame in this condition."""
    frames = [apply_condition(frame, condition, seed=5, frame=index) for index, frame in enumerate(clip.frames)]
    return replace(clip, frames=frames)


def with_movers(clip: EgoClip, share: float) -> EgoClip:
    """Textured boards that cross the picture at 2 to 5 pixels a frame, and carry a share of the tracked corners."""
    busy = clip
    for count in range(2, _ROWS * _COLUMNS, 2):
        some = _with_boards(replace(clip, frames=clip.frames[:12], times_s=clip.times_s[:12]), count)
        if _share_on_boards(some, count) >= share:
            busy = _with_boards(clip, count)
            break
    return busy


def _board_columns(clip: EgoClip, count: int, index: int) -> np.ndarray:
    """(H, W) int: the texture's column that a board shows in a pixel of a frame; -1 where there is no board."""
    height, width = clip.frames[0].shape[:2]
    rng = np.random.default_rng(11)
    tall, wide = height // _ROWS, width // _COLUMNS
    boards = rng.permutation(_ROWS * _COLUMNS)[:count]
    speeds = rng.uniform(2, 5, _ROWS) * rng.choice([-1, 1], _ROWS)
    column_of = np.full((height, width), -1)
    for board in boards:
        row, column = divmod(int(board), _COLUMNS)
        own = np.arange(column * wide, (column + 1) * wide)
        # A row's boards go round: what leaves on one side comes in on the other.
        at = (own + round(float(speeds[row] * index))) % (_COLUMNS * wide)
        column_of[row * tall : (row + 1) * tall, at] = own
    return column_of


def _with_boards(clip: EgoClip, count: int) -> EgoClip:
    height, width = clip.frames[0].shape[:2]
    coarse = np.random.default_rng(12).integers(0, 256, (height // 4 + 1, width // 4 + 1, 3), dtype=np.uint8)
    texture = coarse.repeat(4, axis=0).repeat(4, axis=1)
    frames = []
    for index, frame in enumerate(clip.frames):
        column_of = _board_columns(clip, count, index)
        rows, columns = np.nonzero(column_of >= 0)
        busy = frame.copy()
        busy[rows, columns] = texture[rows, column_of[rows, columns]]
        frames.append(busy)
    return replace(clip, frames=frames)


def _share_on_boards(clip: EgoClip, count: int) -> float:
    """Share of the corners carried into the last frame that lie on boards."""
    before, after = track_run(clip.frames, clip.times_s).frames[-2:]
    at = after.points_px[matched(before, after)[1]].round().astype(int)
    return float((_board_columns(clip, count, len(clip.frames) - 1)[at[:, 1], at[:, 0]] >= 0).mean())
