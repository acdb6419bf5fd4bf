"""The static mesh of a town, including its buildings, with the object that every face belongs to."""

import pickle
from collections.abc import Callable, Iterator
from dataclasses import replace
from enum import IntEnum
from hashlib import sha256
from itertools import chain
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar
from zipfile import BadZipFile

import numpy as np
import shapely
from numpy.typing import NDArray

from flcav.arrays import Array, Bytes, Ints32
from flcav.geometry import left_vectors
from flcav.statistics.streams import stream
from flcav.storage.files import atomic_path
from flcav.world.map.relief import Relief
from flcav.world.map.signals import Signals
from flcav.world.map.town import KERB_M, Town
from flcav.world.materials import Material
from flcav.world.meshes.furniture import (
    make_clutter,
    make_lamp,
    make_tree,
    map_pole,
    sensor_mast,
    sign_plate,
    sign_post,
    signal_head,
    signal_mast,
)
from flcav.world.meshes.mesh import Mesh, box, drape_area, drape_polygon, drape_wall, join_meshes, sheet, transform_mesh

GROUND_M = -0.03  # height of open ground, a little below the road
UNDER_M, ROUGH_M = 1.5, 1.0  # overlap of sloping ground below roads and sidewalks, and tolerance of its outline
DECK_M = (0.2, 1.0)  # least and greatest thickness of a bridge's deck
ROOM_M = 4.0  # clearance below a deck for which it is made thinner
LAND_M = 150.0  # width of open ground beyond the town's bounds
TOWNS_KEPT = 4  # number of cached meshes
_FIELDS = ("vertices", "faces", "material", "part", "row")  # of a static world in a file, and their forms
_FORMS = [("float32", (3,)), ("int32", (3,)), ("uint8", ()), ("uint8", ()), ("int32", ())]


Made = TypeVar("Made")


class TownPart(IntEnum):
    """The kind of object that a face of the town belongs to."""

    GROUND = 0
    ROAD = 1
    SIDEWALK = 2
    BUILDING = 3
    TREE = 4
    CLUTTER = 5
    LAMP = 6
    POST = 7  # of a sign or a signal
    MAST = 8  # of a roadside sensor
    SIGN = 9
    SIGNAL = 10
    POLE = 11  # of an imported map
    DECK = 12  # of a bridge


class StaticWorld(NamedTuple):
    """The static mesh of a town, and the objects that its F faces belong to."""

    mesh: Mesh  # world frame
    part: Bytes  # (F,) a `TownPart`
    row: Ints32  # (F,) the object's row in its field of `Town`; clutter is numbered over all kinds


class SignsAndSignals(NamedTuple):
    """The K traffic signs and signal heads of a town: first the signs, then the heads, in the town's order."""

    kind: tuple[str, ...]  # (K,) stop | yield | speed_30 | speed_60 | speed_90 | signal | walker_signal
    position: Array  # (K, 3) centre of the plate or head, world frame [m]
    yaw: Array  # (K,) direction it faces, world frame [rad]
    link: tuple[str, ...]  # (K,) the entry of `Trace.light` that a head shows; empty for signs
    face: Ints32  # (F,) row of the sign or head that a face of the town's mesh belongs to; -1: none

    def __len__(self) -> int:
        return len(self.kind)


def build_town_mesh(town: Town) -> Mesh:
    """Return the static mesh of a town, world frame. The same town gives the same mesh."""
    return build_static_world(town).mesh


def build_buildings_mesh(town: Town) -> Mesh:
    """Return the mesh of a town's buildings, world frame. Raises `ValueError` where there are none."""
    return join_meshes([mesh for _, _, mesh in _buildings(town)])


def list_signs_and_signals(town: Town) -> SignsAndSignals:
    """Return the signs and signal heads of a town, without posts and masts, and their faces in `build_town_mesh`."""
    world, signs, signals = build_static_world(town), town.signs, town.signals
    face = np.full(len(world.part), -1, np.int32)
    for part, first in ((TownPart.SIGN, 0), (TownPart.SIGNAL, len(signs.kind))):
        face[world.part == part] = first + world.row[world.part == part]
    return SignsAndSignals(
        kind=(*signs.kind, *_head_kinds(signals)),
        position=np.concatenate((signs.position, signals.position)),
        yaw=np.concatenate((signs.yaw, signals.yaw)),
        link=(*("" for _ in signs.kind), *signals.link),
        face=face,
    )


