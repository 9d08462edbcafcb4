"""Which streets the street models learn from, which choose their thresholds, and which judge them."""

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import chain
from multiprocessing import get_context

import cv2
import numpy as np

from dataset.street import Scenario, Street, StreetConfig
from training.street_pool import ObjectTruth, RenderPlan, truths_of

TRAIN_SEED, VALIDATION_SEED, HELD_OUT_SEED = 20_000, 90_000, 95_000
"""First street seed of each set: no street is in two of them. Thresholds are chosen on the validation set alone."""
PLANNED: tuple[Scenario, ...] = (
    "drive", "traffic", "crossing", "stop_and_go", "parked", "traffic", "turn", "cross_traffic", "drive", "crossing",
    "traffic", "lead_leaves", "parked", "fast", "sharp_turn", "reverse", "empty", "wall", "road_only", "still",
)  # fmt: skip
"""Scenarios in turn; busy ones come more often."""
_LEARNT: tuple[Scenario, ...] = (
    *PLANNED, "cross_traffic", "crossing", "stop_and_go", "crossing", "cross_traffic", "crossing", "cross_traffic",
    "crossing",
)  # fmt: skip
"""Scenarios in turn for learners: cars and people are seldom seen from the side, and near ones least of all."""
_WALKERS = (None, 10.0, 20.0, 30.0)
"""People per 100 m that learners see: streets have few, and half of what is to be learnt is people."""
_DESERTED: tuple[Scenario, ...] = ("empty", "wall", "road_only")


def plan_streets(first_seed: int, streets: int, *, frames: int = 12, every: int = 9) -> list[RenderPlan]:
    """``streets`` streets of consecutive seeds, scenarios in turn, every ``every``-th frame of each.

    Three in four are seen by the standard camera, the others from another height, pitch and focal length.

    Args:
        first_seed: of the first street.
        streets: how many.
        frames: of each street.
        every: step between them.
    """
    plans = []
    for index in range(streets):
        seed = first_seed + index
        config = StreetConfig(seed=seed, scenario=PLANNED[index % len(PLANNED)], frames=frames * every)
        if index % 4 == 3:
            config = _other_camera(config, np.random.default_rng((seed, 11)))
        plans.append(_plan(config, index, frames=frames, every=every))
    return plans


def plan_lessons(first_seed: int, streets: int, *, frames: int, every: int) -> list[RenderPlan]:
    """As ``plan_streets``, for learners: more of what is hard, most streets crowded, every other from another camera.

    The camera is drawn for each street by itself: were every fourth street's another one, each scenario would always be
    seen by the same kind of camera, since their number is a multiple of four.
    """
    plans = []
    for index in range(streets):
        seed = first_seed + index
        rng = np.random.default_rng((seed, 13))
        config = StreetConfig(seed=seed, scenario=_LEARNT[index % len(_LEARNT)], frames=frames * every)
        if config.scenario not in _DESERTED:
            config = replace(config, walkers_per_100_m=_WALKERS[int(rng.integers(len(_WALKERS)))])
        if rng.random() < 0.5:
            config = _other_camera(config, rng)
        plans.append(_plan(config, index, frames=frames, every=every))
    return plans


def _other_camera(config: StreetConfig, rng: np.random.Generator) -> StreetConfig:
    return replace(
        config, camera_height_m=rng.uniform(1.2, 1.9), camera_pitch_deg=rng.uniform(-1, 5),
        focal_px=rng.uniform(850, 1250),
    )  # fmt: skip


def _plan(config: StreetConfig, index: int, *, frames: int, every: int) -> RenderPlan:
    return RenderPlan(config=config, frames=tuple(range(index % every, frames * every, every)))


def judging_frames(
    first_seed: int, streets: int, frames: int, *, workers: int = 1
) -> Iterator[tuple[np.ndarray, tuple[ObjectTruth, ...]]]:
    """Rendered frames ((H, W, 3) uint8 RGB) with their truth, 17 frames apart, ``frames`` of each street.

    Args:
        first_seed: of the first street.
        streets: how many.
        frames: of each.
        workers: processes that render ahead, streets in parallel; 1 renders here. The frames are the same.
    """
    plans = plan_streets(first_seed, streets, frames=frames, every=17)
    if workers == 1:
        yield from chain.from_iterable(map(_whole_frames, plans))
        return
    spawn = get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        yield from chain.from_iterable(pool.map(_whole_frames, plans))


def _whole_frames(plan: RenderPlan) -> list[tuple[np.ndarray, tuple[ObjectTruth, ...]]]:
    street = Street(plan.config)
    frames = [street.render(index) for index in plan.frames]
    return [(frame.rgb, truths_of(frame)) for frame in frames]
