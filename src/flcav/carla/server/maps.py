"""Served maps: towns with their OpenDRIVE text, spawn points of vehicles, and navigation meshes of walkers.

A navigation mesh is written in the file format of Recast's Detour library, as a single tile.
"""

import os
import shutil
import struct
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from hashlib import sha256
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from flcav import world
from flcav.carla.frames import MapFrame, to_rotation, to_vector
from flcav.carla.server.blueprints import list_blueprints
from flcav.carla.server.wire import Transform
from flcav.config import InputError, shorten
from flcav.interface.wording import suggest
from flcav.world.dynamics.contacts import Footprints, find_overlaps
from flcav.world.dynamics.obstacles import CLEARANCE_M
from flcav.world.map.roads import Lane, RoadNet, read_net
from flcav.world.map.town import KERB_M, NAME, PACKAGED, Town, load_town
from flcav.world.opendrive.exporting import export_town
from flcav.world.opendrive.importing import import_town
from flcav.world.static import recall_static_world, save_static_world

SPAWN_EVERY_M, SPAWN_FROM_END_M = 20.0, 7.0  # distance of spawn points of a lane, and to its ends
ABOVE_M = 0.3  # height of spawn points above the road
SPAWN_LEAST_M = 11.0  # least distance of spawn points of a lane, for the longest bus
SPAWN_POINTS = {  # number in CARLA's maps; their places are only in its engine's files
    "Town01": 255,
    "Town02": 101,
    "Town03": 265,
    "Town04": 372,
    "Town05": 302,
    "Town06": 436,
    "Town07": 116,
    "Town10HD": 155,
}
OPENDRIVE_MAP = "OpenDriveMap"  # CARLA's name of a map that a client sent
OPTIMISED = "_Opt"  # ending of CARLA's names of layered maps