def _head_kinds(signals: Signals) -> list[str]:
    """Return the kinds of the signal heads, as in `SignsAndSignals`."""
    return ["signal"] * (len(signals.link) - signals.walkers) + ["walker_signal"] * signals.walkers


class TownCache(Generic[Made]):
    """A cache of values made from the last `TOWNS_KEPT` towns, by a hash of their content."""

    def __init__(self) -> None:
        self._kept: dict[str, Made] = {}

    def get(self, town: Town, make: Callable[[], Made]) -> Made:
        """Return the cached value of an equal town, or else make and cache it."""
        key = sha256(pickle.dumps(town)).hexdigest()
        if key not in self._kept:
            while len(self._kept) >= TOWNS_KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = make()
        return self._kept[key]


_WORLDS = TownCache[StaticWorld]()


def build_static_world(town: Town) -> StaticWorld:
    """Return the static mesh of a town with the objects of its faces; the last `TOWNS_KEPT` are cached."""
    return _WORLDS.get(town, lambda: _build_world(town))


def _build_world(town: Town) -> StaticWorld:
    owned = list(_parts(town))
    faces = [len(mesh.faces) for _, _, mesh in owned]
    return StaticWorld(
        join_meshes([mesh for _, _, mesh in owned]),
        np.repeat([part for part, _, _ in owned], faces).astype(np.uint8),
        np.repeat([row for _, row, _ in owned], faces).astype(np.int32),
    )


def save_static_world(town: Town, path: Path) -> None:
    """Write the static world of a town as the NumPy archive `path`, atomically."""
    world = build_static_world(town)
    with atomic_path(path) as scratch, scratch.open("wb") as file:
        fields = {"vertices": world.mesh.vertices, "faces": world.mesh.faces, "material": world.mesh.material}
        np.savez(file, **fields, part=world.part, row=world.row)


def recall_static_world(town: Town, path: Path) -> None:
    """Read what `save_static_world` wrote of the same town into the cache of `build_static_world`.

    Raises `OSError` or `ValueError`, and leaves the cache as it is, where the file is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            vertices, faces, material, part, row = (file[name] for name in _FIELDS)
    except (EOFError, KeyError, BadZipFile) as error:
        raise ValueError(f"{path}: no static world of a town ({error})") from None
    forms = [(array.dtype.name, array.shape[1:]) for array in (vertices, faces, material, part, row)]
    if forms != _FORMS or not len(faces) or {len(material), len(part), len(row)} != {len(faces)}:
        raise ValueError(f"{path}: its arrays are not those of a static world")
    if (
        faces.min() < 0
        or faces.max() >= len(vertices)
        or material.max() >= len(Material)
        or part.max() >= len(TownPart)
    ):
        raise ValueError(f"{path}: a face names a corner, a material or a part that is not there")
    _WORLDS.get(town, lambda: StaticWorld(Mesh(vertices, faces, material), part, row))


Owned = tuple[TownPart, int, Mesh]  # kind of object, row, mesh in the world frame


def _parts(town: Town) -> Iterator[Owned]:
    """Yield the meshes of all static objects of a town."""
    yield TownPart.GROUND, 0, _ground(town)
    yield from _decks(town)
    yield from chain(_roads(town), _sidewalks(town), _buildings(town), _plants(town), _furniture(town))


def _ground(town: Town) -> Mesh:
    """Return the land around the roads; on a relief it is cut out below them, where rays would test it in vain."""
    if town.relief is not None:
        paved = shapely.union_all([shapely.Polygon(ring) for ring in (*town.roads, *town.sidewalks)])
        hidden = shapely.simplify(shapely.buffer(paved, -UNDER_M), ROUGH_M)
        return drape_area(shapely.difference(town.relief.area, hidden), town.relief, GROUND_M, Material.GROUND)
    x0, y0, x1, y1 = town.bounds
    x = np.linspace(x0 - LAND_M, x1 + LAND_M, 16)
    y = np.linspace(y0 - LAND_M, y1 + LAND_M, 16)
    points = np.stack(np.broadcast_arrays(x[:, None], y[None], GROUND_M), axis=-1)
    return sheet(points, Material.GROUND)


def _roads(town: Town) -> Iterator[Owned]:
    return (
        (TownPart.ROAD, row, _plate(polygon, 0.0, Material.ROAD, town.relief)) for row, polygon in enumerate(town.roads)
    )


def _decks(town: Town) -> Iterator[Owned]:
    """Yield the decks of bridges: road, underside and two sides of each."""
    for row, deck in enumerate(() if town.relief is None else town.relief.decks):
        yield TownPart.DECK, row, drape_area(deck.outline, deck.surface, 0.0, Material.ROAD)
        under = drape_area(deck.outline, deck.surface, 0.0, Material.WALL)
        yield TownPart.DECK, row, replace(under, vertices=_lower(under.vertices, town))
        for side in deck.sides:
            yield TownPart.DECK, row, sheet(np.stack((_lower(side, town), side)), Material.WALL)


def _lower(top: NDArray, town: Town) -> NDArray:
    """Return the points (N, 3) [m] of a deck's underside below those of its surface, world frame."""
    thickness = np.clip(top[:, 2] - town.grounds(*top[:, :2].T) - ROOM_M, *DECK_M)
    return np.column_stack((top[:, :2], top[:, 2] - thickness)).astype(top.dtype)


