"""Errors of LiDAR odometry on simulated drives: python benchmarks/bench_odometry.py [SWEEPS].

A vehicle drives through each town and sweeps at 10 Hz with the LiDAR of the rig `kitti_lidar`. Printed are the length
of the drive, how far the last pose is off, along the ground and in height, and by how much it is turned; and the CPU
time that a sweep takes. Poses are relative to the first sweep.
"""

import sys
import time
from itertools import pairwise

import numpy as np

from flcav.fusion.registration import Odometry, measure_offset
from flcav.geometry import inverse
from flcav.sensors.rig import RIGS
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

TOWNS = ("suburb", "grid", "ring", "arterial", "hilly_suburb")


def measure_drive(town: str, sweeps: int, seed: int = 3) -> str:
    """Return the errors of a drive through a town, in words."""
    recipe = Recipe(town=town, seed=seed, cavs=1, spins_per_scene=sweeps, every_s=0.1, vehicle_rig=RIGS["kitti_lidar"])
    source, way, spent = EmbeddedSource(recipe), Odometry(), 0.0
    true, found = [], []
    for frame in source.frames(source.scenes()[0]):
        (name,) = frame.lidar
        true.append(frame.world_from_sensor(name))
        begun = time.process_time()
        found.append(way.step(frame.lidar[name]))
        spent += time.process_time() - begun
    relative = [inverse(true[0]) @ pose for pose in true]
    length = sum(np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in pairwise(relative))
    off = found[-1][:3, 3] - relative[-1][:3, 3]
    turned = measure_offset(found[-1], relative[-1]).rotation_deg
    return (
        f"{town}: {length:.0f} m in {sweeps / 10:g} s, off by {np.hypot(*off[:2]):.2f} m on the ground and "
        f"{abs(off[2]):.2f} m in height, {turned:.2f} degrees; {1000 * spent / sweeps:.0f} CPU-ms a sweep"
    )


if __name__ == "__main__":
    for each in TOWNS:
        print(measure_drive(each, int(sys.argv[1]) if len(sys.argv) > 1 else 100), flush=True)
