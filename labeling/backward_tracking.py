"""Backward in time: what a track is seen to be later tells what was seen of it before.

A run is labelled whole. Someone who comes out from behind a car is at first too unsure to begin a track; once the
detector is sure, the sightings before are those of somebody known. The forward association is therefore run once more
from the last look to the first, in which only believed tracks begin and what no believed track holds may continue them.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from labeling.box_tracker import BoxTracker, TrackerSettings
from labeling.carrying import interpolate_gaps
from labeling.labels import UNTRACKED, Keypoints
from labeling.schemas import Category
from labeling.tracking import TrackedLook

_REACH = TrackerSettings(max_lost_frames=12)
"""As the forward association, over half a second: what was not seen for longer began anew."""
_OWNED, _FREE = 1.0, 0.0
"""Scores above and below the tracker's ``high_score``."""


def reach_back(
    looks: Sequence[TrackedLook], believed: Collection[int], *, categories: Sequence[Category] = ("car", "person")
) -> list[Keypoints]:
    """What was seen of believed tracks in looks in which the forward association gave them nothing.

    Args:
        looks: of one run without a cut, in the order of their frames.
        believed: ids of the tracks that may reach back; labels of all others are free to be theirs.
        categories: which have boxes to be associated by.

    Returns:
        Labels with the ids of the tracks that they belong to, none of which has another label in its look; and those
        between such a label and the track's own or another in the next look or the last, on straight lines.
    """
    return [label for category in categories for label in _of_category(looks, frozenset(believed), category)]


def _of_category(looks: Sequence[TrackedLook], believed: frozenset[int], category: Category) -> list[Keypoints]:
    groups = [[label for label in look.labels if label.category == category] for look in looks]
    if all(label.track_id in believed for group in groups for label in group):
        return []
    tracker = BoxTracker(_REACH)
    names: dict[int, int] = {}
    found: list[Keypoints] = []
    ahead: dict[int, _Sighting] = {}
    for number in reversed(range(len(looks))):
        look, group = looks[number], groups[number]
        later = looks[number + 1] if number + 1 < len(looks) else None
        owned = [label.track_id in believed for label in group]
        ids = tracker.update(
            np.array([label.box_xyxy for label in group], np.float64).reshape(-1, 4),
            np.where(owned, _OWNED, _FREE),
            frame_step=later.frame - look.frame if later else 1,
            previous_to_current=np.linalg.inv(later.turn) if later else None,
        )
        taken = {label.track_id for label in group}
        for label, backward, mine in zip(group, ids.tolist(), owned, strict=True):
            if mine:
                # Who changes hands takes the name along: no two backward tracks reach back for one.
                names = {i: name for i, name in names.items() if name != label.track_id} | {backward: label.track_id}
                sighting = _Sighting(number, label, reached=False)
            elif backward != UNTRACKED and backward in names and names[backward] not in taken:
                sighting = _Sighting(number, label.renumbered(track_id=names[backward]), reached=True)
                found.append(sighting.label)
            else:
                continue
            after = ahead.get(sighting.label.track_id)
            if after and after.look == number + 1 and (sighting.reached or after.reached):
                found += interpolate_gaps([sighting.label], [after.label])
            ahead[sighting.label.track_id] = sighting
    return found


class _Sighting(NamedTuple):
    """Of a track, in one look."""

    look: int
    label: Keypoints
    reached: bool
    """By going backwards; the forward association gave the track nothing here."""
