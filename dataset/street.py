"""The synthetic street: a drive through a made-up town, rendered on a CPU, with the exact truth of everything.

The embedded default data of the project, and the exact-truth world for its tests, charts and stability tables. Frame
``i`` is a pure function of the configuration: frames can be rendered in any order and by any process.
"""

from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Literal, TypeVar, get_args

import numpy as np

from dataset.conditions import Condition, apply_condition
from dataset.street_actors import Actor, car_actor_now, ground_shadows, person_actor_now
from dataset.street_drives import Drive, StreetPath, drive_along, drive_given, path_from_bends, speed_profile, wandering
from dataset.street_labels import StreetObject, label_actors, label_lanes
from dataset.street_polygons import NO_OWNER, Canvas, Polygons, blank_canvas, join, make_polygons
from dataset.street_raster import paint
from dataset.street_scene import StillWorld, build_world, facing, plan_street
from dataset.street_segments import segment_canvas
from dataset.street_shutter import car_between, person_between, pose_between, row_bands
from dataset.street_textures import HAZE, SKY_TANGENTS, SKY_TOP, street_atlas, texture_index, texture_size
from dataset.street_traffic import CarActor, Density, PersonActor, cast_street
from labeling.camera import Intrinsics, Trajectory, invert, rebased_trajectory
from labeling.errors import ConfigError
from labeling.labels import POINT_ABSENT, POINT_DETECTED, Keypoints
from labeling.video import VideoWriter

Scenario = Literal[
    "drive", "traffic", "parked", "empty", "crossing", "still", "turn", "reverse", "wall", "road_only", "stop_and_go",
    "crawl", "fast", "sharp_turn", "lead_leaves", "cross_traffic",
]  # fmt: skip
SCENARIOS: tuple[Scenario, ...] = get_args(Scenario)

_HAZE_M = 420.0
_FAR_M = 260.0
_SHADOW_M = 90.0
_CARS_M, _PEOPLE_M = 130.0, 90.0
_MOST_ACTORS = 250

_Way = TypeVar("_Way", CarActor, PersonActor)
_SKY_M = 2.0e4


