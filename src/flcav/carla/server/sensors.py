"""Sensors of CARLA's clients: when they measure, and the bytes that they send.

Cameras send blue, green, red and alpha, row by row from the top. Depth along the optical axis is coded in 24 bits from
red (lowest) to blue, in units of 1000 m / (2^24 - 1). The semantic tag is in red; an instance image has the two lower
bytes of the actor's id in green and blue.

LiDARs and the radar send points in the sensor's left-handed frame. A LiDAR fires points_per_second over its channels,
from the highest, evenly over the angle that it turns by in the time since its last sweep. Its intensity is
exp(-a distance), and it loses returns as in `flcav.sensors.lidar.lidar`. The radar's rays are random within its field
of view; a detection has the range rate of the surface that its ray hits.

GNSS, IMU, and the events of collision and obstacle sensors are MessagePack records.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.Image import Resampling

from flcav.carla.frames import mirror, mirror_spin
from flcav.carla.server.sight import THREADS, Sensor, TownSight, lens_of
from flcav.carla.server.wire import (
    SEMANTIC_POINT,
    ActorRecord,
    BoundingBox,
    Description,
    ObstacleEvent,
    Stream,
    pack_image,
    pack_lidar,
    pack_record,
)
from flcav.carla.server.wire import CollisionEvent as CollisionRecord
from flcav.geometry import inverse, unit_vectors, yaw_of
from flcav.machine.compiled import compiled
from flcav.sensors.frame import SEMANTICS
from flcav.sensors.lens import BODY_FROM_OPTICAL, compute_pixel_rays
from flcav.sensors.lidar.lidar import CarlaReturns, carla_returns
from flcav.world.geodesy import convert_to_geodetic
from flcav.world.rays.packets import Hits
from flcav.world.snapshot import Collision

FAR_M = 1000.0  # greatest coded depth
DEPTH_STEPS = 2**24 - 1  # code of that depth


def sense_rgb(sight: TownSight, sensor: Sensor) -> bytes:
    """Render a colour image; return its bytes."""
    rgb, lens = sight.photograph(sensor).rgb, lens_of(sensor)
    if rgb.shape[:2] != (lens.height, lens.width):  # of low quality
        rgb = np.asarray(Image.fromarray(rgb).resize((lens.width, lens.height), Resampling.BILINEAR))
    image = np.empty((*rgb.shape[:2], 4), np.uint8)
    _write_colours(rgb, image)
    return _pack_picture(sensor, image)


def sense_depth(sight: TownSight, sensor: Sensor) -> bytes:
    """Render a depth image; return its bytes."""
    lens = lens_of(sensor)
    rays = compute_pixel_rays(lens)
    pose = sensor.pose @ BODY_FROM_OPTICAL
    hits = sight.scene.cast(pose, rays, far_m=FAR_M, hidden=sight.find_inside(sensor), threads=THREADS)
    image = np.empty((lens.height, lens.width, 4), np.uint8)
    _write_depths(hits.distance, rays, image.reshape(-1, 4))
    return _pack_picture(sensor, image)


def sense_semantic(sight: TownSight, sensor: Sensor) -> bytes:
    """Render a semantic image; return its bytes."""
    tags, instance = sight.label(sensor)
    return _pack_picture(sensor, _draw_labels(tags, instance, np.zeros(len(sight.actors), np.uint32)))


def sense_instance(sight: TownSight, sensor: Sensor) -> bytes:
    """Render an instance image, of semantic tags and actor ids; return its bytes."""
    return _pack_picture(sensor, _draw_labels(*sight.label(sensor), sight.actors))


def _draw_labels(tags: NDArray[np.uint8], instance: NDArray[np.int32], actors: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """Return an image of tags (H, W), with the ids of the trace's `actors` (A,) where they are visible."""
    image = np.empty((*tags.shape, 4), np.uint8)
    _write_labels(tags, instance, np.append(np.uint32(0), actors), image)
    return image


def _pack_picture(sensor: Sensor, image: NDArray[np.uint8]) -> bytes:
    return pack_image(image.shape[1], image.shape[0], sensor.number_of("fov"), image)


@compiled
def _write_colours(rgb, image):
    for row in range(len(image)):
        for column in range(image.shape[1]):
            image[row, column, 0], image[row, column, 1] = rgb[row, column, 2], rgb[row, column, 1]
            image[row, column, 2], image[row, column, 3] = rgb[row, column, 0], 255


