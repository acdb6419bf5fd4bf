"""Shamir's secret sharing of 32-byte secrets over a prime field (Shamir, Communications of the ACM 22(11), 1979)."""

import itertools
import math
import secrets
from collections.abc import Mapping

from flcav.statistics.streams import stream

PRIME = 2**521 - 1  # a Mersenne prime above any secret
SECRET_BYTES, SHARE_BYTES = 32, 66
MOST_TRIED = 256  # sets of shares


def split_secret(secret: bytes, threshold: int, shares: int) -> list[bytes]:
    """Return `shares` shares of a secret, of which any `threshold` determine it and fewer tell nothing.

    The share of place i (from 0) is the value at i + 1 of a random polynomial of degree threshold - 1 whose value at 0
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
    """Return the secret of `threshold` or more shares by place, by Lagrange interpolation at 0.

    Raises OverflowError where the shares are not of one secret: a wrong one makes a random element of the field, which
    is of 32 bytes with a probability of 2^-265.
    """
    return _interpolate(shares, 0).to_bytes(SECRET_BYTES)


def find_wrong_shares(shares: Mapping[int, bytes], threshold: int) -> set[int]:
    """Return the places of the shares that do not fit the others, of which `threshold` or more determine the secret.

    Sets of `threshold` shares are tried, all of them where they are few, until one makes a secret. Of a majority as
    threshold and e wrong shares about one set of 2^e does. Raises ValueError where none of those tried makes a secret.
    """
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
