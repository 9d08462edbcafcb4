"""What is true in a rendered frame of the street: boxes, keypoints, what hides what, lane lines."""

from dataclasses import dataclass

import numba
import numpy as np

from dataset.street_actors import Actor
from dataset.street_drives import StreetPath
from dataset.street_polygons import Canvas
from dataset.street_scene import LaneLine
from labeling.camera import Intrinsics
from labeling.schemas import Category

LANE_REACH_M = 60.0
_LANE_NEAR_M = 0.6
_LANE_STEP_M = 0.25
_LANE_SHORTEST_PX = 24.0
_LANE_TRACK_ID = 901
_NEAR_M = 0.05
_SILHOUETTE_PX = 160


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreetObject:
    """The truth about one object in one frame."""

    track_id: int
    category: Category
    schema: str
    box_xyxy: np.ndarray
    """(4,) float32: left, top, right, bottom of its visible pixels (outer edges: pixel centres lie on integers); for a
    lane line, of its points."""
    points_xy: np.ndarray
    """(K, 2) float32, pixels, exact, hidden or not; outside the picture too. NaN behind the camera."""
    visible: np.ndarray
    """(K,) bool: inside the picture and hidden by nothing."""
    visible_share: float
    """Visible pixels over the pixels of its whole outline, also where it lies outside the picture; for a lane line the
    share of visible points."""
    distance_m: float
    """From the camera to its middle; for a lane line to its nearest point."""


