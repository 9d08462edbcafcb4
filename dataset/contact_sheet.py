"""A clip as a contact sheet: moments across, its videos below one another, each tile large enough to read."""

import math
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dataset.loader import Sample
from labeling.object_video import MOST_TRACKS, tracks_of
from labeling.timeline import FPS

SHEET_ROWS = {"rgb.mp4": "RGB", "skeleton.mp4": "skeleton", "ego.mp4": "ego", "objects.mp4": "objects"}
"""The videos of a sheet from the top, and what they are called."""
MOMENTS = 4
"""Few, so that tiles are large: a person twelve metres ahead is then 40 pixels high."""
TILE = (528, 352)
"""Width and height of a tile, pixels: half the working picture."""

_GAP, _GUTTER, _TIMES = 6, 116, 34
_GROUND, _INK, _FAINT = "#14171c", "#f2f4f7", "#b6bfcb"
_THINNEST_PX = 2.0
"""What a line of one pixel of the skeleton video is wide in a tile, at least."""
_LIT = 40
"""A brighter channel is drawn: what a codec makes of black is darker."""
_NOTHING = {"skeleton.mp4": "no point in view", "objects.mp4": "none of the chosen objects in view"}
"""What a black tile says."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Text:
    """Words on the sheet."""

    x: float
    y: float
    """Of the baseline, pixels from the top."""
    words: str
    points: float
    colour: str
    side: str


@dataclass(frozen=True, slots=True, kw_only=True)
class _Layout:
    """Where tiles lie."""

    head: int
    rows: int
    moments: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the sheet, pixels."""
        return self.left(self.moments) + _GAP, self.top(self.rows) + _GAP

    def left(self, column: int) -> int:
        return _GUTTER + column * (TILE[0] + _GAP)

    def top(self, row: int) -> int:
        return self.head + _TIMES + row * (TILE[1] + _GAP)


def contact_sheet(sample: Sample, *, moments: int = MOMENTS) -> np.ndarray:
    """A clip at a glance: moments across, its videos below one another, the caption on top.

    Lines of the skeleton video are thickened where shrinking would lose them, and a tile without anything to show
    says so: black alone might be a fault.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    suffixes = [suffix for suffix in SHEET_ROWS if suffix in sample.members]
    rows = [moment_frames(sample, suffix, moments) for suffix in suffixes]
    caption = textwrap.wrap(sample.caption, width=150)
    layout = _Layout(head=52 + 28 * len(caption), rows=len(rows), moments=moments)
    width, height = layout.size
    canvas = np.full((height, width, 3), tuple(int(_GROUND[i : i + 2], 16) for i in (1, 3, 5)), np.uint8)
    for row, (suffix, frames) in enumerate(zip(suffixes, rows, strict=True)):
        for column, (_, frame) in enumerate(frames):
            top, left = layout.top(row), layout.left(column)
            canvas[top : top + TILE[1], left : left + TILE[0]] = _tile(frame, lines=suffix == "skeleton.mp4")
    heading = [_Text(x=2 * _GAP, y=34, words=sample.key, points=18, colour=_INK, side="left")]
    heading += [
        _Text(x=2 * _GAP, y=66 + 28 * n, words=line, points=14, colour=_INK, side="left")
        for n, line in enumerate(caption)
    ]
    times = [
        _Text(
            x=layout.left(n) + TILE[0] / 2, y=layout.top(0) - 10, words=f"{index / FPS:.2f} s", points=12,
            colour=_FAINT, side="center",
        )
        for n, (index, _) in enumerate(rows[0] if rows else [])
    ]  # fmt: skip
    notes = [note for row, suffix in enumerate(suffixes) for note in _row_notes(sample, suffix, rows[row], layout, row)]
    return _with_texts(canvas, [*heading, *times, *notes])


def moment_frames(sample: Sample, suffix: str, moments: int) -> list[tuple[int, np.ndarray]]:
    """Frames spread evenly over a clip's video, its first and last among them, with their indices."""
    count = len(sample.cam_to_world)
    wanted = [round(index) for index in np.linspace(0, count - 1, moments)]
    found = {index: frame for index, frame in enumerate(sample.iterate_frames(suffix)) if index in set(wanted)}
    return [(index, found[index]) for index in wanted]


