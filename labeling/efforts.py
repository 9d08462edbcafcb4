"""How often the networks look: the efforts, and the rhythm that follows what was seen.

Looks come closer together when objects appear, vanish, or are not where flow put them; a network that has seen nothing
for a second looks twice per second.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from labeling.carrying import COARSE, FINE, FlowWindow, box_diagonal
from labeling.labels import Keypoints

Effort = Literal["fast", "balanced", "exact"]


@dataclass(frozen=True, slots=True, kw_only=True)
class EffortSettings:
    """How often the networks look. Gaps are in frames of the 24 fps grid; 1 is every frame."""

    max_gap: int
    """Longest time between two looks: half a second at most, so that nothing is shown that was not seen 0.25 s away."""
    max_person_gap: int
    """The same while someone walks: legs swing at about 1 Hz and do not go straight."""
    max_lane_gap: int
    """The same for lane lines, which have no points to follow."""
    news_gap: int = 12
    """The same after something near came or went."""
    flow_step: int = 1
    """Frames between two steps of the optical flow that carries points; 0 for none: points go straight then."""
    flow_window: FlowWindow = FINE
    """What flow compares."""
    max_bend: float = 0.03
    """Share of its size by which an object's growth may depart from a straight line where no flow follows it."""
    max_miss: float = 0.05
    """Share of the box diagonal by which carried points may miss the next look before looks come closer together."""
    quiet_frames: int = 24
    """A network that has seen nothing for so long looks only every ``quiet_gap`` frames."""
    quiet_gap: int = 12
    sure_share: float = 1.0
    """Of the detector's sure scores, what counts as sure: who looks rarely must believe sooner."""
    sure_looks: int = 2
    """Looks in a row that must be sure of an object for it to be believed; where they are rare, one must do."""


EFFORTS: dict[Effort, EffortSettings] = {
    "exact": EffortSettings(max_gap=1, max_person_gap=1, max_lane_gap=1, flow_step=0, quiet_gap=1),
    "balanced": EffortSettings(max_gap=5, max_person_gap=5, max_lane_gap=12, news_gap=3, flow_step=2, max_miss=0.04),
    "fast": EffortSettings(
        max_gap=12,
        max_person_gap=10,
        max_lane_gap=12,
        news_gap=8,
        flow_step=5,
        flow_window=COARSE,
        max_bend=0.05,
        max_miss=0.12,
        sure_share=0.6,
        sure_looks=1,
    ),
}

_WAITING_GAP = 6
"""While nothing has been seen for a moment only; where nothing has ever been seen it is quiet from the start."""
_NEAR_PX = 48.0
"""Height of what is near: it brings looks closer together when it comes or goes; what is far may wait."""


class Rhythm:
    """When to look again.

    Args:
        settings: the effort.
        flows: whether flow carries what this look sees.
    """

    def __init__(self, settings: EffortSettings, *, flows: bool) -> None:
        self.settings, self.flows = settings, flows
        # What flow will carry is looked at again soon, to see whether it holds; lanes have nothing to try.
        self.gap = max(1, settings.max_gap // 2) if flows else settings.max_lane_gap
        """Frames from the last look to the next."""
        self._last_seen: int | None = None

    def after(self, seen: Sequence[Keypoints], before: Sequence[Keypoints], *, miss: float, frame: int) -> None:
        """Choose the next gap.

        Args:
            seen: what the look at ``frame`` saw, tracked.
            before: what the look before it saw; nothing at the first.
            miss: how far carried points missed this look, in box diagonals.
            frame: grid number.
        """
        if seen:
            self._last_seen = frame
        self.gap = max(1, int(self._next(seen, before, miss, frame)))

    def _next(self, seen: Sequence[Keypoints], before: Sequence[Keypoints], miss: float, frame: int) -> float:
        settings = self.settings
        if not seen:
            quiet = self._last_seen is None or frame - self._last_seen >= settings.quiet_frames
            return settings.quiet_gap if quiet else min(settings.max_gap, _WAITING_GAP)
        gap = 1.5 * self.gap + 1 if miss <= settings.max_miss else self.gap / 2
        old, new = ({label.track_id: label for label in labels} for labels in (before, seen))
        if any(_is_near(new.get(i) or old[i]) for i in set(old) ^ set(new)):
            gap = min(gap, settings.news_gap)
        return min(gap, *(self._longest(label, old.get(label.track_id)) for label in seen))

    def _longest(self, label: Keypoints, before: Keypoints | None) -> float:
        """How long one object may go without a look."""
        if label.category == "lane":
            return self.settings.max_lane_gap
        longest = self.settings.max_person_gap if label.category == "person" else self.settings.max_gap
        if self.flows or before is None:
            return longest
        return min(longest, straight_gap(before, label, max_bend=self.settings.max_bend))


def straight_gap(before: Keypoints, after: Keypoints, *, max_bend: float) -> float:
    """How many frames an object may be taken to grow evenly: size is 1 / distance, which bends by (rate gap)^2 / 4."""
    frames = after.frame - before.frame
    rate = abs(math.log(box_diagonal(after.box_xyxy) / box_diagonal(before.box_xyxy))) / max(1, frames)
    return math.sqrt(4 * max_bend) / rate if rate > 0 else math.inf


def _is_near(label: Keypoints) -> bool:
    return label.category != "lane" and label.box_xyxy[3] - label.box_xyxy[1] >= _NEAR_PX
