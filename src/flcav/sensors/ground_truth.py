"""Ground truth of one frame from the rays of its sensors: boxes, occlusion, and image annotations of actors and signs.

The occlusion of actors for a LiDAR counts occluded rays, by casting stopped rays again in an empty world: only rays
that would pass through an actor's bounding box but end before it are cast again, against that actor only.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from flcav.arrays import Array, Array32, Ints, Ints32, Mask
from flcav.geometry import Boxes, heading_vectors
from flcav.machine.compiled import compiled
from flcav.sensors.frame import Annotations, SignViews
from flcav.sensors.lens import Lens
from flcav.sensors.lidar.lidar import Lidar, build_ray_pattern
from flcav.sensors.lidar.returns import cast_through_glass
from flcav.sensors.views import find_actor_regions, find_thing_regions, view_actors
from flcav.world.rays.packets import Hits
from flcav.world.scene import Scene


class LidarSweep(NamedTuple):
    """The rays of one LiDAR sweep, and its returns by actor."""

    lidar: Lidar
    world_from_sensor: Array  # (4, 4) [m]
    passes: Mask  # (N,) whether a ray passes through glass: see `draw_passes`
    distance: Array32  # (N,) distance of the rays' ends [m]
    instance: Ints32  # (N,) instance at the rays' ends: a + 1 for the scene's actor a
    returns: Ints  # (A,) points on the scene's actors
    visible: Ints  # (A,) rays that return from the actors, detected or not


class InstanceImage(NamedTuple):
    """The instance image of one colour or thermal camera, and its pose."""

    lens: Lens
    world_from_camera: Array  # (4, 4) of the optical frame [m]
    offset_s: float  # trigger time after the spin [s]
    instance: Ints32  # (H, W) 0 none, a + 1 = the scene's actor a, -(t + 1) = thing t of the town


def annotate_frame(
    scene: Scene,
    own: int | None,
    *,
    within: Mask,
    sweeps: Mapping[str, LidarSweep],
    sights: Mapping[str, InstanceImage],
    echoes: Mapping[str, Ints],
) -> tuple[Annotations, Ints]:
    """Return the annotations of M actors, and their indices (M,) in the trace.

    An actor is annotated if it is `within` (A,) range or visible in a camera; props and the carrier `own` are not.
    `sweeps` are by LiDAR, `sights` by camera; `echoes` are the numbers (A,) of detections of the actors, by radar. This
    moves `scene` to the cameras' trigger times, and back to the spin.
    """
    trace = scene.trace
    index = scene.index
    regions = {name: find_actor_regions(sight.instance, len(trace.actor)) for name, sight in sights.items()}
    labelled = np.logical_or.reduce([within, *(region.pixels > 0 for region in regions.values())])
    labelled &= trace.category != "prop"
    if own is not None:
        labelled[own] = False
    actors = np.flatnonzero(labelled)

    views = {}
    signs = {}
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


def _occlusion(scene: Scene, sweeps: list[LidarSweep], actors: Ints) -> Array:
    """Return (K,) the occluded share of the actors' rays, over all LiDARs; 1 where none is visible."""
    visible, occluded = np.zeros((2, len(actors)), np.int64)
    for sweep in sweeps:
        visible += sweep.visible[actors]
    seen = np.flatnonzero(visible)  # the occlusion of the others is 1 for any number of occluded rays
    for sweep in sweeps:
        occluded[seen] += count_occluded_rays(
            scene, sweep.world_from_sensor, sweep.lidar, sweep.passes, sweep.distance, sweep.instance, actors[seen]
        )
    return 1 - visible / np.maximum(visible + occluded, 1)


BOX_MARGIN_M = 0.01  # by which boxes are enlarged, so that no ray that grazes a mesh is missed


def count_occluded_rays(
    scene: Scene,
    world_from_sensor: Array,
    lidar: Lidar,
    passes: Mask,
    distance: Array32,
    instance: Ints32,
    actors: Ints,
) -> Ints:
    """Count the rays (K,) that would return from `actors` (K,) in an empty world, but do not in this one.

    `distance` (N,) [m] and `instance` (N,) are those of the ends of the sweep's rays: a + 1 for actor a. `passes` (N,)
    marks the rays that pass through glass; `world_from_sensor` (4, 4) [m] is the sensor's pose.
    """
    pattern, surfaces = build_ray_pattern(lidar), scene.surfaces
    body_from_sensor = _bodies_from(scene.poses()[actors], scene.rotations()[actors], world_from_sensor)
    rays, counts = _stopped_rays(
        pattern, lidar.azimuth_steps, body_from_sensor, scene.trace.size[actors], BOX_MARGIN_M, distance
    )
    group = np.repeat(np.arange(len(actors)), counts)
    if lidar.rolling:  # an actor may have been hit at another place than that at the scene's instant
        others = instance[rays] != actors[group] + 1
        rays = rays[others]
        group = group[others]
    directions = pattern[rays]

    def trace(rays: Ints | slice, *, near_m: Array32 | None = None) -> Hits:
        ends = np.searchsorted(group[rays], np.arange(len(actors)), side="right")
        return scene.cast_each(actors, body_from_sensor, ends, directions[rays], near_m=near_m, far_m=lidar.range_m)

    echoes = cast_through_glass(trace, passes[rays], surfaces.first[actors + 1], surfaces.material)
    return np.bincount(group[echoes.instance >= 0], minlength=len(actors))


