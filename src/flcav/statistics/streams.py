"""Named random streams of one seed: every consumer has a separate one, so that adding one does not change the others.

Names become the spawn key of NumPy's `SeedSequence`; strings by their CRC-32.
"""

import zlib

import numpy as np


def stream(seed: int, *keys: str | int) -> np.random.Generator:
    """Return the random generator of the stream named by `keys` under `seed`; equal arguments give equal streams."""
    words = [zlib.crc32(key.encode()) if isinstance(key, str) else int(key) for key in keys]
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(words)))


def derive_seed(seed: int, *keys: str | int) -> int:
    """Return a 31-bit integer seed for a library that needs one (SUMO, torch), drawn from `stream(seed, *keys)`."""
    return int(stream(seed, *keys).integers(2**31 - 1))
