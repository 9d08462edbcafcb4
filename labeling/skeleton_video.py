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
from labeling.schemas import CATEGORIES, Category, facts, keypoint_schema
from labeling.skeleton_raster import Capsules, fill_capsules, mark_cells

LABEL_WIDTH, LABEL_HEIGHT = 1056, 704
"""The picture that label coordinates are pixels of, unless said otherwise."""

_STYLE_WIDTH, _STYLE_HEIGHT = 768, 512
_DRAWING_ORDER: dict[Category, int] = {"lane": 0, "car": 1, "person": 2}
_WHITE = (255, 255, 255)
_HAND_DOT = (0, 0, 255)
_LANE_POINTS = 24
_LANE_LEAST_POINTS = 2


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
    size = math.sqrt(width * height / (_STYLE_WIDTH * _STYLE_HEIGHT))
    parts = []
    for group in _groups(labels):
        points = np.stack([one.points for one in group]).astype(np.float64)
        # Pixel centres lie on integers, so a picture scales about -0.5.
        points[..., 0] = (points[..., 0] + 0.5) * scale_x - 0.5
        points[..., 1] = (points[..., 1] + 0.5) * scale_y - 0.5
        points[..., 2] = np.minimum(points[..., 2], 1.0)
        parts.append(_PAINTERS[group[0].category](points, group[0].schema, style, size))
    if not parts:
        return Capsules(ends=np.zeros((0, 4)), radii=np.zeros(0), colours=np.zeros((0, 3), np.uint8))
    ends, radii, colours = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Capsules(ends=ends, radii=radii, colours=colours)


@functools.cache
def edge_colours(schema: str) -> np.ndarray:
    """(E, 3) uint8 RGB: edge e of E has hue ``(240 - 360 e / E) mod 360`` degrees, full saturation and value."""
    count = len(keypoint_schema(schema).edges)
    hues = [((240 - 360 * edge / count) % 360) / 360 for edge in range(count)]
    colours = np.array([[round(255 * part) for part in colorsys.hsv_to_rgb(hue, 1.0, 1.0)] for hue in hues], np.uint8)
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


def complete_lane(points: np.ndarray, *, count: int = _LANE_POINTS) -> np.ndarray:
    """Evenly spaced points along a lane line.

    Args:
        points: (P, 2) float64, the points that are present, in order along the line.
        count: how many to make.

    Returns:
        (count, 2) float64, evenly spaced by arc length from the first present point to the last; (0, 2) when fewer than
        two distinct points are present.
    """
    steps = np.hypot(*np.diff(points, axis=0).T) if len(points) >= _LANE_LEAST_POINTS else np.zeros(0)
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


_Part = tuple[np.ndarray, np.ndarray, np.ndarray]


def _paint_cars(points: np.ndarray, schema: str, style: SkeletonStyle, size: float) -> _Part:
    colours = edge_colours(schema)
    first, second = np.array(keypoint_schema(schema).edges).T
    shown = points[..., 2] >= style.min_score
    lines = np.concatenate([points[:, first, :2], points[:, second, :2]], axis=-1)
    dots = np.concatenate([points[..., :2], points[..., :2]], axis=-1)
    ends = np.concatenate([lines, dots], axis=1)
    drawn = np.concatenate([shown[:, first] & shown[:, second], shown], axis=1)
    line, dot = _line_radius(style.car_line, size), _dot_radius(style.car_dot, size)
    radii = np.concatenate([np.full(len(first), line), np.full(points.shape[1], dot)])
    palette = np.concatenate([colours, colours[dot_edges(schema)]])
    of = np.broadcast_to(np.arange(len(radii)), drawn.shape)[drawn]
    return ends[drawn], radii[of], palette[of]


