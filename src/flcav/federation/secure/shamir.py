"""Shamir's secret sharing of 32-byte secrets over a prime field (Shamir, Communications of the ACM 22(11), 1979)."""

import secrets
from collections.abc import Mapping

PRIME = 2**521 - 1  # a Mersenne prime above any secret
SECRET_BYTES, SHARE_BYTES = 32, 66


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

    Raises OverflowError where the shares are not of one secret, as far as that can be seen.
    """
    total = 0
    for place, share in shares.items():
        above, below = 1, 1
        for other in shares:
            if other != place:
                above = above * (other + 1) % PRIME
                below = below * (other - place) % PRIME
        total = (total + int.from_bytes(share) * above * pow(below, -1, PRIME)) % PRIME
    return total.to_bytes(SECRET_BYTES)
