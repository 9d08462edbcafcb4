"""Which streets the street models learn from, which choose their thresholds, and which judge them."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from dataset.street import Scenario, Street, StreetConfig
from training.street_pool import ObjectTruth, RenderPlan, truths_of

TRAIN_SEED, VALIDATION_SEED, HELD_OUT_SEED = 20_000, 90_000, 95_000
"""First street seed of each set: no street is in two of them. Thresholds are chosen on the second alone."""
PLANNED: tuple[Scenario, ...] = (
    "drive", "traffic", "crossing", "stop_and_go", "parked", "traffic", "turn", "cross_traffic", "drive", "crossing",
    "traffic", "lead_leaves", "parked", "fast", "sharp_turn", "reverse", "empty", "wall", "road_only", "still",
)  # fmt: skip
"""Scenarios in turn; busy ones come more often."""
_WALKERS = (None, 10.0, 20.0, 30.0)
"""People per 100 m that learners see: streets have few, and half of what is to be learnt is people."""
_DESERTED: tuple[Scenario, ...] = ("empty", "wall", "road_only")


def plan_streets(
    first_seed: int, streets: int, *, frames: int = 12, every: int = 9, crowded: bool = False
) -> list[RenderPlan]:
    """``streets`` streets of consecutive seeds, scenarios in turn, every ``every``-th frame of each.

    Three in four are seen by the standard camera, the others from another height, pitch and focal length.

    Args:
        first_seed: of the first street.
        streets: how many.
        frames: of each street.
        every: step between them.
        crowded: most streets get more people than their scenario has.
    """
    plans = []
    for index in range(streets):
        seed = first_seed + index
        config = StreetConfig(seed=seed, scenario=PLANNED[index % len(PLANNED)], frames=frames * every)
        if index % 4 == 3:
            rng = np.random.default_rng((seed, 11))
            config = replace(
                config, camera_height_m=rng.uniform(1.2, 1.9), camera_pitch_deg=rng.uniform(-1, 5),
                focal_px=rng.uniform(850, 1250),
            )  # fmt: skip
        if crowded and config.scenario not in _DESERTED:
            walkers = _WALKERS[int(np.random.default_rng((seed, 13)).integers(len(_WALKERS)))]
            config = replace(config, walkers_per_100_m=walkers)
        plans.append(RenderPlan(config=config, frames=tuple(range(index % every, frames * every, every))))
    return plans


def judging_frames(first_seed: int, streets: int, frames: int) -> Iterator[tuple[np.ndarray, tuple[ObjectTruth, ...]]]:
    """Rendered frames ((H, W, 3) uint8 RGB) with their truth, 17 frames apart, ``frames`` of each street."""
    for plan in plan_streets(first_seed, streets, frames=frames, every=17):
        street = Street(plan.config)
        for index in plan.frames:
            frame = street.render(index)
            yield frame.rgb, truths_of(frame)
