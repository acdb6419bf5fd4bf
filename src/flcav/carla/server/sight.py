"""What sensors see at one tick, and a sensor with its state from tick to tick."""

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

THREADS = min(os.cpu_count() or 1, 4)  # that draw an image


@dataclass
class Sensor:
    """A sensor in the town."""

    type: str  # name of its blueprint
    attributes: Mapping[str, str]
    number: int  # among the actors of its episode: part of the names of its random streams
    pose: Array  # (4, 4) world from sensor, x forward, y left, z up
    carrier: str = ""  # the actor that it is on, as in `Trace.actor`
    velocity: Array = field(default_factory=lambda: np.zeros(3))  # of the carrier, world [m/s]
    spin: Array = field(default_factory=lambda: np.zeros(3))  # its angular velocity, world [rad/s]
    acceleration: Array = field(default_factory=lambda: np.zeros(3))  # of the carrier, world [m/s^2]
    elapsed_s: float = 0.0  # since the last time it measured
    azimuth_deg: float = 0.0  # of a LiDAR, where its last sweep ended

    def number_of(self, attribute: str) -> float:
        """Return the value of a numeric attribute."""
        return float(self.attributes[attribute])


def lens_of(sensor: Sensor) -> Lens:
    """Return the lens of a camera."""
    width, height = (int(sensor.number_of(f"image_size_{axis}")) for axis in "xy")
    return Lens(width=width, height=height, fov_deg=sensor.number_of("fov"))


def _drawn_lens(sensor: Sensor) -> Lens:
    """Return the lens by which a camera's colours are drawn: of low quality it has half of the columns and rows."""
    lens = lens_of(sensor)
    if sensor.attributes.get("quality") != Quality.LOW:
        return lens
    return Lens(width=-(-lens.width // 2), height=-(-lens.height // 2), fov_deg=lens.fov_deg)


@dataclass
class TownSight:
    """The town at one tick, as all its sensors see it."""

    scene: Scene  # at this tick
    weather: Weather
    frame: MapFrame
    seed: int
    tick: int  # since the map was loaded
    actors: NDArray[np.uint32]  # (A,) the number that clients know each of the trace's actors by; 0 for parked ones
    _exposures: dict[tuple[bytes, Lens], Exposure] = field(default_factory=dict)

    def draw(self, sensor: Sensor) -> np.random.Generator:
        """Return the random stream of a sensor at this tick."""
        return stream(self.seed, "carla", sensor.number, self.tick, sensor.attributes.get("noise_seed", "0"))

    def find_inside(self, sensor: Sensor) -> int | None:
        """Return the sensor's carrier where the sensor is inside its box, so that it would see nothing but the box."""
        trace = self.scene.trace
        rows = np.flatnonzero(trace.actor == sensor.carrier)
        if not len(rows) or not trace.present[0, rows[0]]:
            return None
        row = int(rows[0])
        x, y, z = (inverse(self.scene.world_from_actor(row)) @ sensor.pose[:, 3])[:3]
        length, width, height = trace.size[row]
        return row if abs(x) <= length / 2 and abs(y) <= width / 2 and 0 <= z <= height else None

    def cast(self, sensor: Sensor, directions: NDArray[np.float32], far_m: float) -> Hits:
        """Return the first hits of rays (N, 3) in the sensor's frame."""
        return self.scene.cast(sensor.pose, directions, far_m=far_m, hidden=self.find_inside(sensor))

    def tags(self, hits: Hits) -> NDArray[np.uint8]:
        """Return CARLA's semantic tag of each hit; 0 where there is none."""
        met = hits.instance >= 0
        row = self.scene.surfaces.first[hits.instance] + hits.face
        return np.where(met, build_appearance(self.scene).semantic[np.where(met, row, 0)], np.uint8(0))

    def numbers(self, hits: Hits) -> NDArray[np.uint32]:
        """Return the number of the actor of each hit, as clients know it; 0 for the town."""
        return np.append(np.uint32(0), self.actors)[np.maximum(hits.instance, 0)]

    def label(self, sensor: Sensor) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
        """Return the semantic and the instance image of a camera: those of its colour image, if there is one."""
        lens = lens_of(sensor)
        if (known := self._exposures.get((sensor.pose.tobytes(), lens))) is not None:
            return known.semantic, known.instance
        pose, hidden = sensor.pose @ BODY_FROM_OPTICAL, self.find_inside(sensor)
        return label(self.scene, pose, lens, hidden=hidden, threads=THREADS)

    def photograph(self, sensor: Sensor) -> Exposure:
        """Return the image of a camera, taken once for all cameras of one pose and lens; smaller in low quality."""
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
    """The scenes of a town by name, one for each of the threads that look at it at once."""

    def __init__(self, town: Town) -> None:
        """Start without any: each is built when it is first looked at."""
        self._town, self._building = town, threading.Lock()
        self._scenes: dict[str, Scene] = {}

    def follow(self, name: str, trace: Trace, paints: Mapping[str, tuple[float, float, float]]) -> Scene:
        """Return a scene at the instant of a trace, with actors in these colours (linear RGB)."""
        with self._building:
            if name not in self._scenes:
                self._scenes[name] = Scene(self._town, trace)
            scene = self._scenes[name]
            scene.paints = paints
            scene.follow(trace)
        return scene
