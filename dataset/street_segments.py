"""What each pixel of a street frame shows: one of a few classes, exact."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from dataset.street_actors import Actor
from dataset.street_drives import StreetPath
from dataset.street_polygons import Canvas
from labeling.camera import Intrinsics

SEGMENTS = ("sky", "ground", "thing", "car", "person")
"""Classes by index: ``thing`` is a house, a tree, a pole; ``ground`` is road, pavement and meadow."""
_NEAREST_SKY = 1e-4
_GROUND_M = 0.3


def segment_canvas(
    canvas: Canvas, actors: Sequence[Actor], *, path: StreetPath, cam_to_street: np.ndarray, intrinsics: Intrinsics
) -> np.ndarray:
    """(H, W) uint8: index into ``SEGMENTS`` of what was painted.

    Args:
        canvas: after painting.
        actors: who was painted, by their owner numbers.
        path: the road, which the ground follows up and down.
        cam_to_street: (4, 4).
        intrinsics: of the camera.
    """
    classes = np.full(canvas.owner.shape, SEGMENTS.index("thing"), np.uint8)
    x, y = np.meshgrid(np.arange(intrinsics.width), np.arange(intrinsics.height))
    ray = np.stack([(x - intrinsics.cx) / intrinsics.fx, (y - intrinsics.cy) / intrinsics.fy, np.ones(x.shape)], -1)
    inverse = canvas.inverse_depth
    # The street's y axis points down, and the ground lies at minus the path's elevation.
    place = cam_to_street[:3, 3] + (ray @ cam_to_street[:3, :3].T) / np.maximum(inverse, _NEAREST_SKY)[..., None]
    classes[place[..., 1] > -_ground_m(path, place[..., [0, 2]]) - _GROUND_M] = SEGMENTS.index("ground")
    classes[inverse <= _NEAREST_SKY] = SEGMENTS.index("sky")
    for actor in actors:
        classes[canvas.owner == actor.owner] = SEGMENTS.index(actor.category)
    return classes


def _ground_m(path: StreetPath, places_xz: np.ndarray) -> np.ndarray:
    """Height of the ground at (..., 2) places: the path's, where it comes nearest."""
    if np.ptp(path.elevation) < 1e-6:
        return np.full(places_xz.shape[:-1], path.elevation[0])
    return path.elevation[KDTree(path.points_xz).query(places_xz)[1]]
