"""From a source's decoded frames to the constant-rate frames of a run, one at a time."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import av
import cv2
import numpy as np

from labeling.conversion import FrameConverter, luma
from labeling.encoding import VideoWriter
from labeling.errors import VideoError
from labeling.hard_cuts import find_hard_cuts, thumbnail
from labeling.moments import same_picture
from labeling.video import SAME_TIME_S, SourceFrame


class RunEncoder:
    """Shows each wanted source frame for as many grid frames as want it, and remembers what was lost."""

    def __init__(self, wanted_s: np.ndarray, *, writer: VideoWriter) -> None:
        """``wanted_s`` is (N,) float64, rising: the source time that each frame of the run shows."""
        self._wanted_s = wanted_s
        self._writer = writer
        self._next = 0
        self._shown: av.VideoFrame | None = None
        self._grey: np.ndarray | None = None
        self._is_new = True
        self._thumbnails: list[np.ndarray] = []
        self._thumbnail_of = np.zeros(len(wanted_s), dtype=np.int64)
        self._bidirectional: list[int] = []
        self.lost = np.zeros(len(wanted_s), dtype=bool)
        """(N,) bool, frames whose source frame did not decode, or came out damaged."""
        self.repeated = np.zeros(len(wanted_s), dtype=bool)
        """(N,) bool, frames that show the picture of the one before: a source frame twice, or one of a camera that
        froze. Once coded again they differ."""

    def show(self, frame: SourceFrame) -> None:
        """Take the next frame out of ``converted_frames``; it is encoded if the run wants it."""
        start = self._next
        first, end = _rows(self._wanted_s, frame.time_s)
        # Some containers repeat a time, or go back in it: what is shown already stays.
        first = max(first, start)
        self._mark(frame, first, end)
        if end <= first:
            return
        # What was wanted between the last frame and this one never came.
        self.lost[start:first] = True
        if self._shown is None:
            self._take(frame.picture)
            self._repeat(first - start)
        else:
            self._repeat(first - start)
            self._take(frame.picture)
        self._repeat(end - first)

    def finish(self, source: object) -> None:
        """Fill up the end with the last picture.

        Raises:
            VideoError: no frame of the run decoded.
        """
        if self._shown is None:
            raise VideoError(
                f"{source}: no frame between {self._wanted_s[0]:.3f} and {self._wanted_s[-1]:.3f} s decodes; "
                "leave that part out"
            )
        self.lost[self._next :] = True
        self._repeat(len(self._wanted_s) - self._next)

    def cuts(self) -> np.ndarray:
        """(N,) bool, first frames of new shots."""
        of_pictures = find_hard_cuts(np.stack(self._thumbnails))
        changed = np.concatenate([[False], np.diff(self._thumbnail_of) > 0])
        return of_pictures[self._thumbnail_of] & changed

    def _mark(self, frame: SourceFrame, first: int, end: int) -> None:
        if not frame.is_clean:
            # B-frames shown before a damaged frame may have been predicted from it.
            self.lost[self._bidirectional] = True
            self.lost[first:end] = True
        if not frame.is_bidirectional:
            self._bidirectional.clear()
        else:
            self._bidirectional.extend(range(first, end))

    def _take(self, picture: av.VideoFrame) -> None:
        grey = luma(picture) if picture.format.name == "yuv420p" else _grey(picture)
        self._is_new = self._grey is None or not same_picture(self._grey, grey)
        self._shown, self._grey = picture, grey
        self._thumbnails.append(thumbnail(grey))

    def _repeat(self, times: int) -> None:
        assert self._shown is not None
        for _ in range(times):
            self.repeated[self._next], self._is_new = not self._is_new, False
            self._writer.write_frame(self._shown)
            self._thumbnail_of[self._next] = len(self._thumbnails) - 1
            self._next += 1


def converted_frames(
    frames: Iterable[SourceFrame], wanted_s: np.ndarray, converter: FrameConverter
) -> Iterator[SourceFrame]:
    """All the frames; those that are wanted with their picture converted."""
    for frame in frames:
        first, end = _rows(wanted_s, frame.time_s)
        yield replace(frame, picture=converter.convert(frame.picture)) if end > first else frame


def _rows(wanted_s: np.ndarray, time_s: float) -> tuple[int, int]:
    """The frames ``[first, end)`` of a run that show a source frame."""
    first, end = np.searchsorted(wanted_s, (time_s - SAME_TIME_S, time_s + SAME_TIME_S))
    return int(first), int(end)


def _grey(picture: av.VideoFrame) -> np.ndarray:
    return cv2.cvtColor(picture.to_ndarray(format="rgb24"), cv2.COLOR_RGB2GRAY)
