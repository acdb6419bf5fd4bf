"""G-buffer of a deferred renderer: surface, position and shading normal at the hits of rays."""

from typing import NamedTuple

import numpy as np

from flcav.arrays import Array, Array32, Ints32
from flcav.geometry import heading_vectors
from flcav.machine.compiled import inlined, kernel
from flcav.machine.threads import share_among_threads
from flcav.sensors.rendering.appearance import Appearance
from flcav.world.rays.packets import Hits
from flcav.world.scene import Scene

LIFT_M = 0.015  # offset of secondary rays' origins along the normal, against self-intersection


class GBuffer(NamedTuple):
    """G-buffer: the hits of N rays, world frame."""

    ray: Array32  # (N, 3) unit direction
    distance: Array32  # (N,) [m]; inf for the sky
    instance: Ints32  # (N,) instance of the scene; -1 for the sky
    row: Ints32  # (N,) row of the scene's surfaces; -1 for the sky
    normal: Array32  # (N, 3) unit, towards the camera; interpolated over curved surfaces of actors
    position: Array32  # (N, 3) [m], moved `LIFT_M` off the surface

    def __len__(self) -> int:
        return len(self.distance)

    def part(self, of: slice) -> "GBuffer":
        """Return a slice of the hits, as views."""
        near = self.ray[of], self.distance[of], self.instance[of], self.row[of]
        return GBuffer(*near, self.normal[of], self.position[of])


def fill_gbuffer(
    scene: Scene, appearance: Appearance, world_from_camera: Array, directions: Array32, hits: Hits, threads: int = 1
) -> GBuffer:
    """Return the G-buffer of N hits; `directions` (N, 3) are the unit rays, optical frame."""
    count, poses = len(directions), scene.poses()
    bodies = np.zeros((len(poses) + 1, 5), np.float32)  # by instance: x, y, z, cosine and sine of the yaw
    bodies[1:] = np.c_[poses[:, :3], heading_vectors(poses[:, 3])]
    out = GBuffer(
        np.empty((count, 3), np.float32),
        hits.distance,
        hits.instance,
        np.empty(count, np.int32),
        np.zeros((count, 3), np.float32),
        np.zeros((count, 3), np.float32),
    )
    pose, rays = world_from_camera.astype(np.float32), directions.view()
    rays.flags.writeable = False  # as some are: Numba compiles the loop for one type only
    first, normals = scene.surfaces.first, scene.surfaces.normal

    def look_up(start: int, end: int) -> None:
        at = slice(start, end)
        _look_up(pose, rays[at], hits.face[at], first, normals, bodies, appearance, out.part(at))

    share_among_threads(look_up, count, threads)
    return out


@kernel
def _look_up(pose, directions, face, first, normals, bodies, appearance, out):
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
        distance = out.distance[ray]
        px, py, pz = pose[0, 3] + dx * distance, pose[1, 3] + dy * distance, pose[2, 3] + dz * distance
        nx, ny, nz = normals[row, 0], normals[row, 1], normals[row, 2]
        cos, sin = bodies[instance, 3], bodies[instance, 4]
        if instance > 0:
            nx, ny = cos * nx - sin * ny, sin * nx + cos * ny
        if nx * dx + ny * dy + nz * dz > 0:
            nx, ny, nz = -nx, -ny, -nz
        out.position[ray, 0], out.position[ray, 1], out.position[ray, 2] = (
            px + nx * lift,
            py + ny * lift,
            pz + nz * lift,
        )
        if instance > 0:
            ex, ey, ez = px - bodies[instance, 0], py - bodies[instance, 1], pz - bodies[instance, 2]
            bx, by = cos * ex + sin * ey, cos * ey - sin * ex
            number = row - appearance.first_actor
            sx, sy, sz = _smooth(bx, by, ez, appearance.corner, appearance.corner_normal, number)
            sx, sy = cos * sx - sin * sy, sin * sx + cos * sy
            if sx * nx + sy * ny + sz * nz < 0:
                sx, sy, sz = -sx, -sy, -sz
            if sx * dx + sy * dy + sz * dz < np.float32(-0.02):  # a shading normal must not face away from the camera
                nx, ny, nz = sx, sy, sz
        out.normal[ray, 0], out.normal[ray, 1], out.normal[ray, 2] = nx, ny, nz


@inlined
def _smooth(x, y, z, corner, normal, face):
    """Return the shading normal at a point of an actor's face: the barycentric interpolation of the corner normals.

    The point [m] and the normal are in the body frame; it has unit length, or 0 where the corners have none.
    """
    ax, ay, az = (
        corner[face, 1, 0] - corner[face, 0, 0],
        corner[face, 1, 1] - corner[face, 0, 1],
        corner[face, 1, 2] - corner[face, 0, 2],
    )
    bx, by, bz = (
        corner[face, 2, 0] - corner[face, 0, 0],
        corner[face, 2, 1] - corner[face, 0, 1],
        corner[face, 2, 2] - corner[face, 0, 2],
    )
    cx, cy, cz = x - corner[face, 0, 0], y - corner[face, 0, 1], z - corner[face, 0, 2]
    aa, ab, bb = ax * ax + ay * ay + az * az, ax * bx + ay * by + az * bz, bx * bx + by * by + bz * bz
    ca, cb = cx * ax + cy * ay + cz * az, cx * bx + cy * by + cz * bz
    area = max(aa * bb - ab * ab, np.float32(1e-14))
    v = min(max((bb * ca - ab * cb) / area, np.float32(0)), np.float32(1))
    w = min(max((aa * cb - ab * ca) / area, np.float32(0)), np.float32(1))
    u = 1 - v - w
    sx = u * normal[face, 0, 0] + v * normal[face, 1, 0] + w * normal[face, 2, 0]
    sy = u * normal[face, 0, 1] + v * normal[face, 1, 1] + w * normal[face, 2, 1]
    sz = u * normal[face, 0, 2] + v * normal[face, 1, 2] + w * normal[face, 2, 2]
    length = max(np.sqrt(sx * sx + sy * sy + sz * sz), np.float32(1e-6))
    return sx / length, sy / length, sz / length
