"""What is shown between two looks: objects carried from the first, corrected by the second.

What the second look no longer sees is carried on for a while, and what it sees anew is carried back for as long: half a
gap each, on average where it truly went or came from.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from statistics import median

import numpy as np

from labeling.carrying import (
    FINE,
    UNSEEN_FRAMES,
    FlowWindow,
    along_path,
    box_diagonal,
    carry,
    close_gaps,
    interpolate_gaps,
)
from labeling.labels import Keypoints
from labeling.medians import masked_median

_BORDER_PX = 4.0
"""What is nearer to the picture's border is expected to leave it."""
_LEAST_INSIDE = 0.4
"""Share of a carried box that must lie in the picture for the object to be shown."""


@dataclass(slots=True, kw_only=True, eq=False)
class BetweenLooks:
    """The last look, and where its objects have been carried since."""

    flow_step: int
    """Moments between two steps of flow; 0 for none."""
    flow_window: FlowWindow = FINE
    """What it compares."""
    shown_frames: int
    """How long something is shown that the next look, or the one before, does not know."""
    clocks: Sequence[int]
    """Time of each moment up to now, frames of the grid; all others here are numbered by moments."""
    seen: list[Keypoints] = field(default_factory=list)
    """What the last look saw."""
    frame: int | None = None
    """When it looked."""
    _paths: dict[int, list[Keypoints]] = field(default_factory=dict)
    _trail: list[tuple[np.ndarray, int]] = field(default_factory=list)
    _followed: set[int] = field(default_factory=set)
    _held: dict[int, int] = field(default_factory=dict)
    _slippery: set[int] = field(default_factory=set)

    def start(self, seen: list[Keypoints], *, frame: int, grey: np.ndarray | None) -> None:
        """A look was taken; ``grey`` (``small_grey`` of its frame) where flow is to carry what it saw."""
        self.seen, self.frame = seen, frame
        self._paths = {label.track_id: [label] for label in seen}
        self._trail = [] if grey is None else [(grey, frame)]
        self._followed = set(self._paths)
        self._held = dict.fromkeys(self._paths, frame)

    def due(self, frame: int) -> bool:
        """Whether flow takes a step at ``frame``."""
        return bool(self._trail) and frame - self._trail[-1][1] >= self.flow_step

    def arriving(self, frame: int) -> bool:
        """Whether flow has a way to go to ``frame``, where the next look is taken; to the next frame it has none."""
        return bool(self._trail) and self._trail[-1][1] < frame and frame - self._trail[0][1] > 1

    def carry(self, grey: np.ndarray, *, frame: int) -> bool:
        """Carry all objects on; False when one inside the picture was lost for the first time."""
        labels = [path[-1] for path in self._paths.values()]
        carried = carry(self._trail[-1][0], grey, labels, frame=frame, window=self.flow_window)
        self._trail.append((grey, frame))
        for path, moved in zip(self._paths.values(), carried, strict=True):
            path.append(moved.label)
        lost = {
            moved.label.track_id for moved in carried
            if not moved.followed and not _at_border(moved.label.box_xyxy, self._size)
        }  # fmt: skip
        self._followed -= {moved.label.track_id for moved in carried if not moved.followed}
        self._held |= dict.fromkeys(self._followed, frame)
        # Flow that loses what the next look finds again has nothing to hold on to there: it asks for no second look.
        new = lost - self._slippery
        self._slippery |= lost
        return not new

    def carried(self, frame: int) -> dict[int, np.ndarray]:
        """(4,) boxes by track id, of objects that flow followed all the way to ``frame``."""
        latest = {track_id: path[-1] for track_id, path in self._paths.items() if track_id in self._followed}
        return {i: label.box_xyxy for i, label in latest.items() if len(self._paths[i]) > 1 and label.frame == frame}

    def close(self, seen: Sequence[Keypoints], *, frame: int) -> tuple[list[Keypoints], float]:
        """The labels between the last look and the one just taken.

        Args:
            seen: what the new look saw, tracked.
            frame: when.

        Returns:
            The labels of the frames between, and the median distance by which carried points missed the new look, in
            box diagonals; 0 where nothing was carried.
        """
        now = {label.track_id: label for label in seen}
        labels: list[Keypoints] = []
        arriving: dict[str, list[int]] = {}
        straight: dict[str, list[int]] = {}
        for label in self.seen:
            path, end = self._paths[label.track_id], now.get(label.track_id)
            if end is None:
                # Flow that lost it saw what now stands before it: there is nothing to show any more.
                last = min(frame - 1, self._held[label.track_id])
                labels += [
                    step for step in along_path(path)
                    if step.frame <= last and self._apart(label.frame, step.frame) <= self.shown
                ]  # fmt: skip
            elif len(path) > 1 and path[-1].frame == frame:
                arriving.setdefault(label.schema, []).append(label.track_id)
            else:
                straight.setdefault(label.schema, []).append(label.track_id)
        misses: list[float] = []
        for ids in arriving.values():
            paths, ends = [self._paths[i] for i in ids], [now[i] for i in ids]
            misses += _misses([path[-1] for path in paths], ends)
            labels += close_gaps(paths, ends)
        for ids in straight.values():
            labels += interpolate_gaps([self._paths[i][0] for i in ids], [now[i] for i in ids])
        known = {label.track_id for label in self.seen}
        labels += self._came_from([label for label in seen if label.track_id not in known], frame)
        return self._inside(labels), median(misses) if misses else 0.0

    def run_out(self, grey: np.ndarray, *, frame: int) -> list[Keypoints] | None:
        """The labels up to a run's last frame, or None where flow cannot take everything there: it must be looked at.

        Args:
            grey: ``small_grey`` of the last frame.
            frame: its number.
        """
        if not self._trail or (self._trail[-1][1] < frame and not self.carry(grey, frame=frame)):
            return None
        return self.close((), frame=frame + 1)[0]

    @property
    def shown(self) -> int:
        """Frames after the last look for which something is shown that no later one confirms."""
        return min(self.shown_frames, UNSEEN_FRAMES)

    @property
    def _size(self) -> tuple[int, int]:
        """Width and height of full frames."""
        height, width = self._trail[0][0].shape
        return 2 * width, 2 * height

    def _came_from(self, new: list[Keypoints], frame: int) -> list[Keypoints]:
        """New objects carried back towards the look that did not see them."""
        if not new or not self._trail or self._trail[-1][1] != frame:
            return []
        paths = [[label] for label in new]
        alive = list(paths)
        for (earlier, number), (later, _) in zip(self._trail[-2:0:-1], self._trail[:1:-1], strict=True):
            if self._apart(number, frame) > self.shown or not alive:
                break
            carried = carry(later, earlier, [path[0] for path in alive], frame=number, window=self.flow_window)
            for path, moved in zip(alive, carried, strict=True):
                if moved.followed:
                    path.insert(0, moved.label)
            alive = [path for path in alive if path[0].frame == number]
        return [label for path in paths for label in (path[0], *along_path(path)) if label.frame < frame]

    def _apart(self, earlier: int, later: int) -> int:
        """Frames of the grid from one moment to another."""
        return self.clocks[later] - self.clocks[earlier]

    def _inside(self, labels: list[Keypoints]) -> list[Keypoints]:
        """Without what flow took out of the picture."""
        if not self._trail:
            return labels
        width, height = self._size
        return cut_at_border(labels, width=width, height=height, least_inside=_LEAST_INSIDE)