@dataclass(frozen=True)
class ServedMap:
    """A town as a map of CARLA's protocol."""

    name: str
    town: Town
    opendrive: str  # text of the map
    frame: MapFrame
    lacking: Path | None = None  # cache file of the town's mesh, if it is not written yet

    def keep(self) -> None:
        """Write the town's mesh to the cache, if it is missing there."""
        if self.lacking is not None:
            with suppress(OSError):
                save_static_world(self.town, self.lacking)

    @cached_property
    def net(self) -> RoadNet:
        """The town's road network."""
        return read_net(self.town.net)

    def list_spawn_points(self, standing: Footprints) -> list[Transform]:
        """Return poses on driving lanes with room for every vehicle between obstacles and vehicles at other poses.

        CARLA's maps have as many as in CARLA. Transforms are in CARLA's frame; `standing` are the obstacles.
        """
        wanted = SPAWN_POINTS.get(self.name.removesuffix(OPTIMISED))
        if wanted is None:
            return self._pick_free(SPAWN_EVERY_M, standing)
        points: list[Transform] = []
        for every in np.arange(SPAWN_EVERY_M, SPAWN_LEAST_M, -0.5):
            if len(points := self._pick_free(every, standing)) >= wanted:
                return [points[row] for row in np.linspace(0, len(points) - 1, wanted).round().astype(int)]
        return points

    def _pick_free(self, every_m: float, standing: Footprints) -> list[Transform]:
        """Return the poses, `every_m` apart, where the largest vehicle is free of obstacles and of earlier poses."""
        places = list(self._places(every_m))
        poses = np.array([self.frame.from_transform(*place) for place in places]).reshape(-1, 4, 4)
        length, width, height = (
            max(sides)
            for sides in zip(
                *(blueprint.size for blueprint in list_blueprints().values() if blueprint.kind == "vehicle")
            )
        )
        bottom = poses[:, 2, 3] - ABOVE_M + CLEARANCE_M
        boxes = Footprints(
            np.column_stack((poses[:, :2, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))),
            np.tile((length / 2, width / 2), (len(places), 1)),
            np.column_stack((bottom, bottom + height)),
        )
        free = np.ones(len(places), np.bool_)
        free[find_overlaps(boxes, standing)[:, 0]] = False
        for one, other in find_overlaps(boxes, boxes).tolist():
            free[other] &= one >= other or not free[one]
        return [place for place, fits in zip(places, free) if fits]

    def _places(self, every_m: float) -> Iterator[Transform]:
        for lane in _driving_lanes(self.net):
            line = LineString(lane.shape)
            room = line.length - 2 * SPAWN_FROM_END_M
            for number in range(int(room // every_m) + 1 if room >= 0 else 0):
                at = SPAWN_FROM_END_M + number * every_m
                (x, y), (u, v) = (np.array(line.interpolate(at + ahead).coords[0]) for ahead in (0.0, 0.5))
                here, there = self.town.ground(x, y), self.town.ground(u, v)
                angles = np.array((np.arctan2(v - y, u - x), np.arctan2(here - there, np.hypot(u - x, v - y)), 0.0))
                location = self.frame.to_location(np.array((x, y, here + ABOVE_M)))
                yield Transform(to_vector(location), to_vector(to_rotation(angles)))

    @cached_property
    def mesh(self) -> bytes:
        """The navigation mesh of walkers, as a file; empty without footpaths."""
        return build_navigation_mesh(self.net, self.town, self.frame)


def _find_cache() -> Path:
    """Return the cache folder of imported maps."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "flcav" / "maps"


def _hash_import(path: Path) -> str:
    """Return a cache name for the town of a map: a hash of the map, its name and the code that imports it."""
    code = b"".join(module.read_bytes() for module in sorted(Path(world.__file__).parent.rglob("*.py")))
    return f"map-{sha256(sha256(code).digest() + path.name.encode() + path.read_bytes()).hexdigest()[:24]}"


def _driving_lanes(net: RoadNet) -> Iterator[Lane]:
    return (lane for edge in net.streets for lane in edge.lanes_of("driving"))


class Maps:
    """Maps by name: towns of flcav, folders of towns, and OpenDRIVE files, which are imported on first use."""

    def __init__(self, files: Path | None = None) -> None:
        """Add the maps of all .xodr files in the folder `files`. Raises `InputError` where it has none."""
        self._files: dict[str, Path] = {}
        self._loaded: dict[str, ServedMap] = {}
        if files is not None:
            if not files.is_dir():
                raise InputError(f"{files}: is no folder; --maps takes one with .xodr files")
            self._files = {path.stem: path for path in sorted(files.glob("*.xodr")) if NAME.fullmatch(path.stem)}
            if not self._files:
                raise InputError(f"{files}: has no map (.xodr)")
        self._scratch = tempfile.TemporaryDirectory(prefix="flcav-carla-")
        self._sent = 0

    def discard_files(self) -> None:
        """Remove the temporary files of these maps."""
        self._scratch.cleanup()

    def names(self) -> list[str]:
        """Return the names of the maps that can be loaded."""
        return [*self._files, *(name for name in PACKAGED if name not in self._files)]

    def load(self, name: str) -> ServedMap:
        """Return the map with a name, or of the folder of a town. Raises `InputError` for an unknown one.

        CARLA's name of a layered map, such as Town10HD_Opt, gives the map without layers.
        """
        if name not in self._loaded:
            self._loaded[name] = self._read(name)
        return self._loaded[name]

    def _read(self, name: str) -> ServedMap:
        for known in (name, name.removesuffix(OPTIMISED)):
            if known in self._files:
                return self._import(name, self._files[known], _find_cache() / _hash_import(self._files[known]))
        if name not in PACKAGED and not Path(name).is_dir():
            known = self.names()
            raise InputError(f"no map {shorten(name)}; maps here: {', '.join(known)}{suggest(name, known)}")
        town = load_town(name)
        return ServedMap(town.name, town, export_town(town), MapFrame())

    def receive(self, text: str) -> None:
        """Import an OpenDRIVE text as `OPENDRIVE_MAP`. Raises `InputError` where it cannot be driven."""
        self._sent += 1
        path = Path(self._scratch.name) / f"sent-{self._sent}.xodr"
        path.write_text(text, encoding="utf-8", errors="surrogateescape")
        self._loaded[OPENDRIVE_MAP] = replace(self._import(OPENDRIVE_MAP, path, self._find_scratch()), lacking=None)

    def _import(self, name: str, path: Path, cache: Path) -> ServedMap:
        """Return the map of a file; its town is read from the folder `cache`, or imported and written there.

        The town has the map's name, since the name seeds its random houses.
        """
        town, folder, mesh = None, cache / path.stem, cache / "mesh.npz"
        with suppress(OSError, InputError):  # no such folder yet, or one that is damaged
            town = load_town(folder) if folder.is_dir() else None
        if town is None:
            made = self._find_scratch() / path.stem
            town = import_town(path, made).town
            with suppress(OSError):  # no place for a cache, or another server was faster
                cache.mkdir(parents=True, exist_ok=True)
                with tempfile.TemporaryDirectory(dir=cache) as staging:
                    shutil.copytree(made, Path(staging) / path.stem).rename(folder)
        lacking = mesh if folder.exists() else None
        with suppress(OSError, ValueError):  # not there yet, or damaged
            recall_static_world(town, mesh)
            lacking = None
        source = town.parameters.source
        offset = (0.0, 0.0) if source is None else source.offset_m
        text = path.read_text(encoding="utf-8", errors="surrogateescape")
        return ServedMap(name, town, text, MapFrame(offset), lacking)

    def _find_scratch(self) -> Path:
        """Return a new temporary folder, which is kept as long as this server runs."""
        return Path(tempfile.mkdtemp(dir=self._scratch.name))


GRID_M = 0.01  # precision grid of corners
JOINED_M = 0.15  # paths within twice this distance are joined
SMOOTHED_M = 0.08  # tolerance of simplified outlines
SMALLEST_M2 = 0.5  # smallest face that is kept
MOST_CORNERS = 0xFFFE  # largest number of corners that the format can index
SET = struct.Struct("<3i3f2f2iIi")  # "MSET", version, tiles; origin, size and capacities of the mesh; reference, bytes
TILE = struct.Struct("<5iI9i10f")  # "DNAV", version, place; user; counts; walkers; bounds; factor of a tree
POLYGON = np.dtype(
    [
        ("link", "<u4"),
        ("corners", "<u2", 6),
        ("neighbours", "<u2", 6),
        ("flags", "<u2"),
        ("count", "u1"),
        ("area", "u1"),
    ]
)
DETAIL = np.dtype([("corner", "<u4"), ("first", "<u4"), ("corners", "u1"), ("triangles", "u1"), ("", "<u2")])
LINK_BYTES = 12
OUTLINE = 0b010101  # all edges of a triangle are edges of its polygon
WALKER_M = (2.0, 0.3, 0.4)  # height, radius and climb


class Area(IntEnum):
    """Kinds of ground for walkers; the flag of a kind is 1 << kind."""

    SIDEWALK = 1
    CROSSING = 2


def build_navigation_mesh(net: RoadNet, town: Town, frame: MapFrame) -> bytes:
    """Return a town's navigation mesh as a file; empty without footpaths, and beyond `MOST_CORNERS`."""
    corners, triangles, areas = triangulate(*list_footpaths(net))
    if not len(triangles) or len(corners) > MOST_CORNERS:
        return b""
    height = town.grounds(*corners.T) + KERB_M
    points = frame.to_location(np.column_stack((corners, height)))
    return pack_mesh(points, triangles, areas)


def list_footpaths(net: RoadNet) -> tuple[BaseGeometry, BaseGeometry]:
    """Return the areas of footpaths, and of crossings between them, x, y [m], world frame."""
    paths, crossings = list[BaseGeometry](), list[BaseGeometry]()
    for lane in (lane for edge in net.edges.values() for lane in edge.lanes):
        if lane.kind == "walkingarea" and len(lane.shape) > 2:
            paths.append(Polygon(lane.shape).buffer(0))
        elif lane.kind == "sidewalk":
            paths.append(LineString(lane.shape).buffer(lane.width / 2, cap_style="flat"))
        elif lane.kind == "crossing":
            crossings.append(LineString(lane.shape).buffer(lane.width / 2, cap_style="square"))
    walked = shapely.union_all(paths).buffer(JOINED_M).buffer(-JOINED_M).simplify(SMOOTHED_M)
    walked = shapely.set_precision(walked, GRID_M)
    return walked, shapely.difference(shapely.union_all(crossings), walked, grid_size=GRID_M)


def triangulate(walked: BaseGeometry, crossed: BaseGeometry) -> tuple[NDArray, NDArray, NDArray]:
    """Return corners (V, 2) [m], counter-clockwise triangles (T, 3) that share whole edges, and their `Area` (T,)."""
    lines = shapely.union_all([walked.boundary, crossed.boundary], grid_size=GRID_M)
    faces = shapely.polygonize(shapely.get_parts(lines))
    rings, areas = list[NDArray](), list[int]()
    for face in shapely.get_parts(faces):
        inside = face.representative_point()
        area = Area.SIDEWALK if walked.contains(inside) else Area.CROSSING if crossed.contains(inside) else None
        if area is None or face.area < SMALLEST_M2:
            continue
        for part in shapely.get_parts(shapely.constrained_delaunay_triangles(face)):
            rings.append(shapely.get_coordinates(shapely.orient_polygons(part))[:3])
            areas.append(area)
    if not rings:
        return np.zeros((0, 2)), np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    corners, index = np.unique(np.concatenate(rings).round(3), axis=0, return_inverse=True)
    return corners, index.reshape(-1, 3), np.array(areas)


def find_neighbours(triangles: NDArray) -> NDArray:
    """Return (T, 3) 1 + the triangle beyond every edge, from a corner to the next; 0 for none."""
    start, end = triangles, np.roll(triangles, -1, axis=1)
    rows = {edge: row for row, edge in enumerate(zip(start.ravel().tolist(), end.ravel().tolist(), strict=True))}
    beyond = [rows.get((b, a), -3) // 3 + 1 for a, b in zip(start.ravel().tolist(), end.ravel().tolist(), strict=True)]
    return np.array(beyond).reshape(-1, 3)


def pack_mesh(points: NDArray, triangles: NDArray, areas: NDArray) -> bytes:
    """Return a navigation mesh as a file; `points` (V, 3) [m] and clockwise `triangles` (T, 3) are in CARLA's frame."""
    places = points[:, (0, 2, 1)].astype("<f4")
    low, high = places.min(axis=0), places.max(axis=0)
    count, bits = len(triangles), max(int(len(triangles) - 1).bit_length(), 1)
    polygons = np.zeros(count, POLYGON)
    polygons["corners"][:, :3] = triangles
    polygons["neighbours"][:, :3] = find_neighbours(triangles)
    polygons["flags"], polygons["count"], polygons["area"] = 1 << areas, 3, areas
    details = np.zeros(count, DETAIL)
    details["first"], details["triangles"] = np.arange(count), 1
    faces = np.tile(np.array((0, 1, 2, OUTLINE), np.uint8), (count, 1))
    links = 3 * count
    head = TILE.pack(
        *(int.from_bytes(b"DNAV", "big"), 7, 0, 0, 0, 0),
        *(count, len(places), links, count, 0, count, 0, 0, count),
        *(*WALKER_M, *low.tolist(), *high.tolist(), 1.0),
    )
    body = (places, polygons, np.zeros(links * LINK_BYTES, np.uint8), details, faces)
    tile = head + b"".join(part.tobytes() for part in body)
    size = (high - low)[[0, 2]].tolist()
    header = (int.from_bytes(b"MSET", "big"), 1, 1)
    return SET.pack(*header, *low.tolist(), *size, 1, 1 << bits, 1 << bits, len(tile)) + tile
