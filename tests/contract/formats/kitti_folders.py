"""Made folders in the layout of KITTI's object benchmark, and cast sweeps of a street."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flcav.geometry.poses import pose

ELEVATIONS = {
    2: (-25, 3),
    16: (-15, 15),
    32: (-30.67, 10.67),
    64: (-24.8, 2),
    128: (-25, 15),
}  # of the beams, evenly spaced [deg]
CALIBRATION = """P2: 700 0 600 0 0 700 180 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
"""
LABEL = "Car 0 0 -10 100 100 200 200 1.5 1.6 4.0 0.0 1.5 14.0 -1.57\n"


def write_folder(folder: Path, clouds: Sequence[np.ndarray], label: str = LABEL) -> None:
    """Write a folder whose frames have these sweeps, and a labelled car each."""
    for kind in ("velodyne", "calib", "label_2"):
        (folder / "training" / kind).mkdir(parents=True)
    for number, cloud in enumerate(clouds):
        name = f"{number:06d}"
        cloud.tofile(folder / "training" / "velodyne" / f"{name}.bin")
        (folder / "training" / "calib" / f"{name}.txt").write_text(CALIBRATION)
        (folder / "training" / "label_2" / f"{name}.txt").write_text(label)


def cast(beams: int, height_m: float, pitch: float, roll: float, seed: int, *, ground: bool = True) -> np.ndarray:
    """Return a sweep of a street: level ground, walls 9 m to either side, a box of a car's size ahead."""
    rng = np.random.default_rng(seed)
    low, high = ELEVATIONS[beams]
    elevation = np.radians(np.linspace(low, high, beams))
    azimuth = np.radians(np.arange(0, 360, 0.4) + rng.uniform(0, 0.4))
    up, around = (each.ravel() for each in np.meshgrid(elevation, azimuth, indexing="ij"))
    rays = np.column_stack((np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)))
    mount = pose(0, 0, height_m, 0, pitch, roll)
    world = rays @ mount[:3, :3].T
    far = [np.where(world[:, 2] < 0, height_m / -world[:, 2].clip(max=-1e-9), np.inf)] if ground else []
    far.append(np.where(np.abs(world[:, 1]) > 1e-9, 9.0 / np.abs(world[:, 1]).clip(min=1e-9), np.inf))
    ahead = np.where(world[:, 0] > 0, 12.0 / world[:, 0].clip(min=1e-9), np.inf)
    at = world * ahead.clip(max=1e4)[:, None] + (0, 0, height_m)
    far.append(np.where((np.abs(at[:, 1]) < 2) & (at[:, 2] > 0) & (at[:, 2] < 1.5), ahead, np.inf))
    distance = np.min(far, axis=0)
    seen = (distance < 100) & ((world[:, 2] * distance + height_m) < 8)
    noisy = rays[seen] * (distance[seen] + rng.normal(0, 0.02, seen.sum()))[:, None]
    return np.column_stack((noisy, np.full(len(noisy), 0.3))).astype(np.float32)
