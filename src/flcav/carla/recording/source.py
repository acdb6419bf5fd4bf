"""CARLA as a source of frames: its world and traffic, observed by the sensors of a recipe's rigs."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flcav.carla.frames import MapFrame
from flcav.carla.recording.labels import CameraSight, LabelledSweep, annotate_bodies
from flcav.carla.recording.sensors import (
    Feed,
    depth_name,
    read_classes,
    read_colours,
    read_depths,
    read_fix,
    read_inertia,
    read_lidar_points,
    read_semantic_points,
    semantic_name,
    spawn_feeds,
)
from flcav.carla.recording.session import Session, check_installed, open_session
from flcav.carla.recording.traffic import (
    State,
    TrackedBody,
    list_bodies,
    read_pose,
    read_state,
    spawn_vehicles,
    spawn_walkers,
)
from flcav.carla.server.weather import make_weather
from flcav.config import InputError, Json
from flcav.geometry import Array, Boxes, points_in_boxes, pose, transform_points
from flcav.sensors.frame import Calibration, CameraImage, Frame
from flcav.sensors.navigation import draw_fix_errors, draw_imu_errors
from flcav.sensors.rig import CAMERA_RANGE_M, Rig, build_calibration, perturb_calibration
from flcav.sources.embedded import check_mounts, read_town_files
from flcav.sources.recipe import STEP_S, CarlaRecipe, DividedSource
from flcav.statistics.streams import derive_seed, stream
from flcav.world.geodesy import convert_to_geodetic
from flcav.world.map.parameters import GeoReference
from flcav.world.map.town import PACKAGED, Town, check_town_name, load_town
from flcav.world.weather import Weather

if TYPE_CHECKING:
    import carla

SETTLED = 2  # ticks before the traffic is complete: one for walkers, one to list the actors
LEAD = 2  # ticks from the spawning of sensors to the first spin
BODY_M = 0.1  # by which points on the carrier may lie outside its box


@dataclass(frozen=True)
class Agent:
    """An agent: a vehicle or pole that records."""

    name: str
    rig: Rig
    calibration: Calibration
    number: int | None  # CARLA's id of its vehicle; None for a pole
    base: Array  # (4, 4) pose of the agent frame in the frame of its vehicle, or of a pole in the world frame [m]
    feeds: Mapping[str, Feed]


class CarlaSource(DividedSource):
    """CARLA as a source of a recipe's frames: every scene is a freshly loaded map with new traffic."""

    def __init__(self, recipe: CarlaRecipe, beside: Path | None = None) -> None:
        """Find the town, if it is known, and its poles.

        A town of flcav, or its folder, which may be relative to `beside`, the recipe's folder, gives poles and the
        world's origin; any other `town` is a map of the server without poles. Raises `InputError` where CARLA's client
        is not installed, a pole does not exist, or there is no agent.
        """
        check_installed()
        self.recipe = recipe
        self.town = _find_town(recipe.town, beside)
        name = self.town.name if self.town else recipe.town
        check_town_name(name)
        self.map = recipe.map or name
        source = self.town.parameters.source if self.town else None
        self.frame = MapFrame() if source is None else MapFrame(source.offset_m)
        self.poles = self._find_poles()
        self.agents = [f"cav{i}" for i in range(recipe.cavs)] + list(self.poles)
        super().__init__(recipe, name, tuple(self.agents))
        check_mounts("vehicle_rig", recipe.vehicle_rig, "a vehicle", 0.0)
        for pole, world_from_pole in self.poles.items():
            x, y, z = world_from_pole[:3, 3].tolist()
            ground = self.town.ground(x, y) if self.town else 0.0
            check_mounts("pole_rig", recipe.pole_rig, pole, z - ground)

    def describe(self) -> Mapping[str, Json]:
        """Return the recipe as JSON values without the server's address; it determines the frames as far as CARLA does.

        There are no annotations of signs.
        """
        place = {"host", "port", "traffic_port", "timeout_s"}
        optional = {"scenarios", "rare", "randomise", "window_s", "window_every_s", "window_range_m"}
        fields = self.recipe.model_dump(mode="json", exclude=place)
        return {
            **{name: value for name, value in fields.items() if name not in optional or value},
            "town": self.town.name if self.town else "",
            "map": self.map,
            "carla": version("carla"),
            "scenes": len(self.scenes()),
            "frames": self.frame_total,
            "poles": [int(pole.removeprefix("pole")) for pole in self.poles],
            "labels": ["objects"],
        }

    def trace(self, scene: str) -> None:
        """Return None: the traffic is known only at the frames."""
        return

    def frames(self, scene: str) -> Iterator[Frame]:
        """Yield the scene's frames by spin, and within a spin those of the vehicles before those of the poles.

        Raises `InputError` where the server has another version or lacks what the recipe needs, and `OSError` where
        the connection or a sensor is lost.
        """
        recipe = self.recipe
        left = self.frame_count(scene)
        warmup = int(stream(recipe.seed, scene, "warmup").integers(*recipe.warmup_steps, endpoint=True))
        times_s = recipe.times_s(warmup)
        weather = recipe.weather.draw(stream(recipe.seed, scene, "weather"))
        steps = np.round(times_s / STEP_S).astype(int).tolist()
        with open_session(recipe, self.map, scene, derive_seed(recipe.seed, scene, "traffic")) as session:
            session.world.set_weather(make_weather(weather.at(0.0)))
            rng = stream(recipe.seed, scene, "spawn")
            spawned = spawn_vehicles(session, recipe, rng) | spawn_walkers(session, recipe, rng)
            ticks = SETTLED
            snapshot = session.tick()
            bodies = list_bodies(session, spawned, self.frame)
            agents: list[Agent] = []
            for spin, step in enumerate(steps):
                now = weather.at(float(times_s[spin] - times_s[0]))
                while ticks < step:
                    if not agents and ticks >= steps[0] - LEAD:
                        agents = [self._equip(session, name, spawned, bodies, scene) for name in self.agents]
                    if ticks == step - 1:
                        session.world.set_weather(make_weather(now))
                        for feed in (feed for agent in agents for feed in agent.feeds.values()):
                            feed.expect(snapshot.frame + 1)
                    snapshot, ticks = session.tick(), ticks + 1
                state = read_state(snapshot, bodies, self.frame)
                for agent in agents[:left]:
                    yield self._observe(session, snapshot, agent, state, (scene, spin, float(times_s[spin]), now))
                left -= len(agents[:left])
                if not left:
                    return

    def _equip(
        self,
        session: Session,
        name: str,
        spawned: Mapping[str, "carla.Actor"],
        bodies: Sequence[TrackedBody],
        scene: str,
    ) -> Agent:
        """Spawn the sensors of an agent in CARLA; return the agent."""
        vehicle = spawned.get(name)
        rig = self.recipe.pole_rig if vehicle is None else self.recipe.vehicle_rig
        base = self.poles[name] if vehicle is None else _find_body(bodies, vehicle.id).actor_from_foot()
        seed = derive_seed(self.recipe.seed, scene, name)
        feeds = spawn_feeds(session, rig, name, base, vehicle, self.frame, seed)
        return Agent(name, rig, build_calibration(rig), None if vehicle is None else vehicle.id, base, feeds)

    def _observe(
        self,
        session: Session,
        snapshot: "carla.WorldSnapshot",
        agent: Agent,
        state: State,
        at: tuple[str, int, float, Weather],
    ) -> Frame:
        """Return the frame of an agent at the last tick; `at` is scene, spin, time [s] and weather."""
        (scene, spin, time_s, weather), seed = at, self.recipe.seed
        vehicle = None
        world_from_agent = agent.base
        if agent.number is not None:
            vehicle = snapshot.find(agent.number)
            if vehicle is None:
                raise OSError(f"CARLA's vehicle of {agent.name} is gone at tick {snapshot.frame} of the scene {scene}")
            world_from_agent = read_pose(vehicle.get_transform(), self.frame) @ agent.base
        mounts = agent.calibration.agent_from_sensor

        def take(name: str) -> Any:
            return agent.feeds[name].take(snapshot.frame, session.timeout_s)

        def errors(sensor: str) -> tuple[np.random.Generator, np.random.Generator]:
            return stream(seed, scene, spin, agent.name, sensor), stream(seed, scene, agent.name, sensor)

        carrier = [row for row, body in enumerate(state.bodies) if body.number == agent.number]
        sweeps = {
            name: LabelledSweep(
                mounted.settings,
                world_from_agent @ mounts[name],
                _drop_carrier(read_lidar_points(take(name)), state.boxes[carrier], world_from_agent @ mounts[name]),
                read_semantic_points(take(semantic_name(name))),
            )
            for name, mounted in agent.rig.lidars.items()
        }
        colours = {name: read_colours(take(name)) for name in agent.rig.cameras}
        sights = {
            name: CameraSight(
                mounted.settings,
                world_from_agent @ mounts[name],
                read_depths(take(depth_name(name))),
                read_classes(take(semantic_name(name))),
            )
            for name, mounted in agent.rig.cameras.items()
        }
        within = _within_range(state, agent.rig, world_from_agent, mounts)
        annotations, instances = annotate_bodies(state, agent.number, within, sweeps, sights)
        return Frame(
            scene=scene,
            index=spin,
            time_s=time_s,
            agent=agent.name,
            world_from_agent=world_from_agent,
            calibration=agent.calibration,
            assumed=perturb_calibration(agent.calibration, self.recipe.calibration_error, seed=seed, agent=agent.name),
            lidar={name: sweep.points for name, sweep in sweeps.items()},
            annotations=annotations,
            images={
                name: CameraImage(colours[name], sight.depth_m, sight.semantic, instances[name])
                for name, sight in sights.items()
            },
            gnss={
                name: _fix(read_fix(take(name)), np.add(*draw_fix_errors(mounted.settings, time_s, *errors(name))))
                for name, mounted in agent.rig.gnss.items()
            },
            imu={
                name: read_inertia(take(name)) + sum(draw_imu_errors(mounted.settings, time_s, *errors(name)))
                for name, mounted in agent.rig.imus.items()
            },
            weather=weather,
        )

    def explain_end(self) -> str:
        """Explain the end of the client's process: a thread of its Traffic Manager has lost the server."""
        return (
            f"CARLA at {self.recipe.host}:{self.recipe.port} was lost, and its Traffic Manager ended the recording; "
            "scenes before are kept, and the same command goes on"
        )

    def town_files(self) -> Mapping[str, bytes]:
        """Return the contents of the town's files by name.

        Empty for a town that comes with flcav, and without a town.
        """
        kept = self.town is not None and self.recipe.town not in PACKAGED
        return read_town_files(self.town, self.recipe.town) if kept and self.town else {}

    def _find_poles(self) -> dict[str, Array]:
        """Return the (4, 4) poses of the recording poles, world frame [m], by name.

        Raises `InputError` if one is unknown.
        """
        town = self.town
        sites: list[int] = [] if town is None else town.poles.id.tolist()
        wanted = sites if self.recipe.poles == "all" else self.recipe.poles
        if unknown := [pole for pole in wanted if pole not in sites]:
            where = f"the map {self.recipe.town}, of which no town is known," if town is None else town.name
            raise InputError(f"field 'poles' = {unknown[0]}: no pole of {where} which has {sites}")
        if town is None:
            return {}
        placed = zip(town.poles.position.tolist(), town.poles.yaw.tolist())
        poses = {site: pose(x, y, z, yaw) for site, ((x, y, z), yaw) in zip(sites, placed)}
        return {f"pole{site}": poses[site] for site in wanted}


