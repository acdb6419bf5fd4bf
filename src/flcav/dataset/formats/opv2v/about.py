"""The YAML file of a frame in OPV2V and V2X-Real: reading it, with the numbers that NumPy wrote into it.

Both datasets were written by PyYAML's unsafe dumper, which names classes of Python. Of these only NumPy's scalars and
arrays are read, by their bytes; nothing is imported or called.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from flcav.config import InputError, Loader, read_yaml
from flcav.dataset.formats.reading import FARTHEST

About = Mapping[str, Any]  # content of the file of a frame

CAMERAS = ("camera0", "camera1", "camera2", "camera3", "cam1", "cam2", "cam3", "cam4")  # of OPV2V, of V2X-Real
EGO = ("true_ego_pos", "true_ego_pose")  # likewise
TAG = "tag:yaml.org,2002:"
CODES = {"f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"}


class NumbersLoader(Loader):
    """A safe YAML loader that also reads NumPy's numbers as PyYAML dumps them."""


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
        for name in ("lidar_pose", EGO[0]):
            _check_numbers(about[name], 6)
        for name in CAMERAS:
            if name in about and "cords" not in about[name]:
                del about[name]  # a pose that is not in OPV2V's terms
            elif name in about:
                _check_numbers(about[name]["cords"], 6)
                _check_numbers(np.ravel(about[name]["intrinsic"]), 9)
    except KeyError as lost:
        raise InputError(f"{path}: not a frame of OPV2V, it has no {lost}") from None
    except ValueError as error:
        raise InputError(f"{path}: not a frame of OPV2V, {error}") from None
    except (TypeError, AttributeError):
        raise InputError(f"{path}: not a frame of OPV2V, its entries are of other kinds") from None
    return about


def _check_numbers(values: Any, *shape: int) -> None:
    """Raise `ValueError` where values are not numbers of that shape, one number for ()."""
    numbers = np.array(values)
    if numbers.shape != shape or numbers.dtype.kind not in "iuf" or not (np.abs(numbers) < FARTHEST).all():
        raise ValueError(f"{shape[0]} numbers are wanted" if shape else "a number is wanted")


def _read_parts(loader: Any, node: yaml.Node) -> list[Any]:
    """Return what a dumped object is made of: the items of a sequence, or a mapping's `args` and its `state`."""
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
