"""Ambient occlusion: one short ray for every block of 2 x 2 pixels, averaged over 4 x 4 neighbouring blocks.

Ray directions are cosine-weighted; each of the 16 blocks has another one.
"""

import numpy as np
from numpy.typing import NDArray

from flcav.machine.compiled import compiled
from flcav.sensors.lens import Lens
from flcav.sensors.rendering.gbuffer import GBuffer
from flcav.world.scene import Scene

REACH_M = 2.2  # length of the rays
FARTHEST_M = 40.0  # distance beyond which nothing is occluded
DARKEST = 0.15  # value where all rays are blocked
SPAN = 4  # blocks along each side of the neighbourhood that is averaged over


def compute_ambient_occlusion(
    scene: Scene, seen: GBuffer, lens: Lens, hidden: int | None, threads: int = 1
) -> NDArray[np.float32]:
    """Return the ambient occlusion (N,) of each pixel: the unoccluded share of the hemisphere, scaled to DARKEST..1.

    Only objects within REACH_M occlude; the actor `hidden` does not.
    """
    columns, rows = -(-lens.width // 2), -(-lens.height // 2)
    blocks = (SPAN, SPAN, -(-rows // SPAN), -(-columns // SPAN))  # rays of one direction side by side: faster
    origin, towards = np.empty((*blocks, 3), np.float32), np.empty((*blocks, 3), np.float32)
    far = np.full(blocks, -1, np.float32)
    _hemisphere(seen, lens.width, columns, rows, _ways(), origin, towards, far)
    starts, aims = origin.reshape(-1, 3), towards.reshape(-1, 3)
    blocked = scene.find_occluded(starts, aims, far.ravel(), hidden=hidden, threads=threads)
    out = np.empty(len(seen), np.float32)
    _spread(seen, blocked.reshape(blocks), lens.width, lens.height, columns, rows, out)
    return out


def _ways() -> NDArray[np.float32]:
    """Return (SPAN, SPAN, 3) points, even over the unit sphere; added to a normal: cosine-weighted directions."""
    count = SPAN * SPAN
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    level = np.sqrt(1 - z**2)
    return np.stack((level * np.cos(angle), level * np.sin(angle), z), axis=1).reshape(SPAN, SPAN, 3).astype(np.float32)


@compiled
def _hemisphere(seen, width, columns, rows, ways, origin, towards, far):
    for row in range(rows):
        for column in range(columns):
            pixel = 2 * row * width + 2 * column
            if seen.row[pixel] < 0 or seen.distance[pixel] > FARTHEST_M:
                continue
            b, a, j, i = row % SPAN, column % SPAN, row // SPAN, column // SPAN
            x = seen.normal[pixel, 0] * np.float32(1.02) + ways[b, a, 0]
            y = seen.normal[pixel, 1] * np.float32(1.02) + ways[b, a, 1]
            z = seen.normal[pixel, 2] * np.float32(1.02) + ways[b, a, 2]
            length = np.sqrt(x * x + y * y + z * z)
            towards[b, a, j, i, 0], towards[b, a, j, i, 1], towards[b, a, j, i, 2] = x / length, y / length, z / length
            for axis in range(3):
                origin[b, a, j, i, axis] = seen.position[pixel, axis]
            far[b, a, j, i] = REACH_M


@compiled
def _spread(seen, blocked, width, height, columns, rows, out):
    for row in range(rows):
        for column in range(columns):
            pixel = 2 * row * width + 2 * column
            free, total = np.float32(0), np.float32(0)
            if seen.row[pixel] >= 0:
                near = np.float32(0.1) * seen.distance[pixel] + np.float32(0.1)
                for j in range(max(row - SPAN // 2, 0), min(row + SPAN // 2, rows)):
                    for i in range(max(column - SPAN // 2, 0), min(column + SPAN // 2, columns)):
                        other = 2 * j * width + 2 * i
                        if seen.row[other] >= 0 and abs(seen.distance[other] - seen.distance[pixel]) <= near:
                            total += 1
                            if not blocked[j % SPAN, i % SPAN, j // SPAN, i // SPAN]:
                                free += 1
            share = free / total if total > 0 else np.float32(1)
            share = np.float32(DARKEST) + np.float32(1 - DARKEST) * share
            for y in range(2 * row, min(2 * row + 2, height)):
                for x in range(2 * column, min(2 * column + 2, width)):
                    out[y * width + x] = share
