"""Sources of differential privacy's noise: a party's secret, which is 32 bytes of the operating system, or a seed.

Noise hides a change from whoever cannot repeat it. Of a secret it is drawn with SHAKE256, so that noise that is seen
bare, where a weight did not change, tells nothing of the rest.
"""

import hashlib
import math
import secrets
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flcav.federation.trainable import Weights

Secret = NDArray[np.uint8]  # (32,)
SECRET_BYTES = 32


class Normals(Protocol):
    """Source of normal numbers, as NumPy's generators are."""

    def normal(self, *, scale: float, size: tuple[int, ...]) -> NDArray[np.float64]:
        """Return numbers of mean 0 and standard deviation `scale`."""
        ...


class SecretNormals:
    """Normal numbers by Box and Muller from the output of SHAKE256 for a key; equal keys give equal numbers."""

    def __init__(self, key: bytes) -> None:
        """Draw by `key`, which is to be used for one change alone."""
        self._key, self._arrays = key, 0

    def normal(self, *, scale: float, size: tuple[int, ...]) -> NDArray[np.float64]:
        """Return numbers of mean 0 and standard deviation `scale`."""
        count, self._arrays = math.prod(size), self._arrays + 1
        pairs = -(-count // 2)
        drawn = hashlib.shake_256(_derive(self._key, f"array {self._arrays}")).digest(16 * pairs)
        uniform = ((np.frombuffer(drawn, "<u8") >> np.uint64(11)) + 1.0) * 2.0**-53  # in (0, 1]
        radius, angle = np.sqrt(-2.0 * np.log(uniform[:pairs])), 2.0 * np.pi * uniform[pairs:]
        found = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])
        return scale * found[:count].reshape(size)


def draw_secret() -> Secret:
    """Return a new secret from the operating system's randomness."""
    return np.frombuffer(secrets.token_bytes(SECRET_BYTES), np.uint8)


def derive_key(secret: Secret, purpose: str, round_: int, seed: int) -> bytes:
    """Return the 32-byte key of a secret for a purpose in one round; `seed` is the round's, which others know."""
    return _derive(secret.tobytes(), f"{purpose} {round_} {seed}")


def secret_noise(key: bytes, change: Weights) -> SecretNormals:
    """Return the noise of a change in the round of `key`: the same for the same change, and for another one another.

    So a round that is repeated after a stop sends the same again, and the difference of two messages reveals no change.
    """
    hashed = hashlib.blake2b(key=key, digest_size=SECRET_BYTES)
    for name, array in change.items():
        hashed.update(f"{name} {array.dtype} {array.shape} ".encode())
        hashed.update(np.ascontiguousarray(array).tobytes())
    return SecretNormals(hashed.digest())


def _derive(key: bytes, purpose: str) -> bytes:
    return hashlib.blake2b(purpose.encode(), key=key, digest_size=SECRET_BYTES).digest()
