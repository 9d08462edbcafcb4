"""How one box moves: four constant-velocity Kalman filters, and the line that it goes on along behind what hides it.

A state is (4, 2): centre x, centre y, log width, log height, each with its change per frame; a covariance is (4, 2, 2).
Sightings are (n, 5): frames since each, then centre x, y, log width and height. Compiled, since tracks are many and
their numbers few: calls of numpy would cost ten times as much as what they do.
"""

import math

import numpy as np
from numba import njit

_LEVER_FRAMES = 8
"""Two sightings tell a speed when they are at least so far apart: boxes shake, and a walker's swings with the legs."""
_SLOW_PX = 0.5
"""Per frame: what is slower has no direction."""
_WHOLE_SHARE = 0.75
"""A box of less than this share of its usual width or height shows a part: the picture's border or a column cuts it."""
_STEADY_GROWTH = 0.01
"""Share by which the height of what comes neither nearer nor goes may change per frame: such objects move evenly."""
_UNSEEN_GROWTH = 0.8
"""Share that is left of a rate of growth after a frame that nothing confirms: it is measured badly."""
_PLACE_NOISE, _SIZE_NOISE = 0.012, 0.006
"""White acceleration, in shares of the object's size per frame squared."""
_PLACE_SIGMA, _SIZE_SIGMA = 0.03, 0.04
"""Of a detector's boxes, in shares of their size."""
_START_SIGMA = 0.1
"""Of a new track's state and of its changes per frame."""


@njit(cache=True)
def measurement(box_xyxy: np.ndarray) -> np.ndarray:
    """(4,) centre x, y, log width and height of a box, (4,) float64."""
    measured = np.empty(4)
    for axis in range(2):
        measured[axis] = (box_xyxy[axis] + box_xyxy[axis + 2]) / 2
        measured[axis + 2] = math.log(max(box_xyxy[axis + 2] - box_xyxy[axis], 1e-3))
    return measured


