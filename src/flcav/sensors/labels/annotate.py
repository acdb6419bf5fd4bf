"""Ground truth of one frame, from the rays of its sensors."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import Boxes
from flcav.sensors.frame import Annotations, Array
from flcav.sensors.labels.signs import view_signs
from flcav.sensors.labels.views import find_actor_regions, view_actors
from flcav.sensors.lens import Lens
from flcav.sensors.lidar.lidar import Lidar
from flcav.sensors.lidar.visibility import count_occluded_rays
from flcav.world.scene import Scene


class Sweep(NamedTuple):
    """The rays of one LiDAR sweep, and its returns by actor."""

    lidar: Lidar
    world_from_sensor: Array  # (4, 4)
    passes: NDArray[np.bool_]  # (N,) whether a ray goes through glass: see `draw_passes`
    distance: NDArray[np.float32]  # (N,) where the rays ended [m]
    instance: NDArray[np.int32]  # (N,) what they ended at: a + 1 at the scene's actor a
    returns: NDArray[np.int64]  # (A,) points from each of the scene's actors
    visible: NDArray[np.int64]  # (A,) rays that return from each, detected or not


class InstanceImage(NamedTuple):
    """The instance image of one colour or thermal camera, and its pose."""

    lens: Lens
    world_from_camera: Array  # (4, 4) of the optical frame
    offset_s: float  # trigger time after the spin
    instance: NDArray[np.int32]  # (H, W) 0 none, a + 1 = the scene's actor a, -(t + 1) = thing t of the town


def annotate(
    scene: Scene,
    own: int | None,
    *,
    within: NDArray[np.bool_],
    sweeps: Mapping[str, Sweep],
    sights: Mapping[str, InstanceImage],
    echoes: Mapping[str, NDArray[np.int64]],
) -> tuple[Annotations, NDArray[np.int64]]:
    """Return the annotations of M actors, and their indices (M,) in the trace.

    Annotated are all actors but props and `own` (the carrier) that are `within` (A,) range or show in a camera.
    `sweeps` are by LiDAR, `sights` by camera; `echoes` are by radar the number (A,) of detections of each actor. Moves
    `scene` to the cameras' trigger times, and back to the spin.
    """
    trace, index = scene.trace, scene.index
    regions = {name: find_actor_regions(sight.instance, len(trace.actor)) for name, sight in sights.items()}
    labelled = np.logical_or.reduce([within, *(region.pixels > 0 for region in regions.values())])
    labelled &= trace.category != "prop"
    if own is not None:
        labelled[own] = False
    actors = np.flatnonzero(labelled)

    views, signs = {}, {}
    for name, sight in sights.items():
        scene.move_to(index, sight.offset_s)
        views[name] = view_actors(scene, sight.world_from_camera, sight.lens, sight.instance, regions[name], actors)
        signs[name] = view_signs(scene, sight.world_from_camera, sight.instance)
    scene.move_to(index)

    size = trace.size[actors]
    tilt = None if trace.tilt is None else trace.tilt[index, actors]
    annotations = Annotations(
        track=trace.actor[actors],
        boxes=Boxes(
            trace.box_centres(index)[actors], size, trace.yaw[index, actors], trace.category[actors], tilt=tilt
        ),
        velocity=trace.velocity[index, actors],
        acceleration=trace.acceleration[index, actors],
        returns=np.sum([sweep.returns[actors] for sweep in sweeps.values()], axis=0, dtype=np.int64)
        + np.zeros(len(actors), np.int64),
        occlusion=_occlusion(scene, list(sweeps.values()), actors),
        points={name: sweep.returns[actors] for name, sweep in sweeps.items()}
        | {name: counts[actors] for name, counts in echoes.items()},
        views=views,
        signs=signs,
    )
    return annotations, actors


def _occlusion(scene: Scene, sweeps: list[Sweep], actors: NDArray[np.int64]) -> Array:
    """Return (K,) the occluded share of each actor's rays, all LiDARs together; 1 where none is visible."""
    visible, occluded = np.zeros((2, len(actors)), np.int64)
    for sweep in sweeps:
        visible += sweep.visible[actors]
    seen = np.flatnonzero(visible)  # the occlusion of the others is 1, whatever the number of occluded rays
    for sweep in sweeps:
        occluded[seen] += count_occluded_rays(
            scene, sweep.world_from_sensor, sweep.lidar, sweep.passes, sweep.distance, sweep.instance, actors[seen]
        )
    return 1 - visible / np.maximum(visible + occluded, 1)
