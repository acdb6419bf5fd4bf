"""Procedural textures of facades: plaster, brick or panels, with windows aligned to the mesh's sills and balconies."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flcav.geometry import heading_vectors
from flcav.machine.compiled import inlined
from flcav.sensors.rendering.noise import fade, hash_pair, overlap, sample_noise
from flcav.statistics.streams import stream
from flcav.world.meshes.buildings import BAY_M, GABLED_BELOW_M, STOREY_M

PLASTER, BRICK, PANEL = range(3)
WALLS = (  # style, linear colour
    (PLASTER, (0.62, 0.55, 0.42)),
    (PLASTER, (0.66, 0.63, 0.56)),
    (PLASTER, (0.55, 0.36, 0.24)),
    (PLASTER, (0.50, 0.53, 0.53)),
    (PLASTER, (0.60, 0.45, 0.22)),
    (BRICK, (0.30, 0.105, 0.065)),
    (BRICK, (0.36, 0.17, 0.10)),
    (BRICK, (0.40, 0.31, 0.21)),
    (PANEL, (0.36, 0.37, 0.37)),
    (PANEL, (0.50, 0.48, 0.44)),
)
ROOFS = ((0.21, 0.062, 0.035), (0.25, 0.095, 0.05), (0.07, 0.07, 0.075), (0.14, 0.10, 0.08))
WINDOW_M = (1.30, 1.45)  # width, height
SILL_M = 0.95  # of a window above its floor
FRAME_M = 0.07


class Facades(NamedTuple):
    """Placement, size, style and colours of the B buildings of a town."""

    place: NDArray[np.float32]  # (B, 4) x, y, cos and sin of the yaw
    size: NDArray[np.float32]  # (B, 3) length, width, height of the walls
    style: NDArray[np.uint8]  # (B,) PLASTER, BRICK or PANEL
    wall: NDArray[np.float32]  # (B, 3) linear colour
    roof: NDArray[np.float32]  # (B, 3) linear colour


def facades_of(name: str, buildings: NDArray[np.float64]) -> Facades:
    """Return the facades of `buildings` (B, 6): x, y, yaw, length, width, height. The town's `name` seeds styles."""
    rng = stream(0, "walls", name)
    count = len(buildings)
    kind = rng.integers(len(WALLS), size=count)
    tint = 1 + 0.10 * rng.standard_normal((count, 1)) + 0.03 * rng.standard_normal((count, 3))
    yaw, height = buildings[:, 2], buildings[:, 5]
    gabled = height < GABLED_BELOW_M
    walls = np.where(gabled, 0.68 * height, height - 0.5)
    roof = np.array(ROOFS)[rng.integers(len(ROOFS), size=count)]
    roof[~gabled] = (0.30, 0.29, 0.28)
    return Facades(
        np.column_stack((buildings[:, :2], heading_vectors(yaw))).astype(np.float32),
        np.stack((buildings[:, 3], buildings[:, 4], walls), axis=1).astype(np.float32),
        np.array([style for style, _ in WALLS], np.uint8)[kind],
        np.clip(np.array([colour for _, colour in WALLS])[kind] * tint, 0.02, 0.85).astype(np.float32),
        roof.astype(np.float32),
    )


