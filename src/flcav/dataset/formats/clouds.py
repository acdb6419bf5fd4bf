"""Files of point clouds: layouts of headerless numbers, and PCD files (Point Cloud Library, version 0.7).

The layout of a headerless file is recognised by the ranges of its numbers. KITTI's files are rows of x, y, z [m] and
intensity 0 to 1, nuScenes' of x, y, z [m], intensity 0 to 255 and ring, all little-endian float32. Read with another
number of columns or another type, coordinates fall into the column of intensities, or numbers become huge, tiny or NaN.
"""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError, read_file

FARTHEST_M = 1e4  # largest coordinate that a LiDAR is assumed to measure
MILLIMETRES = 1000.0  # in a metre
NEAREST_M = 1.0  # the farthest point of a sweep is farther than this
TINY = 1e-30  # smallest number above 0; a smaller one shows another type
BRIGHTEST = 255  # largest intensity of nuScenes
HALF_ONE_M = 2.0**-7  # largest y of a cloud whose numbers are float16: its upper bytes are an intensity's, at most 1
BESIDE_M = 1.75  # largest norm of a normal or a colour
TYPES = {"<f4": "float32", "<f8": "float64", ">f4": "big-endian float32", ">f8": "big-endian float64"}
COLUMNS = range(3, 13)
SAMPLE = 48_000  # values from which columns are counted
FEW = 16  # fewest rows for more than a check of ranges

Values = NDArray[np.floating]


def has_kitti_layout(data: bytes) -> bool:
    """Return whether the bytes are rows of x, y, z [m], intensity 0 to 1."""
    rows = _rows(data, 4)
    return rows is not None and _is_cloud(rows) and _within(rows[:, 3], 1) and not _mixes(rows)


def has_nuscenes_layout(data: bytes) -> bool:
    """Return whether the bytes are rows of x, y, z [m], intensity 0 to 255, ring, with an intensity above 1."""
    rows = _rows(data, 5)
    if rows is None or not _is_cloud(rows):
        return False
    ring, intensity = rows[:, 4], rows[:, 3]
    whole = bool((ring == np.rint(ring)).all())
    return whole and _within(ring, BRIGHTEST) and _within(intensity, BRIGHTEST) and bool(intensity.max() > 1)


def find_millimetres(data: bytes) -> float | None:
    """Return the largest coordinate of bytes in one of the layouts but for millimetres in place of metres, or None."""
    for columns, has_layout in ((4, has_kitti_layout), (5, has_nuscenes_layout)):
        rows = _rows(data, columns)
        if rows is not None and np.isfinite(rows).all() and np.abs(rows[:, :3]).max() > FARTHEST_M:
            scaled = rows / np.array((*(MILLIMETRES,) * 3, *(1,) * (columns - 3)), np.float32)
            if has_layout(scaled.astype("<f4").tobytes()):
                return float(np.abs(rows[:, :3]).max())
    return None


def describe_numbers(data: bytes) -> str:
    """Return the apparent layout of bytes in neither layout, as "5 columns of float32"; empty if there is none."""
    for dtype, name in TYPES.items():
        if len(data) % np.dtype(dtype).itemsize == 0:
            values = np.frombuffer(data, dtype)
            if len(values) and _are_numbers(values) and np.nanmax(np.abs(values)) > NEAREST_M:
                count = _count_columns(values)
                return f"{count} columns of {name}" if count else ""
    return ""


def _rows(data: bytes, columns: int) -> NDArray[np.float32] | None:
    return np.frombuffer(data, "<f4").reshape(-1, columns) if data and len(data) % (4 * columns) == 0 else None


def _is_cloud(rows: NDArray[np.float32]) -> bool:
    return (
        bool(np.isfinite(rows).all())
        and _are_numbers(rows)
        and bool(np.linalg.norm(rows[:, :3], axis=1).max() > NEAREST_M)
    )


def _are_numbers(values: Values) -> bool:
    """Return whether the finite values have magnitudes that a LiDAR measures."""
    size = np.abs(values[np.isfinite(values)])
    return bool(len(size) and size.max() <= FARTHEST_M and not ((size > 0) & (size < TINY)).any())


