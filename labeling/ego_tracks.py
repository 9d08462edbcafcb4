"""The picture half of ego-motion: corners spread over a grid and carried from frame to frame by Lucas-Kanade flow.

Everything here is in pixels and knows no camera; ``labeling.ego_motion`` solves the geometry from what is stored here,
so that a run can be solved again with another focal length without looking at its pictures twice.
"""

import zipfile
import zlib
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import numpy as np

from labeling.ego_corners import CornerTracker, FrameTracks, TrackSettings
from labeling.errors import DataError


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunTracks:
    """The corners of a run's frames, enough to solve its geometry without its pictures."""

    width: int
    """Working picture."""
    height: int
    source_width: int
    """The run's picture, whose pixels ``Intrinsics`` are given in."""
    source_height: int
    times_s: np.ndarray
    """(T,) float64, as given."""
    frames: tuple[FrameTracks, ...]

    def middle(self, count: int) -> "RunTracks":
        """The run's middle ``count`` frames, or all of it where it is shorter."""
        start = max(0, (len(self.frames) - count) // 2)
        return replace(self, times_s=self.times_s[start : start + count], frames=self.frames[start : start + count])

    def save(self, path: Path) -> None:
        """Write everything to one ``.npz`` file; the same tracks give the same bytes."""
        counts = [len(frame.ids) for frame in self.frames]
        np.savez_compressed(
            path,
            size=np.array([self.width, self.height, self.source_width, self.source_height]),
            times_s=self.times_s,
            counts=np.array(counts, dtype=np.int64),
            ids=_joined([frame.ids for frame in self.frames], np.zeros(0, np.int64)),
            points_px=_joined([frame.points_px for frame in self.frames], np.zeros((0, 2), np.float32)),
            forward_backward_px=_joined([frame.forward_backward_px for frame in self.frames], np.zeros(0, np.float32)),
            flags=np.array([(frame.cut, frame.repeated) for frame in self.frames], dtype=bool).reshape(-1, 2),
        )


def load_tracks(path: Path) -> RunTracks:
    """Read what ``RunTracks.save`` wrote.

    Raises:
        DataError: the file is not such a file.
    """
    try:
        with np.load(path, allow_pickle=False) as table:
            arrays = {name: table[name] for name in table.files}
        ends = np.cumsum(arrays["counts"])
        parts = {name: np.split(arrays[name], ends[:-1]) for name in ("ids", "points_px", "forward_backward_px")}
        frames = tuple(
            FrameTracks(
                ids=ids, points_px=points, forward_backward_px=back, cut=bool(cut), repeated=bool(repeated)
            )
            for ids, points, back, (cut, repeated) in zip(
                parts["ids"], parts["points_px"], parts["forward_backward_px"], arrays["flags"], strict=True
            )
        )  # fmt: skip
        width, height, source_width, source_height = (int(value) for value in arrays["size"])
    except (OSError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(f"{path}: not a file of corner tracks ({error}); track the run again") from error
    return RunTracks(
        width=width, height=height, source_width=source_width, source_height=source_height,
        times_s=arrays["times_s"], frames=frames,
    )  # fmt: skip


class StoredTracks(Sequence[RunTracks]):
    """A video's runs, read from their files one at a time: the corners of an hour do not fit into memory with ease."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """``paths`` are files that ``RunTracks.save`` wrote."""
        self._paths = list(paths)
        self._held: tuple[int, RunTracks] | None = None

    def __len__(self) -> int:
        return len(self._paths)

    @overload
    def __getitem__(self, index: int) -> RunTracks: ...

    @overload
    def __getitem__(self, index: slice) -> "StoredTracks": ...

    def __getitem__(self, index: int | slice) -> "RunTracks | StoredTracks":
        if isinstance(index, slice):
            return StoredTracks(self._paths[index])
        path = self._paths[index]
        if self._held is None or self._held[0] != index:
            self._held = (index, load_tracks(path))
        return self._held[1]


def matched(first: FrameTracks, second: FrameTracks) -> tuple[np.ndarray, np.ndarray]:
    """Indices into ``first`` and ``second`` of the corners that both frames see."""
    at = np.searchsorted(second.ids, first.ids)
    at_safe = np.minimum(at, max(len(second.ids) - 1, 0))
    same = second.ids[at_safe] == first.ids if len(second.ids) else np.zeros(len(first.ids), bool)
    return np.flatnonzero(same), at_safe[same]


def track_run(
    frames: Iterable[np.ndarray],
    times_s: np.ndarray,
    *,
    boxes: Sequence[np.ndarray] | None = None,
    breaks: Collection[int] = (),
    settings: TrackSettings | None = None,
) -> RunTracks:
    """Follow corners through a run.

    Args:
        frames: (H, W, 3) uint8 RGB or (H, W) uint8 grey pictures, all of one size.
        times_s: (T,) seconds, one for each frame, not decreasing; equal times are repeated frames.
        boxes: per frame (n, 4) xyxy in pixels of the frames: where cars and people are, and corners are not.
        breaks: frames (counted from the run's first) before which a cut or hole lies.
        settings: how to track.

    Raises:
        DataError: times, boxes and frames that do not agree, or times that decrease.
    """
    settings = settings or TrackSettings()
    times = np.asarray(times_s, dtype=np.float64)
    if times.ndim != 1 or not np.isfinite(times).all() or (np.diff(times) < 0).any():
        raise DataError("frame times must be finite seconds that do not decrease; sort the frames by time")
    if boxes is not None and len(boxes) != len(times):
        raise DataError(f"{len(boxes)} lists of boxes for {len(times)} times; give one, perhaps empty, for each frame")
    tracker: CornerTracker | None = None
    found: list[FrameTracks] = []
    source = (0, 0)
    for index, picture in enumerate(frames):
        if index >= len(times):
            raise DataError(f"more frames than the {len(times)} times; give a time for each frame")
        if tracker is None:
            source = (picture.shape[1], picture.shape[0])
            tracker = CornerTracker(source, settings)
        elif picture.shape[1::-1] != source:
            raise DataError(f"frame {index} is {picture.shape[1::-1]}, the first was {source}; give one size")
        here = np.zeros((0, 4)) if boxes is None else np.asarray(boxes[index], dtype=np.float64).reshape(-1, 4)
        same_time = index > 0 and times[index] == times[index - 1]
        found.append(tracker.step(picture, here, restart=index in breaks, repeated=same_time))
    if tracker is None or len(found) != len(times):
        raise DataError(f"{len(found)} frames for {len(times)} times; give at least one frame, and a time for each")
    return RunTracks(
        width=tracker.width, height=tracker.height, source_width=source[0], source_height=source[1],
        times_s=times, frames=tuple(found),
    )  # fmt: skip


def _joined(parts: list[np.ndarray], empty: np.ndarray) -> np.ndarray:
    return np.concatenate([empty, *parts])