@inlined
def shade_facade(building, x, y, z, nx, ny, across, slant, facades, table):
    """Return red, green, blue, the share of glass, and the window's number, at a point of a building's wall.

    x, y, z is the point, nx, ny the normal, world frame. `across` [m] is the pixel's footprint at normal incidence,
    `slant` [m] the same over the cosine of the incidence.
    """
    place, cos, sin = facades.place, facades.place[building, 2], facades.place[building, 3]
    dx, dy = x - place[building, 0], y - place[building, 1]
    u, v = dx * cos + dy * sin, dy * cos - dx * sin
    side = nx * cos + ny * sin  # of the normal along the building
    if abs(side) > np.float32(0.7):
        u, v, length, number = v, u, facades.size[building, 1], 1
    else:
        length, number = facades.size[building, 0], 0
    if v < 0:
        number += 2
    tone = np.float32(0.90) + np.float32(0.20) * sample_noise(table, u * 0.7 + building * 13.0, z * 0.5)
    tone -= np.float32(0.14) * max(np.float32(0), np.float32(1) - z)  # dirt splashed up from the ground
    style = facades.style[building]
    if style == BRICK:
        tone *= _bricks(u, z, slant, across)
    elif style == PANEL:
        joint = overlap(
            np.float32(z % STOREY_M - STOREY_M / 2), np.float32(STOREY_M / 2 - 0.02), max(across, np.float32(0.01))
        )
        tone *= np.float32(0.55) + np.float32(0.45) * joint
    else:
        fine = fade(np.float32(0.05), slant)
        if fine > 0:
            tone += fine * np.float32(0.08) * (sample_noise(table, u * 24.0, z * 24.0) - np.float32(0.5))
    wall = facades.wall
    red, green, blue = wall[building, 0] * tone, wall[building, 1] * tone, wall[building, 2] * tone
    storey = int(z // STOREY_M)
    bays = int(length // BAY_M)
    if bays < 1 or (storey + 1) * STOREY_M > facades.size[building, 2] + np.float32(0.3) or z < 0:
        return red, green, blue, np.float32(0), 0
    pitch = length / bays
    bay = int(np.floor((u + length / 2) / pitch))
    a = u + length / 2 - (bay + np.float32(0.5)) * pitch
    width, height, sill = np.float32(WINDOW_M[0]), np.float32(WINDOW_M[1]), np.float32(SILL_M)
    ground_floor = storey == 0
    door = ground_floor and hash_pair(building * 4 + number, bay) < np.float32(0.3)
    if door:
        width, height, sill = np.float32(1.1), np.float32(2.2), np.float32(0.0)
    b = z - storey * STOREY_M - sill - height / 2
    wide, tall = max(slant, np.float32(0.004)), max(across, np.float32(0.004))
    opening = overlap(a, width / 2, wide) * overlap(b, height / 2, tall)
    if opening <= 0:
        return red, green, blue, np.float32(0), 0
    frame = np.float32(FRAME_M)
    pane = overlap(a, width / 2 - frame, wide) * overlap(b, height / 2 - frame, tall)
    bars = overlap(a, frame / 2, wide)
    if not door:
        bars += (1 - bars) * overlap(b - height * np.float32(0.18), frame / 2, tall)
    glass = pane * (1 - bars)
    trim = opening - glass
    window = bay * 64 + storey * 4 + number
    light_frame = np.float32(0.60) if style != PANEL else np.float32(0.10)
    if door:
        shade = np.float32(0.5) + hash_pair(building, bay)
        red = red * (1 - opening) + opening * np.float32(0.14) * shade
        green = green * (1 - opening) + opening * np.float32(0.085) * shade
        blue = blue * (1 - opening) + opening * np.float32(0.06) * shade
        return red, green, blue, np.float32(0), 0
    inside = np.float32(0.022)
    if hash_pair(building * 7 + 3, window) < np.float32(0.45):  # a curtain
        inside = np.float32(0.20) if b > (hash_pair(building, window) - np.float32(0.6)) * height else inside
    red = red * (1 - opening) + trim * light_frame + glass * inside
    green = green * (1 - opening) + trim * light_frame + glass * inside
    blue = blue * (1 - opening) + trim * light_frame + glass * inside * np.float32(1.05)
    return red, green, blue, glass, window


@inlined
def _bricks(u, z, wide, tall):
    near = fade(np.float32(0.12), wide)
    if near <= 0:
        return np.float32(1)
    course = int(np.floor(z / np.float32(0.075)))
    shifted = u + np.float32(0.12) * (course & 1)
    brick = int(np.floor(shifted / np.float32(0.24)))
    a = np.float32(shifted - (brick + 0.5) * 0.24)
    b = np.float32(z - (course + 0.5) * 0.075)
    inside = overlap(a, np.float32(0.115), max(wide, np.float32(0.003))) * overlap(
        b, np.float32(0.0325), max(tall, np.float32(0.003))
    )
    tone = np.float32(0.86) + np.float32(0.32) * hash_pair(brick, course)
    return 1 + near * (tone * inside + np.float32(1.5) * (1 - inside) - 1)
