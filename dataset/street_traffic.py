"""Who moves on the synthetic street: lead and oncoming cars, parked cars, cross traffic, people who walk and cross.

Every actor's place is a pure function of the frame; nothing depends on what was rendered before.
"""

from dataclasses import dataclass, field

import numpy as np

from dataset.street_car_sizes import CAR_COLOURS, CAR_SHAPES, CarShape
from dataset.street_drives import Drive
from dataset.street_people import PersonLook, random_look
from dataset.street_scene import StreetPlan


@dataclass(frozen=True, slots=True, kw_only=True)
class Density:
    """How busy a street is; shares and numbers per 100 m."""

    lead: float = 0.0
    """Chance of a car ahead in the camera's lane."""
    same: float = 0.0
    """Share of places taken in the other lanes of the same direction."""
    oncoming: float = 0.0
    parked: float = 0.0
    """Share of parking places taken."""
    walkers: float = 0.0
    """People per 100 m of pavement, on each side."""
    cross: bool = False
    """Cars that cross ahead of the camera."""
    crossing: bool = False
    """Two people cross ahead of the camera; one passes behind an advertising column for a second."""
    lead_leaves: bool = False
    """A lead car 8 m ahead drives off after a second."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CarActor:
    """A car's way."""

    track_id: int
    shape: CarShape
    colour: np.ndarray
    """(3,) float32, RGB."""
    position: np.ndarray
    """(T, 3) float64, on the ground, street axes; NaN while it is not there."""
    heading: np.ndarray
    """(T,) float64, radians; 0 looks along z, positive turns right."""
    braking: np.ndarray
    """(T,) bool."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PersonActor:
    """A person's way."""

    track_id: int
    look: PersonLook
    position: np.ndarray
    """(T, 3) float64."""
    heading: np.ndarray
    """(T,) float64."""
    walked_m: np.ndarray
    """(T,) float64: drives the gait."""
    speed_mps: float


@dataclass
class _Cast:
    drive: Drive
    fps: float
    rng: np.random.Generator
    cars: list[CarActor] = field(default_factory=list)
    people: list[PersonActor] = field(default_factory=list)

    @property
    def time(self) -> np.ndarray:
        return np.arange(len(self.drive.arc_m)) / self.fps

    def car_on_road(self, arc: np.ndarray, lateral: float, direction: int, shape: CarShape | None = None) -> None:
        """A car that follows the road at arc lengths (T,)."""
        path = self.drive.path
        there = (arc > path.start_m + 3) & (arc < path.end_m - 3)
        if not there.any():
            return
        position, heading = path.at(arc, lateral)
        self.car_at(np.where(there[:, None], position, np.nan), heading + (0.0 if direction > 0 else np.pi), shape)

    def car_at(self, position: np.ndarray, heading: np.ndarray, shape: CarShape | None = None) -> None:
        """A car at given places."""
        speed = np.linalg.norm(np.diff(np.nan_to_num(position), axis=0, prepend=position[:1]), axis=1) * self.fps
        smooth = np.convolve(np.pad(speed, 4, mode="edge"), np.full(9, 1 / 9), mode="valid")
        slowing = np.gradient(smooth) * self.fps if len(smooth) > 1 else np.zeros_like(smooth)
        self.cars.append(CarActor(
            track_id=len(self.cars) + 1, shape=shape or CAR_SHAPES[int(self.rng.integers(len(CAR_SHAPES)))],
            colour=CAR_COLOURS[int(self.rng.integers(len(CAR_COLOURS)))], position=position,
            heading=np.broadcast_to(heading, speed.shape), braking=slowing < -0.6,
        ))  # fmt: skip

    def person(self, position: np.ndarray, heading: np.ndarray, walked: np.ndarray, speed: float) -> None:
        """Somebody at given places (T, 3)."""
        self.people.append(PersonActor(
            track_id=501 + len(self.people), look=random_look(self.rng), position=position,
            heading=np.broadcast_to(heading, walked.shape), walked_m=walked, speed_mps=speed,
        ))  # fmt: skip


def cast_street(
    drive: Drive, plan: StreetPlan, density: Density, rng: np.random.Generator, *, fps: float
) -> tuple[list[CarActor], list[PersonActor]]:
    """Everybody on the street, for all frames of a drive."""
    cast = _Cast(drive=drive, fps=fps, rng=rng)
    if density.lead_leaves:
        _lead_that_leaves(cast)
    elif rng.random() < density.lead:
        _leads(cast)
    for lateral, direction in plan.lanes:
        _lane_traffic(cast, lateral, direction, density.same if direction > 0 else density.oncoming)
    if density.cross:
        _cross_traffic(cast)
    _parked(cast, plan, density.parked)
    _walkers(cast, plan, density.walkers)
    if density.crossing:
        _crossing_people(cast)
    return cast.cars, cast.people


