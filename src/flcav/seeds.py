"""Randomness by name: each consumer has a stream of its own, so that adding one does not reshuffle another."""

import zlib

import numpy as np


def stream(seed: int, *keys: str | int) -> np.random.Generator:
    """Return the generator of the stream that `keys` name under `seed`; the same names give the same stream."""
    words = [zlib.crc32(key.encode()) if isinstance(key, str) else int(key) for key in keys]
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(words)))


def child_seed(seed: int, *keys: str | int) -> int:
    """Return a 31-bit seed for a program that wants an integer (SUMO, torch), named like `stream`."""
    return int(stream(seed, *keys).integers(2**31 - 1))