def _within(values: Values, most: float) -> bool:
    return bool(((values >= 0) & (values <= most)).all())


def _mixes(rows: NDArray[np.float32]) -> bool:
    """Return whether rows are those of another layout, although every fourth number is an intensity.

    In rows of eight numbers, every second half is not a point but a normal, a colour or padding. In float16, the upper
    bytes of y are an intensity: no y is negative or as large as a centimetre.
    """
    y = rows[rows.any(axis=1), 1]
    if len(y) >= FEW and y.any() and _within(y, HALF_ONE_M):
        return True
    halves = [np.linalg.norm(half[half[:, :3].any(axis=1), :3], axis=1) for half in (rows[::2], rows[1::2])]
    if min(map(len, halves)) < FEW:
        return False
    near, far = sorted(halves, key=lambda half: float(np.median(half)))
    return bool(near.max() < min(BESIDE_M, np.median(far)))


def _count_columns(values: Values) -> int:
    """Return the number of columns for which values differ least from those of the next row; 0 if there is none.

    Two draws from one distribution differ less, on average, than draws from two (G. J. Székely and M. L. Rizzo, "Energy
    statistics", J. Statistical Planning and Inference 143, 2013, prop. 1). For a multiple of the correct number they
    differ as little: the result is the smallest number that is better than all numbers but its multiples.
    """
    some = np.where(np.isfinite(values[:SAMPLE]), values[:SAMPLE], np.nan)
    if len(some) < FEW * max(COLUMNS) or np.isnan(some).all():
        return 0
    changes = {count: float(np.nanmean(np.abs(some[count:] - some[:-count]))) for count in COLUMNS}
    for count, change in changes.items():
        if len(values) % count == 0 and all(change < other for many, other in changes.items() if many % count):
            return count
    return 0


DATA = re.compile(rb"^DATA (\w+)\r?\n", re.MULTILINE)  # last line of the header
PCD_TYPES = {"F": "f", "I": "i", "U": "u"}


def encode_pcd(rows: NDArray[np.void]) -> bytes:
    """Return a binary PCD file, version 0.7, of a structured array, with one field for each of the array's fields."""
    fields = {name: rows.dtype[name] for name in rows.dtype.names or ()}
    letters = {kind: letter for letter, kind in PCD_TYPES.items()}
    header = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(fields),
        "SIZE " + " ".join(str(field.itemsize) for field in fields.values()),
        "TYPE " + " ".join(letters[field.kind] for field in fields.values()),
        "COUNT " + " ".join("1" for _ in fields),
        f"WIDTH {len(rows)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(rows)}",
        "DATA binary\n",
    )
    return "\n".join(header).encode() + rows.tobytes()


def is_pcd(data: bytes) -> bool:
    """Return whether the bytes begin as a PCD file does."""
    return re.match(rb"(#[^\n]*\n)*VERSION ", data) is not None


def read_pcd(path: Path) -> NDArray[np.void]:
    """Return the points of a PCD file as a structured array with the fields of the file.

    Raises `InputError` where the file is missing, truncated, compressed, or not a PCD file with one number per field.
    """
    data = read_file(path)
    header, kind, body = _split(data)
    if kind == "binary_compressed":
        raise InputError(f"{path}: a compressed PCD file; supported: binary, ascii")
    try:
        about = {words[0]: words[1:] for words in header if words}
        if kind not in ("binary", "ascii") or set(about.get("COUNT", ["1"])) != {"1"}:
            raise ValueError
        kinds = [f"<{PCD_TYPES[kind]}{size}" for kind, size in zip(about["TYPE"], about["SIZE"], strict=True)]
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
    """Return the words of the header's lines, how the points are stored, and their bytes; empty for no PCD file."""
    end = DATA.search(data)
    if end is None:
        return [], "", b""
    lines = data[: end.start()].decode("latin-1").splitlines()
    return [line.split() for line in lines if not line.startswith("#")], end[1].decode(), data[end.end() :]
