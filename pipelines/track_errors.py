"""How well tracks keep their objects, and how steady and how late their points are, against the street's truth.

CLEAR MOT (Bernardin and Stiefelhagen 2008) and IDF1 (Ristani et al. 2016), on boxes that overlap by an IoU of 0.5. What
is found of objects that are not judged (too low, too much hidden) is neither right nor wrong, as in MOTChallenge.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from dataset.street_labels import StreetObject
from labeling.boxes import iou
from labeling.labels import Keypoints
from labeling.schemas import Category
from pipelines.keypoint_errors import BODIES, MatchedFrame, by_frame
from training.street_scores import box_overlaps, is_excused, is_judged

_LEAST_IOU = 0.5
_FORBIDDEN = 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackScore:
    """Counts over all frames of one or more clips; sums are scores again."""

    objects: int
    """Judged objects, frame by frame."""
    missed: int
    phantoms: int
    switches: int
    """How often an object was found under another id than before."""
    found: int
    """Boxes that count, right or wrong."""
    kept: int
    """IDTP: boxes whose id is the one that fits their object best over the whole clip."""

    @property
    def mota(self) -> float:
        """1 is perfect; below 0 where more is wrong than there is to be found; NaN without objects."""
        return 1 - (self.missed + self.phantoms + self.switches) / self.objects if self.objects else float("nan")

    @property
    def idf1(self) -> float:
        """0 to 1; NaN where there was nothing and nothing was found."""
        total = self.objects + self.found
        return 2 * self.kept / total if total else float("nan")

    def __add__(self, other: "TrackScore") -> "TrackScore":
        return TrackScore(
            objects=self.objects + other.objects, missed=self.missed + other.missed,
            phantoms=self.phantoms + other.phantoms, switches=self.switches + other.switches,
            found=self.found + other.found, kept=self.kept + other.kept,
        )  # fmt: skip


NO_TRACKS = TrackScore(objects=0, missed=0, phantoms=0, switches=0, found=0, kept=0)


def track_score(
    found: Iterable[Keypoints], truth: Sequence[Sequence[StreetObject]], *, first_frame: int = 0,
    categories: Sequence[Category] = BODIES,
) -> TrackScore:  # fmt: skip
    """Tracks of one clip against the truth, each category with its like."""
    labels = list(found)
    total = NO_TRACKS
    for category in categories:
        frames = by_frame(
            (label for label in labels if label.category == category), len(truth), first_frame=first_frame
        )
        true = [[thing for thing in things if thing.category == category] for things in truth]
        total += _category_score(frames, true)
    return total


def _category_score(frames: Sequence[Sequence[Keypoints]], truth: Sequence[Sequence[StreetObject]]) -> TrackScore:
    last: dict[int, int] = {}
    together: dict[tuple[int, int], int] = defaultdict(int)
    objects = missed = phantoms = switches = counted = 0
    for labels, things in zip(frames, truth, strict=True):
        overlap = _overlap(labels, things)
        partner = _continued(overlap, labels, things, last)
        asked = np.array([is_judged(thing) for thing in things], bool)
        taken = set(partner[partner >= 0].tolist())
        wrong = [i for i, label in enumerate(labels) if i not in taken and not _excused(label, things)]
        objects += int(asked.sum())
        missed += int((partner[asked] < 0).sum())
        phantoms += len(wrong)
        for thing, row in zip(things, partner, strict=True):
            if row >= 0 and is_judged(thing):
                switches += last.get(thing.track_id, labels[row].track_id) != labels[row].track_id
                last[thing.track_id] = labels[row].track_id
                counted += 1
        counted += len(wrong)
        for n, row in np.argwhere((overlap >= _LEAST_IOU) & asked[:, None]):
            together[things[n].track_id, labels[row].track_id] += 1
    return TrackScore(
        objects=objects, missed=missed, phantoms=phantoms, switches=switches, found=counted, kept=_kept(together)
    )


def _overlap(labels: Sequence[Keypoints], things: Sequence[StreetObject]) -> np.ndarray:
    """(n, m) IoU of n true and m found boxes."""
    true = np.array([thing.box_xyxy for thing in things], np.float64).reshape(-1, 4)
    return iou(true, np.array([label.box_xyxy for label in labels], np.float64).reshape(-1, 4))


def _continued(
    overlap: np.ndarray, labels: Sequence[Keypoints], things: Sequence[StreetObject], last: dict[int, int]
) -> np.ndarray:
    """(n,) the label of each object or -1: who was matched before stays matched, the rest are assigned best."""
    partner = np.full(len(things), -1)
    row_of = {label.track_id: row for row, label in enumerate(labels)}
    for n, thing in enumerate(things):
        row = row_of.get(last.get(thing.track_id, -1), -1)
        if row >= 0 and overlap[n, row] >= _LEAST_IOU and row not in partner:
            partner[n] = row
    cost = np.where(overlap >= _LEAST_IOU, 1 - overlap, _FORBIDDEN)
    cost[partner >= 0] = _FORBIDDEN
    cost[:, partner[partner >= 0]] = _FORBIDDEN
    for n, row in zip(*linear_sum_assignment(cost), strict=True):
        if cost[n, row] < _FORBIDDEN:
            partner[n] = row
    return partner


def _excused(label: Keypoints, things: Sequence[StreetObject]) -> bool:
    boxes = np.array([thing.box_xyxy for thing in things]).reshape(-1, 4)
    return is_excused(label.box_xyxy, things, box_overlaps(label.box_xyxy, boxes)[1])


def _kept(together: dict[tuple[int, int], int]) -> int:
    """The most boxes that a one-to-one assignment of ids to objects explains."""
    if not together:
        return 0
    true, mine = (sorted({pair[side] for pair in together}) for side in (0, 1))
    table = np.zeros((len(true), len(mine)), np.int64)
    for (thing, track), count in together.items():
        table[true.index(thing), mine.index(track)] = count
    rows, columns = linear_sum_assignment(table, maximize=True)
    return int(table[rows, columns].sum())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointSeries:
    """One object over the T frames of a clip, as found and as it was."""

    category: Category
    found: np.ndarray
    """(T, K, 2) pixels; NaN where nothing was found."""
    truth: np.ndarray
    """(T, K, 2) pixels, hidden or not; NaN where it is unknown."""
    visible: np.ndarray
    """(T, K) bool: seen in a judged object."""


def point_series(matched: Sequence[MatchedFrame]) -> list[PointSeries]:
    """The points of every object that was matched at all, over time."""
    shown: dict[int, list[tuple[int, StreetObject, Keypoints | None]]] = defaultdict(list)
    for t, frame in enumerate(matched):
        for thing, label in frame.pairs:
            shown[thing.track_id].append((t, thing, label))
    series = []
    for rows in shown.values():
        if all(label is None for _, _, label in rows):
            continue
        shape = (len(matched), len(rows[0][1].points_xy))
        found, truth, visible = np.full((*shape, 2), np.nan), np.full((*shape, 2), np.nan), np.zeros(shape, bool)
        for t, thing, label in rows:
            truth[t] = thing.points_xy
            visible[t] = thing.visible & is_judged(thing)
            if label is not None:
                mine = label.points[: shape[1]]
                found[t] = np.where(mine[:, 2:] > 0, mine[:, :2], np.nan)
        series.append(PointSeries(category=rows[0][1].category, found=found, truth=truth, visible=visible))
    return series


def jitter_px(series: Iterable[PointSeries]) -> float:
    """How much visible points shake: the noise, pixels a frame and axis, that explains the second differences of their
    errors (white noise of 1 px gives 1); NaN where nothing was seen three frames in a row.

    Second differences know neither where a point is nor how fast it goes: what remains shakes.
    """
    bends = []
    for one in series:
        error = np.where(one.visible[..., None], one.found - one.truth, np.nan)
        bends.append(np.diff(error, n=2, axis=0).ravel())
    values = np.concatenate(bends) if bends else np.zeros(0)
    values = values[np.isfinite(values)]
    return float(np.sqrt((values**2).mean() / 6)) if len(values) else float("nan")


def lag_frames(series: Iterable[PointSeries], *, points: Sequence[int] | None = None, upsampled: int = 20) -> float:
    """The delay, frames, that explains the found points best as late true ones; negative where they are early.

    A point that is always found beside its place is not late: what is constant in its errors does not count, so that a
    delay shows where a motion changes.

    Args:
        series: objects that move: what stands still is as well explained by any delay.
        points: indices of the points to look at; all by default.
        upsampled: steps per frame.
    """
    shifts = np.arange(-3 * upsampled, 3 * upsampled + 1) / upsampled
    errors: list[np.ndarray] = []
    for one in series:
        chosen = range(one.truth.shape[1]) if points is None else points
        errors += [_late_errors(one, k, shifts) for k in chosen]
    pooled = np.concatenate(errors, axis=1) if errors else np.zeros((len(shifts), 0))
    if not pooled.shape[1]:
        return float("nan")
    return float(shifts[int(np.argmin(pooled.mean(axis=1)))])


def _late_errors(one: PointSeries, k: int, shifts: np.ndarray) -> np.ndarray:
    """(S, n) distances of one point from where it truly was each delay earlier, where all delays can be judged."""
    known = np.flatnonzero(np.isfinite(one.truth[:, k]).all(axis=1))
    if len(known) < 8:
        return np.zeros((len(shifts), 0))
    times = np.flatnonzero(np.isfinite(one.found[:, k]).all(axis=1) & one.visible[:, k])
    times = times[(times >= known[0] + 3) & (times <= known[-1] - 3)]
    late = times[None] - shifts[:, None]
    if not len(times):
        return np.zeros((len(shifts), 0))
    apart = [np.interp(late, known, one.truth[known, k, axis]) - one.found[times, k, axis] for axis in (0, 1)]
    return np.hypot(*(error - np.median(error, axis=1, keepdims=True) for error in apart))