def _row_notes(
    sample: Sample, suffix: str, frames: Sequence[tuple[int, np.ndarray]], layout: _Layout, row: int
) -> Iterator[_Text]:
    """A row's name, how many objects it was chosen from, and why tiles are black."""
    middle = layout.top(row) + TILE[1] / 2
    yield _Text(x=_GUTTER - 12, y=middle + 5, words=SHEET_ROWS[suffix], points=14, colour=_FAINT, side="right")
    if suffix == "objects.mp4" and (tracks := len(tracks_of(sample.keypoints()))) > MOST_TRACKS:
        # Rare traffic and a random choice of dense traffic look the same.
        words = f"{MOST_TRACKS} of {tracks}"
        yield _Text(x=_GUTTER - 12, y=middle + 27, words=words, points=11, colour=_FAINT, side="right")
    if suffix == "skeleton.mp4" and not any(label.present.any() for label in sample.keypoints()):
        words = "no keypoints: no keypoint network's weights were there, so there is nothing to draw"
        centre = (layout.left(0) + layout.size[0]) / 2
        yield _Text(x=centre, y=middle, words=words, points=14, colour=_FAINT, side="center")
        return
    for column, (_, frame) in enumerate(frames):
        if suffix in _NOTHING and frame.max() < _LIT:
            centre = layout.left(column) + TILE[0] / 2
            yield _Text(x=centre, y=middle, words=_NOTHING[suffix], points=12, colour=_FAINT, side="center")


def _tile(frame: np.ndarray, *, lines: bool = False) -> np.ndarray:
    """A frame shrunk to fit a tile, on black; ``lines`` on black stay wide enough to be seen."""
    scale = min(TILE[0] / frame.shape[1], TILE[1] / frame.shape[0])
    size = (max(1, round(frame.shape[1] * scale)), max(1, round(frame.shape[0] * scale)))
    if lines:
        frame = thickened(frame, max(0, math.ceil((_THINNEST_PX / scale - 1) / 2)))
    shrunk = cv2.resize(frame, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
    tile = np.zeros((TILE[1], TILE[0], 3), np.uint8)
    top, left = (TILE[1] - size[1]) // 2, (TILE[0] - size[0]) // 2
    tile[top : top + size[1], left : left + size[0]] = shrunk
    return tile


def thickened(frame: np.ndarray, radius: int) -> np.ndarray:
    """What is drawn on black, wider by ``radius`` pixels on every side, in its own colours.

    What is black takes the colour of its brightest neighbour; what is drawn already keeps its own, so that no two
    colours are mixed.

    Args:
        frame: (H, W, 3) uint8.
        radius: pixels.
    """
    wide = frame
    for _ in range(radius):
        padded = np.pad(wide, ((1, 1), (1, 1), (0, 0)))
        height, width = wide.shape[:2]
        around = np.stack([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)])
        brightest = around.max(axis=3).argmax(axis=0)
        neighbour = np.take_along_axis(around, brightest[None, :, :, None], axis=0)[0]
        wide = np.where(wide.max(axis=2, keepdims=True) < _LIT, neighbour, wide)
    return wide


def _with_texts(canvas: np.ndarray, texts: Sequence[_Text]) -> np.ndarray:
    """Texts on a picture, pixel for pixel."""
    height, width = canvas.shape[:2]
    dpi = 100
    figure = Figure(figsize=(width / dpi, height / dpi), dpi=dpi)
    painter = FigureCanvasAgg(figure)
    figure.figimage(canvas)
    for text in texts:
        figure.text(
            text.x / width, 1 - text.y / height, text.words.replace("$", r"\$"), fontsize=text.points,
            color=text.colour, ha=text.side, va="baseline",
        )  # fmt: skip
    painter.draw()
    return np.asarray(painter.buffer_rgba())[..., :3].copy()
