"""How much of the sky a surface sees: one short ray for every fourth pixel, averaged over sixteen of them."""

import numpy as np
from numpy.typing import NDArray

from flcav.sensors.lens import Lens
from flcav.sensors.shading.survey import Survey
from flcav.world.rays.compiled import compiled
from flcav.world.scene import Scene

REACH_M = 2.2
FARTHEST_M = 40.0  # beyond, corners are taken as open
DARKEST = 0.15
TURNS = 16


def openness(scene: Scene, seen: Survey, lens: Lens, hidden: int | None) -> NDArray[np.float32]:
    """Return (N,) the share of the sky that is free above each pixel's surface, as far as things nearby hide it."""
    columns, rows = -(-lens.width // 2), -(-lens.height // 2)
    count = columns * rows
    origin, towards = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
    far = np.empty(count, np.float32)
    _hemisphere(seen, lens.width, columns, origin, towards, far)
    blocked = scene.blocked(origin, towards, far, hidden=hidden)
    out = np.empty(len(seen), np.float32)
    _spread(seen, blocked, lens.width, lens.height, columns, rows, out)
    return out


@compiled
def _hemisphere(seen, width, columns, origin, towards, far):
    for cell in range(len(far)):
        i, j = cell % columns, cell // columns
        pixel = 2 * j * width + 2 * i
        if seen.row[pixel] < 0 or seen.distance[pixel] > FARTHEST_M:
            far[cell] = -1
            continue
        turn = ((i & 3) * 5 + (j & 3) * 11) % TURNS
        angle = turn * 2.399963
        rise = np.sqrt((turn + 0.5) / TURNS)
        level = np.sqrt(1 - rise * rise)
        x = seen.normal[pixel, 0] * 1.02 + level * np.cos(angle) * 1.0
        y = seen.normal[pixel, 1] * 1.02 + level * np.sin(angle) * 1.0
        z = seen.normal[pixel, 2] * 1.02 + (rise * 2 - 1) * 0.9
        length = np.sqrt(x * x + y * y + z * z) + 1e-9
        towards[cell, 0], towards[cell, 1], towards[cell, 2] = x / length, y / length, z / length
        origin[cell] = seen.position[pixel]
        far[cell] = REACH_M


@compiled
def _spread(seen, blocked, width, height, columns, rows, out):
    for cell in range(columns * rows):
        i, j = cell % columns, cell // columns
        pixel = 2 * j * width + 2 * i
        free, total = np.float32(0), np.float32(0)
        if seen.row[pixel] >= 0:
            for b in range(max(j - 2, 0), min(j + 2, rows)):
                for a in range(max(i - 2, 0), min(i + 2, columns)):
                    other = 2 * b * width + 2 * a
                    if seen.row[other] < 0 or abs(seen.distance[other] - seen.distance[pixel]) > np.float32(
                        0.1
                    ) * seen.distance[pixel] + np.float32(0.1):
                        continue
                    total += 1
                    free += np.float32(0) if blocked[b * columns + a] else np.float32(1)
        share = free / total if total > 0 else np.float32(1)
        share = np.float32(DARKEST) + np.float32(1 - DARKEST) * share
        for y in range(2 * j, min(2 * j + 2, height)):
            for x in range(2 * i, min(2 * i + 2, width)):
                out[y * width + x] = share
