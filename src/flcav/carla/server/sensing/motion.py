"""CARLA's GNSS and IMU: MessagePack records."""

import numpy as np

from flcav.carla.frames import mirror, mirror_spin
from flcav.carla.server.sensing.sight import Sensor, Sight
from flcav.carla.server.wire import pack_record
from flcav.geometry import yaw_of
from flcav.world.geodesy import convert_to_geodetic

GRAVITY = np.array((0.0, 0.0, 9.81))  # CARLA's [m/s^2]


def sense_gnss(sight: Sight, sensor: Sensor) -> bytes:
    """Return latitude [deg], longitude [deg] and altitude [m].

    As `Map.transform_to_geolocation` of CARLA 0.9.16 does, it takes CARLA's y for north, though the map's is mirrored.
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


def sense_imu(sight: Sight, sensor: Sensor) -> bytes:
    """Return specific force [m/s^2], angular velocity [rad/s] in the sensor's frame, and compass [rad] from north."""
    turn = sensor.pose[:3, :3].T
    rng = sight.draw(sensor)

    def noise(kind: str) -> np.ndarray:
        return np.array([rng.normal(0.0, sensor.number_of(f"noise_{kind}_stddev_{axis}")) for axis in "xyz"])

    bias = np.array([sensor.number_of(f"noise_gyro_bias_{axis}") for axis in "xyz"])
    force = mirror(turn @ (sensor.acceleration + GRAVITY)) + noise("accel")
    rate = mirror_spin(turn @ sensor.spin) + bias + noise("gyro")
    yaw = -yaw_of(sensor.pose)
    return pack_record([force.tolist(), rate.tolist(), float((yaw + np.pi / 2) % (2 * np.pi))])
