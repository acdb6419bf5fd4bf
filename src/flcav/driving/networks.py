"""Perception by the networks of the package: LiDAR at 10 Hz and a camera at 2 Hz on the ego vehicle of a live world.

`objects` detects road users in the sweep, which are tracked together with what stands on the lanes and has no class
(`obstacles`), and `trajectory` forecasts them; `signs` detects lights in the picture, which are matched with the
projected signal heads of the map; `weather` gives the share of the speed limit.
Speed limit signs and stop signs are detected but not used: a route has its limits from the map.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import shapely

from flcav.config import InputError
from flcav.driving.following import CERTAIN, FollowedTracks, Following, PathSpread
from flcav.driving.lines.lane_keeping import LASTS_S, STATIONS_M, SeenLane, find_centres, fit_lane
from flcav.driving.lines.passing import join_lanes
from flcav.driving.obstacles import clear_air, find_obstacles
from flcav.driving.road import RoadUnits, merge_detections
from flcav.driving.scenarios import StagedScenario
from flcav.driving.seen import EGO, WEATHER_SPEED, Seen
from flcav.geometry import Array, Boxes, concatenate, heading_vectors, inverse, transform_points
from flcav.perception.networks import resolve_network
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.road.lines import GroundPlane, trace_lines
from flcav.perception.road.model import RoadNetwork
from flcav.perception.road.predict import segment_picture
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
from flcav.world.map.roads import Route
from flcav.world.map.town import Town, load_town
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot
from flcav.world.weather import draw_weather

SCORE = 0.3  # least score of detected objects
LINE_SCORE = 0.6  # least score of lane lines: below that of the task, since those of other lanes are left out
LIGHT_SCORE = 0.25  # least score of detected lights
CAMERA_STEPS = 5  # of 0.1 s between two pictures
BESIDE_M = 1.0  # of the lanes, where obstacles of no class are looked for, too
LIGHTS_M = 70.0  # range of lights
BESIDE_PX = 6.0  # greatest distance from the projected head to the box of a detection
REMEMBERED_S = 3.0  # for which the last state of a light is kept
LIDAR, CAMERA = "lidar", "camera"
FACING = -0.3  # greatest cosine between the camera's axis and a head's front: others show their side or back
SHOWN = {"light_red": "r", "light_yellow": "y", "light_green": "G"}


class Networks(NamedTuple):
    """One network of each task."""

    objects: Second
    trajectory: TrajectoryNetwork
    signs: SignDetector
    weather: Classifier


@lru_cache(maxsize=1)
def load_networks() -> Networks:
    """Return the networks of the package, cached."""
    return Networks(*(resolve_network(task_named(name), None) for name in Networks._fields))


@lru_cache(maxsize=len(Networks._fields))
def name_network(task: str) -> str:
    """Return the name of the package's network of a task, as in "objects (small)"."""
    return f"{task} ({read_card(find_shipped(task_named(task))).network})"


@lru_cache(maxsize=4)
def load_road_map(town: str) -> RoadMap:
    """Return the road map of a town for the trajectory network, cached."""
    return road_map(load_town(town))


@lru_cache(maxsize=1)
def load_road_network() -> RoadNetwork:
    """Return the package's network of the road task, cached."""
    return resolve_network(task_named("road"), None)


class LightReader:
    """Reader of traffic lights in camera pictures, with a memory of `REMEMBERED_S`."""

    def __init__(self, town: Town) -> None:
        heads = len(town.signals.link) - town.signals.walkers
        self._position, self._yaw = town.signals.position[:heads], town.signals.yaw[:heads]
        self._link = town.signals.link[:heads]
        self._last: dict[str, tuple[float, str]] = {}

    def read(self, frame: Frame, network: SignDetector, time_s: float) -> dict[str, str | None]:
        """Read the lights in the frame's picture, taken at `time_s` [s].

        Return the state (a letter of SUMO) of each light in view, by its link; None where it was not detected.
        """
        detections = detect_in_picture(network, frame.images[CAMERA].rgb, threshold=LIGHT_SCORE)
        read = dict[str, str | None]()
        for row, x, y in self.project(frame):
            read.setdefault(self._link[row], None)
            box = detections.box
            away = np.maximum(np.maximum(box[:, 0] - x, x - box[:, 2]), np.maximum(box[:, 1] - y, y - box[:, 3]))
            for detection in np.flatnonzero(away <= BESIDE_PX).tolist():  # by falling score
                letter = SHOWN.get(network.config.classes[int(detections.label[detection])])
                if letter is not None:
                    self._last[self._link[row]] = (time_s, letter)
                    read[self._link[row]] = letter
                    break
        return read

    def project(self, frame: Frame) -> Iterator[tuple[int, float, float]]:
        """Yield the signal heads in view of a frame's camera: row of the head, and x, y [px] from the corner."""
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
        """Return the links whose lights were last read as red or yellow at `time_s` [s], and those read as yellow."""
        fresh = {link: letter for link, (at, letter) in self._last.items() if time_s - at <= REMEMBERED_S}
        closed = frozenset(link for link, letter in fresh.items() if letter != "G")
        return closed, frozenset(link for link, letter in fresh.items() if letter == "y")


