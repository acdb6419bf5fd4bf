"""Textures of facades and of traffic signs.

Facades are procedural: plaster, brick or panels, with windows aligned to the mesh's sills and balconies. Signs are
mip-maps, rasterised once, with trilinear filtering.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from flcav.arrays import Array, Array32, Bytes, Mask
from flcav.geometry import heading_vectors
from flcav.machine.compiled import inlined
from flcav.sensors.rendering.noise import fade, hash_pair, overlap, sample_noise
from flcav.statistics.streams import stream
from flcav.world.meshes.furniture import SIGN_RADIUS_M
from flcav.world.static import BAY_M, GABLED_BELOW_M, STOREY_M

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
SILL_M = 0.95  # height of a window above its floor
FRAME_M = 0.07  # width of window frames and bars


class Facades(NamedTuple):
    """Pose, size, style and colours of the B buildings of a town, world frame."""

    place: Array32  # (B, 4) centre x, y [m], cosine and sine of the yaw
    size: Array32  # (B, 3) length, width, height of the walls [m]
    style: Bytes  # (B,) PLASTER, BRICK or PANEL
    wall: Array32  # (B, 3) linear colour
    roof: Array32  # (B, 3) linear colour


def facades_of(name: str, buildings: Array) -> Facades:
    """Return the facades of `buildings` (B, 6): x, y [m], yaw [rad], length, width, height [m], world frame.

    The town's `name` seeds their styles and colours.
    """
    rng = stream(0, "walls", name)
    count = len(buildings)
    kind = rng.integers(len(WALLS), size=count)
    tint = 1 + 0.10 * rng.standard_normal((count, 1)) + 0.03 * rng.standard_normal((count, 3))
    yaw = buildings[:, 2]
    height = buildings[:, 5]
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
    """Return red, green, blue, the share of glass, and the window's number at a point of a building's wall.

    x, y, z is the point [m], nx, ny the unit normal, world frame. `across` [m] is the pixel's footprint at normal
    incidence, `slant` [m] the footprint divided by the cosine of the angle of incidence.
    """
    place, cos, sin = facades.place, facades.place[building, 2], facades.place[building, 3]
    dx, dy = x - place[building, 0], y - place[building, 1]
    u, v = dx * cos + dy * sin, dy * cos - dx * sin
    side = nx * cos + ny * sin  # of the normal along the building
    if abs(side) > np.float32(0.7):
        u, v, length, number = v, u, facades.size[building, 1], 1
    else:
        length = facades.size[building, 0]
        number = 0
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


SIGN_KINDS = ("stop", "yield", "speed_30", "speed_60", "speed_90")
SIDE = 128  # texels per side of the finest level
LEVELS = 6  # of the mip-map, every one half the size of the one before
DRAWN = 4  # samples per side of a texel

RED, WHITE, BLACK = (0.56, 0.015, 0.020), (0.80, 0.80, 0.79), (0.012, 0.012, 0.012)
_TEXT = {"stop": "STOP", "speed_30": "30", "speed_60": "60", "speed_90": "90"}
_TEXT_WIDTH = {"stop": 1.34, "speed_30": 0.98, "speed_60": 0.98, "speed_90": 0.98}  # on a plate of radius 1


@lru_cache(maxsize=1)
def draw_signs() -> Array32:
    """Rasterise the signs; return mip-maps (kinds, LEVELS, SIDE, SIDE, 3), rows from the top.

    Level l fills SIDE / 2^l rows and columns.
    """
    out = np.zeros((len(SIGN_KINDS), LEVELS, SIDE, SIDE, 3), np.float32)
    for kind, name in enumerate(SIGN_KINDS):
        picture = _draw(name)
        for level in range(LEVELS):
            out[kind, level, : len(picture), : len(picture)] = picture
            picture = picture.reshape(len(picture) // 2, 2, len(picture) // 2, 2, 3).mean(axis=(1, 3))
    return out


@inlined
def sample_sign(kind, right, up, footprint, drawn):
    """Return red, green, blue of a plate at the offset `right`, `up` [m] from its centre, for a footprint [m]."""
    texel = np.float32(2 * SIGN_RADIUS_M / SIDE)
    level = np.log2(max(footprint / texel, np.float32(1)))
    first = min(int(level), LEVELS - 1)
    second = min(first + 1, LEVELS - 1)
    between = np.float32(min(max(level - first, 0.0), 1.0))
    u, v = right / np.float32(2 * SIGN_RADIUS_M) + np.float32(0.5), np.float32(0.5) - up / np.float32(2 * SIGN_RADIUS_M)
    r0, g0, b0 = _texel(drawn[kind, first], u, v, SIDE >> first)
    r1, g1, b1 = _texel(drawn[kind, second], u, v, SIDE >> second)
    return r0 + between * (r1 - r0), g0 + between * (g1 - g0), b0 + between * (b1 - b0)


@inlined
def _texel(picture, u, v, side):
    x = min(max(u * side - np.float32(0.5), np.float32(0)), np.float32(side - 1))
    y = min(max(v * side - np.float32(0.5), np.float32(0)), np.float32(side - 1))
    i, j = int(x), int(y)
    i1, j1 = min(i + 1, side - 1), min(j + 1, side - 1)
    a, b = np.float32(x - i), np.float32(y - j)
    red = (picture[j, i, 0] * (1 - a) + picture[j, i1, 0] * a) * (1 - b)
    red += (picture[j1, i, 0] * (1 - a) + picture[j1, i1, 0] * a) * b
    green = (picture[j, i, 1] * (1 - a) + picture[j, i1, 1] * a) * (1 - b)
    green += (picture[j1, i, 1] * (1 - a) + picture[j1, i1, 1] * a) * b
    blue = (picture[j, i, 2] * (1 - a) + picture[j, i1, 2] * a) * (1 - b)
    blue += (picture[j1, i, 2] * (1 - a) + picture[j1, i1, 2] * a) * b
    return red, green, blue


def _draw(kind: str) -> Array:
    """Rasterise the finest level (SIDE, SIDE, 3) of a sign; texels outside the plate have the colour of its rim."""
    count = SIDE * DRAWN
    step = (np.arange(count) + 0.5) / count * 2 - 1
    x, y = np.meshgrid(step, -step)
    if kind == "stop":
        apart = np.maximum.reduce([abs(x * np.cos(a) + y * np.sin(a)) for a in np.arange(4) * np.pi / 4])
        inside = apart / np.cos(np.pi / 8)
        picture = _painted(inside < 0.91, RED, WHITE)
        picture[_text(kind, x, y) & (inside < 0.91)] = WHITE
    elif kind == "yield":
        apart = np.maximum.reduce([x * np.cos(a) + y * np.sin(a) for a in np.pi / 2 + np.arange(3) * 2 * np.pi / 3])
        picture = _painted(apart / np.cos(np.pi / 3) < 0.68, WHITE, RED)
    else:
        radius = np.hypot(x, y)
        picture = _painted(radius < 0.74, WHITE, RED)
        picture[radius > 0.965] = WHITE
        picture[_text(kind, x, y)] = BLACK
    return picture.reshape(SIDE, DRAWN, SIDE, DRAWN, 3).mean(axis=(1, 3))


def _painted(inside: Mask, inner: tuple[float, ...], outer: tuple[float, ...]) -> Array:
    return np.where(inside[..., None], inner, outer)


def _text(kind: str, x: Array, y: Array) -> Mask:
    """Return, in the shape of `x`, whether points `x`, `y` of a plate with radius 1 are in a sign's letters."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    letters = TextPath((0, 0), _TEXT[kind], size=1.0, prop=FontProperties(family="DejaVu Sans", weight="bold"))
    low, high = letters.vertices.min(axis=0), letters.vertices.max(axis=0)
    scale = np.array([_TEXT_WIDTH[kind] / (high[0] - low[0])] * 2) * (1.0, 1.15)
    points = np.stack((x.ravel(), y.ravel()), axis=1) / scale + (low + high) / 2
    near = (np.abs(x) < _TEXT_WIDTH[kind] / 2 + 0.02) & (np.abs(y) < 0.75)
    inside = np.zeros(x.size, np.bool_)
    outlines = letters.to_polygons(closed_only=True)
    from matplotlib.path import Path

    for outline in outlines:  # even-odd rule: the holes of letters have outlines too
        inside[near.ravel()] ^= Path(outline).contains_points(points[near.ravel()])
    return inside.reshape(x.shape)
