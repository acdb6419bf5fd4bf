"""What each ray met: the surface, where, and which way it faces."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.world.rays.compiled import compiled
from flcav.world.rays.raycaster import Hits
from flcav.world.scene import Scene

LIFT_M = 0.015  # rays that leave a surface start so far off it


class Survey(NamedTuple):
    """N rays' ends, world frame."""

    ray: NDArray[np.float32]  # (N, 3) unit direction
    distance: NDArray[np.float32]  # (N,) [m]; inf for the sky
    instance: NDArray[np.int32]  # (N,) of the scene; -1 for the sky
    row: NDArray[np.int32]  # (N,) of the scene's surfaces; -1 for the sky
    normal: NDArray[np.float32]  # (N, 3) unit, towards the camera
    position: NDArray[np.float32]  # (N, 3) [m], `LIFT_M` off the surface

    def __len__(self) -> int:
        return len(self.distance)


def survey(
    scene: Scene,
    world_from_camera: NDArray[np.float64],
    directions: NDArray[np.float32],
    *,
    far_m: float,
    hidden: int | None,
    near_m: NDArray[np.float32] | None = None,
) -> Survey:
    """Return what the rays `directions` (N, 3), optical frame, meet between `near_m` (N,) and `far_m`."""
    hits = scene.cast(world_from_camera, directions, near_m=near_m, far_m=far_m, hidden=hidden)
    return ends(scene, world_from_camera, directions, hits)


def ends(scene: Scene, world_from_camera: NDArray[np.float64], directions: NDArray[np.float32], hits: Hits) -> Survey:
    """Return the ends of rays that were cast already."""
    count = len(directions)
    out = Survey(
        np.empty((count, 3), np.float32),
        hits.distance,
        hits.instance,
        np.empty(count, np.int32),
        np.zeros((count, 3), np.float32),
        np.zeros((count, 3), np.float32),
    )
    _ends(
        world_from_camera.astype(np.float32),
        directions,
        hits.face,
        scene.surfaces.first,
        scene.surfaces.normal,
        scene.world_from_instance().astype(np.float32),
        out,
    )
    return out


@compiled
def _ends(pose, directions, face, first, normals, world_from_instance, out):
    lift = np.float32(LIFT_M)
    for ray in range(len(directions)):
        x, y, z = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        dx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z
        dy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z
        dz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z
        out.ray[ray, 0], out.ray[ray, 1], out.ray[ray, 2] = dx, dy, dz
        instance = out.instance[ray]
        if instance < 0:
            out.row[ray] = -1
            continue
        row = first[instance] + face[ray]
        out.row[ray] = row
        nx, ny, nz = normals[row, 0], normals[row, 1], normals[row, 2]
        if instance > 0:
            turn = world_from_instance[instance]
            nx, ny = turn[0, 0] * nx + turn[0, 1] * ny, turn[1, 0] * nx + turn[1, 1] * ny
        if nx * dx + ny * dy + nz * dz > 0:
            nx, ny, nz = -nx, -ny, -nz
        out.normal[ray, 0], out.normal[ray, 1], out.normal[ray, 2] = nx, ny, nz
        distance = out.distance[ray]
        out.position[ray, 0] = pose[0, 3] + dx * distance + nx * lift
        out.position[ray, 1] = pose[1, 3] + dy * distance + ny * lift
        out.position[ray, 2] = pose[2, 3] + dz * distance + nz * lift
