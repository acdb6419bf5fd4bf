"""Compiled loops over packets of 16 rays for Embree's `rtcIntersect16` and `rtcOccluded16`, and records of hits.

Embree's function is called by its address, an integer argument, so that Numba can cache the compiled code on disk; a
kernel that closes over a ctypes function cannot be cached.
"""

from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from flcav.arrays import Array32, Ints32
from flcav.machine.compiled import compiled

# Rows of an RTCRayHit16, seen as a (32, 16) array of float32 or int32.
ORIGIN, NEAR, DIRECTION, TIME, FAR, MASK, RAY_ID, FLAGS = 0, 3, 4, 7, 8, 9, 10, 11
FACE, GEOMETRY, INSTANCE, INSTANCE_PRIMITIVE = 17, 18, 19, 20
ROWS, LANES = 32, 16


@intrinsic
def call_c(typing_context, address, first, second, third, fourth):
    """Call the C function `void f(void*, void*, void*, void*)` at `address`; all five arguments are int64."""

    def generate(context, builder, signature, arguments):
        word = ir.IntType(64)
        function_type = ir.FunctionType(ir.VoidType(), [word] * 4)
        builder.call(builder.inttoptr(arguments[0], function_type.as_pointer()), arguments[1:])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64, types.int64, types.int64), generate


@compiled
def _allocate_packet():
    """Return a ray packet (ROWS, LANES) as float32 and as int32, and its mask of valid rays (LANES,).

    Embree requires them to be aligned to 64 bytes. Time, mask, id and flags of the rays are set.
    """
    spare_floats = np.empty(ROWS * LANES + LANES, np.float32)
    skipped = ((64 - spare_floats.ctypes.data % 64) % 64) // 4
    packet = spare_floats[skipped : skipped + ROWS * LANES].reshape(ROWS, LANES)
    words = packet.view(np.int32)
    spare_words = np.empty(2 * LANES, np.int32)
    skipped = ((64 - spare_words.ctypes.data % 64) % 64) // 4
    packet[TIME, :] = 0
    words[MASK, :] = -1
    words[RAY_ID, :] = 0
    words[FLAGS, :] = 0
    return packet, words, spare_words[skipped : skipped + LANES]


@compiled
def trace_packets(
    intersect, scene, arguments, origin, rotation, directions, near, far, first_ray, last_ray, distance, instance, face
):
    """Write the first hits of the rays from `first_ray` to `last_ray`, exclusive, to `distance`, `instance` and `face`.

    `intersect`, `scene` and `arguments` are addresses. `origin` (3,) [m] and `rotation` (3, 3) are the pose of the ray
    frame in the scene, `directions` (N, 3) unit vectors in it. `near` is (N,), or (1,) for all, `far` a scalar [m]. The
    results are (N,); where nothing is hit, the distance is inf, and instance and face are -1.
    """
    packet, packet_words, valid = _allocate_packet()
    near_step = 1 if len(near) > 1 else 0
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    for axis in range(3):
        packet[ORIGIN + axis, :] = origin[axis]
    for start in range(first_ray, last_ray, LANES):
        lanes = min(LANES, last_ray - start)
        for lane in range(LANES):
            valid[lane] = -1 if lane < lanes else 0
            ray = start + min(lane, lanes - 1)
            x, y, z = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            packet[DIRECTION, lane] = r00 * x + r01 * y + r02 * z
            packet[DIRECTION + 1, lane] = r10 * x + r11 * y + r12 * z
            packet[DIRECTION + 2, lane] = r20 * x + r21 * y + r22 * z
            packet[NEAR, lane] = near[ray * near_step]
            packet[FAR, lane] = far
            packet_words[GEOMETRY, lane] = -1
            packet_words[INSTANCE, lane] = -1
            packet_words[INSTANCE_PRIMITIVE, lane] = -1
        call_c(intersect, valid.ctypes.data, scene, packet.ctypes.data, arguments)  # pyright: ignore[reportCallIssue]
        for lane in range(lanes):
            ray = start + lane
            if packet_words[GEOMETRY, lane] < 0:
                distance[ray] = np.inf
                instance[ray] = -1
                face[ray] = -1
            else:
                distance[ray] = packet[FAR, lane]
                instance[ray] = max(packet_words[INSTANCE, lane], 0)
                face[ray] = packet_words[FACE, lane]


@compiled
def trace_groups(
    intersect, scenes, arguments, origins, rotations, directions, near, far, ends, distance, instance, face
):
    """Write the first hits of K groups of rays, group k with `scenes[k]` alone; `instance` is the group index.

    Group k has the rays from `ends[k - 1]` to `ends[k]`; `origins` (K, 3) [m] and `rotations` (K, 3, 3) are the poses
    of the groups' frames. The other arguments are those of `trace_packets`.
    """
    first = 0
    for group in range(len(scenes)):
        last = ends[group]
        trace_packets(
            *(intersect, scenes[group], arguments, origins[group], rotations[group], directions, near, far),
            *(first, last, distance, instance, face),
        )
        for ray in range(first, last):
            if instance[ray] >= 0:
                instance[ray] = group
        first = last


@compiled
def occlude_packets(occluded, scene, arguments, origins, directions, far, blocked):
    """Write to `blocked` (N,) whether rays are occluded before their ends `far` (N,) [m]; never where `far` <= 0.

    `occluded`, `scene` and `arguments` are addresses. `origins` (N, 3) and unit `directions` (N, 3), or (1, 3) for all,
    are in the scene's frame.
    """
    packet, _, valid = _allocate_packet()
    rays = np.empty(LANES, np.int64)
    direction_step = 1 if len(directions) > 1 else 0
    packet[NEAR, :] = 0
    lanes = 0
    for ray in range(len(far)):
        blocked[ray] = False
        if far[ray] > 0:
            for axis in range(3):
                packet[ORIGIN + axis, lanes] = origins[ray, axis]
                packet[DIRECTION + axis, lanes] = directions[ray * direction_step, axis]
            packet[FAR, lanes] = far[ray]
            rays[lanes] = ray
            lanes += 1
        if lanes == LANES or (ray == len(far) - 1 and lanes > 0):
            for lane in range(LANES):
                valid[lane] = -1 if lane < lanes else 0
            call_c(occluded, valid.ctypes.data, scene, packet.ctypes.data, arguments)  # pyright: ignore[reportCallIssue]
            for lane in range(lanes):
                blocked[rays[lane]] = packet[FAR, lane] < 0
            lanes = 0


MISS = -1  # instance and face of a ray that hits nothing


class Hits(NamedTuple):
    """The first hits of N rays."""

    distance: Array32  # (N,) range along the unit direction [m]; inf where nothing is hit
    instance: Ints32  # (N,) index of the instance; 0 for a solid alone; MISS where nothing is hit
    face: Ints32  # (N,) face index in that solid; MISS where nothing is hit
