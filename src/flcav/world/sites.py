"""Candidate sites of roadside sensors beside the streets of any town, and the names of its streets."""

from dataclasses import dataclass

import numpy as np
import shapely
from scipy.spatial import KDTree
from shapely.geometry import LineString

from flcav.arrays import Array
from flcav.world.geodesy import convert_to_geodetic
from flcav.world.map.parameters import PoleParameters, StreetParameters
from flcav.world.map.roads import CARRIAGEWAY, Edge, read_net
from flcav.world.map.street_furniture import Verge
from flcav.world.map.town import BESIDE_BRIDGE_M, Town

MOUNT_M: float = PoleParameters.model_fields["height_m"].default  # height of a mount above the ground
NEAR_M = 25.0  # from a site to the middle of the street that it stands at
BESIDE_M = 0.35  # from the outer edge of the carriageway to a site


def draw_sites(town: Town, every_m: float, *, bare: bool = False) -> Array:
    """Return candidate sites (N, 3) [m, world] every `every_m` [m] beside the streets of a town, `MOUNT_M` high.

    A street has them on one side, the first one half of `every_m` from its start. They stand neither on a road nor near
    a bridge, and not within half of `every_m` of each other. With `bare` they are those of streets without a sidewalk,
    motorways for instance, beside which `flcav towns import` puts no poles.
    """
    net, done, found = read_net(town.net), set[frozenset[str]](), []
    for edge in net.streets:
        ends = frozenset((edge.start, edge.end))
        if ends in done or not edge.lanes_of("driving") or (bare and edge.lanes_of("sidewalk")):
            continue
        done.add(ends)
        lane = next(lane for lane in edge.lanes if lane.kind in CARRIAGEWAY)
        verge = Verge(LineString(lane.shape), lane.width / 2, StreetParameters(), net.side)
        for along in np.arange(min(every_m, verge.line.length) / 2, verge.line.length, every_m):
            found.append(verge.at(float(along), verge.half_width + BESIDE_M)[:2])
    feet = np.array(found, dtype=np.float64).reshape(-1, 2)
    taken = [shapely.union_all([shapely.Polygon(road) for road in town.roads])]
    if town.relief is not None and town.relief.decks:
        taken.append(shapely.union_all([deck.outline for deck in town.relief.decks]).buffer(BESIDE_BRIDGE_M))
    for area in taken:
        shapely.prepare(area)
        feet = feet[~shapely.contains_xy(area, feet)]
    kept = np.ones(len(feet), np.bool_)
    for one, other in sorted(KDTree(feet).query_pairs(every_m / 2)) if len(feet) else ():
        kept[other] &= not kept[one]
    feet = feet[kept]
    return np.column_stack((feet, town.grounds(feet[:, 0], feet[:, 1]) + MOUNT_M))


def measure_streets(town: Town, *, bare: bool = False) -> float:
    """Return the length of a town's streets [m], both directions counted once; `bare`: of those without a sidewalk."""
    length: dict[frozenset[str], float] = {}
    for edge in read_net(town.net).streets:
        if edge.lanes_of("driving") and not (bare and edge.lanes_of("sidewalk")):
            length.setdefault(frozenset((edge.start, edge.end)), LineString(edge.lanes_of("driving")[0].shape).length)
    return sum(length.values())


@dataclass(frozen=True)
class Located:
    """Position of a site, in the world frame and by latitude and longitude."""

    x: float  # [m, world]
    y: float
    z: float
    latitude: float  # [deg, WGS 84], by the town's geo-reference
    longitude: float
    street: str | None  # name of the street that it stands at; None: it has none

    def __str__(self) -> str:
        """Return the place in words."""
        street = "" if self.street is None else f", {self.street}"
        return (
            f"x {self.x:.1f}, y {self.y:.1f} m (latitude {self.latitude:.6f}, longitude {self.longitude:.6f}){street}"
        )


def locate_sites(town: Town, sites: Array) -> list[Located]:
    """Return where the `sites` (N, 3) [m, world] are: coordinates, and the nearest named street within `NEAR_M`."""
    named = [(name, shapely.MultiLineString(lines)) for name, lines in list_street_names(town).items()]
    found = []
    for site in sites:
        apart = [(line.distance(shapely.Point(site[:2])), name) for name, line in named]
        street = next((name for far, name in sorted(apart)[:1] if far <= NEAR_M), None)
        (latitude, longitude, _), (x, y, z) = convert_to_geodetic(town.geo, site).tolist(), site.tolist()
        found.append(Located(x, y, z, latitude, longitude, street))
    return found


def list_street_names(town: Town) -> dict[str, list[Array]]:
    """Return the centre lines (K, 2) [m, world] of the streets that have a name, by name; both directions once."""
    named: dict[str, dict[frozenset[str], Array]] = {}
    for edge in read_net(town.net).streets:
        if edge.name and edge.lanes_of("driving"):
            named.setdefault(edge.name, {}).setdefault(frozenset((edge.start, edge.end)), _middle(edge))
    return {name: [*lines.values()] for name, lines in named.items()}


def _middle(edge: Edge) -> Array:
    return edge.lanes_of("driving")[-1].shape
