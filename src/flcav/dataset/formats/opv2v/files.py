"""OPV2V's files: poses in CARLA's left-handed frame, point clouds, and the YAML file of a frame.

Poses are x, y, z [m], roll, yaw, pitch [degrees] (OpenCOOD's `transformation_utils.x_to_world`). V2X-Real has raw point
clouds in the same frame.

YAML files of OPV2V and V2X-Real were written by PyYAML's unsafe dumper, which names Python classes. Of these only
NumPy's scalars and arrays are read, by their bytes; nothing is imported or called.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from flcav.carla.frames import MIRROR, MapFrame
from flcav.config import InputError, Loader, read_file, read_yaml
from flcav.dataset.formats.clouds import BRIGHTEST, encode_pcd, has_kitti_layout, read_pcd
from flcav.dataset.formats.kitti.files import read_points
from flcav.dataset.formats.reading import (
    FARTHEST,
    check_cloud,
    check_rotation,
)
from flcav.geometry import Array, wrap_angle

About = Mapping[str, Any]  # content of a frame's file, with poses as `world_from_body` (4, 4) [m]

CAMERAS = ("camera0", "camera1", "camera2", "camera3", "cam1", "cam2", "cam3", "cam4")  # of OPV2V, of V2X-Real
EGO = ("true_ego_pos", "true_ego_pose")  # likewise
RADIANS = "radians"  # whether the angles of one pose are those of the other, in radians
SAME_RAD, OTHER_DEG = 0.02, 2.0  # tolerance of equal yaws, and difference of different ones
EXACT = 1e-6  # rounding of a matrix's last row
TAG = "tag:yaml.org,2002:"
CODES = {"f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"}
POINT = 4  # numbers of a raw point: x, y, z [m], intensity

FOLDERS = {"train": "train", "val": "validate", "test": "test"}
KMH = 3.6
MIRRORED = np.diag((*MIRROR, 1.0))


def carla_pose(world_from_body: Array) -> list[float]:
    """Return OPV2V's pose [x, y, z [m], roll, yaw, pitch [degrees]], in CARLA's frame, of a `world_from_body` (4, 4).

    The body's axes are x ahead, y left, z up.
    """
    location, (pitch, yaw, roll) = MapFrame().to_transform(world_from_body)
    return [*location, roll, yaw, pitch]


def from_carla(values: ArrayLike) -> Array:
    """Return the `world_from_body` (4, 4) [m] of a pose x, y, z, roll, yaw, pitch: the inverse of `carla_pose`.

    `values` may also be the matrix (4, 4) of that pose in CARLA's frame, OpenCOOD's `x_to_world`.
    """
    numbers = np.asarray(values, np.float64)
    if numbers.shape == (4, 4):
        return MIRRORED @ numbers @ MIRRORED
    x, y, z, roll, yaw, pitch = numbers.tolist()
    return MapFrame().from_transform((x, y, z), (pitch, yaw, roll))


def encode_cloud(points: NDArray[np.float32]) -> bytes:
    """Return a PCD file of points (N, 4), x, y, z [m], intensity [0, 1], with y mirrored to CARLA's frame.

    The intensity is the red channel of the colour, as in OPV2V.
    """
    rows = np.empty(len(points), [(name, "<f4") for name in ("x", "y", "z", "rgb")])
    rows["x"], rows["y"], rows["z"] = points[:, 0], -points[:, 1], points[:, 2]
    rows["rgb"] = (np.clip(np.rint(points[:, 3] * 255), 0, 255).astype("<u4") << 16).view("<f4")
    return encode_pcd(rows)


class NumbersLoader(Loader):
    """A safe YAML loader that also reads NumPy's numbers as dumped by PyYAML."""


def read_about(stem: Path) -> About:
    """Return the content of a frame's YAML file; raises `InputError` where it is missing, truncated or no frame."""
    path = stem.with_suffix(".yaml")
    about: Any = read_yaml(path, NumbersLoader)
    try:
        about["vehicles"].values()
        for row in about["vehicles"].values():
            row.setdefault("center", [0.0, 0.0, 0.0])  # V2X-Real's locations are centres
            for name in ("location", "center", "extent", "angle"):
                _check_numbers(row[name], 3)
            _check_numbers(row.get("speed", 0.0))
            if not isinstance(row.get("obj_type", ""), str):
                raise ValueError("a class is no name")
        about[EGO[0]] = about[EGO[0]] if EGO[0] in about else about.get(EGO[1], about["lidar_pose"])
        pair = about["lidar_pose"], about[EGO[0]]
        about["lidar_pose"], about[EGO[0]] = map(_read_pose, pair, ("lidar_pose", EGO[0]))
        about[RADIANS] = _differ_as_radians(*pair)
        for name in CAMERAS:
            if name in about and "cords" not in about[name]:
                del about[name]  # a pose that is not in OPV2V's terms
            elif name in about:
                about[name]["cords"] = _read_pose(about[name]["cords"], f"'cords' of {name}")
                _check_numbers(np.ravel(about[name]["intrinsic"]), 9)
    except KeyError as lost:
        raise InputError(f"{path}: not a frame of OPV2V, it has no {lost}") from None
    except ValueError as error:
        raise InputError(f"{path}: not a frame of OPV2V, {error}") from None
    except (TypeError, AttributeError):
        raise InputError(f"{path}: not a frame of OPV2V, its entries are of other kinds") from None
    return about


