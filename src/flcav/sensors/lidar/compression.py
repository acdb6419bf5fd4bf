"""Compression of LiDAR sweeps: levels of a centimetre, delta-coded from return to return.

A step from one return of a channel to the next has few levels, so that most of its bytes are 0. Steps are split into
planes of equal bytes, which LZMA codes by what precedes them. Order and number of the returns stay.
"""

import lzma

import numpy as np

from flcav.arrays import Array32, Bytes

PER_UNIT = np.array((100.0, 100.0, 100.0, 255.0))  # levels of a metre along x, y and z, and of the full intensity
RETURN_BYTES = 16  # four steps of 4 bytes
MOST = 1 << 22  # returns of a sweep
CODED = {"format": lzma.FORMAT_RAW, "filters": [{"id": lzma.FILTER_LZMA2, "lc": 0, "pb": 0, "preset": 6}]}


def encode_sweep(points: Array32) -> Bytes:
    """Return points (N, 4) x, y, z [m], intensity [0, 1] as compressed bytes, each to the nearest centimetre or 1/255.

    Coordinates are within 10,000 km.
    """
    levels = np.rint(points * PER_UNIT).astype(np.int32)
    steps = np.diff(levels, axis=0, prepend=np.zeros((1, 4), np.int32))
    unsigned = (steps << 1) ^ (steps >> 31)  # 0, -1, 1, -2, ... become 0, 1, 2, 3, ...
    planes = np.ascontiguousarray(unsigned.T, "<u4").view(np.uint8).reshape(4, -1, 4).transpose(0, 2, 1)
    return np.frombuffer(bytearray(lzma.compress(planes.tobytes(), **CODED)), np.uint8)


def decode_sweep(coded: Bytes) -> Array32:
    """Return the points (N, 4) that `encode_sweep` coded, at the centres of their levels.

    Raises ValueError for bytes that are not a sweep's, or more than `MOST` returns.
    """
    try:
        plain = lzma.LZMADecompressor(**CODED).decompress(coded.tobytes(), RETURN_BYTES * MOST + 1)
    except lzma.LZMAError as error:
        raise ValueError(f"not a compressed sweep ({error})") from None
    if len(plain) > RETURN_BYTES * MOST or len(plain) % RETURN_BYTES:
        raise ValueError(f"not a compressed sweep of at most {MOST} returns")
    planes = np.frombuffer(plain, np.uint8).reshape(4, 4, -1)
    unsigned = np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<u4")[..., 0].astype(np.int64).T
    steps = (unsigned >> 1) ^ -(unsigned & 1)
    return (np.cumsum(steps, axis=0) / PER_UNIT).astype(np.float32)
