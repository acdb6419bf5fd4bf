"""Lane centres and heights of OpenDRIVE maps, as flcav reads and imports them, beside those of CARLA's own reader.

`python tests/peers/lanes.py` prints, for each map and for all, quantiles of how far they are apart.
"""

import os
import tempfile
from pathlib import Path

import numpy as np
import shapely
from conftest import build_peer
from numpy.typing import NDArray
from shapely.geometry import LineString

from flcav.world.map.relief import Relief
from flcav.world.map.roads import read_net
from flcav.world.opendrive.document import read_map
from flcav.world.opendrive.heights import sample_heights
from flcav.world.opendrive.importing import import_town
from flcav.world.opendrive.road_surface import Road

Array = NDArray[np.float64]

REAL = Path(os.environ.get("FLCAV_REAL_DATA", Path(__file__).parents[2].parent / "shared" / "data"))
MAPS = sorted([*REAL.glob("carla_maps/*.xodr"), *REAL.glob("opendrive/*.xodr")])
TILTED = "velodrome"  # CARLA takes no superelevation
QUANTILES = (0.5, 0.95, 0.99, 1.0)


def compare_reading(path: Path, rows: list[list]) -> tuple[Array, Array]:
    """Return how far each point by CARLA is, in plan and in height (N,) [m], from the lane centre and from the relief.

    Heights are none for a map with superelevation.
    """
    root = read_map(path)
    roads = {row.get("id"): Road(row) for row in root.iterfind("road")}
    points = np.array([row[3:6] for row in rows])
    found = [
        roads[road].point(np.array([s]), np.array([roads[road].lane_centre(s, lane)])) for road, lane, s, *_ in rows
    ]
    relief = sample_heights(root, path).points
    ground = Relief(relief).heights(*points[:, :2].T) if len(relief) else np.zeros(len(points))
    rise = np.abs(ground - points[:, 2]) if TILTED not in path.name else np.zeros(0)
    return np.hypot(*(np.concatenate(found)[:, :2] - points[:, :2]).T), rise


def compare_town(path: Path, rows: list[list], out: Path) -> tuple[Array, Array]:
    """Return how far each point by CARLA, outside and inside junctions, is from the town's nearest lane (N,) [m].

    The town is imported as the folder `out`.
    """
    town = import_town(path, out).town
    source = town.parameters.source
    assert source is not None
    lanes = [lane for edge in read_net(town.net).edges.values() for lane in edge.lanes_of("driving")]
    tree = shapely.STRtree([LineString(lane.shape) for lane in lanes if len(lane.shape) > 1])
    places = shapely.points(np.array([row[3:5] for row in rows]) + source.offset_m)
    away = tree.query_nearest(places, return_distance=True, all_matches=False)[1]
    inside = np.array([row[6] for row in rows], dtype=bool)
    return away[~inside], away[inside]


def main() -> None:
    """Print a row for each map and what is compared; the last rows are of all maps."""
    every: dict[str, list[Array]] = {}
    print(f"{'millimetres':40s} points   median      95 %      99 %   largest")
    for path, rows in build_peer("carla").read(*MAPS).items():
        with tempfile.TemporaryDirectory() as scratch:
            streets, junctions = compare_town(Path(path), rows, Path(scratch) / "town")
        plan, rise = compare_reading(Path(path), rows)
        for name, away in {"plan": plan, "height": rise, "streets": streets, "junctions": junctions}.items():
            every.setdefault(name, []).append(away)
            _tell(f"{Path(path).stem} {name}", away)
    for name, parts in every.items():
        _tell(f"all {name}", np.concatenate(parts))


def _tell(name: str, away: Array) -> None:
    if len(away):
        print(f"{name:40s} {len(away):6d}", *(f"{1000 * value:9.1f}" for value in np.quantile(away, QUANTILES)))


if __name__ == "__main__":
    main()
