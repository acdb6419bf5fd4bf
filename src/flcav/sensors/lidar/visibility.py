"""Occlusion of actors for a LiDAR: occluded rays, counted by casting stopped rays again in an empty world.

Only rays that end before an actor's bounding box and pass through it are cast again, against that actor alone.
"""

import numpy as np
from numpy.typing import NDArray

from flcav.machine.compiled import compiled
from flcav.sensors.lidar.lidar import Lidar, build_ray_pattern
from flcav.sensors.lidar.returns import cast_through_glass
from flcav.world.rays.hits import Hits
from flcav.world.scene import Scene

BOX_MARGIN_M = 0.01  # by which boxes are grown, so that no ray that grazes a mesh is missed


def count_occluded_rays(
    scene: Scene,
    world_from_sensor: NDArray[np.float64],
    lidar: Lidar,
    passes: NDArray[np.bool_],
    distance: NDArray[np.float32],
    instance: NDArray[np.int32],
    actors: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Return for each of `actors` (K,) the number of rays that would return from it in an empty world, but do not.

    `distance` (N,) [m] and `instance` (N,) are where the sweep's rays ended and at what: a + 1 at actor a. `passes`
    (N,) marks the rays that go through glass.
    """
    pattern, surfaces = build_ray_pattern(lidar), scene.surfaces
    body_from_sensor = _bodies_from(scene.poses()[actors], scene.rotations()[actors], world_from_sensor)
    rays, counts = _stopped_rays(
        pattern, lidar.azimuth_steps, body_from_sensor, scene.trace.size[actors], BOX_MARGIN_M, distance
    )
    group = np.repeat(np.arange(len(actors)), counts)
    if lidar.rolling:  # an actor may have been hit at another place than where it is at the scene's instant
        others = instance[rays] != actors[group] + 1
        rays, group = rays[others], group[others]
    directions = pattern[rays]

    def trace(rays: NDArray[np.int64] | slice, *, near_m: NDArray[np.float32] | None = None) -> Hits:
        ends = np.searchsorted(group[rays], np.arange(len(actors)), side="right")
        return scene.cast_each(actors, body_from_sensor, ends, directions[rays], near_m=near_m, far_m=lidar.range_m)

    echoes = cast_through_glass(trace, passes[rays], surfaces.first[actors + 1], surfaces.material)
    return np.bincount(group[echoes.instance >= 0], minlength=len(actors))


def _bodies_from(
    poses: NDArray[np.float64], rotations: NDArray[np.float64], world_from_sensor: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (K, 4, 4) transforms `body_from_sensor` of actors at `poses` (K, >=3) x, y, z, turned by (K, 3, 3)."""
    turn = np.swapaxes(rotations, 1, 2)
    found = np.tile(np.eye(4), (len(poses), 1, 1))
    found[:, :3, :3] = turn @ world_from_sensor[:3, :3]
    found[:, :3, 3] = np.einsum("kij,kj->ki", turn, world_from_sensor[:3, 3] - poses[:, :3])
    return found


@compiled
def _stopped_rays(directions, steps, body_from_sensor, size, margin, distance):
    """Return the rays that end before each of K boxes on their way, box after box, and their number (K,) by box."""
    counts = np.zeros(len(size), np.int64)
    found = np.empty(1024, np.int64)
    total = 0
    for box in range(len(size)):
        rays = find_occluded_rays(directions, steps, body_from_sensor[box], size[box], margin, distance)
        counts[box] = len(rays)
        if total + len(rays) > len(found):
            larger = np.empty(2 * (total + len(rays)), np.int64)
            larger[:total] = found[:total]
            found = larger
        found[total : total + len(rays)] = rays
        total += len(rays)
    return found[:total], counts


@compiled
def find_occluded_rays(directions, steps, body_from_sensor, size, margin, distance):
    """Return the indices of the rays of a spinning pattern (channels * steps, 3) that end before a box on their way.

    Rays end at `distance` (N,) [m]. The box of `size` (3,), grown by `margin` [m], stands on the origin of the body
    frame. Slab test, for the columns between the azimuths of the box's corners only.
    """
    low = np.array([-size[0] / 2, -size[1] / 2, 0.0]) - margin
    high = np.array([size[0] / 2, size[1] / 2, size[2]]) + margin
    first, columns = _columns(low, high, body_from_sensor, steps)
    channels = len(directions) // steps
    found = np.empty(channels * columns, np.int64)
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
                found[count] = ray
                count += 1
    return found[:count]


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
