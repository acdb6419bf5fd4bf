"""A log of Argoverse 2, written by hand."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
from PIL import Image
from scipy.spatial.transform import Rotation

START, STEP = 315_966_265_000_000_000, 100_000_000  # [ns]
SPEED = 5.0  # of the ego vehicle, north [m/s]; it heads north, and the car ahead of it stands
NORTH = Rotation.from_euler("z", 90, degrees=True)
UP_LIDAR = (1.35, 0.0, 1.64)


def write_feather(path: Path, **columns: Any) -> None:
    """Write columns to a Feather file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), path)


def placed(rotation: Rotation, places: np.ndarray) -> dict[str, Any]:
    """Return the columns of poses with these rotations, one or (N,), and places (N, 3)."""
    x, y, z, w = np.broadcast_to(rotation.as_quat(), (len(places), 4)).T.tolist()
    columns = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    return dict[str, Any](zip(columns, (w, x, y, z, *places.T.tolist()), strict=True))


def write_log(folder: Path, *, annotated: bool = True, attitude: Rotation = NORTH) -> None:
    """Write two sweeps with a car 20 m ahead on the first, and a picture 20 ms after each."""
    sweeps = [START, START + STEP]
    times = [*sweeps, *(sweep + 20_000_000 for sweep in sweeps)]
    north = np.array([(time - START) / 1e9 * SPEED for time in times])
    places = np.column_stack((np.full(4, 100.0), 200 + north, np.full(4, 60.0)))
    write_feather(folder / "city_SE3_egovehicle.feather", timestamp_ns=times, **placed(attitude, places))
    optical = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    mounts = [placed(Rotation.identity(), np.array([UP_LIDAR])), placed(optical, np.array([[1.6, 0.0, 1.4]]))]
    both = {name: [*mounts[0][name], *mounts[1][name]] for name in mounts[0]}
    write_feather(
        folder / "calibration" / "egovehicle_SE3_sensor.feather", sensor_name=["up_lidar", "ring_front_center"], **both
    )
    lens = {"fx_px": [100.0], "fy_px": [100.0], "cx_px": [79.5], "cy_px": [47.5], "width_px": [160], "height_px": [96]}
    write_feather(folder / "calibration" / "intrinsics.feather", sensor_name=["ring_front_center"], **lens)
    for sweep, ahead in zip(sweeps, (20.0, 20.0 - SPEED * 0.1)):
        xyz = np.array([[ahead, 0.0, 0.5], [ahead + 1, 0.5, 0.2], [0.0, 9.0, -0.3]]).astype(np.float16)
        columns = dict(zip("xyz", xyz.T))
        path = folder / "sensors" / "lidar" / f"{sweep}.feather"
        offset_ns = np.array([0, 50_000_000, 99_000_000], np.int32)
        write_feather(path, **columns, intensity=np.array([0, 51, 255], np.uint8), offset_ns=offset_ns)
        path = folder / "sensors" / "cameras" / "ring_front_center" / f"{sweep + 20_000_000}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (160, 96), (200, 30, 30)).save(path)
    if annotated:
        in_ego = np.array([[20.0, 0.0, 0.4], [20.0 - SPEED * 0.1, 0.0, 0.4], [5.0, 5.0, 0.0]])
        write_feather(
            folder / "annotations.feather",
            timestamp_ns=[*sweeps, sweeps[0]],
            track_uuid=["car", "car", "cone"],
            category=["REGULAR_VEHICLE", "REGULAR_VEHICLE", "CONSTRUCTION_CONE"],
            length_m=[4.0, 4.0, 0.4],
            width_m=[1.8, 1.8, 0.4],
            height_m=[1.5, 1.5, 0.7],
            **placed(Rotation.from_euler("z", 180, degrees=True), in_ego),
        )
