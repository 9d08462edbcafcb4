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
from labeling.skeleton_evidence import explained_pixels, line_evidence, merged_places, on_dots
from labeling.skeleton_redraw import redrawn_parts, redrawn_points
from labeling.skeleton_video import DEFAULT_STYLE, LABEL_HEIGHT, LABEL_WIDTH, SkeletonStyle, dot_edges, style_radii

LEAST_POINTS = 4
"""A car with fewer points that hang together is not reported."""

_DARKEST, _PALEST = 96, 80
_SAME_POINT = 2.0
_LEAST_HUE, _LEAST_LIT = 0.4, 0.85
_LEAST_UNCLAIMED = 0.5
_LEAST_DOT, _CLEAR_DOT, _LEAST_SCORE = 0.5, 0.8, 1.0
_ROUNDS = 4
_SURE, _SURE_POINTS = 0.75, 12
"""A car that explains so much of its own drawing, with so many points, is taken out before the rest is read again."""
_LEAST_PIXELS, _MOST_PROPOSALS = 3, 64
"""A piece of fewer pixels proposes nothing, and a point has no more proposals: noise shall not take minutes."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SkeletonReading:
    """Cars read from one picture, and how far they account for it."""

    cars: tuple[Keypoints, ...]
    """Without track ids; a present point scores 1, a car the share of its drawing that the picture shows."""
    unexplained_share: float
    """Of the pixels that have a car's hue, those that no car read draws within a pixel: 0 when all came back."""
    left_out: int
    """Places that were not looked at because there were too many: more than 0 in noise and in piles of cars."""


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _ReadCar:
    """One car, settled."""

    places: dict[int, np.ndarray]
    """(2,) each, pixels of the picture."""
    drawn: np.ndarray
    """(H, W) int32 edge numbers of its drawing, or -1."""
    agreement: float
    """Share of the drawing that the picture shows."""


_Car = dict[int, int]
"""Points of the schema and the number of the proposal that each takes."""


def skeletons_from_frame(
    picture: np.ndarray, *, schema: str = "car66", frame: int = 0, label_width: int = LABEL_WIDTH,
    label_height: int = LABEL_HEIGHT, style: SkeletonStyle = DEFAULT_STYLE,
) -> list[Keypoints]:  # fmt: skip
    """The cars of ``read_skeletons``, without what it says of their trustworthiness.

    Raises:
        DataError: as ``read_skeletons``.
    """
    reading = read_skeletons(
        picture, schema=schema, frame=frame, label_width=label_width, label_height=label_height, style=style
    )
    return list(reading.cars)


def read_skeletons(
    picture: np.ndarray, *, schema: str = "car66", frame: int = 0, label_width: int = LABEL_WIDTH,
    label_height: int = LABEL_HEIGHT, style: SkeletonStyle = DEFAULT_STYLE,
) -> SkeletonReading:  # fmt: skip
    """Cars of a skeleton picture as labels, each with the points that its colours show.

    Within 2 px of what was drawn, where lines are not painted over; what dots or other cars cover may be missing. Time
    is bounded whatever the picture shows: of every hue the largest pieces propose, and of every point's proposals the
    best are kept.

    Args:
        picture: (H, W, 3) uint8, RGB, as ``draw_skeletons`` draws it or as a network imitates it.
        schema: car66 or car24, whichever was drawn.
        frame: number to write into the labels.
        label_width: width of the picture that the labels shall be in.
        label_height: height of that picture.
        style: as it was drawn.

    Returns:
        Labels in pixels of ``label_width`` x ``label_height``, and what they leave unexplained.

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
    lit = picture.max(axis=2) > _DARKEST // 2
    rest, read, left_out = parts, list[_ReadCar](), 0
    for last in (False, True):
        found, missed = _read_once(rest, lit, schema, radii)
        left_out = max(left_out, missed)
        # The second time only what the surest cars leave is read, and all of it is taken.
        sure = [car for car in found if last or (car.agreement >= _SURE and len(car.places) >= _SURE_POINTS)]
        read += sure
        rest = rest.copy()
        for car in sure:
            rest[explained_pixels(rest, car.drawn)] = -1
    scale = np.array([label_width / width, label_height / height])
    coloured = int((parts >= 0).sum())
    return SkeletonReading(
        cars=tuple(_label(car, schema, frame, scale) for car in read),
        unexplained_share=float((rest >= 0).sum() / coloured) if coloured else 0.0, left_out=left_out,
    )  # fmt: skip


def _read_once(
    parts: np.ndarray, lit: np.ndarray, schema: str, radii: tuple[float, float]
) -> tuple[list["_ReadCar"], int]:
    """The cars of a picture of edge numbers, and how many places were left out of account."""
    edges = keypoint_schema(schema).edges
    proposals, left_out = _propose(parts, schema, radii[1])
    evidence = _evidence(parts, lit, proposals, edges, radii[1])
    cars = _unclaimed(_join(proposals, evidence, edges), parts, proposals, edges)
    read = []
    for car in sorted(cars, key=lambda car: sorted(car.items())):
        places = {point: proposals[point].places[number] for point, number in car.items()}
        unsure = [point for point, number in sorted(car.items()) if proposals[point].dots[number] < _CLEAR_DOT]
        places = redrawn_points(parts, places, unsure, schema=schema, radii=radii)
        if len(places) >= LEAST_POINTS:
            drawn = redrawn_parts((parts.shape[0], parts.shape[1]), places, schema=schema, radii=radii)
            on = drawn >= 0
            read.append(_ReadCar(places=places, drawn=drawn, agreement=float((drawn == parts)[on].mean())))
    return read, left_out


def edge_of_pixels(picture: np.ndarray, *, edge_count: int) -> np.ndarray:
    """(H, W) int32, the edge whose hue is nearest to the pixel's, or -1 where it is dark or pale."""
    channels = picture.astype(np.float32)
    high, low = channels.max(axis=2), channels.min(axis=2)
    hue = cv2.cvtColor(channels / 255, cv2.COLOR_RGB2HSV)[..., 0]
    edge = np.rint(((240.0 - hue) % 360.0) * edge_count / 360.0).astype(np.int32) % edge_count
    edge[(high < _DARKEST) | (low > _PALEST)] = -1
    return edge