def _bodies_from(poses: Array, rotations: Array, world_from_sensor: Array) -> Array:
    """Return (K, 4, 4) `body_from_sensor` of actors at `poses` (K, >=3) x, y, z [m] with these rotations (K, 3, 3)."""
    turn = np.swapaxes(rotations, 1, 2)
    transforms = np.tile(np.eye(4), (len(poses), 1, 1))
    transforms[:, :3, :3] = turn @ world_from_sensor[:3, :3]
    transforms[:, :3, 3] = np.einsum("kij,kj->ki", turn, world_from_sensor[:3, 3] - poses[:, :3])
    return transforms


@compiled
def _stopped_rays(directions, steps, body_from_sensor, size, margin, distance):
    """Return the rays that end before K boxes on their way, box by box, and their numbers (K,)."""
    counts = np.zeros(len(size), np.int64)
    stopped = np.empty(1024, np.int64)
    total = 0
    for box in range(len(size)):
        rays = find_occluded_rays(directions, steps, body_from_sensor[box], size[box], margin, distance)
        counts[box] = len(rays)
        if total + len(rays) > len(stopped):
            larger = np.empty(2 * (total + len(rays)), np.int64)
            larger[:total] = stopped[:total]
            stopped = larger
        stopped[total : total + len(rays)] = rays
        total += len(rays)
    return stopped[:total], counts


@compiled
def find_occluded_rays(directions, steps, body_from_sensor, size, margin, distance):
    """Return the indices of the rays of a spinning pattern (channels * steps, 3) that end before a box on their way.

    Rays end at `distance` (N,) [m]. The box of `size` (3,) [m], enlarged by `margin` [m], stands on the origin of the
    body frame. Only the columns between the azimuths of the box's corners are tested, by the slab method.
    """
    low = np.array([-size[0] / 2, -size[1] / 2, 0.0]) - margin
    high = np.array([size[0] / 2, size[1] / 2, size[2]]) + margin
    first, columns = _columns(low, high, body_from_sensor, steps)
    channels = len(directions) // steps
    occluded = np.empty(channels * columns, np.int64)
    count = 0
    for channel in range(channels):
        for column in range(first, first + columns):
            ray = channel * steps + column % steps
            enter, leave = 0.0, np.inf
            for axis in range(3):
                along = (
                    body_from_sensor[axis, 0] * directions[ray, 0]
                    + body_from_sensor[axis, 1] * directions[ray, 1]
                    + body_from_sensor[axis, 2] * directions[ray, 2]
                )
                if abs(along) < 1e-9:
                    along = 1e-9
                one = (low[axis] - body_from_sensor[axis, 3]) / along
                other = (high[axis] - body_from_sensor[axis, 3]) / along
                enter = max(enter, min(one, other))
                leave = min(leave, max(one, other))
            if enter <= leave and distance[ray] <= enter:
                occluded[count] = ray
                count += 1
    return occluded[:count]


@compiled
def _columns(low, high, body_from_sensor, steps):
    """Return the first column (>= 0) of the pattern that can hit the box, and the number of such columns."""
    origin = body_from_sensor[:3, 3]
    ahead, left = body_from_sensor[:3, 0].copy(), body_from_sensor[:3, 1].copy()  # the sensor's axes
    middle = (low + high) / 2 - origin
    x, y = np.dot(ahead, middle), np.dot(left, middle)
    if np.hypot(x, y) <= np.linalg.norm(high - low) / 2:  # the spin axis may pass through the box
        return 0, steps
    azimuth = np.arctan2(y, x)
    least, most = 0.0, 0.0
    for corner in range(8):
        offset = -origin
        for axis in range(3):
            offset[axis] += high[axis] if corner >> axis & 1 else low[axis]
        x, y = np.dot(ahead, offset), np.dot(left, offset)
        aside = (np.arctan2(y, x) - azimuth + np.pi) % (2 * np.pi) - np.pi
        least, most = min(least, aside), max(most, aside)
    step = 2 * np.pi / steps
    first = int(np.floor((azimuth + least) / step))
    last = int(np.ceil((azimuth + most) / step))
    return first % steps, min(last - first + 1, steps)


READABLE = np.cos(np.radians(80.0))  # cosine of the largest angle between a sign's normal and the line of sight
STATES = {
    **dict.fromkeys("rR", "red"),
    **dict.fromkeys("yY", "amber"),
    **dict.fromkeys("gG", "green"),
    "u": "red_amber",
    "s": "red",  # in SUMO a red with a green right-turn arrow; the heads have no arrow
}  # by SUMO's letters for link states; all others are "off"


def view_signs(scene: Scene, world_from_camera: Array, instance: Ints32) -> SignViews:
    """Return the signs and signal heads whose front is visible in an image.

    `instance` (H, W) is -(t + 1) at the town's thing t; `world_from_camera` (4, 4) [m] is the camera's pose. The scene
    must be at the instant of the image.
    """
    things = scene.things
    regions = find_thing_regions(instance, len(things))
    camera = world_from_camera[:3, 3]
    sight = camera - things.position
    distance = np.linalg.norm(sight, axis=1)
    normal = heading_vectors(things.yaw)
    facing = (sight[:, 0] * normal[:, 0] + sight[:, 1] * normal[:, 1]) / np.maximum(distance, 1e-9)
    seen = np.flatnonzero((regions.pixels > 0) & (facing > READABLE))
    state_of = dict(zip(scene.trace.light.tolist(), scene.trace.light_state[scene.index].tolist()))
    states = [STATES.get(state_of.get(things.link[row], ""), "off") if things.link[row] else "" for row in seen]
    return SignViews(
        kind=np.array([things.kind[row] for row in seen], dtype=np.str_),
        state=np.array(states, dtype=np.str_),
        box=regions.box[seen],
        pixels=regions.pixels[seen],
        distance_m=distance[seen],
        thing=seen.astype(np.int64),
    )
