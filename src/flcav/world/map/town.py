"""Towns: static content from a SUMO net (roads) and a parameter file (buildings, furniture, candidate sites)."""

import hashlib
import os
import re
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from itertools import compress
from pathlib import Path
from typing import TypeVar

import numpy as np
import shapely

from flcav.arrays import Array, Ints, Mask
from flcav.config import InputError, read_config, read_file, shorten
from flcav.interface.notebook import Displayed
from flcav.interface.wording import suggest
from flcav.statistics.streams import stream
from flcav.world.map import street_furniture
from flcav.world.map.parameters import GeoReference, TownParameters
from flcav.world.map.relief import Relief
from flcav.world.map.roads import RoadNet, read_net
from flcav.world.map.signals import Signals, place_signals
from flcav.world.map.surfaces import build_ground_surfaces, find_kerbs, join_areas, split_into_polygons, unite

TOWNS: tuple[str, ...] = ("suburb", "grid", "ring", "arterial")
HILLY: dict[str, str] = {f"hilly_{name}": name for name in TOWNS}  # the same towns with slopes and camber
PACKAGED: tuple[str, ...] = (*TOWNS, *HILLY)  # all towns that come with flcav
HEIGHTS = "heights.parquet"  # file of a town's relief, in the folder of its net
HILLS = "hills.parquet"  # file of the relief of a town of `HILLY`, in the folder of the level town
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")  # of a town's name, with which the names of its frames begin
KERB_M = 0.12  # height of a sidewalk above the road
BESIDE_BRIDGE_M = 3.0  # least distance of poles, signs, signals, trees and furniture from a bridge
MARGIN_M = 5.0  # distance of the bounds from the outermost surface or building


@dataclass(frozen=True)
class Poles:
    """The P candidate sites of a roadside sensor."""

    id: Ints  # (P,) site numbers, from 1
    position: Array  # (P, 3) mount of the sensor, world frame [m]
    yaw: Array  # (P,) direction the mount faces, towards the road or the junction, world frame [rad]
    kind: tuple[str, ...]  # (P,) straight | cross | tee | roundabout


@dataclass(frozen=True)
class Signs:
    """The S traffic signs of a town."""

    position: Array  # (S, 3) plate centre, world frame [m]
    yaw: Array  # (S,) direction of the plate's front normal, world frame [rad]
    kind: tuple[str, ...]  # (S,) stop | yield | speed_30 | speed_60 | speed_90


Placed = TypeVar("Placed", Poles, Signs, Signals)


@dataclass(frozen=True)
class Town(Displayed):
    """The static content of a town. World frame: ENU [m], z = 0 at the surface of a level road.

    >>> from flcav import Town, load_town
    >>> town: Town = load_town("suburb")
    >>> town.poles.position.shape  # candidate sites of roadside sensors: x, y, z [m]
    (4, 3)
    """

    name: str
    net: Path  # the SUMO net file (.net.xml)
    parameters: TownParameters  # of its furnishing and its traffic
    bounds: tuple[float, float, float, float]  # x_min, y_min, x_max, y_max [m]
    roads: tuple[Array, ...]  # disjoint polygons (K, 2) of drivable surface, without holes [m]
    sidewalks: tuple[Array, ...]  # disjoint polygons (K, 2), raised by the kerb, with traffic islands [m]
    kerbs: tuple[Array, ...]  # polylines (K, 2) where road meets sidewalk [m]
    buildings: Array  # (B, 6) centre x, y, yaw, length, width, height [m, rad]
    trees: Array  # (T, 4) x, y, height, crown radius [m]
    clutter: tuple[tuple[str, Array], ...]  # kind of `CLUTTER`; (K, 6) x, y, yaw, length, width, height [m, rad]
    poles: Poles
    signs: Signs
    lamps: Array  # (L, 3) street lamps: x, y of the foot, height above it [m]
    geo: GeoReference = field(default_factory=GeoReference)  # geodetic position of the world frame's origin
    signals: Signals = field(default_factory=Signals.none)
    posts: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (K, 3) poles of a map: x, y of foot, height [m]
    relief: Relief | None = None  # heights of the ground; None: level, at z = 0

    def __repr__(self) -> str:
        return (
            f"Town({self.name!r}, {len(self.roads)} roads, {len(self.buildings)} buildings, {len(self.poles.id)} poles)"
        )

    def grounds(self, x: Array, y: Array) -> Array:
        """Return the height (...) [m] of the road or the adjacent land at `x`, `y` (...) [m], world frame."""
        return np.zeros(np.shape(x)) if self.relief is None else self.relief.heights(x, y)

    def ground(self, x: float, y: float) -> float:
        """Return the height [m] of the road or the adjacent land at the point `x`, `y` [m], world frame."""
        return 0.0 if self.relief is None else float(self.relief.heights(x, y))


