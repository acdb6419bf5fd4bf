"""Reading of PCD files (Point Cloud Library, version 0.7), binary or as text."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError, read_file

DATA = re.compile(rb"^DATA (\w+)\r?\n", re.MULTILINE)  # last line of the header
TYPES = {"F": "f", "I": "i", "U": "u"}


def is_pcd(data: bytes) -> bool:
    """Return whether the bytes begin as a PCD file does."""
    return re.match(rb"(#[^\n]*\n)*VERSION ", data) is not None


def read_pcd(path: Path) -> NDArray[np.void]:
    """Return the points of a PCD file as a structured array with a field for each of the file's.

    Raises `InputError` where the file is missing, truncated, compressed, or no PCD file with one number in each field.
    """
    data = read_file(path)
    header, kind, body = _split(data)
    if kind == "binary_compressed":
        raise InputError(f"{path}: a compressed PCD file; supported: binary, ascii")
    try:
        about = {words[0]: words[1:] for words in header if words}
        if kind not in ("binary", "ascii") or set(about.get("COUNT", ["1"])) != {"1"}:
            raise ValueError
        kinds = [f"<{TYPES[kind]}{size}" for kind, size in zip(about["TYPE"], about["SIZE"], strict=True)]
        dtype, count = np.dtype(list(zip(about["FIELDS"], kinds, strict=True))), int(about["POINTS"][0])
        lines = body.decode("ascii").split("\n") if kind == "ascii" else []
        rows = np.loadtxt(lines, dtype, ndmin=1) if any(lines) else np.zeros(0, dtype)
    except (ValueError, KeyError, IndexError, TypeError):
        raise InputError(f"{path}: not a binary PCD file, nor one in ascii") from None
    if kind == "ascii" and len(rows) != count:
        raise InputError(f"{path}: truncated; it holds {len(rows)} of {count} points")
    if kind == "binary" and not 0 <= count * dtype.itemsize <= len(body):
        raise InputError(f"{path}: truncated; {count} points take {count * dtype.itemsize} bytes, here are {len(body)}")
    return rows if kind == "ascii" else np.frombuffer(body, dtype, count)


def _split(data: bytes) -> tuple[list[list[str]], str, bytes]:
    """Return the words of each line of the header, how the points are stored, and their bytes; nothing if no PCD."""
    end = DATA.search(data)
    if end is None:
        return [], "", b""
    lines = data[: end.start()].decode("latin-1").splitlines()
    return [line.split() for line in lines if not line.startswith("#")], end[1].decode(), data[end.end() :]
