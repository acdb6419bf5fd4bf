"""Made folders in the layout of KITTI's object benchmark."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

CALIBRATION = """P2: 700 0 600 0 0 700 180 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
"""
LABEL = "Car 0 0 -10 100 100 200 200 1.5 1.6 4.0 0.0 1.5 14.0 -1.57\n"


def write_folder(folder: Path, clouds: Sequence[np.ndarray]) -> None:
    """Write a folder whose frames have these sweeps, and a labelled car each."""
    for kind in ("velodyne", "calib", "label_2"):
        (folder / "training" / kind).mkdir(parents=True)
    for number, cloud in enumerate(clouds):
        name = f"{number:06d}"
        cloud.tofile(folder / "training" / "velodyne" / f"{name}.bin")
        (folder / "training" / "calib" / f"{name}.txt").write_text(CALIBRATION)
        (folder / "training" / "label_2" / f"{name}.txt").write_text(LABEL)
