"""Simulation of one frame: all sensors of an agent's rig at one instant of the traffic, with ground truth."""

import re
from dataclasses import dataclass

import numpy as np

from flcav.arrays import Array, Array32, Ints32, Mask
from flcav.config import InputError
from flcav.geometry import pose
from flcav.sensors.camera import photograph
from flcav.sensors.frame import Calibration, CameraImage, Frame
from flcav.sensors.ground_truth import InstanceImage, LidarSweep, annotate_frame
from flcav.sensors.infrared import render_thermal
from flcav.sensors.lens import Lens, compute_pixel_rays
from flcav.sensors.lidar.lidar import Lidar, point_times_s, scan
from flcav.sensors.navigation import measure_inertia, measure_position
from flcav.sensors.radar import sweep_radar
from flcav.sensors.rig import CAMERA_RANGE_M, CalibrationError, Rig, build_calibration, perturb_calibration
from flcav.statistics.streams import stream
from flcav.world.scene import Scene
from flcav.world.weather import WEATHERS, Weather

CLEAR = WEATHERS["clear"]
EXACT = CalibrationError()


def observe(
    scene: Scene,
    rig: Rig,
    agent: str,
    index: int,
    *,
    scene_name: str,
    seed: int,
    weather: Weather = CLEAR,
    error: CalibrationError = EXACT,
    number: int | None = None,
) -> Frame:
    """Simulate the frame of `agent` ("cav0", "pole3") with `rig` at instant `index` of the scene's traffic run.

    The frame's index is `number`, by default `index`; in a live world, whose traces have one instant, the step. This
    moves `scene` there. The same arguments give the same bytes, whatever was observed before: a sensor's random stream
    is named by `seed`, scene, number, agent and sensor, so that it does not depend on the rig's other sensors. `error`
    changes only the frame's assumed calibration. Raises `InputError` for an agent that does not exist in the run, or at
    that instant.
    """
    number = index if number is None else number
    carrier = _Carrier(scene, agent, index, _actor_of(scene, agent, index), build_calibration(rig))

    def rng(sensor: str) -> np.random.Generator:
        return stream(seed, scene_name, number, agent, sensor)

    def bias_rng(sensor: str) -> np.random.Generator:
        return stream(seed, scene_name, agent, sensor)

    lidar, sweeps, exposures, sights, infrared, radar, echoes, gnss, imu = ({} for _ in range(9))
    for name, mounted in rig.lidars.items():
        lidar[name], sweeps[name] = _sweep(carrier, name, mounted.settings, weather, rng(name))
    for name, mounted in rig.cameras.items():
        at = carrier.go_to(name)
        exposures[name] = photograph(scene, at, mounted.settings, weather, rng(name), hidden=carrier.own)
        sights[name] = InstanceImage(mounted.settings, at, scene.offset_s, exposures[name].instance)
    for name, mounted in rig.infrareds.items():
        at = carrier.go_to(name)
        infrared[name] = render_thermal(scene, at, mounted.settings, weather, rng(name), hidden=carrier.own)
        sights[name] = InstanceImage(mounted.settings, at, scene.offset_s, _actors_seen(carrier, at, mounted.settings))
    for name, mounted in rig.radars.items():
        at = carrier.go_to(name)
        radar[name], actor = sweep_radar(
            scene, at, carrier.velocity(at), mounted.settings, rng(name), hidden=carrier.own, weather=weather
        )
        echoes[name] = np.bincount(actor + 1, minlength=len(scene.trace.actor) + 1)[1:]
    for name, mounted in rig.gnss.items():
        gnss[name] = measure_position(scene, carrier.go_to(name), mounted.settings, rng(name), bias_rng(name))
    for name, mounted in rig.imus.items():
        imu[name] = measure_inertia(
            scene, carrier.go_to(name), carrier.own, mounted.settings, rng(name), bias_rng(name)
        )

    scene.move_to(index)
    annotations, actors = annotate_frame(
        scene, carrier.own, within=_within_range(carrier, rig), sweeps=sweeps, sights=sights, echoes=echoes
    )
    row = np.zeros(len(scene.trace.actor) + 1, np.uint16)
    row[actors + 1] = np.arange(1, len(actors) + 1)
    return Frame(
        scene=scene_name,
        index=number,
        time_s=float(scene.trace.time_s[index]),
        agent=agent,
        world_from_agent=carrier.pose(),
        calibration=carrier.calibration,
        assumed=perturb_calibration(carrier.calibration, error, seed=seed, agent=agent),
        lidar=lidar,
        annotations=annotations,
        point_times={
            name: point_times_s(mounted.settings, lidar[name])
            for name, mounted in rig.lidars.items()
            if mounted.settings.rolling
        },
        images={
            name: CameraImage(seen.rgb, seen.depth_m, seen.semantic, row[np.maximum(seen.instance, 0)])
            for name, seen in exposures.items()
        },
        infrared=infrared,
        radar=radar,
        gnss=gnss,
        imu=imu,
        weather=weather,
        agent_at_trigger=carrier.poses_at_triggers(),
    )


