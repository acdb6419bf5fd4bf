"""Primitives of secure aggregation: masks, and Shamir's secret sharing.

Masks: key agreement (X25519), expansion of seeds (SHAKE256), sealing of shares, fixed-point numbers. Updates are
vectors of integers modulo 2^32, in which masks cancel exactly and a masked update is uniformly distributed. Secrets of
32 bytes are shared over a prime field (Shamir, Communications of the ACM 22(11), 1979).
"""

import hashlib
import itertools
import math
import secrets
from collections.abc import Iterable, Mapping

import numpy as np
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from numpy.typing import NDArray

from flcav.statistics.streams import stream

LARGEST_SUM = 2**31 - 1
NONCE = bytes(12)  # constant, since a key seals a single message
Vector = NDArray[np.uint32]  # (coordinates,)


def draw_keys() -> tuple[bytes, bytes]:
    """Return a new X25519 key pair, private and public, of 32 bytes each, from the operating system's randomness."""
    private = X25519PrivateKey.generate()
    return private.private_bytes_raw(), private.public_key().public_bytes_raw()


def public_key(private: bytes) -> bytes:
    """Return the public key of an X25519 private key."""
    return X25519PrivateKey.from_private_bytes(private).public_key().public_bytes_raw()


def agree(private: bytes, public: bytes, purpose: str) -> bytes:
    """Return the 32-byte key that two clients have in common for a purpose (X25519, HKDF with SHA-256)."""
    common = X25519PrivateKey.from_private_bytes(private).exchange(X25519PublicKey.from_public_bytes(public))
    return HKDF(SHA256(), 32, salt=None, info=purpose.encode()).derive(common)


def is_public_key(data: object) -> bool:
    """Return whether data are a usable X25519 public key: 32 bytes, and a point of no small order.

    With a point of small order every shared secret would be 0 (RFC 7748, section 6.1).
    """
    try:
        agree(bytes(range(32)), data, "trial")  # type: ignore[arg-type]: whatever a client sent
    except (TypeError, ValueError):
        return False
    return True


def seal(key: bytes, data: bytes) -> bytes:
    """Return data encrypted and authenticated (ChaCha20-Poly1305) with a key that is used once."""
    return ChaCha20Poly1305(key).encrypt(NONCE, data, None)


def unseal(key: bytes, sealed: bytes) -> bytes:
    """Return the sealed data; raises cryptography's `InvalidTag` where they were changed or sealed with another key."""
    return ChaCha20Poly1305(key).decrypt(NONCE, sealed, None)


def expand(seed: bytes, size: int) -> Vector:
    """Return the mask of a 32-byte seed, (size,): the output of SHAKE256, as little-endian integers."""
    return np.frombuffer(hashlib.shake_256(b"flcav mask" + seed).digest(4 * size), "<u4").astype(np.uint32)


def add_vectors(vectors: Iterable[Vector]) -> Vector:
    """Return the sum of vectors, modulo 2^32."""
    return np.asarray(np.sum([*vectors], axis=0, dtype=np.uint32))


def to_integers(values: NDArray[np.float64], largest: float, clients: int) -> Vector:
    """Return values (coordinates,) as fixed-point numbers modulo 2^32, clipped to +-largest.

    The step is the finest at which the sum of `clients` vectors cannot overflow. Raises ValueError for values that are
    not finite.
    """
    if not np.isfinite(values).all():
        raise ValueError("an update with values that are not finite cannot be masked")
    # signed 32-bit range over the number of clients: the sum of all vectors cannot wrap around
    limit = LARGEST_SUM // clients
    return np.rint(np.clip(values / largest, -1.0, 1.0) * limit).astype(np.int64).astype(np.uint32)


def to_values(total: Vector, largest: float, clients: int) -> NDArray[np.float64]:
    """Return the sum of values (coordinates,) whose fixed-point sum is `total`: the inverse of `to_integers`."""
    return total.astype(np.int32).astype(np.float64) * (largest / (LARGEST_SUM // clients))


PRIME = 2**521 - 1  # a Mersenne prime above any secret
SECRET_BYTES, SHARE_BYTES = 32, 66
MOST_TRIED = 256  # subsets of shares in the search for wrong ones


def split_secret(secret: bytes, threshold: int, shares: int) -> list[bytes]:
    """Return `shares` shares of a secret; any `threshold` of them determine it, and fewer reveal nothing.

    The share at index i (from 0) is the value at i + 1 of a random polynomial of degree threshold - 1 whose value at 0
    is the secret.
    """
    polynomial = [int.from_bytes(secret), *(secrets.randbelow(PRIME) for _ in range(threshold - 1))]

    def value(x: int) -> int:
        total = 0
        for coefficient in reversed(polynomial):
            total = (total * x + coefficient) % PRIME
        return total

    return [value(place + 1).to_bytes(SHARE_BYTES) for place in range(shares)]


def join_shares(shares: Mapping[int, bytes]) -> bytes:
    """Return the secret of `threshold` or more shares by index, by Lagrange interpolation at 0.

    Raises OverflowError where the shares are inconsistent: a wrong share gives a random element of the field of 521
    bits, which fits in 32 bytes with a probability of 2^-265.
    """
    return _interpolate(shares, 0).to_bytes(SECRET_BYTES)


def find_wrong_shares(shares: Mapping[int, bytes], threshold: int) -> set[int]:
    """Return the indices of the wrong shares, if at least `threshold` others are consistent.

    Subsets of `threshold` shares are tried, all where there are few, until one gives a secret of 32 bytes. With e wrong
    shares and a threshold of half, about one subset in 2^e does. Raises ValueError where none of those tried does.
    """
    # the order of trials is no secret, so a fixed seed keeps the result reproducible
    every = math.comb(len(shares), threshold)
    rng = stream(0, "shares")
    tried = (
        itertools.combinations(shares, threshold)
        if every <= MOST_TRIED
        else (rng.permutation([*shares])[:threshold].tolist() for _ in range(MOST_TRIED))
    )
    for places in tried:
        trusted = {place: shares[place] for place in places}
        if _interpolate(trusted, 0) < 256**SECRET_BYTES:
            return {place for place, share in shares.items() if _interpolate(trusted, place + 1) != _number(share)}
    raise ValueError(f"no {threshold} of {len(shares)} shares make a secret")


def _interpolate(shares: Mapping[int, bytes], x: int) -> int:
    """Return the value at x of the polynomial through the shares."""
    # Lagrange basis polynomials at x; the share at index i has the abscissa i + 1
    total = 0
    for place, share in shares.items():
        above, below = 1, 1
        for other in shares:
            if other != place:
                above = above * (other + 1 - x) % PRIME
                below = below * (other - place) % PRIME
        total = (total + _number(share) * above * pow(below, -1, PRIME)) % PRIME
    return total


def _number(share: bytes) -> int:
    return int.from_bytes(share)
