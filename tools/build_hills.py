"""Build the slopes and the camber of the hilly towns: `python tools/build_hills.py`.

Writes src/flcav/world/towns/<name>/hills.parquet, which is committed. The land is a sum of two waves, about 10 % steep
at most. Roads fall by `CAMBER` from the left border of their leftmost lane, the middle of a two-way street; sidewalks
rise from the kerb by `CROSSFALL`. The camber fades out towards junctions.
"""

from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from flcav.geometry import left_vectors
from flcav.statistics.streams import stream
from flcav.world.map.relief import Relief
from flcav.world.map.roads import Edge, RoadNet, read_net
from flcav.world.map.town import HILLS, TOWNS
from flcav.world.opendrive.heights import surround_terrain

FOLDER = Path(__file__).parents[1] / "src/flcav/world/towns"
Array = NDArray[np.float64]

WAVES = ((3.5, 340.0), (1.5, 220.0))  # amplitude and length [m]
CAMBER, CROSSFALL = 0.025, 0.02  # usual falls of roads and of sidewalks
FADE_M = 15.0  # before a junction the camber fades out
STEP_M = 16.0  # between two cross-sections
LAND_M = 48.0  # between points of the land beside the roads
FAR_M = 120.0  # from the outermost of them to the edge of the land
APART_M = 3.0  # points of junctions and land are so far from those of roads


def build_relief(name: str, net: RoadNet) -> Relief:
    """Return the relief of a town on `net`; the same name and net give the same one."""
    rng = stream(0, "hills", name)
    bearing, phase = rng.uniform(0, 2 * np.pi, (2, len(WAVES)))

    def land(xy: Array) -> Array:
        along = xy @ np.stack((np.cos(bearing), np.sin(bearing)))  # (N, waves)
        height, length = np.array(WAVES).T
        return (height * np.sin(2 * np.pi * along / length + phase)).sum(axis=1)

    junctions = shapely.union_all(
        [shapely.Polygon(each.shape) for each in net.junctions.values() if len(each.shape) > 2]
    )
    sections = [_cross_sections(edge) for edge in net.streets if edge.lanes_of("driving")]
    places, falls = (np.concatenate(each) for each in zip(*sections))
    fade = np.clip(shapely.distance(junctions, shapely.points(places)) / FADE_M, 0.0, 1.0)
    roads = _thin(np.column_stack((places, land(places) - fade * falls)), 0.5)
    corners = shapely.get_coordinates(shapely.segmentize(shapely.boundary(junctions), STEP_M))
    low, high = roads[:, :2].min(axis=0) - 2 * LAND_M, roads[:, :2].max(axis=0) + 2 * LAND_M
    grid = np.meshgrid(*(np.arange(first, last, LAND_M) for first, last in zip(low, high)))
    beside = np.concatenate((corners, np.stack(grid, axis=-1).reshape(-1, 2)))
    points = _thin(np.concatenate((roads, np.column_stack((beside, land(beside))))), APART_M, keep=len(roads))
    return Relief(np.concatenate((points, surround_terrain(points, FAR_M))).round(3))


def _cross_sections(edge: Edge) -> tuple[Array, Array]:
    """Return places (N, 2) across one direction of a street, and how much (N,) lower than its middle they lie [m]."""
    paved = sum(lane.width for lane in edge.lanes if lane.kind != "sidewalk")
    walked = sum(lane.width for lane in edge.lanes_of("sidewalk"))
    inner = edge.lanes[-1]
    line = shapely.LineString(inner.shape)
    stations = np.linspace(0.0, line.length, max(round(line.length / STEP_M), 1) + 1)
    here = shapely.get_coordinates(shapely.line_interpolate_point(line, stations))
    ahead, behind = (
        shapely.get_coordinates(shapely.line_interpolate_point(line, np.clip(stations + by, 0.0, line.length)))
        for by in (0.5, -0.5)
    )
    left = left_vectors(np.arctan2(*(ahead - behind).T[::-1]))
    aside = np.array([0.0, paved, paved + walked])[: 3 if walked else 2]
    falls = np.array([0.0, CAMBER * paved, CAMBER * paved - CROSSFALL * walked])[: len(aside)]
    places = here[:, None] + left[:, None] * (inner.width / 2 - aside)[:, None]
    return places.reshape(-1, 2), np.tile(falls, len(stations))


def _thin(points: Array, apart_m: float, keep: int = 0) -> Array:
    """Return the first `keep` points (N, 3), and of the others those at least `apart_m` from all kept before."""
    tree = shapely.STRtree(np.asarray(shapely.points(points[:, :2])))
    kept = np.ones(len(points), np.bool_)
    one, other = tree.query(shapely.points(points[:, :2]), predicate="dwithin", distance=apart_m)
    near: dict[int, list[int]] = {}
    for a, b in zip(one.tolist(), other.tolist()):
        if b < a:
            near.setdefault(a, []).append(b)
    for a in range(keep, len(points)):
        kept[a] = not any(kept[b] for b in near.get(a, []))
    return points[kept]


if __name__ == "__main__":
    for name in TOWNS:
        relief = build_relief(name, read_net(FOLDER / name / "town.net.xml"))
        relief.save(FOLDER / name / HILLS)
        print(f"{name}: {len(relief.points)} points")