def check_town_name(name: str) -> None:
    """Check the name of a town, after which scenes and frames are named. Raises `InputError` if it is invalid."""
    if not NAME.fullmatch(name):
        raise InputError(
            f"town {shorten(name)}: the folder's name must be letters, digits, - and _, 64 at most, the first a letter "
            "or digit"
        )


def load_town(name: str | Path, beside: Path | str | None = None) -> Town:
    """Load a town of `PACKAGED`, or that of a folder with `town.net.xml`, `town.yaml` and optionally heights.

    A `Path` is that folder; any other name is a folder in `beside`, if given, or else in the working directory. The
    same files give the same town. Raises `InputError` for an unknown name, and for files that are missing, malformed or
    inconsistent.

    >>> from flcav import load_town
    >>> load_town("grid").poles.id
    array([1, 2, 3, 4, 5, 6, 7, 8, 9])
    >>> load_town("atlantis")
    Traceback (most recent call last):
    flcav.config.InputError: unknown town 'atlantis'; known towns: ...
    """
    beside = None if beside is None else Path(beside)
    if isinstance(name, str) and name in HILLY:
        return _raise_hills(name, _folder(HILLY[name], beside))
    folder = name if isinstance(name, Path) else _folder(name, beside)
    return _build_town(folder.absolute(), _hash_files(folder))


def _hash_files(folder: Path) -> str:
    """Return a hash of the names and contents of the files in a folder."""
    files = sorted(path for path in folder.glob("*") if path.is_file())
    return hashlib.sha256(b"".join(path.name.encode() + read_file(path) for path in files)).hexdigest()


@lru_cache(maxsize=16)
def _build_town(folder: Path, files: str) -> Town:
    """Build the town of a folder whose `files` have this hash, the cache key."""
    parameters = read_config(TownParameters, folder / "town.yaml")
    net = read_net(folder / "town.net.xml")
    _check(net, parameters, folder / "town.yaml")
    heights = folder / HEIGHTS
    relief = Relief.load(heights) if heights.exists() else None
    town = furnish_town(folder.name, folder / "town.net.xml", net, parameters)
    return town if relief is None else lift_town(town, relief)


@lru_cache(maxsize=4)
def _raise_hills(name: str, folder: Path) -> Town:
    """Build the hilly town `name`: the level town of a folder of flcav with its slopes and camber."""
    level = load_town(folder)
    description = f"{level.parameters.description.rstrip('.')}; with slopes and camber."
    named = replace(level, name=name, parameters=level.parameters.model_copy(update={"description": description}))
    return lift_town(named, Relief.load(folder / HILLS))


def _folder(name: str, beside: Path | None) -> Path:
    if name in TOWNS:
        return Path(__file__).parents[1] / "towns" / name
    sought = [place / name for place in (beside, Path.cwd()) if place is not None]
    for folder in sought:
        if os.path.isdir(folder):  # noqa: PTH112 - accepts names that no path may have
            return folder
    places = " nor ".join(map(str, dict.fromkeys(folder.absolute() for folder in sought)))
    raise InputError(
        f"unknown town {shorten(name)}; known towns: {', '.join(PACKAGED)}, or a folder, and there is no {places}"
        + suggest(name, PACKAGED)
    )


def _check(net: RoadNet, parameters: TownParameters, origin: Path) -> None:
    """Check that the parameters fit the net: street types, poles, stop lines and signals. Raises `InputError`."""
    if missing := sorted({edge.type for edge in net.streets} - set(parameters.streets)):
        raise InputError(f"{origin}: field 'streets' lacks the street type '{missing[0]}' of the net")
    walked = {edge.id for edge in net.streets if edge.lanes_of("sidewalk")}
    for pole in parameters.poles:
        if pole.edge not in walked:
            raise InputError(f"{origin}: pole {pole.id} stands on '{pole.edge}', which is no edge with a sidewalk")
    lanes = {lane.id for edge in net.streets for lane in edge.lanes}
    for line in parameters.stop_lines:
        if line.lane not in lanes:
            raise InputError(f"{origin}: a stop line lies on {shorten(line.lane)}, which is no lane of the net")
    lights = {way.light for way in net.connections}
    for signal in parameters.signals:
        if not signal.light or signal.light not in lights:
            raise InputError(f"{origin}: a signal shows {shorten(signal.light)}, which is no light of the net")