@compiled
def _write_depths(distance, rays, image):
    for pixel in range(len(image)):
        share = min(distance[pixel] * rays[pixel, 2] / np.float32(FAR_M), np.float32(1))
        code = np.uint32(np.float64(share) * DEPTH_STEPS)
        image[pixel, 0], image[pixel, 1], image[pixel, 2] = code >> 16 & 255, code >> 8 & 255, code & 255
        image[pixel, 3] = 255


@compiled
def _write_labels(tags, instance, numbers, image):
    for row in range(len(image)):
        for column in range(image.shape[1]):
            number = numbers[max(instance[row, column], 0)]
            image[row, column, 0], image[row, column, 1] = number >> 8 & 255, number & 255
            image[row, column, 2], image[row, column, 3] = tags[row, column], 255


GRAVITY = np.array((0.0, 0.0, 9.81))  # CARLA's [m/s^2]


def sense_gnss(sight: TownSight, sensor: Sensor) -> bytes:
    """Measure latitude [deg], longitude [deg] and altitude [m]; return their bytes.

    Like `Map.transform_to_geolocation` of CARLA 0.9.16, it takes CARLA's y as north, although the map's is mirrored.
    """
    x, y, z = sight.frame.to_location(sensor.pose[:3, 3])
    dx, dy = sight.frame.offset_m
    place = convert_to_geodetic(sight.scene.town.geo, np.array((x + dx, y + dy, z)))
    rng = sight.draw(sensor)
    noise = [
        rng.normal(sensor.number_of(f"noise_{axis}_bias"), sensor.number_of(f"noise_{axis}_stddev"))
        for axis in ("lat", "lon", "alt")
    ]
    return pack_record((place + noise).tolist())


def sense_imu(sight: TownSight, sensor: Sensor) -> bytes:
    """Measure specific force [m/s^2], angular velocity [rad/s], sensor frame, and compass [rad] from north."""
    turn = sensor.pose[:3, :3].T
    rng = sight.draw(sensor)

    def noise(kind: str) -> np.ndarray:
        return np.array([rng.normal(0.0, sensor.number_of(f"noise_{kind}_stddev_{axis}")) for axis in "xyz"])

    bias = np.array([sensor.number_of(f"noise_gyro_bias_{axis}") for axis in "xyz"])
    force = mirror(turn @ (sensor.acceleration + GRAVITY)) + noise("accel")
    rate = mirror_spin(turn @ sensor.spin) + bias + noise("gyro")
    yaw = -yaw_of(sensor.pose)
    return pack_record([force.tolist(), rate.tolist(), float((yaw + np.pi / 2) % (2 * np.pi))])


MOST_RAYS = 4_000_000  # of a sweep


def sense_lidar(sight: TownSight, sensor: Sensor) -> bytes:
    """Measure a LiDAR sweep, x, y, z [m], sensor frame, and intensity; return its bytes."""
    directions, channels = _fire(sensor)
    hits = sight.cast(sensor, directions, sensor.number_of("range"))
    rng = sight.draw(sensor)
    settings = CarlaReturns(
        atmosphere_attenuation_rate=sensor.number_of("atmosphere_attenuation_rate"),
        dropoff_general_rate=sensor.number_of("dropoff_general_rate"),
        dropoff_intensity_limit=max(sensor.number_of("dropoff_intensity_limit"), 1e-6),
        dropoff_zero_intensity=sensor.number_of("dropoff_zero_intensity"),
    )
    noise = sensor.number_of("noise_stddev")
    error_m = np.float32(noise) * rng.standard_normal(len(directions), np.float32) if noise else np.zeros(1, np.float32)
    points, rays = carla_returns(settings, directions, hits.distance, np.broadcast_to(error_m, len(directions)), rng)
    points[:, :3] = mirror(points[:, :3])
    return _pack_returns(sensor, channels, rays, points.astype("<f4"))


def sense_semantic_lidar(sight: TownSight, sensor: Sensor) -> bytes:
    """Measure a semantic LiDAR sweep: x, y, z [m], sensor frame, cosine of incidence, actor id and tag."""
    directions, channels = _fire(sensor)
    hits = sight.cast(sensor, directions, sensor.number_of("range"))
    rays = np.flatnonzero(np.isfinite(hits.distance))
    met = Hits(hits.distance[rays], hits.instance[rays], hits.face[rays])
    points = np.empty(len(rays), SEMANTIC_POINT)
    points["xyz"] = mirror(directions[rays] * met.distance[:, None])
    points["cosine"] = _incidence(sight, sensor, directions[rays], met)
    points["actor"], points["tag"] = sight.numbers(met), sight.tags(met)
    return _pack_returns(sensor, channels, rays, points)