def _check_numbers(values: Any, *shape: int) -> None:
    """Raise ValueError where `values` are not numbers of that shape; () stands for one number."""
    numbers = np.array(values)
    if numbers.shape != shape or numbers.dtype.kind not in "iuf" or not (np.abs(numbers) < FARTHEST).all():
        raise ValueError(f"{shape[0]} numbers are wanted" if shape else "a number is wanted")


def _read_pose(values: Any, name: str) -> Array:
    """Return the `world_from_body` (4, 4) of a pose: x, y, z, roll, yaw, pitch, or a matrix in CARLA's frame."""
    matrix = np.shape(values) == (4, 4)
    try:
        _check_numbers(values, *((4, 4) if matrix else (6,)))
    except ValueError:
        raise ValueError(f"'{name}' is not of 6 numbers, nor of 4 x 4") from None
    placed = from_carla(values)
    if matrix and np.abs(placed[3] - (0, 0, 0, 1)).max() > EXACT:
        raise ValueError(f"the last row of '{name}' is not 0, 0, 0, 1")
    try:
        placed[:3, :3] = check_rotation(placed[:3, :3])
    except ValueError as error:
        raise ValueError(f"'{name}' {error}") from None
    placed[3] = 0, 0, 0, 1
    return placed


def _differ_as_radians(one: Any, other: Any) -> bool:
    """Return whether, for two poses of 6 numbers, one yaw is the other in radians."""
    if np.shape(one) != (6,) or np.shape(other) != (6,):
        return False
    yaws = float(one[4]), float(other[4])
    return any(
        abs(wrap_angle(np.radians(degrees) - radians)) < SAME_RAD and abs(degrees - radians) > OTHER_DEG
        for radians, degrees in (yaws, yaws[::-1])
    )


def _read_parts(loader: Any, node: yaml.Node) -> list[Any]:
    """Return the parts of a dumped object: the items of a sequence, or a mapping's `args` and `state`."""
    if isinstance(node, yaml.MappingNode):
        parts = loader.construct_mapping(node, deep=True)
        return [*parts.get("args", ()), parts.get("state")]
    return loader.construct_sequence(node, deep=True)


def _read_dtype(loader: Any, node: yaml.Node) -> np.dtype[Any]:
    code, *_, state = _read_parts(loader, node)
    if code not in CODES:
        raise ValueError(f"numbers of an unknown kind, {code!r}")
    order = state[1] if isinstance(state, list | tuple) and len(state) > 1 and state[1] in ("<", ">") else "<"
    return np.dtype(f"{order}{code}")


def _read_scalar(loader: Any, node: yaml.Node) -> float | int:
    dtype, data = _read_parts(loader, node)[:2]
    if not isinstance(dtype, np.dtype) or not isinstance(data, bytes) or len(data) != dtype.itemsize:
        raise ValueError("a number of NumPy's without its bytes")
    return np.frombuffer(data, dtype)[0].item()


def _read_array(loader: Any, node: yaml.Node) -> Any:
    *_, state = _read_parts(loader, node)
    if not isinstance(state, list | tuple) or len(state) != 5:
        raise ValueError("an array of NumPy's without its state")
    _, shape, dtype, by_column, data = state
    if not isinstance(dtype, np.dtype) or not isinstance(data, bytes):
        raise ValueError("an array of NumPy's without its bytes")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if by_column else "C").tolist()


for module in ("numpy.core.multiarray", "numpy._core.multiarray"):
    NumbersLoader.add_constructor(f"{TAG}python/object/apply:{module}.scalar", _read_scalar)
    NumbersLoader.add_constructor(f"{TAG}python/object/apply:{module}._reconstruct", _read_array)
NumbersLoader.add_constructor(f"{TAG}python/object/apply:numpy.dtype", _read_dtype)
NumbersLoader.add_constructor(f"{TAG}python/name:numpy.ndarray", lambda *_: None)
NumbersLoader.add_constructor(f"{TAG}python/tuple", _read_parts)


def read_raw_cloud(path: Path) -> NDArray[np.float32]:
    """Return points (N, 4) of a raw cloud with y to the right: x ahead, y left, z [m], intensity [0, 1].

    Points that are not finite are left out; intensities in the file may reach 255. Raises `InputError` for other files.
    """
    data = read_file(path)
    if not data or len(data) % (4 * POINT):
        return read_points(path)  # which says what it is
    rows = np.frombuffer(data, "<f4").reshape(-1, POINT)
    rows = rows[np.isfinite(rows).all(axis=1)] * np.array([1, -1, 1, 1], np.float32)
    if len(rows) and 1 < rows[:, 3].max() <= BRIGHTEST:
        rows[:, 3] /= np.float32(BRIGHTEST)
    return rows if has_kitti_layout(rows.tobytes()) else read_points(path)


def read_cloud(path: Path) -> NDArray[np.float32]:
    """Return points (N, 4) of a PCD file: x ahead, y left, z [m], intensity [0, 1] from the red channel."""
    rows = read_pcd(path)
    try:
        x, y, z, colour = (rows[name] for name in ("x", "y", "z", "rgb"))
    except ValueError:
        raise InputError(f"{path}: not a point cloud of OPV2V, which has the fields x, y, z, rgb") from None
    red = (np.ascontiguousarray(colour).view("<u4") >> 16) & 255
    with np.errstate(invalid="ignore"):  # signalling NaNs, which are refused
        points = np.stack((x, -y, z, red / np.float32(255)), axis=1).astype(np.float32)
    return check_cloud(points, path)
