"""Ambient occlusion: one short ray for every block of 2 x 2 pixels, averaged over 4 x 4 neighbouring blocks.

Ray directions are cosine-weighted; each of the 16 blocks has another one.
"""

import numpy as np
from numpy.typing import NDArray

from flcav.machine.compiled import compiled
from flcav.machine.threads import share_among_threads
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
    around = blocked.reshape(blocks).transpose(2, 0, 3, 1).reshape(blocks[2] * SPAN, -1)[:rows, :columns]
    around, out = np.ascontiguousarray(around).view(np.uint8), np.empty(len(seen), np.float32)

    def spread(first: int, last: int) -> None:
        _spread(seen, around, lens.width, lens.height, columns, first, last, out)

    share_among_threads(spread, rows, threads)
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
def _spread(seen, blocked, width, height, columns, first, last, out):
    """Write the shares of the blocks in rows `first` to `last`: 1 where no ray is blocked nearby, as mostly."""
    half = SPAN // 2
    along = np.zeros(columns, np.int64)  # blocked rays in the neighbourhood's rows, by column
    for row in range(max(first - half, 0), min(first + half - 1, len(blocked))):
        for column in range(columns):
            along[column] += blocked[row, column]
    for row in range(first, last):
        entering, left = row + half - 1, row - half - 1
        for column in range(columns):
            if entering < len(blocked):
                along[column] += blocked[entering, column]
            if left >= max(first - half, 0):
                along[column] -= blocked[left, column]
        for column in range(columns):
            pixel = 2 * row * width + 2 * column
            share, around = np.float32(1), 0
            for i in range(max(column - half, 0), min(column + half, columns)):
                around += along[i]
            if around > 0 and seen.row[pixel] >= 0:
                free, total = np.float32(0), np.float32(0)
                near = np.float32(0.1) * seen.distance[pixel] + np.float32(0.1)
                for j in range(max(row - half, 0), min(row + half, len(blocked))):
                    for i in range(max(column - half, 0), min(column + half, columns)):
                        other = 2 * j * width + 2 * i
                        if seen.row[other] >= 0 and abs(seen.distance[other] - seen.distance[pixel]) <= near:
                            total += 1
                            if not blocked[j, i]:
                                free += 1
                share = free / total if total > 0 else np.float32(1)
            share = np.float32(DARKEST) + np.float32(1 - DARKEST) * share
            for y in range(2 * row, min(2 * row + 2, height)):
                for x in range(2 * column, min(2 * column + 2, width)):
                    out[y * width + x] = share