def sense_radar(sight: TownSight, sensor: Sensor) -> bytes:
    """Measure radar detections: range rate [m/s], azimuth, altitude [rad] and range [m]; return their bytes."""
    rng = sight.draw(sensor)
    count = min(max(1, round(sensor.number_of("points_per_second") * sensor.elapsed_s)), MOST_RAYS)
    wide, high = (
        np.tan(np.radians(min(sensor.number_of(name), 179.0)) / 2) for name in ("horizontal_fov", "vertical_fov")
    )
    radius, angle = np.sqrt(rng.random(count)), rng.random(count) * 2 * np.pi
    azimuth = np.arctan(radius * np.cos(angle) * wide)  # to the right
    altitude = np.arctan(radius * np.sin(angle) * high)
    directions = unit_vectors(-azimuth, altitude).astype(np.float32)
    hits = sight.cast(sensor, directions, sensor.number_of("range"))
    rays = np.flatnonzero(np.isfinite(hits.distance))
    line = directions[rays] @ sensor.pose[:3, :3].T
    moving = np.concatenate((np.zeros((1, 3)), np.nan_to_num(sight.scene.trace.velocity[0])))[hits.instance[rays]]
    rate = ((moving - sensor.velocity) * line).sum(axis=1)
    return np.column_stack((rate, azimuth[rays], altitude[rays], hits.distance[rays])).astype("<f4").tobytes()


def _fire(sensor: Sensor) -> tuple[NDArray[np.float32], int]:
    """Return the unit rays of a sweep (channels * columns, 3), sensor frame, channel by channel, and the channels."""
    channels, field = int(sensor.number_of("channels")), sensor.number_of("horizontal_fov")
    columns = _count_columns(sensor, channels)
    turn = sensor.number_of("rotation_frequency") * field * sensor.elapsed_s
    azimuth = (sensor.azimuth_deg + np.arange(columns) * turn / columns) % field - field / 2
    sensor.azimuth_deg = round(float(sensor.azimuth_deg + turn), 6) % field
    elevation = np.linspace(sensor.number_of("upper_fov"), sensor.number_of("lower_fov"), channels)
    rays = unit_vectors(-np.radians(azimuth)[None], np.radians(elevation)[:, None])  # it turns to the right
    return rays.reshape(-1, 3).astype(np.float32), channels


