"""Traffic of a scene in CARLA: walkers, and vehicles of its Traffic Manager, drawn by the recipe's seed."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np

from flcav.carla.frames import MapFrame, mirror
from flcav.carla.recording.session import Session
from flcav.config import InputError
from flcav.geometry import Array, Boxes, turned_boxes
from flcav.sources.recipe import CarlaRecipe

if TYPE_CHECKING:
    import carla

CATEGORIES = ("car", "van", "truck", "bus", "motorcycle", "bicycle")  # as in CARLA's attribute base_type
ALONE = "vehicle.tesla.model3"  # blueprint of the vehicles that record
NARROWEST_M = 0.6  # least width of two-wheelers, whose boxes in CARLA may have a width of 0
THINNEST_M = 0.05  # least side of a box


@dataclass(frozen=True)
class TrackedBody:
    """An actor of CARLA, or a parked vehicle of its map, with its box."""

    number: int  # CARLA's actor id; 0 for a parked vehicle, which is not an actor
    track: str
    category: str
    size: tuple[float, float, float]  # length, width, height [m]
    middle: Array  # (4, 4) pose of the box centre in the actor frame, of a parked vehicle in the world frame [m]

    def actor_from_foot(self) -> Array:
        """Return the (4, 4) pose of the centre of the box's underside in the actor frame [m]."""
        foot = self.middle.copy()
        foot[:3, 3] -= foot[:3, 2] * self.size[2] / 2
        return foot


@dataclass(frozen=True)
class State:
    """The states of the N bodies that exist at a tick."""

    bodies: tuple[TrackedBody, ...]
    boxes: Boxes  # (N,) world frame
    velocity: Array  # (N, 3) world frame [m/s]
    acceleration: Array  # (N, 3) world frame [m/s^2]


def spawn_vehicles(session: Session, recipe: CarlaRecipe, rng: np.random.Generator) -> dict[str, "carla.Vehicle"]:
    """Spawn recording and other vehicles, driven by the Traffic Manager; return them by agent or track.

    Raises `InputError` where the map has too few spawn points for the recording vehicles.
    """
    library, points = session.world.get_blueprint_library(), session.world.get_map().get_spawn_points()
    every = sorted(
        (blueprint for blueprint in library.filter("vehicle.*") if _category(blueprint)),
        key=lambda blueprint: blueprint.id,
    )
    ego_blueprint = next((blueprint for blueprint in every if blueprint.id == ALONE), None)
    if ego_blueprint is None:
        raise InputError(f"CARLA at {session.address} has no blueprint {ALONE}, which records")
    places = [points[i] for i in rng.permutation(len(points))]
    names = [f"cav{i}" for i in range(recipe.cavs)] + [f"veh{i}" for i in range(recipe.vehicles)]
    vehicles: dict[str, carla.Vehicle] = {}
    for name in names:
        blueprint = ego_blueprint if name.startswith("cav") else every[int(rng.integers(len(every)))]
        if blueprint.has_attribute("color"):
            colours = blueprint.get_attribute("color").recommended_values
            blueprint.set_attribute("color", colours[int(rng.integers(len(colours)))])
        blueprint.set_attribute("role_name", name)
        vehicle = None
        while places and vehicle is None:
            vehicle = cast("carla.Vehicle | None", session.world.try_spawn_actor(blueprint, places.pop()))
        if vehicle is not None:
            vehicles[name] = vehicle
        elif name.startswith("cav"):
            raise InputError(f"CARLA at {session.address} has no free spawn point for {name}: lower 'cavs'")
    for vehicle in vehicles.values():
        vehicle.set_autopilot(True, session.manager.get_port())
    return vehicles


def spawn_walkers(session: Session, recipe: CarlaRecipe, rng: np.random.Generator) -> dict[str, "carla.Actor"]:
    """Spawn walkers with random targets on the navigation mesh; return them by track, fewer where there is no room."""
    import carla

    library = session.world.get_blueprint_library()
    kinds = sorted(library.filter("walker.pedestrian.*"), key=lambda blueprint: blueprint.id)
    control = library.find("controller.ai.walker")
    walkers: dict[str, carla.Actor] = {}
    drivers = []
    for number in range(recipe.pedestrians if kinds else 0):
        place = session.world.get_random_location_from_navigation()
        if place is None:
            raise InputError(
                f"CARLA at {session.address} has no navigation mesh for walkers here: set 'pedestrians' to 0"
            )
        kind = kinds[int(rng.integers(len(kinds)))]
        kind.set_attribute("role_name", f"ped{number}")
        walker = session.world.try_spawn_actor(kind, carla.Transform(place))
        if walker is not None:
            walkers[f"ped{number}"] = walker
            drivers.append(session.world.spawn_actor(control, carla.Transform(), attach_to=walker))
    session.tick()  # a controller starts after the tick that its walker appears at
    for driver in drivers:
        driver.start()
        target = session.world.get_random_location_from_navigation()
        if target is not None:
            driver.go_to_location(target)
    return walkers


