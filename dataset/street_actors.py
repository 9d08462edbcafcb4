"""An actor of the synthetic street at one moment: its polygons as the camera sees them, and its keypoints."""

from dataclasses import dataclass, replace

import numpy as np

from dataset.street_cars import CarModel, car_model
from dataset.street_cars import hidden_by_itself as hidden_on_car
from dataset.street_people import hidden_by_itself as hidden_on_person
from dataset.street_people import joints_at, person_polygons
from dataset.street_polygons import ALL_SOFT, Polygons
from dataset.street_traffic import CarActor, PersonActor
from labeling.camera import invert, rigid
from labeling.schemas import Category

_SMALL_PX2 = 1.5
_FOCAL_HINT_PX = 1056.0
_SKY_LIGHT = np.array([150.0, 172.0, 196.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Actor:
    """One car or person in one frame."""

    track_id: int
    category: Category
    schema: str
    distance_m: float
    """From the camera to its middle."""
    polygons: Polygons
    """Facing the camera, back to front, owned by ``owner``."""
    keypoints: np.ndarray
    """(K, 3) float64, street axes."""
    hidden: np.ndarray
    """(K,) bool: hidden by the object itself."""
    footprint: np.ndarray
    """(2,) float64: half length and half width of its shadow, metres."""
    own_to_street: np.ndarray
    """(4, 4) float64."""
    owner: int

    def with_owner(self, owner: int) -> "Actor":
        """The same actor, painting pixels as ``owner``."""
        count = len(self.polygons)
        return replace(self, owner=owner, polygons=replace(self.polygons, owner=np.full(count, owner, np.int32)))


def own_to_street(position: np.ndarray, heading: float) -> np.ndarray:
    """(4, 4): from x forward, y left, z up to street axes (x right, y down, z forward)."""
    s, c = np.sin(heading), np.cos(heading)
    return rigid(np.array([[s, -c, 0.0], [0.0, 0.0, -1.0], [c, s, 0.0]]), position)


def car_actor_now(car: CarActor, i: int, *, eye: np.ndarray, sun: np.ndarray) -> Actor:
    """A car in frame ``i``, seen from ``eye`` (3,) in street axes."""
    model = car_model(car.shape)
    placed = own_to_street(car.position[i], float(car.heading[i]))
    eye_own = (invert(placed) @ np.append(eye, 1.0))[:3]
    middle = placed[:3, 3] - (0.0, model.size.height / 2, 0.0)
    distance = float(np.linalg.norm(middle - eye))
    return Actor(
        track_id=car.track_id, category="car", schema="car24", distance_m=distance,
        polygons=_car_polygons(model, car.colour, bool(car.braking[i]), placed, eye_own, sun, distance),
        keypoints=model.keypoints @ placed[:3, :3].T + placed[:3, 3], hidden=hidden_on_car(model, eye_own),
        footprint=np.array([model.size.length, model.size.width]) / 2, own_to_street=placed, owner=0,
    )  # fmt: skip


def _car_polygons(
    model: CarModel, paint: np.ndarray, braking: bool, placed: np.ndarray, eye: np.ndarray, sun: np.ndarray,
    distance: float,
) -> Polygons:  # fmt: skip
    towards = model.normal @ eye > model.plane + 1e-4
    facing = towards & ((model.area * (_FOCAL_HINT_PX / max(distance, 1.0)) ** 2 > _SMALL_PX2) | model.painted)
    rank = np.argsort(np.array(model.part_order(eye)))[model.part]
    index = np.flatnonzero(facing)
    index = index[np.argsort(rank[index], kind="stable")]
    normal = model.normal[index] @ placed[:3, :3].T
    colour = np.where(model.painted[index, None], paint, model.colour[index])
    if braking:
        colour = np.where(model.brake[index, None], np.array([255.0, 48.0, 40.0]), colour)
    light = 0.66 + 0.36 * np.clip(normal @ sun, -0.3, 1.0) + 0.12 * np.clip(-normal[:, 1], -1, 1)
    lights = ~model.painted[index] & (colour.max(axis=1) > 200)
    light = np.where(lights, np.maximum(light, 0.95), light)
    shine = (model.gloss[index] * np.clip(0.25 - 0.75 * normal[:, 1], 0, 1) * 0.55)[:, None]
    lit = np.clip(colour * light[:, None] * (1 - shine) + _SKY_LIGHT * shine, 0, 255)
    corners = model.corners[index] @ placed[:3, :3].T + placed[:3, 3]
    count, detail = len(index), model.beside[index, 0] < 0
    # An edge is part of the outline where the face across it looks away; other edges are seams.
    outline = (~towards[model.beside[index]] * np.array([1, 2, 4])).sum(axis=1)
    soft = np.where(detail, ALL_SOFT, outline).astype(np.int32)
    return Polygons(
        corners=corners.astype(np.float32), corner_count=model.corner_count[index], colour=lit.astype(np.float32),
        texture=np.full(count, -1, np.int32), gradient=np.zeros((count, 2, 4), np.float32),
        owner=np.zeros(count, np.int32), alpha=np.ones(count, np.float32),
        grow_px=np.where(detail, 0.3, 0.0).astype(np.float32), soft=soft,
        fog=np.ones(count, np.float32),
    )  # fmt: skip


def person_actor_now(person: PersonActor, i: int, *, eye: np.ndarray, sun: np.ndarray) -> Actor:
    """A person in frame ``i``, seen from ``eye`` (3,) in street axes."""
    placed = own_to_street(person.position[i], float(person.heading[i]))
    joints = joints_at(person.look, walked_m=float(person.walked_m[i]), speed_mps=person.speed_mps)
    eye_own = (invert(placed) @ np.append(eye, 1.0))[:3]
    middle = placed[:3, 3] - (0.0, person.look.height / 2, 0.0)
    return Actor(
        track_id=person.track_id, category="person", schema="coco17", distance_m=float(np.linalg.norm(middle - eye)),
        polygons=person_polygons(person.look, joints, own_to_street=placed, eye=eye, sun=sun, owner=0),
        keypoints=joints @ placed[:3, :3].T + placed[:3, 3], hidden=hidden_on_person(person.look, joints, eye_own),
        footprint=np.array([0.26, 0.3]), own_to_street=placed, owner=0,
    )  # fmt: skip


def ground_shadows(actors: list[Actor], sun: np.ndarray) -> Polygons:
    """Soft dark patches under actors, a little away from the sun: three rings each."""
    angle = np.arange(12) * 2 * np.pi / 12
    power = np.array([4.0 if actor.category == "car" else 1.0 for actor in actors])[:, None]
    radius = (np.abs(np.cos(angle)) ** (2 * power) + np.abs(np.sin(angle)) ** (2 * power)) ** (-0.5 / power)
    ring = np.stack([np.cos(angle) * radius, np.sin(angle) * radius, np.zeros_like(radius)], -1)
    footprint = np.array([[*actor.footprint, 0.0] for actor in actors]).reshape(-1, 3)
    placed = np.array([actor.own_to_street for actor in actors]).reshape(-1, 4, 4)
    shift = np.array([-sun[0], 0.0, -sun[2]]) * 0.18
    sizes = np.maximum(footprint[:, None] + np.array([0.22, 0.06, -0.12])[:, None], 0.05)
    own = ring[:, None] * sizes[:, :, None]
    corners = np.einsum("aij,arkj->arki", placed[:, :3, :3], own) + placed[:, None, None, :3, 3] + shift
    count = 3 * len(actors)
    return Polygons(
        corners=corners.reshape(count, 12, 3).astype(np.float32), corner_count=np.full(count, 12, np.int32),
        colour=np.full((count, 3), 20.0, np.float32), texture=np.full(count, -1, np.int32),
        gradient=np.zeros((count, 2, 4), np.float32), owner=np.zeros(count, np.int32),
        alpha=np.tile(np.array([0.22, 0.34, 0.4], np.float32), len(actors)), grow_px=np.zeros(count, np.float32),
        soft=np.full(count, ALL_SOFT, np.int32),
        fog=np.zeros(count, np.float32),
    )  # fmt: skip
