"""Towns: static content from a SUMO net (roads) and a parameter file (buildings, furniture, candidate sites)."""

import hashlib
import os
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from flcav.config import InputError, read_config, shorten
from flcav.seeds import stream
from flcav.world.map import street_furniture
from flcav.world.map.parameters import GeoReference, TownParameters
from flcav.world.map.roads import RoadNet, read_net
from flcav.world.map.signals import Signals, place_signals
from flcav.world.map.surfaces import build_ground_surfaces, find_kerbs, split_into_polygons

Array = NDArray[np.float64]

TOWNS: tuple[str, ...] = ("suburb", "grid", "ring", "arterial")
KERB_M = 0.12  # height of a sidewalk above the road
MARGIN_M = 5.0  # from the outermost surface or building to the bounds


@dataclass(frozen=True)
class Poles:
    """The P candidate sites of a roadside sensor."""

    id: NDArray[np.int64]  # (P,) site numbers, from 1
    position: Array  # (P, 3) mount of the sensor, world [m]; z is its height above ground
    yaw: Array  # (P,) direction the mount faces: the road or the junction, world [rad]
    kind: tuple[str, ...]  # (P,) straight | cross | tee | roundabout


@dataclass(frozen=True)
class Signs:
    """The S traffic signs of a town."""

    position: Array  # (S, 3) plate centre, world [m]
    yaw: Array  # (S,) direction of the plate's front normal, world [rad]
    kind: tuple[str, ...]  # (S,) stop | yield | speed_30 | speed_60 | speed_90


@dataclass(frozen=True)
class Town:
    """The static content of a town. World frame: ENU, metres, z = 0 at the road surface.

    >>> from flcav import Town, load_town
    >>> town: Town = load_town("suburb")
    >>> town.poles.position.shape  # candidate sites of roadside sensors: x, y, z [m]
    (4, 3)
    """

    name: str
    net: Path  # the SUMO net file (.net.xml)
    parameters: TownParameters  # of its furnishing and of its traffic
    bounds: tuple[float, float, float, float]  # x_min, y_min, x_max, y_max [m]
    roads: tuple[Array, ...]  # disjoint polygons (K, 2) of drivable surface, without holes
    sidewalks: tuple[Array, ...]  # disjoint polygons (K, 2), raised by the kerb; traffic islands too
    kerbs: tuple[Array, ...]  # polylines (K, 2) where road meets sidewalk
    buildings: Array  # (B, 6) centre x, y, yaw, length, width, height [m, rad]
    trees: Array  # (T, 4) x, y, height, crown radius [m]
    clutter: tuple[tuple[str, Array], ...]  # (kind of `parameters.CLUTTER`, (K, 6) x, y, yaw, length, width, height)
    poles: Poles
    signs: Signs
    lamps: Array  # (L, 3) street lamps: x, y of the foot, height [m]
    geo: GeoReference = field(default_factory=GeoReference)  # geodetic position of the world frame's origin
    signals: Signals = field(default_factory=Signals.none)


def load_town(name: str | Path, beside: Path | None = None) -> Town:
    """Return a town of `TOWNS`, or the town of a folder that holds `town.net.xml` and `town.yaml`.

    A `Path` is that folder; any other name is a folder in `beside`, where given, or else in the working directory. The
    same files give the same town. Raises `InputError` for an unknown name, and for files that are missing, not of their
    format or not consistent with each other.

    >>> from flcav import load_town
    >>> load_town("grid").poles.id
    array([1, 2, 3, 4, 5, 6, 7, 8, 9])
    >>> load_town("atlantis")
    Traceback (most recent call last):
    flcav.config.InputError: unknown town 'atlantis'; known towns: ...
    """
    folder = name if isinstance(name, Path) else _folder(name, beside)
    return _build_town(folder.absolute(), _hash_files(folder))


def _hash_files(folder: Path) -> str:
    """Return a hash of the names and bytes of the files in a folder."""
    files = sorted(path for path in folder.glob("*") if path.is_file())
    return hashlib.sha256(b"".join(path.name.encode() + path.read_bytes() for path in files)).hexdigest()


