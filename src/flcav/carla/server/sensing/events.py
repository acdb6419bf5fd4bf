"""Events of collision and obstacle sensors: records of the two actors."""

from collections.abc import Callable, Sequence

import numpy as np

from flcav.carla.frames import mirror
from flcav.carla.server.sensing.sight import Sensor, Sight
from flcav.carla.server.wire import Actor, BoundingBox, Description, Obstacle, pack_record
from flcav.carla.server.wire import Collision as CollisionRecord
from flcav.geometry import inverse
from flcav.sensors.frame import SEMANTICS
from flcav.world.snapshot import Collision

RING = 8  # rays around the middle one, on the circle of the radius
AHEAD = np.array([[1.0, 0.0, 0.0]], np.float32)
TAG_NAMES = {number: name for name, number in SEMANTICS.items()}


TAG_OF = {  # kind of a thing -> its semantic class
    "tree": "vegetation",
    "clutter": "static",
    "post": "pole",
    "lamp": "pole",
    "sign": "traffic_sign",
    "signal": "traffic_light",
    "vehicle": "car",
}


def describe_thing(kind: str) -> Actor:
    """Return the record of a thing of the town, such as a building, by CARLA's name of its class."""
    kind = TAG_OF.get(kind, kind).replace("_", "")
    nowhere = BoundingBox((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    return Actor(0, 0, Description(0, f"static.{kind}", ()), nowhere, b"", b"")


def find_collisions(collisions: Sequence[Collision], describe: Callable[[str], Actor]) -> dict[str, list[bytes]]:
    """Return what collision sensors on each actor send, by its name; `describe` gives the record of a name."""
    found: dict[str, list[bytes]] = {}
    for each in collisions:
        impulse = np.array((*each.impulse, 0.0))
        for name, other, share in ((each.name, each.other, impulse), (each.other, each.name, -impulse)):
            x, y, z = mirror(share).tolist()
            record = CollisionRecord(describe(name), describe(other), (x, y, z))
            found.setdefault(name, []).append(pack_record(record))
    return found


def _sweep_actors(sight: Sight, sensor: Sensor) -> tuple[float, str] | None:
    """Return distance [m] and name of the first vehicle or walker whose box, grown by the radius, the ray ahead meets.

    Parked vehicles, props and the town neither count nor hide what is behind them.
    """
    trace, radius, best = sight.scene.trace, sensor.number_of("hit_radius"), None
    moves = (sight.actors > 0) & (trace.category != "prop") & (trace.actor != sensor.carrier) & trace.present[0]
    for row in np.flatnonzero(moves).tolist():
        to_box = inverse(sight.scene.world_from_actor(row)) @ sensor.pose
        start, way = to_box[:3, 3], to_box[:3, 0]
        length, width, height = trace.size[row]
        low = np.array((-length / 2, -width / 2, 0.0)) - radius
        high = np.array((length / 2, width / 2, height)) + radius
        with np.errstate(divide="ignore", invalid="ignore"):
            enter, leave = np.sort(np.stack((low - start, high - start)) / way, axis=0)
        nearest, farthest = float(np.nanmax(enter)), float(np.nanmin(leave))
        if nearest <= farthest and farthest >= 0 and max(nearest, 0.0) <= sensor.number_of("distance"):
            met = max(nearest, 0.0), str(trace.actor[row])
            best = met if best is None else min(best, met)
    return best


def find_obstacle(sight: Sight, sensor: Sensor, carrier: Actor, describe: Callable[[str], Actor]) -> bytes | None:
    """Return what an obstacle sensor on `carrier` sends: what is nearest ahead of it within its radius, or None."""
    if sensor.attributes["only_dynamics"].lower() in ("true", "1"):
        met = _sweep_actors(sight, sensor)
        return None if met is None else pack_record(Obstacle(carrier, describe(met[1]), met[0]))
    trace = sight.scene.trace
    rows = np.flatnonzero(trace.actor == sensor.carrier)
    hidden = int(rows[0]) if len(rows) else None
    radius, far = sensor.number_of("hit_radius"), sensor.number_of("distance")
    turns = np.arange(RING) * (2 * np.pi / RING)
    offsets = [(0.0, 0.0), *((radius * np.cos(turn), radius * np.sin(turn)) for turn in turns)]
    best: tuple[float, str] | None = None
    for left, up in offsets:
        pose = sensor.pose.copy()
        pose[:3, 3] += pose[:3, :3] @ (0.0, left, up)
        hits = sight.scene.cast(pose, AHEAD, far_m=far, hidden=hidden)
        instance, distance = int(hits.instance[0]), float(hits.distance[0])
        if instance < 0 or (best is not None and distance >= best[0]):
            continue
        if instance == 0:
            tag = int(sight.tags(hits)[0])
            if TAG_NAMES.get(tag) in ("road", "road_line"):
                continue
            best = distance, f"{TAG_NAMES.get(tag, 'unknown')}:"
        else:
            best = distance, str(trace.actor[instance - 1])
    return None if best is None else pack_record(Obstacle(carrier, describe(best[1]), best[0]))
