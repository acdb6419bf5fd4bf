"""Textures of traffic signs: mip-maps, drawn once, with trilinear filtering."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flcav.machine.compiled import inlined
from flcav.world.meshes.furniture import SIGN_RADIUS_M

SIGN_KINDS = ("stop", "yield", "speed_30", "speed_60", "speed_90")
SIDE = 128  # texels along each side of the finest level
LEVELS = 6  # of the mip-map, each of half the size of the one before
DRAWN = 4  # samples along each side of a texel

RED, WHITE, BLACK = (0.56, 0.015, 0.020), (0.80, 0.80, 0.79), (0.012, 0.012, 0.012)
_TEXT = {"stop": "STOP", "speed_30": "30", "speed_60": "60", "speed_90": "90"}
_TEXT_WIDTH = {"stop": 1.34, "speed_30": 0.98, "speed_60": 0.98, "speed_90": 0.98}  # on a plate of radius 1


@lru_cache(maxsize=1)
def draw_signs() -> NDArray[np.float32]:
    """Return mip-maps (kinds, LEVELS, SIDE, SIDE, 3), rows from the top; level l fills SIDE / 2^l rows and columns."""
    out = np.zeros((len(SIGN_KINDS), LEVELS, SIDE, SIDE, 3), np.float32)
    for kind, name in enumerate(SIGN_KINDS):
        picture = _draw(name)
        for level in range(LEVELS):
            out[kind, level, : len(picture), : len(picture)] = picture
            picture = picture.reshape(len(picture) // 2, 2, len(picture) // 2, 2, 3).mean(axis=(1, 3))
    return out


@inlined
def sample_sign(kind, right, up, footprint, drawn):
    """Return red, green, blue of a plate at `right`, `up` of its centre [m], for a pixel's `footprint` [m]."""
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


def _draw(kind: str) -> NDArray[np.float64]:
    """Return the finest level (SIDE, SIDE, 3) of a sign; texels outside its plate have the colour of its rim."""
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


def _painted(inside: NDArray[np.bool_], inner: tuple[float, ...], outer: tuple[float, ...]) -> NDArray[np.float64]:
    return np.where(inside[..., None], inner, outer)


def _text(kind: str, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return, in the shape of `x`, which points `x`, `y` of a plate of radius 1 lie in a sign's letters."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    letters = TextPath((0, 0), _TEXT[kind], size=1.0, prop=FontProperties(family="DejaVu Sans", weight="bold"))
    low, high = letters.vertices.min(axis=0), letters.vertices.max(axis=0)
    scale = np.array([_TEXT_WIDTH[kind] / (high[0] - low[0])] * 2) * (1.0, 1.15)
    points = np.stack((x.ravel(), y.ravel()), axis=1) / scale + (low + high) / 2
    near = (np.abs(x) < _TEXT_WIDTH[kind] / 2 + 0.02) & (np.abs(y) < 0.75)
    found = np.zeros(x.size, np.bool_)
    outlines = letters.to_polygons(closed_only=True)
    from matplotlib.path import Path

    for outline in outlines:  # even-odd rule: the holes of letters have outlines too
        found[near.ravel()] ^= Path(outline).contains_points(points[near.ravel()])
    return found.reshape(x.shape)