@lru_cache(maxsize=16)
def _build_town(folder: Path, files: str) -> Town:
    """Return the town of a folder whose `files` have that hash; the last ones are kept in memory."""
    parameters = read_config(TownParameters, folder / "town.yaml")
    net = read_net(folder / "town.net.xml")
    _check(net, parameters, folder / "town.yaml")
    return _furnish(folder.name, folder / "town.net.xml", net, parameters)


def _folder(name: str, beside: Path | None) -> Path:
    if name in TOWNS:
        return Path(__file__).parents[1] / "towns" / name
    sought = [place / name for place in (beside, Path.cwd()) if place is not None]
    for folder in sought:
        if os.path.isdir(folder):  # noqa: PTH112 - accepts names that no path may have
            return folder
    places = " nor ".join(map(str, dict.fromkeys(folder.absolute() for folder in sought)))
    raise InputError(
        f"unknown town {shorten(name)}; known towns: {', '.join(TOWNS)}, or a folder, and there is no {places}"
    )


def _check(net: RoadNet, parameters: TownParameters, origin: Path) -> None:
    """Raise `InputError` where the parameters lack a street type, or a pole is on an edge without a sidewalk."""
    if missing := sorted({edge.type for edge in net.streets} - set(parameters.streets)):
        raise InputError(f"{origin}: field 'streets' lacks the street type '{missing[0]}' of the net")
    walked = {edge.id for edge in net.streets if edge.lanes_of("sidewalk")}
    for pole in parameters.poles:
        if pole.edge not in walked:
            raise InputError(f"{origin}: pole {pole.id} stands on '{pole.edge}', which is no edge with a sidewalk")


def _furnish(name: str, path: Path, net: RoadNet, parameters: TownParameters) -> Town:
    """Return the town of a net: ground first, then buildings, clutter, trees, poles, signs, lamps and signals."""
    ground = build_ground_surfaces(net, {kind: street.frontage_m for kind, street in parameters.streets.items()})
    rows = list(street_furniture.list_verges(net, parameters))
    paved = ground.roads.union(ground.sidewalks)
    land = street_furniture.Plot(paved)
    buildings = street_furniture.place_buildings(rows, land, stream(parameters.seed, "buildings"))
    walked = shapely.union_all([verge.line.buffer(verge.half_width, cap_style="flat") for verge in rows])
    facades = [
        street_furniture.make_footprint(x, y, yaw, length, width).buffer(0.1)
        for x, y, yaw, length, width, _ in buildings
    ]
    open_land = street_furniture.Plot(shapely.union_all([ground.roads, walked, *facades]))
    clutter = street_furniture.place_clutter(rows, open_land, stream(parameters.seed, "clutter"))
    trees = street_furniture.place_trees(rows, ground, open_land, stream(parameters.seed, "trees"))
    poles = street_furniture.place_poles(net, parameters.poles)
    mounts = np.array([row[1] for row in poles], dtype=np.float64).reshape(-1, 3)
    signs = street_furniture.place_signs(net)
    low_x, low_y, high_x, high_y = shapely.union_all([paved, *facades]).bounds
    return Town(
        name=name,
        net=path,
        parameters=parameters,
        geo=parameters.geo,
        bounds=(low_x - MARGIN_M, low_y - MARGIN_M, high_x + MARGIN_M, high_y + MARGIN_M),
        roads=split_into_polygons(ground.roads),
        sidewalks=split_into_polygons(ground.sidewalks),
        kerbs=find_kerbs(ground),
        buildings=buildings,
        trees=trees,
        clutter=clutter,
        poles=Poles(
            id=np.array([row[0] for row in poles], dtype=np.int64),
            position=mounts,
            yaw=np.array([row[2] for row in poles], dtype=np.float64),
            kind=tuple(row[3] for row in poles),
        ),
        signs=Signs(
            position=np.array([row[0] for row in signs], dtype=np.float64).reshape(-1, 3),
            yaw=np.array([row[1] for row in signs], dtype=np.float64),
            kind=tuple(row[2] for row in signs),
        ),
        lamps=street_furniture.place_lamps(rows, mounts, stream(parameters.seed, "lamps")),
        signals=place_signals(net, mounts),
    )
