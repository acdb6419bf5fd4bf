"""Reading of binary PCD files (Point Cloud Library, version 0.7)."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError

END = b"DATA binary\n"
TYPES = {"F": "f", "I": "i", "U": "u"}


def read_pcd(path: Path) -> NDArray[np.void]:
    """Return the points of a PCD file as a structured array with a field for each of the file's.

    Raises `InputError` where the file is missing, truncated, or no binary PCD file with one number in each field.
    """
    try:
        data = path.read_bytes()
    except (FileNotFoundError, IsADirectoryError):
        raise InputError(f"{path}: no such file") from None
    header, end, body = data.partition(END)
    try:
        lines = (line.split() for line in header.decode("ascii").splitlines() if not line.startswith("#"))
        about = {words[0]: words[1:] for words in lines if words}
        if not end or set(about.get("COUNT", ["1"])) != {"1"}:
            raise ValueError
        kinds = [f"<{TYPES[kind]}{size}" for kind, size in zip(about["TYPE"], about["SIZE"], strict=True)]
        dtype, count = np.dtype(list(zip(about["FIELDS"], kinds, strict=True))), int(about["POINTS"][0])
    except (ValueError, KeyError, IndexError, TypeError):
        raise InputError(f"{path}: not a binary PCD file") from None
    if count < 0 or len(body) < count * dtype.itemsize:
        raise InputError(f"{path}: truncated; {count} points take {count * dtype.itemsize} bytes, here are {len(body)}")
    return np.frombuffer(body, dtype, count)