def _leads(cast: _Cast) -> None:
    """One or two cars ahead in the camera's lane, whose distance breathes with the speed."""
    arc, time, rng = cast.drive.arc_m, cast.time, cast.rng
    gap = float(rng.uniform(11, 22))
    sway = 0.18 * gap * np.sin(time * float(rng.uniform(0.25, 0.5)) + float(rng.uniform(0, 6)))
    cast.car_on_road(arc + gap + sway, float(rng.normal(0, 0.12)), 1)
    if rng.random() < 0.5:
        cast.car_on_road(arc + gap * 1.3 + sway + float(rng.uniform(9, 20)), float(rng.normal(0, 0.12)), 1)


def _lead_that_leaves(cast: _Cast) -> None:
    driven = 0.5 * 2.0 * np.maximum(0.0, cast.time - 1.0) ** 2
    cast.car_on_road(cast.drive.arc_m[0] + 8.0 + driven, 0.0, 1)


def _lane_traffic(cast: _Cast, lateral: float, direction: int, share: float) -> None:
    arc, time, rng = cast.drive.arc_m, cast.time, cast.rng
    if share <= 0:
        return
    wobble = float(rng.normal(0, 0.1))
    if direction > 0:
        pace, phase = float(rng.uniform(0.2, 0.5)), float(rng.uniform(0, 6))
        for place in np.arange(-14.0, 110.0, 14.0):
            if rng.random() < share:
                cast.car_on_road(
                    arc + place + rng.uniform(-2, 2) + 1.8 * np.sin(pace * time + phase), lateral + wobble, 1
                )
        return
    speed = float(rng.uniform(6, 12))
    first = arc.min() - 20 + float(rng.uniform(0, 16))
    for place in np.arange(first, arc.max() + speed * time[-1] + 130, 16.0):
        if rng.random() < share:
            cast.car_on_road(place + float(rng.uniform(-3, 3)) - speed * time, lateral + wobble, -1)


def _cross_traffic(cast: _Cast) -> None:
    """Cars that pass from one side to the other, 7 and 10.5 m ahead of the camera's start."""
    rng, time = cast.rng, cast.time
    for ahead, sign in ((7.0, 1.0), (10.5, -1.0)):
        spot, heading = cast.drive.path.at(cast.drive.arc_m[0] + ahead)
        right = np.array([np.cos(heading), 0.0, -np.sin(heading)])
        speed = float(rng.uniform(4, 7))
        for start in np.arange(-12.0, speed * time[-1] + 20, float(rng.uniform(6.5, 9))):
            along = sign * (speed * time - start - 8.0)
            inside = np.abs(along) < 45
            position = np.where(inside[:, None], spot + right * along[:, None], np.nan)
            cast.car_at(position, np.full(len(time), heading + sign * np.pi / 2))


def _parked(cast: _Cast, plan: StreetPlan, share: float) -> None:
    rng, path, arc = cast.rng, cast.drive.path, cast.drive.arc_m
    if share <= 0:
        return
    for side, lateral in ((1, plan.right_m - 1.15), (-1, plan.left_m + 1.15)):
        for place in np.arange(max(path.start_m, arc.min() - 25), min(path.end_m, arc.max() + 130), 6.6):
            bend = float(path.curvature(np.array(place))) * side
            if rng.random() < share and bend < 0.5 / abs(lateral):
                spot = np.full(len(arc), place + float(rng.uniform(-0.4, 0.4)))
                cast.car_on_road(spot, lateral + side * float(rng.normal(0, 0.06)), side)


def _walkers(cast: _Cast, plan: StreetPlan, per_100_m: float) -> None:
    rng, path, time, arc = cast.rng, cast.drive.path, cast.time, cast.drive.arc_m
    start, end = arc.min() - 15, arc.max() + 90
    for kerb, side in ((plan.right_m, 1), (plan.left_m, -1)):
        for _ in range(round(per_100_m * (end - start) / 100)):
            lateral = kerb + side * float(rng.uniform(0.5, plan.pavement_m - 0.4))
            direction = 1 if rng.random() < 0.5 else -1
            speed = float(rng.uniform(1.0, 1.6)) if rng.random() < 0.85 else 0.0
            walked = speed * time
            place = float(rng.uniform(start, end)) + direction * walked
            position, heading = path.at(np.clip(place, path.start_m + 1, path.end_m - 1), lateral)
            turn = 0.0 if direction > 0 else np.pi
            if speed == 0:
                turn = float(rng.uniform(0, 2 * np.pi))
            cast.person(position, heading + turn, walked + float(rng.uniform(0, 2)), speed)


def _crossing_people(cast: _Cast) -> None:
    """One from the right passes behind the column; one from the left walks nearer; their ways cross in the picture."""
    path, time, base = cast.drive.path, cast.time, cast.drive.arc_m[0]
    for ahead, start, direction, speed in ((12.0, 2.4, -1, 1.4), (10.6, -5.6, 1, 1.3)):
        walked = np.clip(speed * (time - 0.3), 0, 16.0)
        spot, heading = path.at(base + ahead)
        right = np.array([np.cos(heading), 0.0, -np.sin(heading)])
        position = spot + right * (start + direction * walked)[:, None]
        cast.person(position, np.full(len(time), heading + direction * np.pi / 2), walked, speed)