def _propose(parts: np.ndarray, schema: str, dot_radius: float) -> tuple[list[_Proposals], int]:
    """Proposals for each point, from the ends of each hue's pieces; and how many pieces and proposals were too many."""
    edges, dots = keypoint_schema(schema).edges, dot_edges(schema)
    places: list[list[np.ndarray]] = [[] for _ in dots]
    last, left_out = np.array(parts.shape[::-1]) - 1.0, 0
    for edge, ends in enumerate(edges):
        pieces, missed = _pieces(parts == edge)
        left_out += missed
        for middle, axis, half in pieces:
            for way in (-1.0, 1.0):
                tip = middle + way * half * axis
                if min(*tip, *(last - tip)) < 1.0:
                    continue  # the line goes on outside the picture
                for point in ends:
                    # A point's own dot is the last thing of its hue; another's dot covers the last of the line.
                    own = dots[point] == edge
                    inward = min(dot_radius - 0.25, half) if own else -dot_radius - 0.3
                    places[point].append(tip - way * inward * axis)
    proposals = []
    for edge, these in zip(dots, places, strict=True):
        found, missed = _on_dots(parts, int(edge), np.array(these).reshape(-1, 2), dot_radius)
        left_out += missed
        proposals.append(found)
    return proposals, left_out


def _pieces(mask: np.ndarray) -> tuple[list[tuple[np.ndarray, np.ndarray, float]], int]:
    """Middle (2,), axis (2,) and half length of a mask's largest connected pieces; and how many more there were."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    crop = mask[top : top + height, left : left + width].astype(np.uint8)
    if not crop.size:
        return [], 0
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
    return pieces, int((area >= _LEAST_PIXELS).sum()) - len(pieces)


def _on_dots(parts: np.ndarray, edge: int, places: np.ndarray, dot_radius: float) -> tuple[_Proposals, int]:
    """Proposals moved onto the dots of their point where one is seen; without a dot or a second vote, dropped.

    Returns:
        The best, and how many more there were.
    """
    means, votes = merged_places(places, _SAME_POINT)
    moved, seen = on_dots(parts, edge, means, dot_radius)
    kept: dict[tuple[float, float], tuple[float, float]] = {}
    for place, vote, share in zip(moved.tolist(), votes.tolist(), seen.tolist(), strict=True):
        if share < _LEAST_DOT and vote < 2:
            continue
        same = [other for other in kept if math.dist(other, place) < _SAME_POINT / 2]
        key = same[0] if same else (place[0], place[1])
        before = kept.get(key, (0.0, 0.0))
        kept[key] = (before[0] + vote, max(before[1], share))
    best = sorted(kept.items(), key=lambda one: (-one[1][1] - 0.1 * one[1][0], one[0]))[:_MOST_PROPOSALS]
    found, numbers = (np.array([one[i] for one in best]).reshape(-1, 2) for i in (0, 1))
    return _Proposals(places=found, votes=numbers[:, 0], dots=numbers[:, 1]), len(kept) - len(best)


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
        shares = line_evidence(hue, wide, proposals[a].places, proposals[b].places, dot_radius)
        found.append(_Evidence(hue=shares[0], lit=shares[1]))
    return found


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


def _label(car: _ReadCar, schema: str, frame: int, scale: np.ndarray) -> Keypoints:
    points = np.zeros((keypoint_schema(schema).point_count, 3))
    for point, place in car.places.items():
        points[point] = *((place + 0.5) * scale - 0.5), 1.0
    seen = points[:, 2] > 0
    box = np.concatenate([points[seen, :2].min(axis=0), points[seen, :2].max(axis=0)])
    return Keypoints(
        frame=frame, category="car", schema=schema, score=car.agreement, box_xyxy=box.astype(np.float32),
        points=points.astype(np.float32), point_source=np.where(seen, POINT_DETECTED, 0).astype(np.int8),
    )  # fmt: skip
