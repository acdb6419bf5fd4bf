"""Perception by the networks of the package: LiDAR at 10 Hz and a camera at 2 Hz on the ego vehicle of a live world.

`objects` finds road users in the sweep, which are tracked, and `trajectory` forecasts them; `signs` finds lights in the
picture, which are told apart by where the map has their heads; `weather` gives the share of the speed limit. Signs of
speed limits and stop signs are found, and feed nothing: a route has its limits from the map.
"""

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from flcav.driving.following import CERTAIN, CONFIRMED, Confirmed, FollowedTracks, Following, PathSpread
from flcav.driving.road import RoadUnits, merge_detections
from flcav.driving.scenarios import StagedScenario
from flcav.driving.seen import EGO, WEATHER_SPEED, Seen
from flcav.geometry import Boxes, heading_vectors, inverse, transform_points
from flcav.perception.networks import resolve_network
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.signs.model import SignDetector
from flcav.perception.signs.predict import detect_in_picture
from flcav.perception.tasks import task_named
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.rasters import RoadMap, road_map
from flcav.perception.weather.evaluate import predict_probabilities
from flcav.perception.weather.model import Classifier
from flcav.perception.weather.samples import reduce_picture
from flcav.perception.weights import find_shipped, read_card
from flcav.sensors.frame import Frame
from flcav.sensors.observe import observe
from flcav.sensors.rig import Rig, car, lidar32
from flcav.statistics.streams import stream
from flcav.world.map.town import Town, load_town
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot
from flcav.world.weather import draw_weather

SCORE = 0.3  # of objects that count
LIGHT_SCORE = 0.25
CAMERA_STEPS = 5  # of 0.1 s between two pictures
LIGHTS_M = 70.0  # lights are looked for so far ahead
BESIDE_PX = 6.0  # from the projected head to the box of a detection, at most
REMEMBERED_S = 3.0  # a light is what it last was for so long
LIDAR, CAMERA = "lidar", "camera"
FACING = -0.3  # cosine between the camera's axis and a head's front below which it is read
SHOWN = {"light_red": "r", "light_yellow": "y", "light_green": "G"}


class Networks(NamedTuple):
    """One network of each task."""

    objects: Second
    trajectory: TrajectoryNetwork
    signs: SignDetector
    weather: Classifier


@lru_cache(maxsize=1)
def load_networks() -> Networks:
    """Return the networks of the package."""
    return Networks(*(resolve_network(task_named(name), None) for name in Networks._fields))


@lru_cache(maxsize=len(Networks._fields))
def name_network(task: str) -> str:
    """Return the name of the package's network of a task, as in "objects (small)"."""
    return f"{task} ({read_card(find_shipped(task_named(task))).network})"


@lru_cache(maxsize=4)
def load_road_map(town: str) -> RoadMap:
    """Return the map of a town for forecasts, cached."""
    return road_map(load_town(town))


class LightReader:
    """Memory of the lights that were seen not to be green, for `REMEMBERED_S`."""

    def __init__(self, town: Town) -> None:
        heads = len(town.signals.link) - town.signals.walkers
        self._position, self._yaw = town.signals.position[:heads], town.signals.yaw[:heads]
        self._link = town.signals.link[:heads]
        self._last: dict[str, tuple[float, str]] = {}

    def read(self, frame: Frame, network: SignDetector, time_s: float) -> dict[str, str | None]:
        """Read the lights in the frame's picture; return the letter of each that may be read, None where it was not."""
        found, read = (
            detect_in_picture(network, frame.images[CAMERA].rgb, threshold=LIGHT_SCORE),
            dict[str, str | None](),
        )
        for row, x, y in self.project(frame):
            read.setdefault(self._link[row], None)
            box = found.box
            beside = np.maximum(np.maximum(box[:, 0] - x, x - box[:, 2]), np.maximum(box[:, 1] - y, y - box[:, 3]))
            for other in np.flatnonzero(beside <= BESIDE_PX).tolist():  # by falling score
                letter = SHOWN.get(network.config.classes[int(found.label[other])])
                if letter is not None:
                    self._last[self._link[row]] = (time_s, letter)
                    read[self._link[row]] = letter
                    break
        return read

    def project(self, frame: Frame) -> Iterator[tuple[int, float, float]]:
        """Yield the heads that a frame's camera may read: row, and the pixel of its centre from the image's corner."""
        pose = frame.assumed_world_from_sensor(CAMERA)
        seen = transform_points(inverse(pose), self._position)
        turned = heading_vectors(self._yaw) @ pose[:2, 2]  # the optical axis is z
        height, width = frame.images[CAMERA].rgb.shape[:2]
        for row in np.flatnonzero((seen[:, 2] > 4.0) & (seen[:, 2] < LIGHTS_M) & (turned < FACING)).tolist():
            u, v, w = frame.assumed.intrinsics[CAMERA] @ seen[row]
            x, y = float(u / w) + 0.5, float(v / w) + 0.5
            if 0 <= x <= width and 0 <= y <= height:
                yield row, x, y

    def closed(self, time_s: float) -> tuple[frozenset[str], frozenset[str]]:
        """Return the lights that were last seen red or yellow, and the yellow ones."""
        fresh = {link: letter for link, (at, letter) in self._last.items() if time_s - at <= REMEMBERED_S}
        return frozenset(n for n, each in fresh.items() if each != "G"), frozenset(
            n for n, each in fresh.items() if each == "y"
        )