@njit(cache=True)
def start(box_xyxy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """State and covariance of what was seen once, (4,) float64."""
    mean, covariance = np.zeros((4, 2)), np.zeros((4, 2, 2))
    mean[:, 0] = measurement(box_xyxy)
    for axis in range(4):
        spread = _START_SIGMA * (_mean_side(box_xyxy) if axis < 2 else 1.0)
        covariance[axis, 0, 0] = covariance[axis, 1, 1] = spread**2
    return mean, covariance


@njit(cache=True)
def predict(mean: np.ndarray, covariance: np.ndarray, steps: int, seen: bool) -> None:
    """Let a state go on for ``steps`` frames, in place; ``seen``: in the frame that it comes from.

    Bar-Shalom et al. 2001, eq. 6.3.2-4.
    """
    if not seen:
        mean[2:, 1] *= _UNSEEN_GROWTH**steps
    for axis in range(4):
        mean[axis, 0] += steps * mean[axis, 1]
    size = math.exp(min(max((mean[2, 0] + mean[3, 0]) / 2, -3.0), 9.0))
    for axis in range(4):
        strength = (_PLACE_NOISE * size if axis < 2 else _SIZE_NOISE) ** 2
        one = covariance[axis]
        one[0, 0] += steps * (one[0, 1] + one[1, 0] + steps * one[1, 1]) + strength * steps**3 / 3
        one[0, 1] += steps * one[1, 1] + strength * steps**2 / 2
        one[1, 0] = one[0, 1]
        one[1, 1] += strength * steps


@njit(cache=True)
def correct(mean: np.ndarray, covariance: np.ndarray, box_xyxy: np.ndarray) -> None:
    """Take a box, (4,) float64, into a state, in place."""
    measured = measurement(box_xyxy)
    for axis in range(4):
        sigma = _PLACE_SIGMA * _mean_side(box_xyxy) if axis < 2 else _SIZE_SIGMA
        one = covariance[axis]
        innovation, total = measured[axis] - mean[axis, 0], one[0, 0] + sigma**2
        gain, gain_of_change = one[0, 0] / total, one[1, 0] / total
        mean[axis, 0] += gain * innovation
        mean[axis, 1] += gain_of_change * innovation
        one[1, 1] -= gain_of_change * one[0, 1]
        one[0, 0] *= 1 - gain
        one[0, 1] *= 1 - gain
        one[1, 0] = one[0, 1]


@njit(cache=True)
def move_with_camera(mean: np.ndarray, past: np.ndarray, previous_to_current: np.ndarray) -> None:
    """Move a state's place and its sightings, in place, as a (3, 3) homography moves far points."""
    mean[0, 0], mean[1, 0] = _mapped(mean[0, 0], mean[1, 0], previous_to_current)
    for n in range(len(past)):
        past[n, 1], past[n, 2] = _mapped(past[n, 1], past[n, 2], previous_to_current)


@njit(cache=True)
def seen_whole(past: np.ndarray) -> np.ndarray:
    """(n,) bool: which sightings are of the whole object."""
    least = math.log(_WHOLE_SHARE)
    width, height = np.median(past[:, 3]) + least, np.median(past[:, 4]) + least
    return (past[:, 3] >= width) & (past[:, 4] >= height)


@njit(cache=True)
def line(past: np.ndarray) -> tuple[bool, np.ndarray]:
    """State of an object that goes on as it went while it was seen whole, and whether anything tells how.

    Its last boxes before something hides it are what was left in view: their middle stops at the edge of that. The line
    through most sightings does not (Theil 1950, Sen 1968: the median of the slopes of pairs, of which three in ten may
    be wrong).
    """
    state, places = np.zeros((4, 2)), past[seen_whole(past)]
    slopes = np.empty((4, len(places) * (len(places) - 1) // 2))
    pairs = 0
    for first in range(len(places)):
        for second in range(first + 1, len(places)):
            apart = places[first, 0] - places[second, 0]
            if apart >= _LEVER_FRAMES:
                for axis in range(4):
                    slopes[axis, pairs] = (places[second, axis + 1] - places[first, axis + 1]) / apart
                pairs += 1
    if not pairs or abs(np.median(slopes[3, :pairs])) > _STEADY_GROWTH:
        return False, state
    for axis in range(2):
        state[axis, 1] = np.median(slopes[axis, :pairs])
        state[axis, 0] = np.median(places[:, axis + 1] + state[axis, 1] * places[:, 0])
        state[axis + 2, 0] = np.median(places[:, axis + 3])
    return True, state


@njit(cache=True)
def turned_back(mean: np.ndarray, past: np.ndarray, boxes_xyxy: np.ndarray, lost: bool) -> np.ndarray:
    """(N,) by how much of its size each of (N, 4) boxes lies behind where an object is expected, against its motion.

    What was just seen whole may turn: 0.
    """
    behind = np.zeros(len(boxes_xyxy))
    known, state = True, mean
    if not lost:
        # Of which only a part was just seen: whole, it has a line.
        if seen_whole(past)[-1]:
            return behind
        known, state = line(past)
    if not known:
        return behind
    speed = math.hypot(state[0, 1], state[1, 1])
    if speed < _SLOW_PX:
        return behind
    size = math.exp(min(max(min(state[2, 0], state[3, 0]), -3.0), 9.0))
    for n in range(len(boxes_xyxy)):
        ahead = 0.0
        for axis in range(2):
            ahead += ((boxes_xyxy[n, axis] + boxes_xyxy[n, axis + 2]) / 2 - state[axis, 0]) * state[axis, 1]
        behind[n] = min(max(-ahead / speed / size, 0.0), 1.0)
    return behind


@njit(cache=True)
def _mean_side(box_xyxy: np.ndarray) -> float:
    return (max(box_xyxy[2] - box_xyxy[0], 1e-3) + max(box_xyxy[3] - box_xyxy[1], 1e-3)) / 2


@njit(cache=True)
def _mapped(x: float, y: float, homography: np.ndarray) -> tuple[float, float]:
    depth = homography[2, 0] * x + homography[2, 1] * y + homography[2, 2]
    return (
        (homography[0, 0] * x + homography[0, 1] * y + homography[0, 2]) / depth,
        (homography[1, 0] * x + homography[1, 1] * y + homography[1, 2]) / depth,
    )