def find_lines(frame: Frame, network: RoadNetwork) -> list[Array]:
    """Return the lane lines in a frame's picture: x, y (K, 2) on the ground, world frame [m].

    Raises `InputError` where the frame has no such camera.
    """
    if CAMERA not in frame.images:
        raise InputError(f"the vehicle's rig has no camera '{CAMERA}', which its lane is seen by")
    shares, _ = segment_picture(network, frame.images[CAMERA].rgb)
    traced = trace_lines(shares, GroundPlane.of(frame, CAMERA))
    to_camera = frame.assumed.agent_from_sensor[CAMERA]
    world_from_agent = frame.assumed_world_from_sensor(CAMERA) @ inverse(to_camera)
    ground = [line.ground for line in traced if line.score >= LINE_SCORE and line.ground is not None]
    return [transform_points(world_from_agent, np.pad(points, ((0, 0), (0, 1))))[:, :2] for points in ground]


class LaneReader:
    """Reader of the vehicle's lane beside its route in camera pictures, with a memory of `LASTS_S`."""

    def __init__(self, route: Route, along: float) -> None:
        self._route, self._along = route, along
        self.centres: Array = np.full(len(STATIONS_M), np.nan)  # of the last picture, as of `find_centres`
        self._last: tuple[float, SeenLane | None] = (-LASTS_S, None)

    def read(self, frame: Frame, network: RoadNetwork, time_s: float) -> None:
        """Look for the lane in the frame's picture, taken at `time_s` [s]; raises `InputError` without a camera."""
        x, y = frame.world_from_agent[:2, 3].tolist()
        self._along, _ = self._route.project(x, y, self._along)
        self.centres = find_centres(find_lines(frame, network), self._route, self._along)
        if (lane := fit_lane(self.centres, self._route, self._along)) is not None:
            self._last = time_s, lane

    def lane(self, time_s: float) -> SeenLane | None:
        """Return the lane at `time_s` [s] as it was last seen; None where that is longer ago than `LASTS_S`."""
        read_s, lane = self._last
        return lane if time_s - read_s <= LASTS_S else None


class NetworkPerception:
    """Perception of a drive by the networks, from its sensors."""

    def __init__(
        self,
        staged: StagedScenario,
        seed: int,
        *,
        spread: PathSpread = CERTAIN,
        road: RoadUnits | None = None,
        lanes: bool = False,
    ) -> None:
        """Take a drive and its seed, the calibrated uncertainty, roadside units if any, and if lanes are looked for."""
        self.networks = load_networks()
        self.scene = Scene(staged.town, staged.world.snapshot.trace)
        self._seed, self._name = seed, staged.scenario.name
        drawn = draw_weather(staged.scenario.weather, stream(seed, "weather", self._name))
        self.weather = staged.scenario.sky or drawn
        self.lights = LightReader(staged.town)
        self._following = Following(self.networks.trajectory, load_road_map(staged.scenario.town), spread)
        self.lanes = LaneReader(staged.route, staged.start_m) if lanes else None
        self._step, self.pictured = 0, False  # steps so far, and whether the last one had a picture
        self.named, self.heads, self.lights_read_s = "clear", dict[str, str | None](), -1.0  # in the last picture
        self._road = road
        self._town, self._lanes = staged.town, join_lanes(staged.town).buffer(BESIDE_M)
        shapely.prepare(self._lanes)
        # of the last look in the world frame: the vehicle's detections, those with roadside units', what has no class
        self.own = self.found = self.obstacles = Boxes.empty()
        self.followed: FollowedTracks | None = None

    def look(self, snapshot: Snapshot) -> Seen:
        """Return the perception at this instant: observe the world with the rig, and run the networks."""
        self.scene.follow(snapshot.trace)
        self.pictured = self._step % CAMERA_STEPS == 0
        rig = Rig(lidars=lidar32().lidars, cameras=car().cameras if self.pictured else {})
        self._step += 1
        named = {"scene_name": self._name, "seed": self._seed, "number": snapshot.step, "weather": self.weather}
        frame = observe(self.scene, rig, EGO, 0, **named)
        if self.pictured:
            self.heads = self.lights.read(frame, self.networks.signs, snapshot.time_s)
            self.named, self.lights_read_s = self.name_weather(frame), snapshot.time_s
            if self.lanes is not None:
                self.lanes.read(frame, load_road_network(), snapshot.time_s)
        frame = replace(frame, lidar={LIDAR: clear_air(frame.lidar[LIDAR])})
        detections = detect_in(self.networks.objects, [frame], score_threshold=SCORE)[0]
        self.own = self.found = detections.transform(frame.assumed_world_from_sensor(LIDAR))
        if self._road is not None:
            self.found = merge_detections(self.own, self._road.receive(self.scene, snapshot))
        pose = frame.assumed_world_from_sensor(LIDAR)
        points = transform_points(pose, frame.lidar[LIDAR][:, :3])
        self.obstacles = find_obstacles(points, pose[:2, 3], self.found, self._lanes, self._town)
        closed, amber = self.lights.closed(snapshot.time_s)
        tracks = self._following.step(concatenate([self.found, self.obstacles]), snapshot.time_s, closed)
        self.followed = tracks
        return Seen(
            tracks.boxes,
            tracks.velocity,
            tracks.path,
            tracks.yaw,
            tracks.spread,
            closed,
            amber,
            WEATHER_SPEED[self.named],
            name_network("objects"),
            None if self.lanes is None else self.lanes.lane(snapshot.time_s),
        )

    def name_weather(self, frame: Frame) -> str:
        """Return the most probable weather class of the frame's picture."""
        network = self.networks.weather
        shares = predict_probabilities(network, [reduce_picture(frame.images[CAMERA].rgb)])[0]
        return network.config.classes[int(shares.argmax())]


def sense_networks(staged: StagedScenario, seed: int) -> NetworkPerception:
    """Return the perception by the networks of the package, as a `loop.Sensing`."""
    return NetworkPerception(staged, seed)