@dataclass(frozen=True, slots=True, kw_only=True)
class StreetConfig:
    """What street, what camera, what happens.

    Raises:
        ConfigError: an unknown scenario, no frames, or a trajectory with fewer poses than frames.
    """

    seed: int
    width: int = 1056
    height: int = 704
    fps: float = 24.0
    frames: int = 240
    scenario: Scenario = "drive"
    trajectory: Trajectory | None = None
    """The camera's way, one pose per frame; the road is laid under it. None: made up by the scenario."""
    focal_px: float | None = None
    """None: the longer side of the picture."""
    camera_height_m: float = 1.5
    camera_pitch_deg: float = 0.0
    """Positive looks down. A given trajectory that moves brings its own."""
    rolling_shutter_s: float = 0.0
    """Seconds from the first row to the last. Labels, flow, depth and the trajectory are those of the middle row's
    time."""
    walkers_per_100_m: float | None = None
    """People per 100 m of pavement, on each side. None: as the scenario has it."""

    def __post_init__(self) -> None:
        if self.scenario not in SCENARIOS:
            raise ConfigError(f"scenario {self.scenario!r} is not known; choose one of {', '.join(SCENARIOS)}")
        if self.frames < 1 or self.width < 16 or self.height < 16 or self.fps <= 0:
            raise ConfigError(
                f"a street of {self.frames} frames, {self.width}x{self.height} at {self.fps:g} fps cannot be; give at "
                "least one frame, 16x16 pixels, and a positive rate"
            )
        if not 0 <= self.rolling_shutter_s <= 1 / self.fps:
            raise ConfigError(
                f"a rolling shutter of {self.rolling_shutter_s:g} s at {self.fps:g} fps cannot be; give 0 to "
                f"{1 / self.fps:.3g} s from the first row to the last"
            )
        if self.trajectory is not None and len(self.trajectory) < self.frames:
            raise ConfigError(
                f"the trajectory has {len(self.trajectory)} poses for {self.frames} frames; ask for fewer frames or "
                "resample it"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StreetFrame:
    """One rendered frame with its truth."""

    index: int
    rgb: np.ndarray
    """(H, W, 3) uint8."""
    objects: tuple[StreetObject, ...]
    """Cars, people and lane lines with at least one visible pixel, cars and people from far to near."""
    segments: np.ndarray
    """(H, W) uint8, index into ``dataset.street_segments.SEGMENTS``; (0, 0) where it was not asked for."""


class Street:
    """A street and a camera driving through it."""

    def __init__(self, config: StreetConfig) -> None:
        self.config = config
        focal = config.focal_px or float(max(config.width, config.height))
        self.intrinsics = Intrinsics(
            width=config.width, height=config.height, fx=focal, fy=focal, cx=(config.width - 1) / 2,
            cy=(config.height - 1) / 2, source="given",
        )  # fmt: skip
        rng = np.random.default_rng([config.seed, 7])
        angle = rng.uniform(0, 2 * np.pi)
        self._sun = np.array([0.6 * np.cos(angle), -0.8, 0.6 * np.sin(angle)])
        density = _density(config)
        town = config.scenario not in ("road_only", "wall")
        plan = plan_street(
            rng, parking=density.parked > 0, buildings=town, trees=town, wall=config.scenario == "wall",
            column=density.crossing,
        )  # fmt: skip
        self.drive = _drive(config, rng)
        self.plan = plan
        self._world: StillWorld = build_world(self.drive.path, plan, rng, sun=self._sun)
        self._cars, self._people = cast_street(self.drive, plan, density, rng, fps=config.fps)
        times = np.arange(config.frames) / config.fps
        self.trajectory: Trajectory = rebased_trajectory(times, self.drive.cam_to_street)
        self._sky = _sky_ring()

    def __len__(self) -> int:
        return self.config.frames

    def render(self, i: int, *, segments: bool = False) -> StreetFrame:
        """Frame ``i`` with its labels, and what each pixel shows if asked; frames can be asked for in any order.

        Raises:
            ConfigError: ``i`` is outside ``[0, frames)``.
        """
        cam_to_street = self._pose(i)
        actors = self._actors(i, cam_to_street)
        canvas, drawn, rejected = self._paint(cam_to_street, actors)
        world_to_cam = invert(cam_to_street)
        objects = label_actors(actors, canvas, drawn, rejected, world_to_cam=world_to_cam, intrinsics=self.intrinsics)
        lanes = label_lanes(
            self.drive.path, self.plan.lines, canvas, arc_m=float(self.drive.arc_m[i]), world_to_cam=world_to_cam,
            intrinsics=self.intrinsics,
        )  # fmt: skip
        classes = np.zeros((0, 0), np.uint8)
        if segments:
            classes = segment_canvas(
                canvas, actors, path=self.drive.path, cam_to_street=cam_to_street, intrinsics=self.intrinsics
            )
        rgb = self._rolling_rgb(i) if self.config.rolling_shutter_s else canvas.rgb
        return StreetFrame(index=i, rgb=rgb, objects=(*objects, *lanes), segments=classes)

    def keypoints(self, frame: StreetFrame) -> list[Keypoints]:
        """The truth as label records: score 1 where a point is visible, 0 (absent) where it is hidden."""
        return [_record(frame.index, thing) for thing in frame.objects]

    def depth(self, i: int) -> np.ndarray:
        """(H, W) float32, metres along z of the still scene (no cars, no people); infinite in the sky."""
        with np.errstate(divide="ignore"):
            return np.float32(1.0) / self._still_inverse_depth(i)

    def flow(self, i: int, j: int) -> np.ndarray:
        """(H, W, 2) float32: how far each pixel of the still scene in frame ``i`` has moved in frame ``j``, pixels.

        NaN where the point lies behind the camera of ``j``. Occlusion in ``j`` is not looked at.
        """
        camera = self.intrinsics
        i_to_j = invert(self._pose(j)) @ self._pose(i)
        x, y = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
        ray = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
        moved = ray @ i_to_j[:3, :3].T + self._still_inverse_depth(i)[..., None] * i_to_j[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            spot = moved[..., :2] / moved[..., 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        spot[moved[..., 2] <= 0] = np.nan
        return (spot - np.stack([x, y], -1)).astype(np.float32)

    def _still_inverse_depth(self, i: int) -> np.ndarray:
        canvas, _, _ = self._paint(self._pose(i), [])
        inverse = canvas.inverse_depth
        inverse[inverse < 2.0 / _SKY_M] = 0.0
        return inverse

    def _pose(self, i: int) -> np.ndarray:
        if not 0 <= i < self.config.frames:
            raise ConfigError(f"frame {i} of a street with {self.config.frames} frames; ask for 0 to {len(self) - 1}")
        return self.drive.cam_to_street[i]

    def _rolling_rgb(self, i: int) -> np.ndarray:
        """(H, W, 3) uint8: frame ``i`` with each band of rows at its own time."""
        canvas = blank_canvas(self.config.width, self.config.height, SKY_TOP)
        for rows, late in row_bands(self.config.height, shutter_s=self.config.rolling_shutter_s, fps=self.config.fps):
            cam_to_street = pose_between(self.drive.cam_to_street, i + late)
            cars = [car_between(car, i + late) for car in self._cars]
            people = [person_between(person, i + late) for person in self._people]
            self._paint(cam_to_street, self._actors_of(cars, people, 0, cam_to_street), canvas=canvas, rows=rows)
        return canvas.rgb

    def _actors(self, i: int, cam_to_street: np.ndarray) -> list[Actor]:
        """Who is near and not wholly behind, from far to near."""
        return self._actors_of(self._cars, self._people, i, cam_to_street)

    def _actors_of(
        self, cars: list[CarActor], people: list[PersonActor], i: int, cam_to_street: np.ndarray
    ) -> list[Actor]:
        eye = cam_to_street[:3, 3]
        near_cars = self._near(cars, i, 3.0, _CARS_M, cam_to_street)
        near_people = self._near(people, i, 1.5, _PEOPLE_M, cam_to_street)
        found = [car_actor_now(car, i, eye=eye, sun=self._sun) for car in near_cars]
        found += [person_actor_now(person, i, eye=eye, sun=self._sun) for person in near_people]
        found.sort(key=lambda actor: -actor.distance_m)
        return [actor.with_owner(order + 1) for order, actor in enumerate(found[-_MOST_ACTORS:])]

    def _near(
        self, actors: list[_Way], i: int, radius: float, farthest: float, cam_to_street: np.ndarray
    ) -> list[_Way]:
        """Those that may reach into the picture; a place of NaN (not there now) never does."""
        if not actors:
            return []
        middle = np.array([actor.position[i] for actor in actors]) - (0.0, 0.9, 0.0)
        seen = self._in_view(middle, np.full(len(middle), radius), cam_to_street)
        seen &= np.linalg.norm(middle - cam_to_street[:3, 3], axis=1) < farthest
        return [actors[index] for index in np.flatnonzero(seen)]

    def _paint(
        self, cam_to_street: np.ndarray, actors: list[Actor], *, canvas: Canvas | None = None,
        rows: tuple[int, int] | None = None,
    ) -> tuple[Canvas, np.ndarray, np.ndarray]:  # fmt: skip
        polygons = self._visible(cam_to_street, actors)
        canvas = canvas or blank_canvas(self.config.width, self.config.height, SKY_TOP)
        camera = self.intrinsics
        drawn, rejected = paint(
            canvas, polygons, world_to_cam=invert(cam_to_street), camera=(camera.fx, camera.fy, camera.cx, camera.cy),
            atlas=street_atlas(), haze=HAZE, haze_m=_HAZE_M, rows=rows,
        )  # fmt: skip
        return canvas, drawn, rejected

    def _visible(self, cam_to_street: np.ndarray, actors: list[Actor]) -> Polygons:
        """What to paint, back to front: sky, ground, shadows, then standing things and actors by distance."""
        eye, ahead, world = cam_to_street[:3, 3], cam_to_street[:3, 2], self._world
        offset = world.ground_middle - eye
        near = (np.linalg.norm(offset, axis=1) < _FAR_M) & (offset @ ahead > -20.0) | world.ground_is_base
        distance = np.linalg.norm(world.thing_middle - eye, axis=1)
        seen = self._in_view(world.thing_middle, world.thing_radius, cam_to_street) & (distance < _FAR_M)
        order = [(-float(distance[index]), 0, int(index)) for index in np.flatnonzero(seen)]
        order += [(-actor.distance_m, 1, index) for index, actor in enumerate(actors)]
        standing = []
        for _, kind, index in sorted(order):
            thing = actors[index].polygons if kind else world.things[index]
            standing.append(thing)
        shadows = ground_shadows([actor for actor in actors if actor.distance_m < _SHADOW_M], self._sun)
        behind = [self._sky_at(eye), world.ground.take(np.flatnonzero(near)), shadows]
        if not standing:
            return join(behind)
        upright = join(standing)
        return join([*behind, upright.take(np.flatnonzero((upright.owner != NO_OWNER) | facing(upright, eye)))])

    def _in_view(self, middle: np.ndarray, radius: np.ndarray, cam_to_street: np.ndarray) -> np.ndarray:
        """(G,) bool: balls that may reach into the picture."""
        cam = (middle - cam_to_street[:3, 3]) @ cam_to_street[:3, :3]
        camera = self.intrinsics
        slope = np.array([camera.width / camera.fx, camera.height / camera.fy]) / 2
        outside = np.abs(cam[:, :2]) - slope * cam[:, 2:] > radius[:, None] * np.sqrt(1 + slope**2)
        return (cam[:, 2] > -radius) & ~outside.any(axis=1)

    def _sky_at(self, eye: np.ndarray) -> Polygons:
        """The sky's ring around the camera: infinitely far in effect, since it moves along."""
        gradient = self._sky.gradient.copy()
        gradient[:, :, 3] -= gradient[:, :, :3] @ eye.astype(np.float32)
        return replace(self._sky, corners=self._sky.corners + eye.astype(np.float32), gradient=gradient)


_DENSITY: dict[Scenario, Density] = {
    "drive": Density(lead=0.7, same=0.35, oncoming=0.4, parked=0.4, walkers=6),
    "traffic": Density(lead=1.0, same=0.9, oncoming=0.9, parked=0.6, walkers=8),
    "parked": Density(parked=0.9),
    "empty": Density(),
    "crossing": Density(parked=0.3, crossing=True),
    "still": Density(oncoming=0.5, parked=0.3, walkers=5),
    "turn": Density(parked=0.3),
    "reverse": Density(parked=0.5, walkers=3),
    "wall": Density(),
    "road_only": Density(),
    "stop_and_go": Density(lead=1.0, same=0.4, oncoming=0.4, parked=0.3, walkers=4),
    "crawl": Density(oncoming=0.3, parked=0.4, walkers=4),
    "fast": Density(lead=0.5, oncoming=0.2),
    "sharp_turn": Density(parked=0.3, walkers=3),
    "lead_leaves": Density(parked=0.3, lead_leaves=True),
    "cross_traffic": Density(parked=0.3, cross=True),
}


def _density(config: StreetConfig) -> Density:
    density = _DENSITY[config.scenario]
    return density if config.walkers_per_100_m is None else replace(density, walkers=config.walkers_per_100_m)


_SPEEDS: dict[Scenario, tuple[tuple[float, float], ...]] = {
    "traffic": ((0, 6.0), (3, 8.0), (6, 4.0), (9, 7.0)),
    "parked": ((0, 5.0), (6, 7.0)),
    "empty": ((0, 9.0), (6, 11.0)),
    "crossing": ((0, 0.0),),
    "still": ((0, 0.0),),
    "turn": ((0, 0.0),),
    "reverse": ((0, -2.5), (4, -2.5), (6, -1.5)),
    "wall": ((0, 0.8), (9, 0.8), (10, 0.0)),
    "road_only": ((0, 10.0),),
    "stop_and_go": ((0, 8.0), (1.5, 8.0), (3.5, 0.0), (5, 0.0), (7, 6.0), (8, 6.0), (9.5, 0.0), (10.5, 0.0), (12, 7.0)),
    "crawl": ((0, 0.5),),
    "fast": ((0, 30.0),),
    "sharp_turn": ((0, 6.0),),
    "lead_leaves": ((0, 0.0),),
    "cross_traffic": ((0, 0.0),),
}
_TURN_RATE_DEG = 30.0


def _drive(config: StreetConfig, rng: np.random.Generator) -> Drive:
    """The camera's way: given, or made up by the scenario."""
    height, pitch = config.camera_height_m, config.camera_pitch_deg
    if config.trajectory is not None:
        return drive_given(config.trajectory.slice(0, config.frames), height_m=height, pitch_deg=pitch)
    seconds = config.frames / config.fps
    bends: list[tuple[float, float, float]] = []
    keys: list[tuple[float, float]] = []
    if config.scenario == "drive":
        keys, bends = wandering(rng, seconds=seconds)
    else:
        keys = list(_SPEEDS[config.scenario])
    if config.scenario in ("traffic", "parked", "empty", "stop_and_go", "reverse", "road_only"):
        side = 1.0 if rng.random() < 0.5 else -1.0
        bends = [(25, 95, 0.35 * side), (130, 220, -0.4 * side)]
    if config.scenario == "sharp_turn":
        bends = [(3, 27, np.pi / 2 * (1.0 if rng.random() < 0.5 else -1.0))]
    speed = speed_profile(keys, frames=config.frames, fps=config.fps)
    yaw = np.zeros(config.frames)
    if config.scenario == "turn":
        yaw = np.radians(_TURN_RATE_DEG) * np.arange(config.frames) / config.fps
    path: StreetPath = path_from_bends(bends, length_m=max(60.0, float(speed.clip(0).sum()) / config.fps))
    return drive_along(path, speed, fps=config.fps, height_m=height, pitch_deg=pitch, yaw=yaw)


def _sky_ring(pieces: int = 24) -> Polygons:
    """Quads around the origin that carry the sky's texture once around."""
    low, high = SKY_TANGENTS
    width, height = texture_size("sky")
    corners, gradients = [], []
    for k in range(pieces):
        angle = np.array([k, k + 1]) * 2 * np.pi / pieces
        ring = np.stack([np.sin(angle), np.zeros(2), np.cos(angle)], -1) * _SKY_M
        chord = ring[1] - ring[0]
        bottom, top = np.array([0, -low * _SKY_M, 0]), np.array([0, -high * _SKY_M, 0])
        corners.append(np.array([ring[0] + bottom, ring[1] + bottom, ring[1] + top, ring[0] + top]))
        along = chord / (chord @ chord) * width / pieces
        down = height / ((high - low) * _SKY_M)
        gradients.append(np.array([[*along, k * width / pieces - along @ ring[0]], [0, down, 0, high * _SKY_M * down]]))
    return make_polygons(corners, texture=texture_index("sky"), gradient=np.array(gradients), fog=0.0, soft=0)


def _record(frame: int, thing: StreetObject) -> Keypoints:
    seen = thing.visible & np.isfinite(thing.points_xy).all(axis=1)
    points = np.zeros((len(seen), 3), np.float32)
    points[:, :2] = np.nan_to_num(thing.points_xy, nan=0.0)
    points[:, 2] = seen
    return Keypoints(
        frame=frame, track_id=thing.track_id, category=thing.category, schema=thing.schema, score=1.0,
        box_xyxy=thing.box_xyxy, points=points,
        point_source=np.where(seen, POINT_DETECTED, POINT_ABSENT).astype(np.int8),
    )  # fmt: skip


def write_street_video(config: StreetConfig, path: Path, *, condition: Condition = "clean") -> None:
    """Render all frames of a street into an H.264 MP4 at ``config.fps``, in a picture condition.

    Raises:
        ConfigError: an unknown condition, odd sides.
        StorageError: the file cannot be written.
    """
    street = Street(config)
    rate = Fraction(config.fps).limit_denominator(1001)
    with VideoWriter(path, width=config.width, height=config.height, fps=rate) as writer:
        for i in range(config.frames):
            writer.write(apply_condition(street.render(i).rgb, condition, seed=config.seed, frame=i))
