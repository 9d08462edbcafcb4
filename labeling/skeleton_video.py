"""Keypoints drawn as coloured skeletons on black: the released look, computed from geometry.

A skeleton video is a view of the labels. Every shape is a capsule (a dot is a capsule of no length), and a pixel is lit
when its centre lies inside: no antialiasing, so colours are exact and a drawn frame can be read back
(``labeling.skeleton_reading``). Colour names the part, never the instance.

Sources: OpenPifPaf's rainbow over a car's edges, DWPose's OpenPose-18 body, as ``keypoint_schemas.json`` names them.
"""

import colorsys
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from labeling.errors import ConfigError
from labeling.labels import Keypoints
from labeling.schemas import Category, facts, keypoint_schema
from labeling.skeleton_raster import Capsules, fill_capsules, mark_cells

LABEL_WIDTH, LABEL_HEIGHT = 1056, 704
"""The picture that label coordinates are pixels of, unless said otherwise."""

_STYLE_WIDTH, _STYLE_HEIGHT = 768, 512
_DRAWING_ORDER: dict[Category, int] = {"lane": 0, "car": 1, "person": 2}
_WHITE = (255, 255, 255)
_HAND_DOT = (0, 0, 255)
_LANE_POINTS = 24


@dataclass(frozen=True, slots=True, kw_only=True)
class SkeletonStyle:
    """Sizes in pixels of a 768x512 picture; they scale with the picture, lines never below one pixel."""

    car_line: float = 1.5
    """Line width, covering 1 to 2 pixels."""
    car_dot: float = 3.0
    """Diameter of a car point's dot."""
    lane_line: float = 2.0
    lane_dot: float = 5.0
    limb_line: float = 3.0
    limb_dot: float = 4.0
    hand_line: float = 1.0
    hand_dot: float = 1.6
    face_dot: float = 1.6
    min_score: float = 0.3
    """Points scored below this are not drawn."""


DEFAULT_STYLE = SkeletonStyle()


def draw_skeletons(
    labels: Sequence[Keypoints], *, width: int, height: int, label_width: int = LABEL_WIDTH,
    label_height: int = LABEL_HEIGHT, style: SkeletonStyle = DEFAULT_STYLE,
) -> np.ndarray:  # fmt: skip
    """One frame's labels as a picture; far objects lie under near ones, whatever the order of ``labels``.

    Args:
        labels: the keypoints of one frame, pixels of ``label_width`` x ``label_height``.
        width: of the picture, pixels.
        height: of the picture, pixels.
        label_width: width of the picture that the labels are in.
        label_height: height of that picture.
        style: sizes and the least score.

    Returns:
        (height, width, 3) uint8, RGB on black.

    Raises:
        ConfigError: a size is not positive.
    """
    shapes = skeleton_capsules(
        labels, width=width, height=height, label_width=label_width, label_height=label_height, style=style
    )
    picture = np.zeros((height, width, 3), np.uint8)
    fill_capsules(picture, shapes)
    return picture