def list_bodies(session: Session, spawned: Mapping[str, "carla.Actor"], frame: MapFrame) -> list[TrackedBody]:
    """Return the bodies of a world: all vehicles and walkers, and the parked vehicles of its map.

    Actors that are not `spawned` by this recording have the track `other` with CARLA's id.
    """
    import carla

    track = {actor.id: name for name, actor in spawned.items()}
    bodies = []
    for actor in session.world.get_actors():
        category = "pedestrian" if actor.type_id.startswith("walker.") else _category(actor)
        if category and (actor.type_id.startswith(("walker.", "vehicle."))):
            middle, size = _read_box(actor.bounding_box, MapFrame(), category)
            bodies.append(TrackedBody(actor.id, track.get(actor.id, f"other{actor.id}"), category, size, middle))
    parked: list[tuple[tuple[float, ...], str, tuple[Array, tuple[float, float, float]]]] = []
    for category in ("car", "truck", "bus", "motorcycle", "bicycle"):
        things = session.world.get_environment_objects(getattr(carla.CityObjectLabel, category.capitalize()))
        for middle, size in (_read_box(thing.bounding_box, frame, category) for thing in things):
            parked.append((tuple(middle[:3, 3].tolist()), category, (middle, size)))
    parked.sort(key=lambda vehicle: vehicle[:2])  # their numbers may differ when the map is loaded anew
    bodies += [TrackedBody(0, f"parked{i}", kind, size, middle) for i, (_, kind, (middle, size)) in enumerate(parked)]
    return bodies


def read_state(snapshot: "carla.WorldSnapshot", bodies: list[TrackedBody], frame: MapFrame) -> State:
    """Return the states of the bodies that exist in a snapshot, and of the parked vehicles."""
    present, middles, velocity, acceleration = [], [], [], []
    for body in bodies:
        actor = snapshot.find(body.number) if body.number else None
        if body.number and actor is None:
            continue
        present.append(body)
        middles.append(body.middle if actor is None else read_pose(actor.get_transform(), frame) @ body.middle)
        velocity.append((0.0, 0.0, 0.0) if actor is None else read_vector(actor.get_velocity()))
        acceleration.append((0.0, 0.0, 0.0) if actor is None else read_vector(actor.get_acceleration()))
    placed = np.array(middles).reshape(-1, 4, 4)
    count = len(present)
    return State(
        tuple(present),
        turned_boxes(
            placed[:, :3, 3],
            np.array([body.size for body in present]).reshape(count, 3),
            placed[:, :3, :3],
            np.array([body.category for body in present], np.str_).reshape(count),
        ),
        np.array(velocity).reshape(count, 3),
        np.array(acceleration).reshape(count, 3),
    )


def read_pose(transform: "carla.Transform", frame: MapFrame) -> Array:
    """Convert a CARLA transform to a (4, 4) pose of the world frame [m]."""
    at = transform.location
    turn = transform.rotation
    return frame.from_transform((at.x, at.y, at.z), (turn.pitch, turn.yaw, turn.roll))


def make_transform(pose: Array, frame: MapFrame) -> "carla.Transform":
    """Convert a (4, 4) pose of the world frame [m] to a CARLA transform."""
    import carla

    (x, y, z), (pitch, yaw, roll) = frame.to_transform(pose)
    return carla.Transform(carla.Location(x, y, z), carla.Rotation(pitch=pitch, yaw=yaw, roll=roll))


def read_vector(vector: "carla.Vector3D") -> Array:
    """Convert a CARLA vector to an array (3,) in right-handed axes; the unit stays the same."""
    return mirror(np.array((vector.x, vector.y, vector.z)))


def _read_box(box: "carla.BoundingBox", frame: MapFrame, category: str) -> tuple[Array, tuple[float, float, float]]:
    """Return the (4, 4) pose of the centre and the size [m] of a box, which is in the map's or its actor's frame."""
    import carla

    middle = read_pose(carla.Transform(box.location, box.rotation), frame)
    narrowest = NARROWEST_M if category in ("motorcycle", "bicycle") else THINNEST_M
    length, width, height = (2 * side for side in (box.extent.x, box.extent.y, box.extent.z))
    return middle, (max(length, THINNEST_M), max(width, narrowest), max(height, THINNEST_M))


def _category(thing: "carla.Actor | carla.ActorBlueprint") -> str:
    """Return the category of a vehicle or its blueprint; empty if CARLA's base_type is not one of CATEGORIES."""
    import carla

    if isinstance(thing, carla.ActorBlueprint):
        base_type = thing.get_attribute("base_type").as_str() if thing.has_attribute("base_type") else ""
    else:
        base_type = thing.attributes.get("base_type", "")
    return base_type.lower() if base_type.lower() in CATEGORIES else ""
