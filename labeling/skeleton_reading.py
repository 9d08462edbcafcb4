"""Cars read back from a drawn skeleton: how a generated skeleton video is judged.

Colour names the part: each edge has a hue of its own, and each point's dot takes the hue of one of its edges. The
pieces of every hue propose where the two points of that edge lie; proposals are joined along lines that are really
there, as long as no line that should then be there is missing; and the joined ones are cars.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from labeling.errors import DataError
from labeling.labels import POINT_DETECTED, Keypoints
from labeling.schemas import keypoint_schema
from labeling.skeleton_redraw import redrawn_points
from labeling.skeleton_video import DEFAULT_STYLE, LABEL_HEIGHT, LABEL_WIDTH, SkeletonStyle, dot_edges, style_radii

LEAST_POINTS = 4
"""A car with fewer points that hang together is not reported."""

_DARKEST, _PALEST = 96, 80
_SAME_POINT = 2.0
_LEAST_HUE, _LEAST_LIT = 0.4, 0.85
_OVERSHOOT = 0.25
_SAMPLES = 13
_LEAST_UNCLAIMED = 0.5
_LEAST_DOT, _CLEAR_DOT, _LEAST_SCORE = 0.5, 0.8, 1.0
_ROUNDS = 4
_LEAST_PIXELS, _MOST_PROPOSALS = 3, 64
"""A piece of fewer pixels proposes nothing, and a point has no more proposals: noise shall not take minutes."""
_SEARCH = np.arange(-2.0, 2.01, 0.5)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Proposals:
    """Where one point of the schema may lie in the picture."""

    places: np.ndarray
    """(n, 2) float64, pixels of the picture."""
    votes: np.ndarray
    """(n,) float64: how many ends of pieces propose it."""
    dots: np.ndarray
    """(n,) float64: share of the point's dot that is seen there, in its hue."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Evidence:
    """What the picture says of one edge between n proposals of its first point and m of its second."""

    hue: np.ndarray
    """(n, m) float64: share of the line that has the edge's hue, less where it runs on beyond the ends."""
    lit: np.ndarray
    """(n, m) float64: share of the line that is not black; a drawn edge may be painted over but is never black."""


_Car = dict[int, int]
"""Points of the schema and the number of the proposal that each takes."""


