"""The town's static objects for clients: boxes by semantic tag, and ray casts."""

from typing import TYPE_CHECKING, Any

import numpy as np

from flcav.carla.frames import mirror, to_rotation, to_vector
from flcav.carla.server.wire import BoundingBox, Vector
from flcav.geometry import rotations_about_z
from flcav.sensors.frame import SEMANTICS
from flcav.sensors.rendering.appearance import build_appearance
from flcav.world.static import find_lowest_ground

if TYPE_CHECKING:
    from flcav.carla.server.episode import Episode

ANY = 0xFF  # CARLA's tag for all objects
UP_M = 0.5  # a trunk's half width, for boxes of poles


def find_boxes(episode: "Episode", tag: int) -> list[BoundingBox]:
    """Return the bounding boxes of the town's objects with a semantic tag, in CARLA's map frame [m]."""
    return [box for number, box, _ in _list_things(episode) if tag in (number, ANY)]


def list_scenery(episode: "Episode", tag: int) -> list[list[Any]]:
    """Return the town's objects with a semantic tag, as rows: transform, box, id, name and tag."""
    return [
        [[box.location, box.rotation], box, row, name, number]
        for row, (number, box, name) in enumerate(_list_things(episode), start=1)
        if tag in (number, ANY)
    ]


def _list_things(episode: "Episode") -> list[tuple[int, BoundingBox, str]]:
    """Return tag, box and name of all buildings, trees, lamps, signs, poles, traffic lights and parked vehicles."""
    town = episode.served.town
    objects = []

    def add(kind: str, x: float, y: float, z: float, size: tuple[float, float, float], yaw: float = 0.0) -> None:
        place = to_vector(episode.served.frame.to_location(np.array((x, y, z + size[2] / 2))))
        length, width, height = size
        box = BoundingBox(place, (length / 2, width / 2, height / 2), to_vector(to_rotation(np.array((yaw, 0.0, 0.0)))))
        objects.append((SEMANTICS[kind], box, f"{kind}_{len(objects)}"))

    ground = find_lowest_ground(town, town.buildings) if len(town.buildings) else []
    for (x, y, yaw, length, width, height), foot in zip(town.buildings.tolist(), ground):
        add("building", x, y, float(foot), (length, width, height), yaw)
    for x, y, height, radius in town.trees.tolist():
        add("vegetation", x, y, town.ground(x, y), (2 * radius, 2 * radius, height))
    for x, y, height in [*town.lamps.tolist(), *town.posts.tolist()]:
        add("pole", x, y, town.ground(x, y), (0.2, 0.2, height))
    for (x, y, z), yaw in zip(town.signs.position.tolist(), town.signs.yaw.tolist()):
        add("traffic_sign", x, y, z - 0.4, (0.1, 0.8, 0.8), yaw)
    for (x, y, z), yaw in zip(town.signals.position.tolist(), town.signals.yaw.tolist()):
        add("traffic_light", x, y, z - 0.45, (0.3, 0.3, 0.9), yaw)
    trace = episode.world.snapshot.trace
    for row, name in enumerate(trace.actor.tolist()):
        if name.startswith("parked"):
            x, y, z = trace.position[0, row].tolist()
            length, width, height = trace.size[row].tolist()
            category = {"van": "car"}.get(str(trace.category[row]), str(trace.category[row]))
            add(category, x, y, z, (length, width, height), float(trace.yaw[0, row]))
    return objects


def project_ray(episode: "Episode", location: Vector, direction: Vector, distance: float) -> list[list[Any]]:
    """Return location and tag of the first hit of a ray within `distance` [m], in CARLA's frame, if there is one."""
    way = mirror(np.array(direction))
    length = float(np.linalg.norm(way))
    if not length or distance <= 0:
        return []
    pose = np.eye(4)
    pose[:3, :3] = rotations_about_z(np.array(0.0))
    pose[:3, 3] = episode.served.frame.from_location(location)
    scene = episode.survey()
    hits = scene.cast(pose, (way / length)[None].astype(np.float32), far_m=distance)
    if hits.instance[0] < 0:
        return []
    row = scene.surfaces.first[hits.instance[0]] + hits.face[0]
    tag = int(build_appearance(scene).semantic[row])
    point = pose[:3, 3] + way / length * float(hits.distance[0])
    return [[to_vector(episode.served.frame.to_location(point)), tag]]