def cut_at_border(
    labels: Sequence[Keypoints], *, width: int, height: int, least_inside: float = 0.0
) -> list[Keypoints]:
    """Labels with their boxes cut at the picture's border.

    Args:
        labels: of any frames.
        width: of the picture.
        height: of the picture.
        least_inside: share of a box that must lie in the picture for its label to be kept; what lies outside never is.
    """
    if not labels:
        return []
    boxes = np.stack([label.box_xyxy for label in labels])
    cut = np.clip(boxes, 0, np.array([width, height, width, height], boxes.dtype))
    areas, left = ((one[:, 2:] - one[:, :2]).clip(0).prod(axis=1) for one in (boxes, cut))
    same = (cut == boxes).all(axis=1)
    return [
        label if same[i] else replace(label, box_xyxy=cut[i])
        for i, label in enumerate(labels)
        if left[i] > 0 and left[i] >= least_inside * areas[i]
    ]


def _at_border(box_xyxy: np.ndarray, size: tuple[int, int]) -> bool:
    return bool((box_xyxy[:2] <= _BORDER_PX).any() or (box_xyxy[2:] >= np.subtract(size, _BORDER_PX)).any())


def _misses(carried: Sequence[Keypoints], seen: Sequence[Keypoints]) -> list[float]:
    """How far the points of carried objects of one schema are from where they are seen: medians, in box diagonals."""
    there, here = (np.array([label.points for label in labels]) for labels in (carried, seen))
    both = (there[..., 2] > 0) & (here[..., 2] > 0)
    medians = masked_median(np.linalg.norm(there[..., :2] - here[..., :2], axis=2), both)
    return (medians / [box_diagonal(label.box_xyxy) for label in seen]).tolist()
