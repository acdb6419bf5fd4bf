"""A Gymnasium environment: one car drives along a route through a town's traffic.

    gymnasium.make("flcav.sources.environment:flcav/Driving-v0", town="grid", traffic=30)

It needs the extra `gym`. An action is the pedals, from full brake (-1) to full throttle (1), and the steering, from
right (-1) to left (1). The reward is the progress along the route [m], less `COLLISION` for a collision; the episode
ends with a collision, `OFF_M` off the route, and at the end of the route: `info["ended"]` says which.
`render_mode="rgb_array"` has `render` return the picture of a camera above and behind the ego. Observations are in the
ego frame, x forward and y left:

- `ego` (5,): speed [m/s], yaw rate [rad/s], angle of the front wheels [rad], offset to the left of the route [m],
  heading less the route's [rad]
- `route` (`AHEAD`, 2): the route every `SPACING_M` from here on [m]
- `limit` (1,): the speed limit [m/s]
- `light` (2,): distance to the next traffic light on the route [m], at most `SIGHT_M`, and 1 where it is green
- `actors` (`ACTORS`, 8): the nearest others within `SIGHT_M`: x, y [m], cosine and sine of the heading, velocity x, y
  over ground [m/s], length, width [m]; zeros where there are fewer
- `lidar` (N, 4), with a `lidar`: x, y, z [m] in the LiDAR frame and intensity, zeros after the last return
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.arrays import Bytes
from flcav.config import InputError, shorten
from flcav.geometry import Array, rotate, wrap_angle
from flcav.interface.wording import format_install_command
from flcav.sensors.camera import Camera, photograph
from flcav.sensors.lens import BODY_FROM_OPTICAL
from flcav.sensors.lidar.lidar import Lidar
from flcav.sensors.observe import observe
from flcav.sensors.rig import Mount, MountedLidar, Rig
from flcav.statistics.streams import stream
from flcav.world.commands import Controls, Spawn
from flcav.world.live import LiveWorld, Settings
from flcav.world.map.roads import Route, draw_route, read_net
from flcav.world.map.town import Town, load_town
from flcav.world.scene import Scene
from flcav.world.snapshot import Snapshot
from flcav.world.weather import Weather

try:
    import gymnasium
    from gymnasium.spaces import Box, Dict, Space
except ImportError:
    raise InputError(f"the environment needs gymnasium, which is in: {format_install_command('gym')}") from None

Observation = dict[str, NDArray[np.float32]]

EGO = "ego"
CAR = ("car", 3)  # a sedan
COLLISION = 50.0  # penalty, in metres of progress
OFF_M = 6.0
AHEAD, SPACING_M = 16, 3.0
ACTORS, SIGHT_M = 16, 80.0
ROUTE_M = 400.0
FAR = 1e4  # no value of an observation is greater
TRIES = 100  # to find room for the car
BEHIND = Mount(x=-9.0, z=5.0, pitch_deg=18.0)  # of the camera that `render` looks through
VIEW = Camera(width=480, height=320, noise=0.0)


class DrivingEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One car among the traffic of a live world."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - as Gymnasium has it

    def __init__(
        self,
        town: Town | str = "grid",
        *,
        traffic: int = 20,
        pedestrians: int = 0,
        dt_s: float = 0.1,
        lidar: Lidar | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Take a town or its name, the number of SUMO's vehicles and pedestrians, and the time between actions.

        Raises `InputError` for a `render_mode` that is neither None nor "rgb_array".
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"render_mode = {shorten(render_mode)}: must be rgb_array, or None for no pictures")
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": max(round(1 / dt_s), 1) if dt_s > 0 else 1}
        self.town = load_town(town) if isinstance(town, str) else town
        self._net = read_net(self.town.net)
        self._settings = {"traffic": traffic, "pedestrians": pedestrians, "dt_s": dt_s}
        self._rig = None if lidar is None else Rig(lidars={"lidar": MountedLidar(mount=Mount(z=1.85), settings=lidar)})
        self._world: LiveWorld | None = None
        self._scene: Scene | None = None
        self._route: Route | None = None
        self._along, self._seed = 0.0, 0
        spaces: dict[str, Space[Any]] = {
            "ego": _box(5),
            "route": _box(AHEAD, 2),
            "limit": _box(1),
            "light": _box(2),
            "actors": _box(ACTORS, 8),
        }
        if lidar is not None:
            spaces["lidar"] = _box(lidar.channels * lidar.azimuth_steps, 4)
        self.observation_space = Dict(spaces)  # pyright: ignore[reportAttributeAccessIssue] # narrower than the base's
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode in a new world, on a new route; the same `seed` gives the same one."""
        super().reset(seed=seed)
        self.close()
        self._seed = int(self.np_random.integers(2**31))
        self._world = LiveWorld(self.town, Settings(seed=self._seed, **self._settings))
        self._route, self._along = self._set_out(self._world)
        return self._observe(self._world.snapshot), {}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive for one step.

        `info` has the collisions, the progress [m], the time [s], and in "ended" why the episode ends: "collision",
        "off the route" or "arrived"; None while it goes on.
        """
        if self._world is None or self._route is None:
            raise InputError("the environment must be reset before the first step")
        pedal, steer = (float(value) for value in np.clip(action, -1.0, 1.0))
        snapshot = self._world.step({EGO: Controls(throttle=max(pedal, 0.0), steer=steer, brake=max(-pedal, 0.0))})
        before = self._along
        seen = self._observe(snapshot)
        hits = [hit for hit in snapshot.collisions if EGO in (hit.name, hit.other)]
        arrived = self._along >= self._route.length_m - 1.0
        off = abs(float(seen["ego"][3])) > OFF_M
        ended = "collision" if hits else "off the route" if off else "arrived" if arrived else None
        info = {"collisions": hits, "arrived": arrived, "progress_m": self._along, "time_s": snapshot.time_s}
        return seen, self._along - before - COLLISION * bool(hits), ended is not None, False, {**info, "ended": ended}

    def render(self) -> Bytes | None:  # pyright: ignore[reportIncompatibleMethodOverride] # narrower than the base's
        """Return the picture (H, W, 3) of the car from behind, sRGB; None without the `render_mode` "rgb_array".

        Raises `InputError` before the first `reset`.
        """
        if self.render_mode is None:
            return None
        if self._world is None:
            raise InputError("the environment must be reset before it is rendered")
        snapshot = self._world.snapshot
        scene = self._follow(snapshot)
        camera = scene.world_from_actor(snapshot.row(EGO)) @ BEHIND.agent_from_sensor() @ BODY_FROM_OPTICAL
        return photograph(scene, camera, VIEW, Weather(), stream(self._seed, "render", snapshot.step)).rgb

    def close(self) -> None:
        """End the world."""
        if self._world is not None:
            self._world.close()
            self._world = None

    def _set_out(self, world: LiveWorld) -> tuple[Route, float]:
        """Spawn the ego where there is room near the start of a route; return the route and its distance along [m]."""
        for _ in range(TRIES):
            route = draw_route(self._net, self.np_random, ROUTE_M)
            along = float(self.np_random.uniform(5.0, 15.0))
            x, y, yaw = route.at(along).tolist()
            car = Spawn(EGO, *CAR, x, y, yaw)
            if route.length_m > ROUTE_M / 4 and not world.find_obstruction(car):
                world.apply(car)
                return route, along
        raise InputError(f"{self.town.name}: no room was found for the car in {TRIES} places")

    def _observe(self, snapshot: Snapshot) -> Observation:
        """Return the observation in the ego frame, and update the distance along the route [m]."""
        assert self._world is not None
        assert self._route is not None
        trace = snapshot.trace
        row = snapshot.row(EGO)
        position = trace.position[0, :, :2]
        yaw = trace.yaw[0]
        x, y, heading = *position[row].tolist(), float(yaw[row])
        self._along, offset = self._route.project(x, y, self._along)
        velocity = np.stack(rotate(trace.velocity[0, :, 0], trace.velocity[0, :, 1], -heading), axis=1)
        steer = self._world.bodies.steer[self._world.bodies.row(EGO)]
        turned = wrap_angle(heading - self._route.at(self._along)[2])
        points = self._route.at(self._along + SPACING_M * np.arange(AHEAD))
        route = np.stack(rotate(points[:, 0] - x, points[:, 1] - y, -heading), axis=1)
        away = np.linalg.norm(position - (x, y), axis=1)
        away[row] = np.inf
        near = np.argsort(away, kind="stable")[:ACTORS]
        near = near[away[near] <= SIGHT_M]
        actors = np.zeros((ACTORS, 8))
        place = rotate(position[near, 0] - x, position[near, 1] - y, -heading)
        turn = yaw[near] - heading
        actors[: len(near)] = np.column_stack(
            (*place, np.cos(turn), np.sin(turn), velocity[near], trace.size[near, :2])
        )
        seen = {
            "ego": np.array((velocity[row, 0], trace.yaw_rate[0, row], steer, offset, turned)),
            "route": route,
            "limit": np.array((self._route.limit(self._along),)),
            "light": self._see_light(snapshot),
            "actors": actors,
        }
        if self._rig is not None:
            seen["lidar"] = self._scan(snapshot)
        return {name: values.astype(np.float32) for name, values in seen.items()}

    def _see_light(self, snapshot: Snapshot) -> Array:
        """Return (2,) the distance to the next traffic light on the route [m], and 1 if it is green, else 0."""
        assert self._route is not None
        for along, link in self._route.stops:
            if self._along <= along <= self._along + SIGHT_M:
                letter = snapshot.trace.light_state[0, snapshot.trace.light == link]
                return np.array((along - self._along, float(str(letter[0]) in "Gg" if len(letter) else True)))
        return np.array((SIGHT_M, 1.0))

    def _scan(self, snapshot: Snapshot) -> NDArray[np.float32]:
        """Return (N, 4) points x, y, z [m] in the LiDAR frame and intensity, zero-padded to the number of rays."""
        assert self._rig is not None
        scene = self._follow(snapshot)
        frame = observe(scene, self._rig, EGO, 0, scene_name="driving", seed=self._seed, number=snapshot.step)
        lidar = self._rig.lidars["lidar"].settings
        points = np.zeros((lidar.channels * lidar.azimuth_steps, 4), np.float32)
        points[: len(frame.lidar["lidar"])] = frame.lidar["lidar"]
        return points

    def _follow(self, snapshot: Snapshot) -> Scene:
        """Return the scene of the world at this instant."""
        if self._scene is None:
            self._scene = Scene(self.town, snapshot.trace)
        self._scene.follow(snapshot.trace)
        return self._scene


def _box(*shape: int) -> Box:
    return Box(-FAR, FAR, shape, np.float32)


gymnasium.register("flcav/Driving-v0", entry_point=f"{__name__}:DrivingEnv", max_episode_steps=1000)
