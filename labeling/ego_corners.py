"""Corners spread over a grid and carried into the next picture by Lucas-Kanade flow."""

from dataclasses import dataclass

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

_LK_TERMINATION = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 12, 0.02)
_THUMBNAIL = (64, 36)
_LEAST_CORNERS = 20


class TrackSettings(BaseModel):
    """How corners are found and followed. Lengths are pixels of the working picture."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    long_side: int = Field(default=640, ge=64)
    """The working picture's longer side; larger pictures are shrunk to it, smaller ones are left alone."""
    corners: int = Field(default=320, ge=50)
    window: int = Field(default=11, ge=5)
    """Side of the Lucas-Kanade window."""
    levels: int = Field(default=3, ge=0)
    """Pyramid levels above the first."""
    forward_backward_px: float = Field(default=0.8, gt=0)
    """A corner that does not come back within this distance is dropped."""
    quality: float = Field(default=2e-4, gt=0)
    """Least smaller eigenvalue of a corner's gradient matrix, for grey values 0 to 1."""
    dark_level: float = Field(default=50.0, ge=0)
    """Mean grey (0 to 255) below which contrast is equalised, of a picture and the one it is compared with alike."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameTracks:
    """The corners of one frame."""

    ids: np.ndarray
    """(n,) int64, increasing; the same corner keeps its id."""
    points_px: np.ndarray
    """(n, 2) float32, pixels of the working picture."""
    forward_backward_px: np.ndarray
    """(n,) float32: how far the corner came back from where it started; 0 for new corners."""
    cut: bool
    """The scene changes at this frame: no corner is older than it."""
    repeated: bool
    """The picture is the previous one again."""


class CornerTracker:
    """Follows corners frame by frame; holds the last frame and its corners, nothing older."""

    def __init__(self, source: tuple[int, int], settings: TrackSettings) -> None:
        """``source`` is the (width, height) of the pictures to come."""
        self._settings = settings
        scale = min(1.0, settings.long_side / max(source))
        self.width, self.height = max(16, round(source[0] * scale)), max(16, round(source[1] * scale))
        self._box_scale = np.array([self.width / source[0], self.height / source[1]] * 2)
        self._previous: np.ndarray | None = None
        self._seen: np.ndarray | None = None
        self._dark = False
        self._thumbnail = np.zeros(_THUMBNAIL[::-1], np.uint8)
        self._ids = np.zeros(0, np.int64)
        self._points = np.zeros((0, 2), np.float32)
        self._flow = np.zeros((0, 2), np.float32)
        self._next_id = 0
        self._usual_change = 3.0
        self._cell = max(8, round(np.sqrt(2.0 * self.width * self.height / settings.corners)))

    def step(self, picture: np.ndarray, boxes_xyxy: np.ndarray, *, restart: bool, repeated: bool) -> FrameTracks:
        """Follow the corners into the next picture and find new ones where there are few."""
        grey = self._grey(picture)
        thumbnail = cv2.resize(grey, _THUMBNAIL, interpolation=cv2.INTER_AREA)
        repeated = (
            not restart and self._previous is not None and (repeated or _same_picture(thumbnail, self._thumbnail))
        )
        dark = bool(thumbnail.mean() < self._settings.dark_level)
        seen = _equalised(grey) if dark else grey
        allowed = self._allowed(boxes_xyxy)
        back = np.zeros(len(self._ids), np.float32)
        cut = restart
        if self._previous is not None and not restart and len(self._ids):
            before = len(self._ids)
            back = self._follow(self._previous_seen(dark), seen, allowed)
            lost = before >= _LEAST_CORNERS and len(self._ids) < 0.2 * before
            cut = lost and self._scene_changes(thumbnail)
        if cut:
            back = self._forget()
        added = self._replenish(seen, allowed)
        # What shows nothing is no new scene: the old one may come back.
        cut = restart or (cut and added >= _LEAST_CORNERS)
        if self._previous is not None and not restart:
            change = np.abs(thumbnail.astype(np.int16) - self._thumbnail).mean()
            self._usual_change += 0.2 * (float(change) - self._usual_change)
        self._previous, self._seen, self._dark, self._thumbnail = grey, seen, dark, thumbnail
        return FrameTracks(
            ids=self._ids.copy(), points_px=self._points.copy(),
            forward_backward_px=np.concatenate([back, np.zeros(added, np.float32)]),
            cut=cut, repeated=repeated,
        )  # fmt: skip

    def _scene_changes(self, thumbnail: np.ndarray) -> bool:
        """Whether the picture as a whole changes far more than it has of late."""
        change = np.abs(thumbnail.astype(np.int16) - self._thumbnail).mean()
        return bool(change > max(6.0, 3.0 * self._usual_change)) or _histogram_jumps(thumbnail, self._thumbnail)

    def _forget(self) -> np.ndarray:
        self._keep(np.zeros(len(self._ids), bool))
        return np.zeros(0, np.float32)

    def _grey(self, picture: np.ndarray) -> np.ndarray:
        size = (self.width, self.height)
        if picture.shape[1::-1] != size:
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        return picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)

    def _previous_seen(self, dark: bool) -> np.ndarray:
        """The last picture, equalised as the new one is: no corner survives a change of contrast by a factor."""
        assert self._previous is not None and self._seen is not None
        if dark == self._dark:
            return self._seen
        return _equalised(self._previous) if dark else self._previous

    def _allowed(self, boxes_xyxy: np.ndarray) -> np.ndarray:
        allowed = np.full((self.height, self.width), 255, np.uint8)
        margin = 2.0
        for left, top, right, bottom in boxes_xyxy * self._box_scale:
            rows = slice(max(0, int(top - margin)), max(0, int(bottom + margin + 1)))
            allowed[rows, max(0, int(left - margin)) : max(0, int(right + margin + 1))] = 0
        return allowed

    def _follow(self, before: np.ndarray, grey: np.ndarray, allowed: np.ndarray) -> np.ndarray:
        """Move the corners into the new picture, drop the lost ones, return what is left's distance on coming back."""
        window = (self._settings.window, self._settings.window)
        options = {"winSize": window, "maxLevel": self._settings.levels, "criteria": _LK_TERMINATION}
        start = self._points
        guess = start + self._flow
        moved, ok, _ = cv2.calcOpticalFlowPyrLK(
            before, grey, start, guess.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **options
        )
        returned, ok_back, _ = cv2.calcOpticalFlowPyrLK(
            grey, before, moved, start.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **{**options, "maxLevel": 0}
        )
        back = np.linalg.norm(returned - start, axis=1).astype(np.float32)
        column = np.clip(np.rint(moved[:, 0]), 0, self.width - 1).astype(int)
        row = np.clip(np.rint(moved[:, 1]), 0, self.height - 1).astype(int)
        inside = (moved >= 2).all(axis=1) & (moved < np.array([self.width - 2, self.height - 2])).all(axis=1)
        good = (ok[:, 0] > 0) & (ok_back[:, 0] > 0) & (back < self._settings.forward_backward_px) & inside
        good &= allowed[row, column] > 0
        self._flow = (moved - start).astype(np.float32)
        self._points = moved.astype(np.float32)
        self._keep(good)
        return back[good]

    def _keep(self, good: np.ndarray) -> None:
        self._ids, self._points, self._flow = self._ids[good], self._points[good], self._flow[good]

    def _replenish(self, grey: np.ndarray, allowed: np.ndarray) -> int:
        """Fill cells that hold fewer than two corners; returns how many were added."""
        cell, settings = self._cell, self._settings
        if len(self._ids) > 0.85 * settings.corners:
            return 0
        rows, columns = -(-self.height // cell), -(-self.width // cell)
        for x, y in np.rint(self._points).astype(int):
            cv2.circle(allowed, (int(x), int(y)), max(3, cell // 3), 0, -1)
        # cv2 scales the gradient by 1 / (2 * 3 * 255) for an aperture and block of 3: eigenvalues of grey 0 to 1.
        strength = cv2.cornerMinEigenVal(grey, 3, ksize=3)
        strength[allowed == 0] = 0
        border = settings.window // 2
        strength[:border], strength[-border:], strength[:, :border], strength[:, -border:] = 0, 0, 0, 0
        held = np.zeros(rows * columns, int)
        if len(self._points):
            index = (self._points[:, 1] // cell).astype(int) * columns + (self._points[:, 0] // cell).astype(int)
            held = np.bincount(index, minlength=rows * columns)
        new = np.concatenate([self._best_of_cells(strength, held < limit, rows, columns) for limit in (2, 1)])
        if not len(new):
            return 0
        self._points = np.concatenate([self._points, new])
        self._flow = np.concatenate([self._flow, self._nearest_flow(new)])
        self._ids = np.concatenate([self._ids, np.arange(self._next_id, self._next_id + len(new))])
        self._next_id += len(new)
        return len(new)

    def _best_of_cells(self, strength: np.ndarray, wanted: np.ndarray, rows: int, columns: int) -> np.ndarray:
        """(m, 2) float32: the strongest pixel of each wanted cell; it is blanked, so that a second call finds the
        next."""
        cell = self._cell
        padded = np.zeros((rows * cell, columns * cell), np.float32)
        padded[: self.height, : self.width] = strength
        cells = padded.reshape(rows, cell, columns, cell).transpose(0, 2, 1, 3).reshape(rows * columns, cell * cell)
        best = cells.argmax(axis=1)
        good = wanted & (cells[np.arange(len(cells)), best] > self._settings.quality)
        index = np.flatnonzero(good)
        y, x = (index // columns) * cell + best[good] // cell, (index % columns) * cell + best[good] % cell
        for column, row in zip(x.tolist(), y.tolist(), strict=True):
            cv2.circle(strength, (column, row), max(3, cell // 3), 0, -1)
        return np.stack([x, y], axis=1).astype(np.float32)

    def _nearest_flow(self, new: np.ndarray) -> np.ndarray:
        """The last flow of the nearest old corner, to start the search from."""
        old = len(self._flow)
        if not old:
            return np.zeros((len(new), 2), np.float32)
        distance = ((new[:, None] - self._points[None, :old]) ** 2).sum(axis=-1)
        return self._flow[distance.argmin(axis=1)]


def _equalised(grey: np.ndarray) -> np.ndarray:
    return cv2.createCLAHE(clipLimit=4.0, tileGridSize=(8, 8)).apply(grey)


def _same_picture(thumbnail: np.ndarray, before: np.ndarray) -> bool:
    return bool(np.abs(thumbnail.astype(np.int16) - before).mean() < 0.02)


def _histogram_jumps(thumbnail: np.ndarray, before: np.ndarray) -> bool:
    """Whether the grey histograms overlap by less than half."""
    histograms = [np.bincount(picture.ravel() >> 4, minlength=16) / picture.size for picture in (thumbnail, before)]
    return bool(np.minimum(*histograms).sum() < 0.5)