class NetworkPerception:
    """Perception of a drive by the networks, from its sensors."""

    def __init__(
        self,
        staged: StagedScenario,
        seed: int,
        *,
        spread: PathSpread = CERTAIN,
        road: RoadUnits | None = None,
        confirmed: Confirmed | None = CONFIRMED,
    ) -> None:
        """Take a drive, its seed, how uncertain tracks are, poles that send what they find, and which tracks hold."""
        self.networks = load_networks()
        self.scene = Scene(staged.town, staged.world.snapshot.trace)
        self._seed, self._name = seed, staged.scenario.name
        drawn = draw_weather(staged.scenario.weather, stream(seed, "weather", self._name))
        self.weather = staged.scenario.sky or drawn
        self.lights = LightReader(staged.town)
        self._following = Following(self.networks.trajectory, load_road_map(staged.scenario.town), spread, confirmed)
        self._step = 0
        self.named, self.heads, self.lights_read_s = "clear", dict[str, str | None](), -1.0  # in the last picture
        self._road = road
        self.own = self.found = Boxes.empty()  # of the last look, world frame: the vehicle's own, and with the road's
        self.followed: FollowedTracks | None = None

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the networks' perception at this instant."""
        self.scene.follow(snapshot.trace)
        pictured = self._step % CAMERA_STEPS == 0
        rig = Rig(lidars=lidar32().lidars, cameras=car().cameras if pictured else {})
        self._step += 1
        named = {"scene_name": self._name, "seed": self._seed, "number": snapshot.step, "weather": self.weather}
        frame = observe(self.scene, rig, EGO, 0, **named)
        if pictured:
            self.heads = self.lights.read(frame, self.networks.signs, snapshot.time_s)
            self.named, self.lights_read_s = self.name_weather(frame), snapshot.time_s
        found = detect_in(self.networks.objects, [frame], score_threshold=SCORE)[0]
        self.own = self.found = found.transform(frame.assumed_world_from_sensor(LIDAR))
        if self._road is not None:
            self.found = merge_detections(self.own, self._road.receive(self.scene, snapshot))
        closed, amber = self.lights.closed(snapshot.time_s)
        told = self._following.step(self.found, snapshot.time_s, closed)
        self.followed = told
        return Seen(
            told.boxes,
            told.velocity,
            told.path,
            told.yaw,
            told.spread,
            closed,
            amber,
            WEATHER_SPEED[self.named],
            name_network("objects"),
        )

    def name_weather(self, frame: Frame) -> str:
        """Return the likeliest class of weather in the frame's picture."""
        network = self.networks.weather
        shares = predict_probabilities(network, [reduce_picture(frame.images[CAMERA].rgb)])[0]
        return network.config.classes[int(shares.argmax())]


def sense_networks(staged: StagedScenario, seed: int) -> NetworkPerception:
    """Return the perception by the networks of the package, for `loop.drive`."""
    return NetworkPerception(staged, seed)


def sense_unconfirmed(staged: StagedScenario, seed: int) -> NetworkPerception:
    """Return the perception by the networks of the package, which believes every track of two detections."""
    return NetworkPerception(staged, seed, confirmed=None)