def _sidewalks(town: Town) -> Iterator[Owned]:
    """Yield the sidewalks: surface and kerb face of each."""
    for row, polygon in enumerate(town.sidewalks):
        yield TownPart.SIDEWALK, row, _plate(polygon, KERB_M, Material.SIDEWALK, town.relief)
        ring = np.concatenate((polygon, polygon[:1]))
        heights = (GROUND_M, KERB_M)
        if town.relief is not None:
            yield TownPart.SIDEWALK, row, drape_wall(ring, town.relief, heights, Material.SIDEWALK)
            continue
        kerb = sheet(np.stack([np.c_[ring, np.full(len(ring), z)] for z in heights]), Material.SIDEWALK)
        yield TownPart.SIDEWALK, row, kerb


def _plate(polygon: Array, z: float, material: Material, relief: Relief | None) -> Mesh:
    """Return a polygon (K, 2) [m] as a surface `z` [m] above the ground, by constrained Delaunay triangulation."""
    if relief is not None:
        return drape_polygon(polygon, relief, z, material)
    triangles = shapely.constrained_delaunay_triangles(shapely.Polygon(polygon))
    corners = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3].reshape(-1, 2)
    vertices = np.c_[corners, np.full(len(corners), z)].astype(np.float32)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Mesh(vertices, faces, np.full(len(faces), material, np.uint8))


def _buildings(town: Town) -> Iterator[Owned]:
    rng = stream(0, "facades", town.name)
    foot = find_lowest_ground(town, town.buildings)
    for row, (x, y, yaw, length, width, height) in enumerate(town.buildings):
        yield TownPart.BUILDING, row, transform_mesh(make_building(length, width, height, rng), x, y, foot[row], yaw)


def find_lowest_ground(town: Town, rows: Array) -> Array:
    """Return the lowest ground (N,) [m] under footprints (N, >=5): x, y [m], yaw [rad], length, width [m]."""
    x, y, yaw, length, width = rows[:, :5].T
    cos, sin = np.cos(yaw), np.sin(yaw)
    corners = [(a * length / 2, b * width / 2) for a in (-1, 1) for b in (-1, 1)]
    return np.min([town.grounds(x + a * cos - b * sin, y + a * sin + b * cos) for a, b in corners], axis=0)


def _plants(town: Town) -> Iterator[Owned]:
    rng = stream(0, "leaves", town.name)
    for row, (x, y, height, radius) in enumerate(town.trees):
        yield TownPart.TREE, row, transform_mesh(make_tree(height, radius, rng), x, y, town.ground(x, y))


def _furniture(town: Town) -> Iterator[Owned]:
    """Yield clutter, lamps, signs with their posts, sensor masts and signals."""
    pieces = [(kind, *values) for kind, rows in town.clutter for values in rows]
    for row, (kind, x, y, yaw, length, width, height) in enumerate(pieces):
        yield (
            TownPart.CLUTTER,
            row,
            transform_mesh(make_clutter(kind, length, width, height), x, y, town.ground(x, y), yaw),
        )
    for row, (x, y, height) in enumerate(town.posts):
        yield TownPart.POLE, row, transform_mesh(map_pole(height), x, y, town.ground(x, y))
    for row, (x, y, height) in enumerate(town.lamps):
        yield TownPart.LAMP, row, transform_mesh(make_lamp(height), x, y, town.ground(x, y))
    for row, ((x, y, z), yaw, kind) in enumerate(zip(town.signs.position, town.signs.yaw, town.signs.kind)):
        foot = town.ground(x, y)
        yield TownPart.SIGN, row, transform_mesh(sign_plate(kind, z - foot), x, y, foot, yaw)
        yield TownPart.POST, row, transform_mesh(sign_post(z - foot), x, y, foot, yaw)
    for row, ((x, y, z), yaw) in enumerate(zip(town.poles.position, town.poles.yaw)):
        foot = town.ground(x, y)
        yield TownPart.MAST, row, transform_mesh(sensor_mast(z - foot), x, y, foot, yaw)
    yield from _signals(town)