def _find_town(name: str, beside: Path | None) -> Town | None:
    """Return the town of a recipe; None where `name` is neither a town of flcav nor a folder."""
    folder = Path(name) if beside is None else beside / name
    return load_town(name, beside) if name in PACKAGED or os.path.isdir(folder) else None  # noqa: PTH112 - a long name


def _find_body(bodies: Sequence[TrackedBody], number: int) -> TrackedBody:
    return next(body for body in bodies if body.number == number)


def _drop_carrier(points: NDArray[np.float32], box: Boxes, world_from_sensor: Array) -> NDArray[np.float32]:
    """Return the points (N, 4) of a LiDAR, sensor frame, that are not on its carrier.

    `box` is the carrier's, or empty.
    """
    inside = points_in_boxes(transform_points(world_from_sensor, points[:, :3].astype(np.float64)), box, BODY_M)
    return points[~inside.any(axis=0)]


def _within_range(state: State, rig: Rig, world_from_agent: Array, mounts: Mapping[str, Array]) -> NDArray[np.bool_]:
    """Return (N,) whether box centres are in range of a LiDAR, or, without LiDARs, CAMERA_RANGE_M of a camera."""
    ranges = {name: mounted.settings.range_m for name, mounted in rig.lidars.items()}
    within = np.zeros(len(state.bodies), bool)
    for name, range_m in (ranges or dict.fromkeys(rig.cameras, CAMERA_RANGE_M)).items():
        place = (world_from_agent @ mounts[name])[:3, 3]
        within |= np.linalg.norm(state.boxes.center - place, axis=1) <= range_m
    return within


def _fix(exact: Array, error_m: Array) -> Array:
    """Return a GNSS fix (3,), latitude, longitude [deg], altitude [m], displaced by `error_m` (3,) east, north, up."""
    latitude, longitude, altitude = exact.tolist()
    here = GeoReference(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)
    return convert_to_geodetic(here, error_m)