def _paint_lanes(points: np.ndarray, schema: str, style: SkeletonStyle, size: float) -> _Part:
    ends, radii = [np.zeros((0, 4))], [np.zeros(0)]
    for lane in points:
        line = complete_lane(lane[lane[:, 2] >= style.min_score, :2])
        ends += [np.concatenate([line[:-1], line[1:]], axis=1), np.concatenate([line, line], axis=1)]
        radii += [np.full(max(len(line) - 1, 0), _line_radius(style.lane_line, size))]
        radii += [np.full(len(line), _dot_radius(style.lane_dot, size))]
    stacked = np.concatenate(radii)
    return np.concatenate(ends), stacked, np.full((len(stacked), 3), _WHITE, np.uint8)


def _paint_people(points: np.ndarray, schema: str, style: SkeletonStyle, size: float) -> _Part:
    body = openpose_body(points, schema)
    table = facts()["openpose18"]
    limbs, colours = np.array(table["limbs_zero_based"]), np.array(table["colours_rgb"], np.float64)
    parts = [
        _shaded_lines(body, limbs, colours[: len(limbs)], _line_radius(style.limb_line, size), style.min_score),
        _shaded_dots(body, colours, _dot_radius(style.limb_dot, size), style.min_score),
    ]
    if schema == "wholebody133":
        parts += _hands_and_face(points, style, size)
    # One person after another, each with all its parts.
    ends, drawn, radii, shades = (np.concatenate([part[i] for part in parts], axis=1) for i in range(4))
    return ends[drawn], radii[drawn], shades[drawn]


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


_ShadedPart = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def _hands_and_face(points: np.ndarray, style: SkeletonStyle, size: float) -> list[_ShadedPart]:
    table = facts()["wholebody133"]
    fingers = np.array(table["hand_edges_zero_based_within_hand"])
    rainbow = [[255 * part for part in colorsys.hsv_to_rgb(i / len(fingers), 1.0, 1.0)] for i in range(len(fingers))]
    parts = []
    for name in ("left_hand", "right_hand"):
        hand = points[:, slice(*table["slices"][name])]
        parts.append(
            _shaded_lines(hand, fingers, np.array(rainbow), _line_radius(style.hand_line, size), style.min_score)
        )
        dots = np.tile(np.array(_HAND_DOT, np.float64), (hand.shape[1], 1))
        parts.append(_shaded_dots(hand, dots, _dot_radius(style.hand_dot, size), style.min_score))
    face = points[:, slice(*table["slices"]["face"])]
    white = np.tile(np.array(_WHITE, np.float64), (face.shape[1], 1))
    return [*parts, _shaded_dots(face, white, _dot_radius(style.face_dot, size), style.min_score)]


def _shaded_lines(
    points: np.ndarray, pairs: np.ndarray, colours: np.ndarray, radius: float, least: float
) -> _ShadedPart:
    """Lines whose brightness is the geometric mean of their ends' scores."""
    one, other = points[:, pairs[:, 0]], points[:, pairs[:, 1]]
    drawn = (one[..., 2] >= least) & (other[..., 2] >= least)
    shade = np.sqrt(np.maximum(one[..., 2] * other[..., 2], 0.0))
    ends = np.concatenate([one[..., :2], other[..., :2]], axis=-1)
    return ends, drawn, np.full(drawn.shape, radius), _shaded(colours, shade)


def _shaded_dots(points: np.ndarray, colours: np.ndarray, radius: float, least: float) -> _ShadedPart:
    ends = np.concatenate([points[..., :2], points[..., :2]], axis=-1)
    drawn = points[..., 2] >= least
    return ends, drawn, np.full(drawn.shape, radius), _shaded(colours, points[..., 2])


def _shaded(colours: np.ndarray, shade: np.ndarray) -> np.ndarray:
    return np.rint(colours * shade[..., None]).astype(np.uint8)


def _line_radius(width: float, size: float) -> float:
    # A line one pixel wide lights at least one pixel of every column or row that it crosses.
    return max(width * size, 1.0) / 2


def _dot_radius(diameter: float, size: float) -> float:
    # The centre of some pixel is never farther than half a pixel's diagonal, so no dot is lost.
    return max(diameter * size / 2, math.sqrt(0.5))


_PAINTERS = {"car": _paint_cars, "lane": _paint_lanes, "person": _paint_people}
assert set(_PAINTERS) == set(CATEGORIES)
