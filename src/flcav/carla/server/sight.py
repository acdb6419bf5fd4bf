"""The view of sensors at one tick, and a sensor with its state between ticks."""

import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from flcav.carla.frames import MapFrame
from flcav.carla.server.blueprints import Quality
from flcav.geometry import Array, inverse
from flcav.sensors.camera import Camera, Exposure, label, photograph
from flcav.sensors.lens import BODY_FROM_OPTICAL, Lens
from flcav.sensors.rendering.appearance import build_appearance
from flcav.statistics.streams import stream
from flcav.world.map.town import Town
from flcav.world.rays.packets import Hits
from flcav.world.scene import Scene
from flcav.world.trace import Trace
from flcav.world.weather import Weather

THREADS = min(os.cpu_count() or 1, 4)  # rendering threads of an image


@dataclass
class Sensor:
    """A sensor with its pose, motion and state."""

    type: str  # name of its blueprint
    attributes: Mapping[str, str]  # of the blueprint
    number: int  # index among the actors of its episode, part of the names of its random streams
    pose: Array  # (4, 4) world from sensor [m]; x forward, y left, z up
    carrier: str = ""  # the actor that carries it, as in `Trace.actor`
    velocity: Array = field(default_factory=lambda: np.zeros(3))  # (3,) of the carrier, world frame [m/s]
    spin: Array = field(
        default_factory=lambda: np.zeros(3)
    )  # (3,) angular velocity of the carrier, world frame [rad/s]
    acceleration: Array = field(default_factory=lambda: np.zeros(3))  # (3,) of the carrier, world frame [m/s^2]
    elapsed_s: float = 0.0  # time since its last measurement [s]
    azimuth_deg: float = 0.0  # azimuth at which a LiDAR's last sweep ended [deg]

    def number_of(self, attribute: str) -> float:
        """Return the value of a numeric attribute."""
        return float(self.attributes[attribute])


def lens_of(sensor: Sensor) -> Lens:
    """Return the lens (intrinsics) of a camera."""
    width, height = (int(sensor.number_of(f"image_size_{axis}")) for axis in "xy")
    return Lens(width=width, height=height, fov_deg=sensor.number_of("fov"))


def _drawn_lens(sensor: Sensor) -> Lens:
    """Return the lens for rendering a camera's colours: in low quality it has half the columns and rows."""
    lens = lens_of(sensor)
    if sensor.attributes.get("quality") != Quality.LOW:
        return lens
    return Lens(width=-(-lens.width // 2), height=-(-lens.height // 2), fov_deg=lens.fov_deg)


@dataclass
class TownSight:
    """The town's state at one tick, for all sensors."""

    scene: Scene  # at this tick
    weather: Weather
    frame: MapFrame
    seed: int
    tick: int  # number of ticks since the map was loaded
    actors: NDArray[np.uint32]  # (A,) clients' ids of the trace's actors; 0 for parked vehicles
    _exposures: dict[tuple[bytes, Lens], Exposure] = field(default_factory=dict)

    def draw(self, sensor: Sensor) -> np.random.Generator:
        """Return the random number generator of a sensor at this tick."""
        return stream(self.seed, "carla", sensor.number, self.tick, sensor.attributes.get("noise_seed", "0"))

    def find_inside(self, sensor: Sensor) -> int | None:
        """Return the row of the sensor's carrier if the sensor is inside its box, where it would see only the box."""
        trace = self.scene.trace
        rows = np.flatnonzero(trace.actor == sensor.carrier)
        if not len(rows) or not trace.present[0, rows[0]]:
            return None
        row = int(rows[0])
        x, y, z = (inverse(self.scene.world_from_actor(row)) @ sensor.pose[:, 3])[:3]
        length, width, height = trace.size[row]
        return row if abs(x) <= length / 2 and abs(y) <= width / 2 and 0 <= z <= height else None

    def cast(self, sensor: Sensor, directions: NDArray[np.float32], far_m: float) -> Hits:
        """Return the first hits of unit rays (N, 3), sensor frame, up to `far_m` [m]."""
        return self.scene.cast(sensor.pose, directions, far_m=far_m, hidden=self.find_inside(sensor))

    def tags(self, hits: Hits) -> NDArray[np.uint8]:
        """Return (N,) CARLA's semantic tags of hits; 0 where nothing is hit."""
        met = hits.instance >= 0
        row = self.scene.surfaces.first[hits.instance] + hits.face
        return np.where(met, build_appearance(self.scene).semantic[np.where(met, row, 0)], np.uint8(0))

    def numbers(self, hits: Hits) -> NDArray[np.uint32]:
        """Return (N,) the clients' actor ids of hits; 0 for the town."""
        return np.append(np.uint32(0), self.actors)[np.maximum(hits.instance, 0)]

    def label(self, sensor: Sensor) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
        """Return the semantic and the instance image (H, W) of a camera, from its colour image if there is one."""
        lens = lens_of(sensor)
        if (known := self._exposures.get((sensor.pose.tobytes(), lens))) is not None:
            return known.semantic, known.instance
        pose, hidden = sensor.pose @ BODY_FROM_OPTICAL, self.find_inside(sensor)
        return label(self.scene, pose, lens, hidden=hidden, threads=THREADS)

    def photograph(self, sensor: Sensor) -> Exposure:
        """Return the image of a camera, rendered once for all cameras with its pose and lens.

        Smaller in low quality.
        """
        lens = _drawn_lens(sensor)
        key = sensor.pose.tobytes(), lens
        if key not in self._exposures:
            camera = Camera(**lens.model_dump(), noise=0.0)
            pose, hidden = sensor.pose @ BODY_FROM_OPTICAL, self.find_inside(sensor)
            rng = stream(self.seed, "carla", "camera", self.tick)
            self._exposures[key] = photograph(
                self.scene, pose, camera, self.weather, rng, hidden=hidden, threads=THREADS
            )
        return self._exposures[key]


class Scenes:
    """The scenes of a town by name, so that threads that render concurrently use different ones."""

    def __init__(self, town: Town) -> None:
        """Start without scenes: they are built on first use."""
        self._town, self._building = town, threading.Lock()
        self._scenes: dict[str, Scene] = {}

    def follow(self, name: str, trace: Trace, paints: Mapping[str, tuple[float, float, float]]) -> Scene:
        """Return the named scene in the state of a trace, with these colours of actors (linear RGB)."""
        with self._building:
            if name not in self._scenes:
                self._scenes[name] = Scene(self._town, trace)
            scene = self._scenes[name]
            scene.paints = paints
            scene.follow(trace)
        return scene