def skeletons_from_frame(
    picture: np.ndarray, *, schema: str = "car66", frame: int = 0, label_width: int = LABEL_WIDTH,
    label_height: int = LABEL_HEIGHT, style: SkeletonStyle = DEFAULT_STYLE,
) -> list[Keypoints]:  # fmt: skip
    """Cars of a skeleton picture as labels, each with the points that its colours show.

    Args:
        picture: (H, W, 3) uint8, RGB, as ``draw_skeletons`` draws it or as a network imitates it.
        schema: car66 or car24, whichever was drawn.
        frame: number to write into the labels.
        label_width: width of the picture that the labels shall be in.
        label_height: height of that picture.
        style: as it was drawn.

    Returns:
        Labels without track ids, pixels of ``label_width`` x ``label_height``; a present point scores 1. Within 2 px of
        what was drawn, where lines are not painted over; what dots or other cars cover may be missing.

    Raises:
        DataError: ``picture`` is not (H, W, 3) uint8, or the schema is not a car's.
    """
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise DataError(f"a picture is (H, W, 3) uint8 RGB, got {picture.shape} {picture.dtype}; convert it first")
    table = keypoint_schema(schema)
    if table.category != "car":
        raise DataError(f"only cars are read back from colours, not {schema}; give car66 or car24")
    height, width = picture.shape[:2]
    radii = style_radii(style.car_line, style.car_dot, width=width, height=height)
    parts = edge_of_pixels(picture, edge_count=len(table.edges))
    proposals = _propose(parts, schema, radii[1])
    evidence = _evidence(parts, picture.max(axis=2) > _DARKEST // 2, proposals, table.edges, radii[1])
    cars = _unclaimed(_join(proposals, evidence, table.edges), parts, proposals, table.edges)
    scale = np.array([label_width / width, label_height / height])
    labels = []
    for car in sorted(cars, key=lambda car: sorted(car.items())):
        places = {point: proposals[point].places[number] for point, number in car.items()}
        unsure = [point for point, number in sorted(car.items()) if proposals[point].dots[number] < _CLEAR_DOT]
        places = redrawn_points(parts, places, unsure, schema=schema, radii=radii)
        if len(places) < LEAST_POINTS:
            continue
        points = np.zeros((table.point_count, 3))
        for point, place in places.items():
            points[point] = *((place + 0.5) * scale - 0.5), 1.0
        labels.append(_label(points, schema, frame))
    return labels


def edge_of_pixels(picture: np.ndarray, *, edge_count: int) -> np.ndarray:
    """(H, W) int32, the edge whose hue is nearest to the pixel's, or -1 where it is dark or pale."""
    channels = picture.astype(np.float32)
    high, low = channels.max(axis=2), channels.min(axis=2)
    hue = cv2.cvtColor(channels / 255, cv2.COLOR_RGB2HSV)[..., 0]
    edge = np.rint(((240.0 - hue) % 360.0) * edge_count / 360.0).astype(np.int32) % edge_count
    edge[(high < _DARKEST) | (low > _PALEST)] = -1
    return edge


def _propose(parts: np.ndarray, schema: str, dot_radius: float) -> list[_Proposals]:
    """Proposals for each point, from the ends of each hue's pieces."""
    edges, dots = keypoint_schema(schema).edges, dot_edges(schema)
    places: list[list[np.ndarray]] = [[] for _ in dots]
    last = np.array(parts.shape[::-1]) - 1.0
    for edge, ends in enumerate(edges):
        for middle, axis, half in _pieces(parts == edge):
            for way in (-1.0, 1.0):
                tip = middle + way * half * axis
                if min(*tip, *(last - tip)) < 1.0:
                    continue  # the line goes on outside the picture
                for point in ends:
                    # A point's own dot is the last thing of its hue; another's dot covers the last of the line.
                    own = dots[point] == edge
                    inward = min(dot_radius - 0.25, half) if own else -dot_radius - 0.3
                    places[point].append(tip - way * inward * axis)
    return [
        _on_dots(parts, int(edge), _merged(np.array(these).reshape(-1, 2)), dot_radius)
        for edge, these in zip(dots, places, strict=True)
    ]


def _pieces(mask: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Middle (2,), axis (2,) and half length of the largest connected pieces of a mask, along their principal axes."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    crop = mask[top : top + height, left : left + width].astype(np.uint8)
    if not crop.size:
        return []
    _, numbers, stats, _ = cv2.connectedComponentsWithStats(crop, connectivity=8)
    area = stats[1:, cv2.CC_STAT_AREA]
    largest = 1 + np.argsort(-area, kind="stable")[:_MOST_PROPOSALS]
    rows, columns = np.nonzero(numbers)
    piece = numbers[rows, columns]
    all_pixels = np.column_stack([columns + left, rows + top]).astype(np.float64)
    pieces = []
    for number in largest[area[largest - 1] >= _LEAST_PIXELS]:
        pixels = all_pixels[piece == number]
        centred = pixels - pixels.mean(axis=0)
        axis = np.linalg.eigh(centred.T @ centred)[1][:, 1]
        along = centred @ axis
        middle = pixels.mean(axis=0) + (along.max() + along.min()) / 2 * axis
        pieces.append((middle, axis, float(along.max() - along.min()) / 2))
    return pieces


def _merged(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of one point that lie within two pixels, taken together, the most agreed upon first; and their numbers."""
    means, votes = [], []
    left = np.ones(len(places), bool)
    near = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)) <= _SAME_POINT
    while left.any():
        agreeing = (near & left).sum(axis=1) * left
        members = near[int(np.argmax(agreeing))] & left
        means.append(places[members].mean(axis=0))
        votes.append(float(members.sum()))
        left &= ~members
    return np.array(means).reshape(-1, 2), np.array(votes)


def _on_dots(parts: np.ndarray, edge: int, proposed: tuple[np.ndarray, np.ndarray], dot_radius: float) -> _Proposals:
    """Proposals moved onto the dots of their point where one is seen; without a dot or a second vote, dropped."""
    kept: dict[tuple[float, float], tuple[float, float]] = {}
    for place, votes in zip(*proposed, strict=True):
        place, seen = _on_dot(parts, edge, place, dot_radius)
        if seen < _LEAST_DOT and votes < 2:
            continue
        same = [other for other in kept if math.dist(other, place) < _SAME_POINT / 2]
        key = same[0] if same else (float(place[0]), float(place[1]))
        before = kept.get(key, (0.0, 0.0))
        kept[key] = (before[0] + votes, max(before[1], seen))
    best = sorted(kept.items(), key=lambda one: (-one[1][1] - 0.1 * one[1][0], one[0]))[:_MOST_PROPOSALS]
    places, numbers = (np.array([one[i] for one in best]).reshape(-1, 2) for i in (0, 1))
    return _Proposals(places=places, votes=numbers[:, 0], dots=numbers[:, 1])


def _evidence(
    parts: np.ndarray, lit: np.ndarray, proposals: Sequence[_Proposals], edges: Sequence[tuple[int, int]],
    dot_radius: float,
) -> list[_Evidence]:  # fmt: skip
    """What the picture says of each edge; lines are looked for within a pixel."""
    box = np.ones((3, 3), np.uint8)
    wide = cv2.dilate(lit.astype(np.uint8), box)
    found = []
    for edge, (a, b) in enumerate(edges):
        hue = cv2.dilate((parts == edge).astype(np.uint8), box)
        found.append(_between(hue, wide, proposals[a].places, proposals[b].places, dot_radius))
    return found


def _between(hue: np.ndarray, lit: np.ndarray, first: np.ndarray, second: np.ndarray, dot_radius: float) -> _Evidence:
    way = second[None] - first[:, None]
    length = np.maximum(np.hypot(way[..., 0], way[..., 1]), 1e-9)[..., None]
    # Clear of the dots at both ends, which have hues of their own.
    margin = np.minimum((dot_radius + 0.5) / length, 0.45)
    inner = _look_up(hue, first, way, margin + (1 - 2 * margin) * np.linspace(0, 1, _SAMPLES)).mean(axis=-1)
    whole = _look_up(lit, first, way, np.broadcast_to(np.linspace(0, 1, 2 * _SAMPLES), (*way.shape[:2], 2 * _SAMPLES)))
    # A line that runs on beyond an end means that the end is not one, but where another line broke it.
    past = (dot_radius + 2.5) / length
    beyond = _look_up(hue, first, way, np.concatenate([-past, 1 + past], axis=-1)).max(axis=-1)
    return _Evidence(hue=np.where(beyond > 0, _OVERSHOOT, 1.0) * inner, lit=whole.mean(axis=-1))


def _look_up(mask: np.ndarray, first: np.ndarray, way: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(n, m, S) float64: the mask (0 outside the picture) at shares ``at`` (n, m, S) of the way."""
    places = np.rint(first[:, None, None] + way[:, :, None] * at[..., None]).astype(np.int64)
    height, width = mask.shape
    inside = ((places >= 0) & (places < [width, height])).all(axis=-1)
    x, y = np.clip(places[..., 0], 0, width - 1), np.clip(places[..., 1], 0, height - 1)
    return (mask[y, x] * inside).astype(np.float64)


def _join(
    proposals: Sequence[_Proposals], evidence: Sequence[_Evidence], edges: Sequence[tuple[int, int]]
) -> list[_Car]:
    """Cars from the best lines to the least: never two proposals of one point, never a black line."""
    total = [these.dots + 0.1 * these.votes for these in proposals]
    for (a, b), seen in zip(edges, evidence, strict=True):
        if seen.hue.size:
            # A proposal that many edges reach is a point; a broken line's end is reached by that line alone.
            total[a] += seen.hue.max(axis=1)
            total[b] += seen.hue.max(axis=0)
    links = []
    for edge, ((a, b), seen) in enumerate(zip(edges, evidence, strict=True)):
        for i, j in np.argwhere((seen.hue >= _LEAST_HUE) & (seen.lit >= _LEAST_LIT)).tolist():
            links.append((-seen.hue[i, j] * min(total[a][i], total[b][j]), edge, i, j))
    car_of: dict[tuple[int, int], _Car] = {}
    for _, edge, i, j in sorted(links):
        a, b = edges[edge]
        one, other = car_of.get((a, i), {a: i}), car_of.get((b, j), {b: j})
        if one is other or not _agree(one, other, evidence, edges):
            continue
        joined = {**one, **other}
        for node in joined.items():
            car_of[node] = joined
    unique = {id(car): car for car in car_of.values()}
    settled = [_settled(car, proposals, evidence, edges) for car in unique.values() if len(car) >= LEAST_POINTS]
    return [car for car in settled if len(car) >= LEAST_POINTS]


def _settled(
    car: _Car, proposals: Sequence[_Proposals], evidence: Sequence[_Evidence], edges: Sequence[tuple[int, int]]
) -> _Car:
    """The car with each point where its dot and its lines to the other points speak for it most, or left out."""
    car = dict(car)
    for _ in range(_ROUNDS):
        before = dict(car)
        for point, these in enumerate(proposals):
            if not len(these.votes):
                continue
            scores = these.dots.copy()
            for edge, (a, b) in enumerate(edges):
                if point == a and b in car:
                    seen = evidence[edge].hue[:, car[b]], evidence[edge].lit[:, car[b]]
                elif point == b and a in car:
                    seen = evidence[edge].hue[car[a]], evidence[edge].lit[car[a]]
                else:
                    continue
                scores += np.where(seen[1] < _LEAST_LIT, -2.0, seen[0])
            best = int(np.argmax(scores))
            lines = scores[best] - these.dots[best]
            if scores[best] >= _LEAST_SCORE and lines >= _LEAST_HUE:
                car[point] = best
            else:
                car.pop(point, None)
        if car == before:
            break
    return car


def _agree(one: _Car, other: _Car, evidence: Sequence[_Evidence], edges: Sequence[tuple[int, int]]) -> bool:
    """Whether two parts can be one car: no point twice, and every edge between them not black."""
    if any(one.get(point, number) != number for point, number in other.items()):
        return False
    for edge, (a, b) in enumerate(edges):
        if (a in one and b in other) or (a in other and b in one):
            i, j = (one[a], other[b]) if a in one and b in other else (other[a], one[b])
            if evidence[edge].lit[i, j] < _LEAST_LIT:
                return False
    return True


def _unclaimed(
    cars: Sequence[_Car], parts: np.ndarray, proposals: Sequence[_Proposals], edges: Sequence[tuple[int, int]]
) -> list[_Car]:
    """Cars without those that only repeat the lines of a larger one."""
    free = np.ones(parts.shape, bool)
    kept = []
    for car in sorted(cars, key=lambda car: (-len(car), sorted(car.items()))):
        lines = np.full(parts.shape, -1, np.int32)
        for edge, (a, b) in enumerate(edges):
            if a in car and b in car:
                start, end = np.rint([proposals[a].places[car[a]], proposals[b].places[car[b]]]).astype(int).tolist()
                cv2.line(lines, start, end, edge, 3)
        own = (lines == parts) & (parts >= 0)
        if own.any() and free[own].mean() >= _LEAST_UNCLAIMED:
            kept.append(car)
            free &= ~own
    return kept


def _on_dot(parts: np.ndarray, edge: int, place: np.ndarray, dot_radius: float) -> tuple[np.ndarray, float]:
    """``place`` moved to where a dot of its hue fits best within two pixels, if one does, and the dot's seen share."""
    height, width = parts.shape
    reach = math.ceil(dot_radius + _SEARCH[-1])
    columns, rows = np.meshgrid(*(np.arange(round(c) - reach, round(c) + reach + 1) for c in place))
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    hue = parts[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    gain = np.where(hue == edge, 1.0, -1.0)[inside]
    centres = place + np.stack(np.meshgrid(_SEARCH, _SEARCH), axis=-1).reshape(-1, 2)
    covered = np.hypot(columns[inside] - centres[:, :1], rows[inside] - centres[:, 1:]) <= dot_radius
    scores = covered @ gain / max(math.pi * dot_radius**2, 1.0)
    best = float(scores.max()) if len(gain) else 0.0
    if best < _LEAST_DOT:
        return place, max(best, 0.0)
    return centres[scores >= best - 1e-9].mean(axis=0), min(best, 1.0)


def _label(points: np.ndarray, schema: str, frame: int) -> Keypoints:
    seen = points[:, 2] > 0
    box = np.concatenate([points[seen, :2].min(axis=0), points[seen, :2].max(axis=0)])
    return Keypoints(
        frame=frame, category="car", schema=schema, score=float(seen.mean()), box_xyxy=box.astype(np.float32),
        points=points.astype(np.float32), point_source=np.where(seen, POINT_DETECTED, 0).astype(np.int8),
    )  # fmt: skip
