"""One agent's frame: what its sensors see, and the truth about everything within their range."""

import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav import seeds
from flcav.config import InputError
from flcav.geometry import Boxes, pose
from flcav.sensors.frame import Annotations, Calibration, Frame
from flcav.sensors.lidar import Lidar, cast, draw_passes, measure
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
    calibration = Calibration({name: lidar.mount.agent_from_sensor() for name, lidar in rig.lidars.items()})
    sweeps = {
        name: _sweep(
            scene,
            lidar.settings,
            world_from_agent @ calibration.agent_from_sensor[name],
            own,
            seeds.stream(seed, scene_name, index, agent, name),
        )
        for name, lidar in rig.lidars.items()
    }
    return Frame(
        scene=scene_name,
        index=index,
        time_s=float(scene.trace.time_s[index]),
        agent=agent,
        world_from_agent=world_from_agent,
        calibration=calibration,
        assumed=calibration,
        lidar={name: sweep.points for name, sweep in sweeps.items()},
        annotations=_annotate(scene, list(sweeps.values()), own),
    )


class _Sweep(NamedTuple):
    lidar: Lidar
    world_from_sensor: NDArray[np.float64]
    passes: NDArray[np.bool_]  # see `draw_passes`
    points: NDArray[np.float32]  # (N, 4) see `scan`
    returns: NDArray[np.int64]  # (A,) points of each actor
    visible: NDArray[np.int64]  # (A,) rays that come back from it, detected or not


def _sweep(
    scene: Scene,
    lidar: Lidar,
    world_from_sensor: NDArray[np.float64],
    own: int | None,
    rng: np.random.Generator,
) -> _Sweep:
    passes = draw_passes(lidar, rng)
    echoes = cast(scene, world_from_sensor, lidar, passes, own)
    points, actor = measure(scene, world_from_sensor, lidar, echoes, rng)
    count = len(scene.trace.actor)
    returns = np.bincount(actor + 1, minlength=count + 1)[1:]
    visible = np.bincount(echoes.instance + 1, minlength=count + 2)[2:]  # without what is missed, and the town
    return _Sweep(lidar, world_from_sensor, passes, points, returns, visible)


def _annotate(scene: Scene, sweeps: list[_Sweep], own: int | None) -> Annotations:
    trace, index = scene.trace, scene.index
    actors = _within_range(scene, sweeps, own)
    visible = np.sum([sweep.visible[actors] for sweep in sweeps], axis=0)
    unoccluded = np.zeros(len(actors), np.int64)
    seen = np.flatnonzero(visible)  # of the others nothing is visible, whatever they would show
    for sweep in sweeps:
        unoccluded[seen] += unoccluded_rays(scene, sweep.world_from_sensor, sweep.lidar, sweep.passes, actors[seen])
    size = trace.size[actors]
    center = trace.position[index, actors] + size * (0, 0, 0.5)
    return Annotations(
        track=trace.actor[actors],
        boxes=Boxes(center, size, trace.yaw[index, actors], trace.category[actors]),
        velocity=trace.velocity[index, actors],
        acceleration=trace.acceleration[index, actors],
        returns=np.sum([sweep.returns[actors] for sweep in sweeps], axis=0),
        occlusion=1 - visible / np.maximum(np.maximum(unoccluded, visible), 1),
    )


def _within_range(scene: Scene, sweeps: list[_Sweep], own: int | None) -> NDArray[np.int64]:
    """Return the actors present whose box centre lies within the range of a sensor, but `own`."""
    trace = scene.trace
    center = trace.position[scene.index] + trace.size * (0, 0, 0.5)
    within = np.zeros(len(trace.actor), bool)
    for sweep in sweeps:
        away = np.linalg.norm(center - sweep.world_from_sensor[:3, 3], axis=1)
        within |= trace.present[scene.index] & (away <= sweep.lidar.range_m)
    if own is not None:
        within[own] = False
    return np.flatnonzero(within)


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