def lift_town(town: Town, relief: Relief) -> Town:
    """Lift a level town onto a relief: poles, signs and signals by the height of the ground at their feet.

    Poles, signs, signals, trees and furniture under and on bridges are left out.
    """
    town = _clear_bridges(town, relief)

    def raise_by(position: Array, foot: Array) -> Array:
        lift = relief.heights(*foot[:, :2].T)
        return np.column_stack((position[:, :2], position[:, 2] + lift))

    poles, signs, signals = town.poles, town.signs, town.signals
    return replace(
        town,
        relief=relief,
        poles=replace(poles, position=raise_by(poles.position, poles.position)),
        signs=replace(signs, position=raise_by(signs.position, signs.position)),
        signals=replace(signals, position=raise_by(signals.position, signals.foot)),
    )


def _clear_bridges(town: Town, relief: Relief) -> Town:
    """Return a town without objects, except buildings, on or under bridges or within `BESIDE_BRIDGE_M` of them."""
    if not relief.decks:
        return town
    taken = shapely.union_all([deck.outline for deck in relief.decks]).buffer(BESIDE_BRIDGE_M)
    shapely.prepare(taken)

    def is_free(feet: Array) -> Mask:
        return ~shapely.contains_xy(taken, *feet[:, :2].T)

    def is_clear(rows: Array) -> Mask:
        return ~shapely.intersects(taken, [street_furniture.make_footprint(*row[:5]) for row in rows])

    signals = town.signals
    poles, signs, heads = is_free(town.poles.position), is_free(town.signs.position), is_free(signals.foot)
    return replace(
        town,
        trees=town.trees[is_free(town.trees)],
        clutter=tuple((kind, rows[is_clear(rows)]) for kind, rows in town.clutter),
        lamps=town.lamps[is_free(town.lamps)],
        posts=town.posts[is_free(town.posts)],
        poles=_pick(town.poles, poles),
        signs=_pick(town.signs, signs),
        signals=replace(_pick(signals, heads), walkers=int(heads[len(heads) - signals.walkers :].sum())),
    )


def _pick(record: Placed, kept: Mask) -> Placed:
    """Select the rows of a record's arrays and tuples for which `kept` (N,) is true."""
    columns = {field.name: getattr(record, field.name) for field in fields(record)}
    arrays = {name: column[kept] for name, column in columns.items() if isinstance(column, np.ndarray)}
    words = {name: tuple(compress(column, kept)) for name, column in columns.items() if isinstance(column, tuple)}
    return replace(record, **arrays, **words)


def furnish_town(name: str, path: Path, net: RoadNet, parameters: TownParameters) -> Town:
    """Furnish the net of the file `path` as a level town.

    The ground comes first, then buildings, clutter, hedges and fences, trees, poles, signs, lamps and signals.
    """
    frontage = {kind: street.frontage_m for kind, street in parameters.streets.items()}
    ground = build_ground_surfaces(
        net, frontage, [street_furniture.outline_space(space) for space in parameters.parking]
    )
    rows = list(street_furniture.list_verges(net, parameters))
    paved = join_areas(ground.roads, ground.sidewalks)
    land = street_furniture.Plot(paved)
    for shape in (given := street_furniture.outline_objects(parameters.objects)):
        land.build(shape, 0.0)
    buildings = street_furniture.list_buildings(parameters.objects)
    if not len(buildings):
        buildings = street_furniture.place_buildings(rows, land, stream(parameters.seed, "buildings"))
    walked = unite([verge.line.buffer(verge.half_width, cap_style="flat") for verge in rows])
    facades = [street_furniture.make_footprint(*row[:5]).buffer(0.1) for row in buildings]
    open_land = street_furniture.Plot(unite([ground.roads, walked, *facades]))
    for shape in given:
        open_land.build(shape, 0.0)
    clutter = street_furniture.place_clutter(rows, open_land, stream(parameters.seed, "clutter"))
    enclosing = street_furniture.place_boundaries(rows, open_land, stream(parameters.seed, "boundaries"))
    kerbside = street_furniture.place_kerbside(rows, stream(parameters.seed, "kerbside"))
    trees = street_furniture.list_trees(parameters.objects)
    if not len(trees):
        trees = street_furniture.place_trees(rows, ground, open_land, stream(parameters.seed, "trees"))
    poles = street_furniture.place_poles(net, parameters.poles)
    mounts = np.array([row[1] for row in poles], dtype=np.float64).reshape(-1, 3)
    signs = street_furniture.place_signs(net, parameters.signs, limits_known=parameters.limits_known)
    posts = np.array([(post.x, post.y, post.height_m) for post in parameters.posts], dtype=np.float64).reshape(-1, 3)
    low_x, low_y, high_x, high_y = shapely.total_bounds(np.array([paved, *facades]))
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
        clutter=street_furniture.join_clutter(
            street_furniture.list_clutter(parameters.objects), clutter, enclosing, kerbside
        ),
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
        posts=posts,
        lamps=street_furniture.place_lamps(rows, mounts, stream(parameters.seed, "lamps")),
        signals=place_signals(net, mounts, parameters.signals),
    )