def _count_columns(sensor: Sensor, channels: int) -> int:
    """Return the number of rays per channel in a sweep; halves are rounded up, as in CARLA."""
    wanted = int(sensor.number_of("points_per_second") * sensor.elapsed_s / channels + 0.5 + 1e-6)
    return min(max(1, wanted), MOST_RAYS // channels)


def _incidence(sight: TownSight, sensor: Sensor, directions: NDArray[np.float32], met: Hits) -> NDArray[np.float32]:
    """Return the cosines of the angles of incidence of hits (N,)."""
    surfaces = sight.scene.surfaces
    normal = surfaces.normal[surfaces.first[met.instance] + met.face]
    turn = (sensor.pose[:3, :3].T @ sight.scene.world_from_instance()).astype(np.float32)
    return np.abs(np.einsum("nij,nj,ni->n", turn[met.instance], normal, directions))


def _pack_returns(sensor: Sensor, channels: int, rays: NDArray[np.int64], points: NDArray) -> bytes:
    per_channel = np.bincount(rays // _count_columns(sensor, channels), minlength=channels)
    return pack_lidar(float(np.radians(sensor.azimuth_deg)), per_channel, points)


class Kind(NamedTuple):
    """The implementation of a kind of sensor."""

    stream: Stream  # of its messages
    measure: Callable[[TownSight, Sensor], bytes] | None  # returns the payload; None for sensors that send events
    rays: bool = False  # whether it casts rays, which takes some time
    late: bool = False  # whether it renders an image, which takes longer: sent after the world state


KINDS: dict[str, Kind] = {
    "sensor.camera.rgb": Kind(Stream.RGB, sense_rgb, True, True),
    "sensor.camera.depth": Kind(Stream.DEPTH, sense_depth, True, True),
    "sensor.camera.semantic_segmentation": Kind(Stream.SEMANTIC, sense_semantic, True, True),
    "sensor.camera.instance_segmentation": Kind(Stream.INSTANCE, sense_instance, True, True),
    "sensor.lidar.ray_cast": Kind(Stream.LIDAR, sense_lidar, True),
    "sensor.lidar.ray_cast_semantic": Kind(Stream.SEMANTIC_LIDAR, sense_semantic_lidar, True),
    "sensor.other.gnss": Kind(Stream.GNSS, sense_gnss),
    "sensor.other.imu": Kind(Stream.IMU, sense_imu),
    "sensor.other.radar": Kind(Stream.RADAR, sense_radar, True),
    "sensor.other.collision": Kind(Stream.COLLISION, None),
    "sensor.other.lane_invasion": Kind(Stream.LANE_INVASION, None),  # clients compute these from the map
    "sensor.other.obstacle": Kind(Stream.OBSTACLE, None),
}
EARLY_S = 1e-6  # rounding of times


class SensorClock:
    """The clock of a sensor: it measures at its first tick, then every `sensor_tick`, or every tick if that is 0."""

    def __init__(self, tick_s: float) -> None:
        """Set the period `sensor_tick` [s]."""
        self._tick_s = tick_s
        self._next_s: float | None = None
        self._last_s: float | None = None

    def take(self, time_s: float, dt_s: float) -> float | None:
        """Return the time since the last measurement [s] if one is due at `time_s` [s], `dt_s` [s] after the last tick.

        The first measurement covers a whole `sensor_tick`. None if none is due.
        """
        if self._next_s is not None and time_s < self._next_s - EARLY_S:
            return None
        elapsed = max(self._tick_s, dt_s) if self._last_s is None else round(time_s - self._last_s, 9)
        due = time_s if self._next_s is None else self._next_s
        self._next_s = max(due + self._tick_s, time_s) if self._tick_s else time_s
        self._last_s = time_s
        return elapsed


RING = 8  # rays on the circle of the hit radius, around the central one
AHEAD = np.array([[1.0, 0.0, 0.0]], np.float32)
TAG_NAMES = {number: name for name, number in SEMANTICS.items()}


TAG_OF = {  # kind of object -> semantic class
    "tree": "vegetation",
    "clutter": "static",
    "post": "pole",
    "lamp": "pole",
    "sign": "traffic_sign",
    "signal": "traffic_light",
    "vehicle": "car",
}


def describe_thing(kind: str) -> ActorRecord:
    """Return the record of an object of the town, such as a building, named after CARLA's class."""
    kind = TAG_OF.get(kind, kind).replace("_", "")
    nowhere = BoundingBox((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    return ActorRecord(0, 0, Description(0, f"static.{kind}", ()), nowhere, b"", b"")


def find_collisions(collisions: Sequence[Collision], describe: Callable[[str], ActorRecord]) -> dict[str, list[bytes]]:
    """Return the messages of collision sensors by the name of their carrier; `describe` gives the record of a name."""
    messages: dict[str, list[bytes]] = {}
    for collision in collisions:
        impulse = np.array((*collision.impulse, 0.0))
        for name, other, share in (
            (collision.name, collision.other, impulse),
            (collision.other, collision.name, -impulse),
        ):
            x, y, z = mirror(share).tolist()
            record = CollisionRecord(describe(name), describe(other), (x, y, z))
            messages.setdefault(name, []).append(pack_record(record))
    return messages


def _sweep_actors(sight: TownSight, sensor: Sensor) -> tuple[float, str] | None:
    """Return distance [m] and name of the first vehicle or walker whose box, plus the radius, the ray ahead hits.

    Parked vehicles, props and the town are ignored, and do not occlude.
    """
    trace, radius, best = sight.scene.trace, sensor.number_of("hit_radius"), None
    moves = (sight.actors > 0) & (trace.category != "prop") & (trace.actor != sensor.carrier) & trace.present[0]
    for row in np.flatnonzero(moves).tolist():
        to_box = inverse(sight.scene.world_from_actor(row)) @ sensor.pose
        start = to_box[:3, 3]
        way = to_box[:3, 0]
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


def find_obstacle(
    sight: TownSight, sensor: Sensor, carrier: ActorRecord, describe: Callable[[str], ActorRecord]
) -> bytes | None:
    """Return the message of an obstacle sensor on `carrier`, on the nearest object ahead within its radius, or None."""
    if sensor.attributes["only_dynamics"].lower() in ("true", "1"):
        met = _sweep_actors(sight, sensor)
        return None if met is None else pack_record(ObstacleEvent(carrier, describe(met[1]), met[0]))
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
    return None if best is None else pack_record(ObstacleEvent(carrier, describe(best[1]), best[0]))