def project(points: np.ndarray, world_to_cam: np.ndarray, camera: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """(..., 3) street points to (..., 2) pixels and (...) depths; NaN pixels behind the camera."""
    cam = points @ world_to_cam[:3, :3].T + world_to_cam[:3, 3]
    z = cam[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = cam[..., :2] / z[..., None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    pixels[z < _NEAR_M] = np.nan
    return pixels, z


def inside_picture(pixels: np.ndarray, camera: Intrinsics) -> np.ndarray:
    """(...) bool: nearest pixel exists."""
    x, y = pixels[..., 0], pixels[..., 1]
    with np.errstate(invalid="ignore"):
        return (x >= -0.5) & (x < camera.width - 0.5) & (y >= -0.5) & (y < camera.height - 0.5)


def label_actors(
    actors: list[Actor], canvas: Canvas, drawn: np.ndarray, rejected: np.ndarray, *, world_to_cam: np.ndarray,
    intrinsics: Intrinsics,
) -> list[StreetObject]:  # fmt: skip
    """Cars and people with at least one visible pixel, in the order given (far to near)."""
    counts, boxes = owner_boxes(canvas.owner, len(actors) + 1)
    found = []
    for actor in actors:
        visible_pixels = int(counts[actor.owner])
        if not visible_pixels:
            continue
        pixels, z = project(actor.keypoints, world_to_cam, intrinsics)
        seen = inside_picture(pixels, intrinsics) & ~actor.hidden
        seen[seen] = _unhidden(pixels[seen], z[seen], actor.owner, canvas)
        whole = _outline_area(actor, world_to_cam, intrinsics, float(drawn[actor.owner]), bool(rejected[actor.owner]))
        found.append(
            StreetObject(
                track_id=actor.track_id, category=actor.category, schema=actor.schema,
                box_xyxy=boxes[actor.owner], points_xy=pixels.astype(np.float32), visible=seen,
                visible_share=min(1.0, visible_pixels / max(whole, 1.0)), distance_m=actor.distance_m,
            )
        )  # fmt: skip
    return found


def owner_boxes(owner: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(count,) pixels per owner and (count, 4) float32 boxes around them, over outer edges of pixels."""
    pixels, extents = _owner_extents(owner, count)
    return pixels, (extents + (-0.5, -0.5, 0.5, 0.5)).astype(np.float32)


@numba.njit(cache=True)
def _owner_extents(owner, count):
    height, width = owner.shape
    pixels = np.zeros(count, np.int64)
    extents = np.zeros((count, 4), np.int64)
    for y in range(height):
        line = owner[y]
        x = 0
        while x < width:
            start, who = x, line[x]
            while x < width and line[x] == who:
                x += 1
            if who > 0:
                if pixels[who] == 0:
                    extents[who, 0], extents[who, 1] = start, y
                pixels[who] += x - start
                extents[who, 0] = min(extents[who, 0], start)
                extents[who, 2] = max(extents[who, 2], x - 1)
                extents[who, 3] = y
    return pixels, extents


def _unhidden(pixels: np.ndarray, z: np.ndarray, owner: int, canvas: Canvas) -> np.ndarray:
    """(n,) bool: nothing else lies more than 0.3 m nearer at the nearest pixel."""
    x, y = np.round(pixels).astype(int).T
    x, y = np.clip(x, 0, canvas.owner.shape[1] - 1), np.clip(y, 0, canvas.owner.shape[0] - 1)
    nearer = canvas.inverse_depth[y, x] > 1.0 / np.maximum(z - 0.3, 0.05)
    return (canvas.owner[y, x] == owner) | ~nearer


def _outline_area(
    actor: Actor, world_to_cam: np.ndarray, intrinsics: Intrinsics, drawn: float, rejected: bool
) -> float:
    """Pixels of the whole outline: as painted where all of it was, else from a small picture of the outline alone."""
    polygons = actor.polygons
    pixels, z = project(polygons.corners.astype(np.float64), world_to_cam, intrinsics)
    used = np.arange(pixels.shape[1])[None] < polygons.corner_count[:, None]
    ahead = ((z > 0.2) | ~used).all(axis=1)
    corners = pixels[used & ahead[:, None]]
    if not len(corners):
        return drawn
    low, high = corners.min(axis=0), corners.max(axis=0)
    inside = bool(inside_picture(np.stack([low, high]), intrinsics).all()) and bool(ahead.all())
    if inside and not rejected:
        return drawn
    scale = _SILHOUETTE_PX / max(float((high - low).max()), 1.0)
    small = np.ascontiguousarray((pixels[ahead] - low) * scale)
    return _union_area(small, polygons.corner_count[ahead], _SILHOUETTE_PX + 1) / scale**2


@numba.njit(cache=True)
def _union_area(corners, counts, size):
    """Pixels of a square picture whose centre lies in any of the convex polygons (N, K, 2)."""
    mask = np.zeros((size, size), np.uint8)
    for n in range(len(counts)):
        for y in range(size):
            low, high = 1e9, -1e9
            for k in range(counts[n]):
                ax, ay = corners[n, k, 0], corners[n, k, 1]
                m = (k + 1) % counts[n]
                bx, by = corners[n, m, 0], corners[n, m, 1]
                if (ay <= y) != (by <= y):
                    x = ax + (y - ay) / (by - ay) * (bx - ax)
                    low, high = min(low, x), max(high, x)
            for x in range(max(0, int(np.ceil(low))), min(size - 1, int(np.floor(high))) + 1):
                mask[y, x] = 1
    return mask.sum()


def label_lanes(
    path: StreetPath, lines: tuple[LaneLine, ...], canvas: Canvas, *, arc_m: float, world_to_cam: np.ndarray,
    intrinsics: Intrinsics,
) -> list[StreetObject]:  # fmt: skip
    """24 points along the longest stretch of each line that lies in the picture within LANE_REACH_M, nearest first."""
    arcs = np.arange(
        max(path.start_m + 1, arc_m - LANE_REACH_M - 10), min(path.end_m - 1, arc_m + LANE_REACH_M + 10), _LANE_STEP_M
    )
    found = []
    for index, line in enumerate(lines):
        points, _ = path.at(arcs, line.lateral_m)
        pixels, z = project(points, world_to_cam, intrinsics)
        good = inside_picture(pixels, intrinsics) & (z > _LANE_NEAR_M) & (z < LANE_REACH_M)
        spaced = _spread_over(_longest_run(good, pixels), arcs, pixels, z)
        if spaced is None:
            continue
        points, _ = path.at(spaced, line.lateral_m)
        pixels, z = project(points, world_to_cam, intrinsics)
        x, y = np.clip(np.round(pixels).astype(int), 0, np.array(canvas.owner.shape[::-1]) - 1).T
        visible = canvas.inverse_depth[y, x] <= 1.0 / np.maximum(0.96 * z - 0.3, 0.05)
        visible &= inside_picture(pixels, intrinsics)
        if visible.any():
            found.append(
                StreetObject(
                    track_id=_LANE_TRACK_ID + index, category="lane", schema="lane24",
                    box_xyxy=np.concatenate([pixels.min(axis=0), pixels.max(axis=0)]).astype(np.float32),
                    points_xy=pixels.astype(np.float32), visible=visible, visible_share=float(visible.mean()),
                    distance_m=float(z[0]),
                )
            )  # fmt: skip
    return found


def _longest_run(good: np.ndarray, pixels: np.ndarray) -> slice:
    """The stretch of consecutive good samples that is longest in the picture."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(np.int8), [0]])))
    best, length = slice(0, 0), 0.0
    for start, end in edges.reshape(-1, 2):
        run = float(np.linalg.norm(np.diff(pixels[start:end], axis=0), axis=1).sum())
        if run > length:
            best, length = slice(int(start), int(end)), run
    return best


def _spread_over(run: slice, arcs: np.ndarray, pixels: np.ndarray, z: np.ndarray) -> np.ndarray | None:
    """(24,) arc lengths, evenly spaced in the picture, nearest first; None when the stretch is too short."""
    if run.stop - run.start < 2:
        return None
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pixels[run], axis=0), axis=1))])
    if length[-1] < _LANE_SHORTEST_PX:
        return None
    spaced = np.interp(np.linspace(0, length[-1], 24), length, arcs[run])
    return spaced if z[run][0] <= z[run][-1] else spaced[::-1]
