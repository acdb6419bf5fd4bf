"""Reading of a LiDAR sweep from a single file: headerless numbers of KITTI or nuScenes, or PCD."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError, read_file
from flcav.dataset.formats.clouds import has_nuscenes_layout, is_pcd, read_pcd
from flcav.dataset.formats.kitti.files import read_points
from flcav.dataset.formats.nuscenes.files import read_nuscenes_points
from flcav.dataset.formats.reading import check_cloud
from flcav.dataset.payloads import TIMES

ENDINGS = (".bin", ".pcd")
FIELDS = ("x", "y", "z", "intensity")
OTHERS = {  # unsupported formats, by their first bytes
    b"\x93NUMPY": "a NumPy array",
    b"PK\x03\x04": "a zip archive",
    b"\x1f\x8b": "compressed by gzip",
    b"ply\n": "a PLY file",
    b"ply\r\n": "a PLY file",
    b"LASF": "a LAS file",
    b"ARROW1": "a Feather file",
    b"\x89HDF": "an HDF5 file",
    b"\x89PNG": "a PNG image",
    b"\xff\xd8\xff": "a JPEG image",
}


def read_cloud_file(path: Path) -> NDArray[np.float32]:
    """Return points (N, 4) of a point cloud file: x ahead, y left, z up [m], intensity [0, 1]; LiDAR frame.

    Files of KITTI and nuScenes are recognised by their numbers, see `clouds`; a PCD file has the fields `FIELDS`.
    Raises `InputError` for other files, and for points that are not finite or have an intensity out of range.
    """
    data = read_file(path)
    for start, name in OTHERS.items():
        if data.startswith(start):
            raise InputError(f"{path}: {name}; supported are point clouds of KITTI (.bin), nuScenes (.pcd.bin) and PCD")
    if is_pcd(data):
        return _read_fields(path)
    return read_nuscenes_points(path) if has_nuscenes_layout(data) else read_points(path)


def list_sweeps(folder: Path) -> list[Path]:
    """Return the files of point clouds in a folder, in order, without the files of point times that datasets keep."""
    return sorted(file for file in folder.iterdir() if file.suffix in ENDINGS and not file.name.endswith(f".{TIMES}"))


def list_cloud_files(path: Path) -> list[Path]:
    """Return the point cloud files of a folder, or the file itself; raises `InputError` where there are none."""
    if not path.is_dir():
        if not path.is_file():
            raise InputError(f"{path}: no such file or folder")
        return [path]
    files = list_sweeps(path)
    if not files:
        raise InputError(f"{path}: neither a dataset nor a folder with .bin or .pcd files")
    return files


def _read_fields(path: Path) -> NDArray[np.float32]:
    rows = read_pcd(path)
    if missing := [name for name in FIELDS if name not in (rows.dtype.names or ())]:
        raise InputError(f"{path}: a PCD file without {missing[0]}; wanted are the fields {', '.join(FIELDS)}")
    return check_cloud(np.column_stack([rows[name] for name in FIELDS]).astype(np.float32), path)