def _signals(town: Town) -> Iterator[Owned]:
    """Yield the signal heads with their masts."""
    signals = town.signals
    heads = zip(signals.position, signals.yaw, signals.foot, _head_kinds(signals))
    for row, ((x, y, z), yaw, foot, kind) in enumerate(heads):
        left = left_vectors(yaw)
        reach = float(left @ ((x, y) - foot))
        ground = town.ground(*foot)
        yield TownPart.SIGNAL, row, transform_mesh(signal_head(kind, z - ground), x, y, ground, yaw)
        yield TownPart.POST, row, transform_mesh(signal_mast(z - ground, reach), foot[0], foot[1], ground, yaw)


STOREY_M = 3.0  # height of a storey
BAY_M = 4.5  # width of a bay of the facade
GABLED_BELOW_M = 9.0  # buildings lower than this have a gabled roof


def make_building(length: float, width: float, height: float, rng: np.random.Generator) -> Mesh:
    """Return the mesh of a building of these dimensions [m], body frame, `length` along x; `rng` draws its facades."""
    walls = height * 0.68 if height < GABLED_BELOW_M else height - 0.5
    parts = [box((0, 0, walls / 2), (length, width, walls), Material.WALL)]
    parts.append(_gable(length, width, walls, height) if height < GABLED_BELOW_M else _parapet(length, width, walls))
    for turned, (along, depth) in enumerate(((length, width), (width, length))):
        for side in (-1, 1):
            front = _facade(along, depth, walls, rng)
            if front is not None:
                parts.append(transform_mesh(front, 0, 0, 0, np.pi / 2 * turned + (np.pi if side < 0 else 0)))
    return join_meshes(parts)


def _facade(along: float, depth: float, walls: float, rng: np.random.Generator) -> Mesh | None:
    """Return the balconies, sills and porches of the side at y = `depth` / 2 [m], or None if it has no bay."""
    bays = int(along // BAY_M)
    storeys = int(walls // STOREY_M)
    parts = []
    balconies = rng.random() < 0.6
    for bay in range(bays):
        x = (bay - (bays - 1) / 2) * along / bays
        for storey in range(storeys):
            z = storey * STOREY_M
            if storey == 0:
                reach, size = (0.35, (1.6, 0.7, 0.12)) if rng.random() < 0.25 else (0.05, (1.4, 0.1, 0.12))
                parts.append(box((x, depth / 2 + reach, z + 2.4), size, Material.ROOF))
            elif balconies and rng.random() < 0.8:
                parts.append(box((x, depth / 2 + 0.5, z), (2.4, 1.0, 0.15), Material.ROOF))
                parts.append(box((x, depth / 2 + 0.97, z + 0.5), (2.4, 0.06, 0.9), Material.METAL))
            else:
                parts.append(box((x, depth / 2 + 0.06, z + 0.9), (1.5, 0.12, 0.12), Material.ROOF))
    return join_meshes(parts) if parts else None


def _parapet(length: float, width: float, walls: float) -> Mesh:
    return box((0, 0, walls + 0.25), (length + 0.4, width + 0.4, 0.5), Material.ROOF)


def _gable(length: float, width: float, walls: float, height: float) -> Mesh:
    """Return a gabled roof with its ridge along the longer side, from the height `walls` to `height` [m]."""
    turned = width > length
    along, across = (width, length) if turned else (length, width)
    x = np.array((-1.0, 1.0)) * (along / 2 + 0.3)
    slopes = [[(end, y * (across / 2 + 0.3), z) for y, z in ((-1, walls), (0, height), (1, walls))] for end in x]
    ends = [[(end, y * across / 2, z) for y, z in ((-1, walls), (0, height - 0.1), (1, walls))] for end in x * 0.97]
    walled = [Mesh(np.array(end, np.float32), np.array([[0, 1, 2]], np.int32), _one(Material.WALL)) for end in ends]
    return transform_mesh(join_meshes((sheet(slopes, Material.ROOF), *walled)), 0, 0, 0, np.pi / 2 if turned else 0.0)


def _one(material: Material) -> np.ndarray:
    """Return the material of a mesh of one face."""
    return np.array([material], np.uint8)
