"""How much of each actor a sensor would see if nothing stood in the way: its rays, traced against it alone."""

import numba
import numpy as np
from numpy.typing import NDArray

from flcav.geometry import inverse, wrap_angle
from flcav.sensors.echoes import cast_through_glass
from flcav.sensors.lidar import Lidar, ray_pattern
from flcav.world.scene import Scene

BOX_MARGIN_M = 0.01


def unoccluded_rays(
    scene: Scene,
    world_from_sensor: NDArray[np.float64],
    lidar: Lidar,
    passes: NDArray[np.bool_],
    actors: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Return, for each of `actors` (K,), how many rays of the sweep would come back from it in an empty world."""
    return np.array([_alone(scene, world_from_sensor, lidar, passes, int(actor)) for actor in actors], np.int64)


def _alone(
    scene: Scene,
    world_from_sensor: NDArray[np.float64],
    lidar: Lidar,
    passes: NDArray[np.bool_],
    actor: int,
) -> int:
    body_from_sensor = inverse(scene.world_from_actor(actor)) @ world_from_sensor
    size = scene.trace.size[actor]
    first_column, columns = _azimuth_window(body_from_sensor, size, lidar.azimuth_steps)
    directions = ray_pattern(lidar)
    rays = _rays_into_box(directions, lidar.azimuth_steps, first_column, columns, body_from_sensor, size, BOX_MARGIN_M)
    if not len(rays):
        return 0

    def trace(directions: NDArray[np.float32], near_m: NDArray[np.float32] | None):
        return scene.cast_alone(actor, body_from_sensor, directions, near_m=near_m, far_m=lidar.range_m)

    surfaces = scene.surfaces
    first = surfaces.first[actor + 1 : actor + 2]
    echoes = cast_through_glass(trace, directions[rays], passes[rays], first, surfaces.material)
    return int(np.count_nonzero(echoes.instance >= 0))


def _azimuth_window(body_from_sensor: NDArray[np.float64], size: NDArray[np.float64], steps: int) -> tuple[int, int]:
    """Return the first column and the number of columns of the pattern that can meet the actor's box."""
    sensor_from_body = inverse(body_from_sensor)
    half = size / 2 + BOX_MARGIN_M
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half + (0, 0, size[2] / 2)
    points = corners @ sensor_from_body[:3, :3].T + sensor_from_body[:3, 3]
    center = points.mean(axis=0)
    if np.hypot(*center[:2]) <= np.linalg.norm(half):  # the spin axis may pass through the box
        return 0, steps
    middle = np.arctan2(center[1], center[0])
    aside = wrap_angle(np.arctan2(points[:, 1], points[:, 0]) - middle)
    step = 2 * np.pi / steps
    first = int(np.floor((middle + aside.min()) / step))
    last = int(np.ceil((middle + aside.max()) / step))
    return first % steps, min(last - first + 1, steps)


@numba.njit(nogil=True, cache=True)
def _rays_into_box(directions, steps, first_column, columns, body_from_sensor, size, margin):
    """Return the numbers of the rays of those columns that enter the box standing on the body's ground centre."""
    low = np.array([-size[0] / 2, -size[1] / 2, 0.0]) - margin
    high = np.array([size[0] / 2, size[1] / 2, size[2]]) + margin
    channels = len(directions) // steps
    found = np.empty(channels * columns, np.int64)
    count = 0
    for channel in range(channels):
        for column in range(first_column, first_column + columns):
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
            if enter <= leave:
                found[count] = ray
                count += 1
    return found[:count]
