"""KITTI's 3D object detection benchmark: its `files`, a source of frames (`read`), the export (`write`).

Geiger et al., "Are we ready for autonomous driving?", CVPR 2012, and the benchmark's development kit.
"""

from flcav.dataset.formats.kitti.files import (
    KittiCalibration,
    KittiFolder,
    KittiFrame,
    Objects,
    read_calibration,
    read_objects,
    read_points,
)

__all__ = [
    "KittiCalibration",
    "KittiFolder",
    "KittiFrame",
    "Objects",
    "read_calibration",
    "read_objects",
    "read_points",
]