@dataclass(frozen=True)
class _Carrier:
    """The vehicle or pole that carries the sensors in a scene, with their true calibration."""

    scene: Scene
    agent: str
    index: int
    own: int | None  # index of its actor in the trace; None for a pole
    calibration: Calibration

    def pose(self) -> Array:
        """Return the (4, 4) `world_from_agent` at the scene's time."""
        if self.own is not None:
            return self.scene.world_from_actor(self.own)
        poles = self.scene.town.poles
        site = np.flatnonzero(poles.id == int(self.agent.removeprefix("pole")))[0]
        x, y, z = poles.position[site]
        return pose(x, y, z, float(poles.yaw[site]))

    def go_to(self, sensor: str) -> Array:
        """Move the scene to the trigger time of `sensor`, and return the sensor's (4, 4) pose at that time."""
        self.scene.move_to(self.index, self.calibration.offset_ms[sensor] / 1e3)
        return self.pose() @ self.calibration.agent_from_sensor[sensor]

    def velocity(self, world_from_sensor: Array) -> Array:
        """Return the (3,) velocity of a sensor at the scene's time, world frame [m/s]."""
        if self.own is None:
            return np.zeros(3)
        trace = self.scene.trace
        offset_s = self.scene.offset_s
        arm = world_from_sensor[:3, 3] - self.pose()[:3, 3]
        spin = np.array((0.0, 0.0, trace.yaw_rate[self.index, self.own]))
        velocity = trace.velocity[self.index, self.own] + offset_s * trace.acceleration[self.index, self.own]
        return velocity + np.cross(spin, arm)

    def poses_at_triggers(self) -> dict[str, Array]:
        """Return the (4, 4) `world_from_agent` at trigger times that differ from the spin, by sensor; empty for a pole.

        The scene is left at the spin.
        """
        poses = {}
        for sensor, offset_ms in self.calibration.offset_ms.items():
            if offset_ms and self.own is not None:
                self.go_to(sensor)
                poses[sensor] = self.pose()
        self.scene.move_to(self.index)
        return poses


def _actor_of(scene: Scene, agent: str, index: int) -> int | None:
    """Move the scene to instant `index`, and return the row of the actor named `agent`; None for a pole.

    Raises `InputError` for a pole or vehicle that does not exist, or is not in town at that instant.
    """
    scene.move_to(index)
    poles = scene.town.poles.id
    if match := re.fullmatch(r"pole(\d+)", agent):
        if int(match[1]) not in poles:
            known = ", ".join(f"pole{pole}" for pole in poles)
            raise InputError(f"agent '{agent}': town {scene.town.name} has no such pole; it has {known}")
        return None
    rows = np.flatnonzero(scene.trace.actor == agent)
    if not len(rows):
        raise InputError(f"agent '{agent}': no such vehicle in this traffic run")
    if not scene.trace.present[index, rows[0]]:
        raise InputError(f"agent '{agent}' is not in town at {scene.trace.time_s[index]:.1f} s")
    return int(rows[0])


def _sweep(
    carrier: _Carrier, name: str, lidar: Lidar, weather: Weather, rng: np.random.Generator
) -> tuple[Array32, LidarSweep]:
    """Return the points (N, 4) of a LiDAR, sensor frame, and its sweep for the ground truth."""
    scene = carrier.scene
    world_from_sensor = carrier.go_to(name)
    points, actor, passes, hits = scan(scene, world_from_sensor, lidar, rng, carrier.own, weather)
    count = len(scene.trace.actor)
    returns = np.bincount(actor + 1, minlength=count + 1)[1:]
    visible = np.bincount(hits.instance + 1, minlength=count + 2)[2:]  # without misses (-1) and the town (0)
    return points, LidarSweep(lidar, world_from_sensor, passes, hits.distance, hits.instance, returns, visible)


def _actors_seen(carrier: _Carrier, world_from_camera: Array, lens: Lens) -> Ints32:
    """Return an instance image (H, W) with one ray per pixel: a + 1 at the trace's actor a, else 0."""
    hits = carrier.scene.cast(world_from_camera, compute_pixel_rays(lens), hidden=carrier.own)
    return np.maximum(hits.instance, 0).reshape(lens.height, lens.width)


def _within_range(carrier: _Carrier, rig: Rig) -> Mask:
    """Return (A,) whether actors are present with their box centres within the range of a LiDAR.

    Without LiDARs, within CAMERA_RANGE_M of a camera.
    """
    scene = carrier.scene
    world_from_agent = carrier.pose()
    trace = scene.trace
    center = trace.position[scene.index] + trace.size * (0, 0, 0.5)
    ranges = {name: mounted.settings.range_m for name, mounted in rig.lidars.items()}
    within = np.zeros(len(trace.actor), bool)
    for name, range_m in (ranges or dict.fromkeys((*rig.cameras, *rig.infrareds), CAMERA_RANGE_M)).items():
        sensor = (world_from_agent @ carrier.calibration.agent_from_sensor[name])[:3, 3]
        within |= trace.present[scene.index] & (np.linalg.norm(center - sensor, axis=1) <= range_m)
    return within