def lit_cells(
    frames_labels: Sequence[Sequence[Keypoints]], *, width: int, height: int, cell: int = 32,
    label_width: int = LABEL_WIDTH, label_height: int = LABEL_HEIGHT, style: SkeletonStyle = DEFAULT_STYLE,
) -> np.ndarray:  # fmt: skip
    """Which cells of ``cell`` x ``cell`` pixels hold skeleton, rasterised from keypoints and never from a video.

    Args:
        frames_labels: one sequence of labels per frame.
        width: of the picture, a multiple of ``cell``.
        height: of the picture, a multiple of ``cell``.
        cell: side of a cell, pixels.
        label_width: width of the picture that the labels are in.
        label_height: height of that picture.
        style: as it is drawn.

    Returns:
        (T, height / cell, width / cell) bool: lit exactly where ``draw_skeletons`` lights a pixel of the cell.

    Raises:
        ConfigError: the picture is not a whole number of cells.
    """
    if cell <= 0 or width % cell or height % cell:
        raise ConfigError(f"a picture of {width}x{height} is not a whole number of {cell}-pixel cells; resize it first")
    lit = np.zeros((len(frames_labels), height // cell, width // cell), np.bool_)
    for row, labels in zip(lit, frames_labels, strict=True):
        shapes = skeleton_capsules(
            labels, width=width, height=height, label_width=label_width, label_height=label_height, style=style
        )
        mark_cells(row, shapes, width=width, height=height, cell=cell)
    return lit


def skeleton_capsules(
    labels: Sequence[Keypoints], *, width: int, height: int, label_width: int = LABEL_WIDTH,
    label_height: int = LABEL_HEIGHT, style: SkeletonStyle = DEFAULT_STYLE,
) -> Capsules:  # fmt: skip
    """The shapes of one frame in drawing order: lanes, cars, people; within each, the nearest last.

    Raises:
        ConfigError: a size is not positive.
    """
    if min(width, height, label_width, label_height) <= 0:
        raise ConfigError(f"cannot draw {label_width}x{label_height} labels on {width}x{height}; sizes are positive")
    scale_x, scale_y = width / label_width, height / label_height
    size = _size(width, height)
    parts = []
    for group in _groups(labels):
        points = np.array([one.points for one in group], np.float64)
        # Pixel centres lie on integers, so a picture scales about -0.5.
        points[..., 0] = (points[..., 0] + 0.5) * scale_x - 0.5
        points[..., 1] = (points[..., 1] + 0.5) * scale_y - 0.5
        points[..., 2] = np.clip(points[..., 2], 0.0, 1.0)
        schema = group[0].schema
        parts.append(_paint(_prepared(points, schema, style.min_score), _plan(schema, style, size), style.min_score))
    if not parts:
        return Capsules(ends=np.zeros((0, 4)), radii=np.zeros(0), colours=np.zeros((0, 3), np.uint8))
    ends, radii, colours = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Capsules(ends=ends, radii=radii, colours=colours)


@functools.cache
def edge_colours(schema: str) -> np.ndarray:
    """(E, 3) uint8 RGB: edge e of E has hue ``(240 - 360 e / E) mod 360`` degrees, full saturation and value."""
    count = len(keypoint_schema(schema).edges)
    colours = _rainbow([240 - 360 * edge / count for edge in range(count)])
    colours.flags.writeable = False
    return colours


@functools.cache
def dot_edges(schema: str) -> np.ndarray:
    """(K,) int64: for each point one of its own edges, whose colour its dot takes; no two points share one.

    A system of distinct representatives (Kuhn's augmenting paths); no part of a car's graph is a tree, so one exists.
    With it a dot's colour says which point it is, and every pixel of a car keeps an edge's colour.
    """
    table = keypoint_schema(schema)
    owner: dict[int, int] = {}
    for point in range(table.point_count):
        _claim_edge(point, table.edges, owner, set())
    chosen = np.zeros(table.point_count, np.int64)
    for edge, point in owner.items():
        chosen[point] = edge
    return chosen


def style_radii(line: float, dot: float, *, width: int, height: int) -> tuple[float, float]:
    """Radii in pixels of a picture, of a line and a dot that a style gives as thicknesses at 768x512."""
    size = _size(width, height)
    return _line_radius(line * size), _dot_radius(dot * size)


def complete_lane(points: np.ndarray, *, count: int = _LANE_POINTS) -> np.ndarray:
    """Evenly spaced points along a lane line.

    Args:
        points: (P, 2) float64, the points that are present, in order along the line.
        count: how many to make.

    Returns:
        (count, 2) float64, evenly spaced by arc length from the first present point to the last; (0, 2) when fewer than
        two distinct points are present.
    """
    steps = np.hypot(*np.diff(points, axis=0).T) if len(points) > 1 else np.zeros(0)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    if along[-1] <= 0:
        return np.zeros((0, 2))
    at = np.linspace(0.0, along[-1], count)
    return np.column_stack([np.interp(at, along, axis) for axis in points.T])


def _groups(labels: Sequence[Keypoints]) -> list[list[Keypoints]]:
    """Labels by category and schema, each group from far to near: the lower a box ends, the nearer the object."""
    groups: dict[tuple[int, str], list[Keypoints]] = {}
    for one in labels:
        groups.setdefault((_DRAWING_ORDER[one.category], one.schema), []).append(one)
    return [sorted(groups[key], key=_nearness) for key in sorted(groups)]


def _nearness(one: Keypoints) -> tuple:
    return float(one.box_xyxy[3]), one.track_id, one.score, one.points.tobytes()


def _claim_edge(point: int, edges: tuple[tuple[int, int], ...], owner: dict[int, int], tried: set[int]) -> bool:
    for edge, ends in enumerate(edges):
        if point not in ends or edge in tried:
            continue
        tried.add(edge)
        if edge not in owner or _claim_edge(owner[edge], edges, owner, tried):
            owner[edge] = point
            return True
    return False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Plan:
    """How one object is drawn: S shapes in order, each between two of its points (a dot: twice the same)."""

    start: np.ndarray
    """(S,) int64, index of a point."""
    stop: np.ndarray
    """(S,) int64."""
    radii: np.ndarray
    """(S,) float64, pixels."""
    colours: np.ndarray
    """(S, 3) float64, RGB 0 to 255."""
    shaded: bool
    """Whether the score dims the colour."""


def _paint(points: np.ndarray, plan: _Plan, least: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends, radii and colours of n objects of K points, (n, K, 3), one object after another."""
    first, second = points[:, plan.start], points[:, plan.stop]
    drawn = (first[..., 2] >= least) & (second[..., 2] >= least)
    ends = np.concatenate([first[..., :2], second[..., :2]], axis=-1)[drawn]
    shape = np.nonzero(drawn)[1]
    colours = plan.colours[shape]
    if plan.shaded:
        # The geometric mean: a line of two equal scores is as bright as its dots.
        colours = colours * np.sqrt(first[..., 2] * second[..., 2])[drawn][:, None]
    return ends, plan.radii[shape], np.rint(colours).astype(np.uint8)


@functools.lru_cache(maxsize=64)
def _plan(schema: str, style: SkeletonStyle, size: float) -> _Plan:
    category = keypoint_schema(schema).category
    parts = {"car": _car_parts, "lane": _lane_parts, "person": _person_parts}[category](schema, style)
    start, stop, radii, colours = [], [], [], []
    for pairs, palette, thickness in parts:
        pairs = np.atleast_2d(pairs)
        dots = pairs.shape[0] == 1
        start.append(pairs[0])
        stop.append(pairs[0] if dots else pairs[1])
        radii.append(np.full(len(pairs[0]), _dot_radius(thickness * size) if dots else _line_radius(thickness * size)))
        colours.append(np.broadcast_to(np.asarray(palette, np.float64), (len(pairs[0]), 3)))
    return _Plan(
        start=np.concatenate(start), stop=np.concatenate(stop), radii=np.concatenate(radii),
        colours=np.concatenate(colours), shaded=category == "person",
    )  # fmt: skip


_Parts = list[tuple[np.ndarray, object, float]]
"""(2, S) ends of lines or (S,) dots; an RGB colour for all or for each; the thickness in pixels of the style."""


def _car_parts(schema: str, style: SkeletonStyle) -> _Parts:
    table, colours = keypoint_schema(schema), edge_colours(schema)
    return [
        (np.array(table.edges).T, colours, style.car_line),
        (np.arange(table.point_count), colours[dot_edges(schema)], style.car_dot),
    ]


def _lane_parts(schema: str, style: SkeletonStyle) -> _Parts:
    points = np.arange(keypoint_schema(schema).point_count)
    return [(np.stack([points[:-1], points[1:]]), _WHITE, style.lane_line), (points, _WHITE, style.lane_dot)]


def _person_parts(schema: str, style: SkeletonStyle) -> _Parts:
    table = facts()["openpose18"]
    limbs, colours = np.array(table["limbs_zero_based"]).T, np.array(table["colours_rgb"])
    body = colours.shape[0]
    parts: _Parts = [(limbs, colours[: limbs.shape[1]], style.limb_line), (np.arange(body), colours, style.limb_dot)]
    if schema != "wholebody133":
        return parts
    whole = facts()["wholebody133"]
    fingers = np.array(whole["hand_edges_zero_based_within_hand"]).T
    rainbow = _rainbow([360 * finger / fingers.shape[1] for finger in range(fingers.shape[1])])
    for name in ("left_hand", "right_hand"):
        first, end = (body + index for index in whole["slices"][name])
        parts += [(first + fingers, rainbow, style.hand_line), (np.arange(first, end), _HAND_DOT, style.hand_dot)]
    face = np.arange(*(body + index for index in whole["slices"]["face"]))
    return [*parts, (face, _WHITE, style.face_dot)]


def _prepared(points: np.ndarray, schema: str, least: float) -> np.ndarray:
    """(n, K, 3) label points as (n, K', 3) points of the drawing: lanes completed, people in OpenPose's order."""
    category = keypoint_schema(schema).category
    if category == "person":
        body = openpose_body(points, schema)
        return np.concatenate([body, points], axis=1) if schema == "wholebody133" else body
    if category == "lane":
        lanes = np.zeros((len(points), points.shape[1], 3))
        for lane, given in zip(lanes, points, strict=True):
            line = complete_lane(given[given[:, 2] >= least, :2], count=len(lane))
            lane[: len(line), :2], lane[: len(line), 2] = line, 1.0
        return lanes
    return points


def openpose_body(points: np.ndarray, schema: str) -> np.ndarray:
    """Bodies in OpenPose's order of 18; the neck is the shoulders' mean, seen only if both score above 0.3.

    Args:
        points: (n, K, 3) x, y, score.
        schema: wholebody133, coco17 (its 17 are the first of wholebody133) or openpose18.

    Returns:
        (n, 18, 3) float64; the neck's score is the lesser of the shoulders'.
    """
    if schema == "openpose18":
        return points
    order = facts()["openpose18"]["from_wholebody133"]
    body = points[:, [0 if index is None else index for index in order]].copy()
    neck, right_shoulder, left_shoulder = order.index(None), body[:, 2], body[:, 5]
    body[:, neck] = (right_shoulder + left_shoulder) / 2
    least = np.minimum(right_shoulder[:, 2], left_shoulder[:, 2])
    body[:, neck, 2] = np.where(least > 0.3, least, 0.0)
    return body


def _rainbow(hues_deg: Sequence[float]) -> np.ndarray:
    """(N, 3) uint8 RGB of full saturation and value."""
    colours = [colorsys.hsv_to_rgb((hue % 360) / 360, 1.0, 1.0) for hue in hues_deg]
    return np.rint(255 * np.array(colours)).astype(np.uint8)


def _size(width: int, height: int) -> float:
    return math.sqrt(width * height / (_STYLE_WIDTH * _STYLE_HEIGHT))


def _line_radius(width: float) -> float:
    # A line one pixel wide lights at least one pixel of every column or row that it crosses.
    return max(width, 1.0) / 2


def _dot_radius(diameter: float) -> float:
    # The centre of some pixel is never farther than half a pixel's diagonal, so no dot is lost.
    return max(diameter / 2, math.sqrt(0.5))
