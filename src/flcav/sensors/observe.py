"""One agent's frame: what its sensors see, and the truth about everything within their range."""

import re

import numpy as np
from numpy.typing import NDArray

from flcav import seeds
from flcav.config import InputError
from flcav.geometry import Boxes, pose
from flcav.sensors.frame import Annotations, Frame
from flcav.sensors.lidar import cast, draw_passes, measure
from flcav.sensors.rig import Rig
from flcav.sensors.visibility import unoccluded_rays
from flcav.world.scene import Scene


def observe(scene: Scene, rig: Rig, agent: str, index: int, *, scene_name: str, seed: int) -> Frame:
    """Return what `agent` ("cav0", "pole3") sees with `rig` at instant `index` of the scene's traffic run.

    Moves `scene` there. The same arguments give the same bytes, whatever was observed before.
    Raises `InputError` for an agent that the run does not have, or not at that instant.
    """
    scene.move_to(index)
    own, world_from_agent = _carrier(scene, agent)
    agent_from_sensor = {name: lidar.mount.agent_from_sensor() for name, lidar in rig.lidars.items()}
    actors = _within_range(
        scene, rig, {name: world_from_agent @ sensor for name, sensor in agent_from_sensor.items()}, own
    )
    count = len(scene.trace.actor)
    returns, visible, unoccluded = np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros(count, np.int64)
    sweeps: dict[str, NDArray[np.float32]] = {}
    for name, lidar in rig.lidars.items():
        world_from_sensor = world_from_agent @ agent_from_sensor[name]
        rng = seeds.stream(seed, scene_name, index, agent, name)
        passes = draw_passes(lidar.settings, rng)
        echoes = cast(scene, world_from_sensor, lidar.settings, passes, own)
        sweeps[name], actor = measure(scene, world_from_sensor, lidar.settings, echoes, rng)
        returns += np.bincount(actor + 1, minlength=count + 1)[1:]
        visible += np.bincount(echoes.instance + 1, minlength=count + 2)[2:]
        unoccluded[actors] += unoccluded_rays(scene, world_from_sensor, lidar.settings, passes, actors)
    occlusion = 1 - visible[actors] / np.maximum(unoccluded[actors], 1)
    return Frame(
        scene=scene_name,
        index=index,
        time_s=float(scene.trace.time_s[index]),
        agent=agent,
        world_from_agent=world_from_agent,
        agent_from_sensor=agent_from_sensor,
        lidar=sweeps,
        annotations=Annotations(
            track=scene.trace.actor[actors],
            boxes=_boxes(scene, actors),
            velocity=scene.trace.velocity[index, actors],
            returns=returns[actors],
            occlusion=np.clip(occlusion, 0.0, 1.0),
        ),
    )


def _carrier(scene: Scene, agent: str) -> tuple[int | None, NDArray[np.float64]]:
    """Return the actor that carries the sensors (None for a pole) and the (4, 4) `world_from_agent`."""
    poles = scene.town.poles
    if match := re.fullmatch(r"pole(\d+)", agent):
        site = np.flatnonzero(poles.id == int(match[1]))
        if not len(site):
            known = ", ".join(f"pole{pole}" for pole in poles.id)
            raise InputError(f"agent '{agent}': town {scene.town.name} has no such pole; it has {known}")
        x, y, z = poles.position[site[0]]
        return None, pose(x, y, z, float(poles.yaw[site[0]]))
    found = np.flatnonzero(scene.trace.actor == agent)
    if not len(found):
        raise InputError(f"agent '{agent}': no such vehicle in this traffic run")
    actor = int(found[0])
    if not scene.trace.present[scene.index, actor]:
        raise InputError(f"agent '{agent}' is not in town at {scene.trace.time_s[scene.index]:.1f} s")
    return actor, scene.world_from_actor(actor)


def _within_range(
    scene: Scene, rig: Rig, world_from_sensor: dict[str, NDArray[np.float64]], own: int | None
) -> NDArray[np.int64]:
    """Return the actors present whose box centre lies within the range of a sensor, but `own`."""
    trace = scene.trace
    center = trace.position[scene.index] + trace.size * (0, 0, 0.5)
    within = np.zeros(len(trace.actor), bool)
    for name, lidar in rig.lidars.items():
        away = np.linalg.norm(center - world_from_sensor[name][:3, 3], axis=1)
        within |= trace.present[scene.index] & (away <= lidar.settings.range_m)
    if own is not None:
        within[own] = False
    return np.flatnonzero(within)


def _boxes(scene: Scene, actors: NDArray[np.int64]) -> Boxes:
    trace = scene.trace
    size = trace.size[actors]
    center = trace.position[scene.index, actors] + size * (0, 0, 0.5)
    return Boxes(center, size, trace.yaw[scene.index, actors], trace.category[actors])
