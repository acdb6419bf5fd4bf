"""av2-api on a log of Argoverse 2: python read_av2.py LOG OUT.

It writes the points of each sweep to OUT/TIME.npy and prints, of each, the ego vehicle's pose in the city and the
annotated boxes there: category, track, centre, size, yaw, and the number of interior points that the file says.
"""

import json
import sys
from pathlib import Path

import numpy as np
from av2.structures.cuboid import CuboidList
from av2.structures.sweep import Sweep
from av2.utils.io import read_city_SE3_ego


def main(log: Path, out: Path) -> dict:
    """Return what is printed."""
    poses, cuboids = read_city_SE3_ego(log), CuboidList.from_feather(log / "annotations.feather")
    found = {}
    for path in sorted((log / "sensors" / "lidar").glob("*.feather")):
        sweep = Sweep.from_feather(path)
        np.save(out / f"{path.stem}.npy", np.column_stack((sweep.xyz, sweep.intensity)))
        city_from_ego = poses[sweep.timestamp_ns]
        own = [one for one in cuboids.cuboids if one.timestamp_ns == sweep.timestamp_ns]
        boxes = [one.transform(city_from_ego) for one in own]
        found[path.stem] = {
            "pose": city_from_ego.transform_matrix.tolist(),
            "categories": [str(one.category) for one in own],
            "centers": [one.dst_SE3_object.translation.tolist() for one in boxes],
            "sizes": [[one.length_m, one.width_m, one.height_m] for one in own],
            "yaws": [float(np.arctan2(*one.dst_SE3_object.rotation[[1, 0], [0, 0]])) for one in boxes],
            "inside": [len(one.compute_interior_points(sweep.xyz)[0]) for one in own],
        }
    return found


if __name__ == "__main__":
    print()
    print(json.dumps(main(Path(sys.argv[1]), Path(sys.argv[2]))))
