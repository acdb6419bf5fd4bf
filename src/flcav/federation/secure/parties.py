"""Clients and server of secure aggregation (Bonawitz et al., "Practical Secure Aggregation", CCS 2017, figure 4).

The server is honest but curious: it follows the protocol and reads all that it gets. Four exchanges make a round.
Keys: clients send public keys. Shares: each sends, sealed for every other client, shares of its seed and of its private
key of masks. Masked: each trains, and sends its update plus the mask of its seed plus masks that it has in common with
every other client, which cancel in the sum. Unmask: those who are left send their shares of the seeds of clients who
sent an update, and of the keys of clients who did not, so that no client's both masks can be taken off.
"""

import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from flcav.federation.secure.masks import Vector, agree, draw_keys, expand, seal, unseal
from flcav.federation.secure.shamir import SHARE_BYTES, join_shares, split_secret


@dataclass(frozen=True)
class PublicKeys:
    """Public keys of a client for one round."""

    cipher: bytes  # that others seal its shares by
    mask: bytes  # that it has masks in common with others by


@dataclass
class SecureClient:
    """A client during one round; it does not reveal both of a client's masks, and reveals once."""

    name: str
    cipher: bytes  # private key that others' shares are sealed for
    private: bytes  # private key of the masks in common with others
    seed: bytes  # of its own mask
    keys: PublicKeys
    peers: dict[str, PublicKeys] = field(default_factory=dict)  # of all clients of the round
    threshold: int = 0  # of shares
    own_shares: bytes = b""
    sealed: dict[str, bytes] = field(default_factory=dict)  # by other client, for this one
    revealed: bool = False

    @classmethod
    def draw(cls, name: str) -> "SecureClient":
        """Return a client with new keys and a new seed, from the operating system's randomness."""
        (cipher, cipher_public), (private, mask_public) = draw_keys(), draw_keys()
        return cls(name, cipher, private, secrets.token_bytes(32), PublicKeys(cipher_public, mask_public))

    def share(self, peers: Mapping[str, PublicKeys], threshold: int) -> dict[str, bytes]:
        """Return by name of every other client, sealed for it, a share of this one's seed and of its key of masks.

        peers: public keys of all clients of the round, this one included. Raises ValueError where `threshold` is not
        more than half of them: two halves could then reveal both of a client's masks.
        """
        if not len(peers) / 2 < threshold <= len(peers):
            raise ValueError(f"a threshold of {threshold} of {len(peers)} clients: more than half of them is wanted")
        self.peers, self.threshold = dict(peers), threshold
        parts = (split_secret(secret, threshold, len(peers)) for secret in (self.seed, self.private))
        both = {name: seed + key for name, seed, key in zip(peers, *parts, strict=True)}
        self.own_shares = both.pop(self.name)
        return {name: seal(self._sealing_key(self.name, name), shares) for name, shares in both.items()}

    def mask(self, update: Vector, sealed: Mapping[str, bytes]) -> Vector:
        """Return the update with its masks.

        sealed: by name of the other clients who take part in the masks, the shares that they sealed for this one.
        """
        if len(sealed) + 1 < self.threshold:
            raise ValueError(f"{len(sealed) + 1} clients are left, and {self.threshold} are needed")
        self.sealed = dict(sealed)
        total = update + expand(self.seed, len(update))
        for name in sealed:
            common = agree(self.private, self.peers[name].mask, "mask")
            total = add_mask(total, common, self.name < name)
        return total

    def reveal(self, survivors: Sequence[str], dropped: Sequence[str]) -> dict[str, bytes]:
        """Return this client's shares: of the survivors' seeds, and of the keys of masks of those who dropped out.

        Raises ValueError where this would reveal both of a client, where it was done before, or with too few survivors.
        """
        if self.revealed or set(survivors) & set(dropped) or len(set(survivors)) < self.threshold:
            raise ValueError("shares are revealed once, one of each client, to a server that has enough updates")
        if self.name not in survivors or not {*survivors, *dropped} <= {self.name, *self.sealed}:
            raise ValueError("shares are revealed of the clients of the round alone")
        self.revealed = True
        found = {}
        for name in (*survivors, *dropped):
            if name == self.name:
                both = self.own_shares
            else:
                both = unseal(self._sealing_key(name, self.name), self.sealed[name])
            found[name] = both[:SHARE_BYTES] if name in survivors else both[SHARE_BYTES:]
        return found

    def _sealing_key(self, sender: str, receiver: str) -> bytes:
        other = receiver if sender == self.name else sender
        return agree(self.cipher, self.peers[other].cipher, f"shares of {sender} for {receiver}")


def add_mask(total: Vector, seed: bytes, plus: bool) -> Vector:
    """Return a vector with the mask of a seed added, or subtracted, modulo 2^32."""
    mask = expand(seed, len(total))
    return total + mask if plus else total - mask


def unmask_sum(
    total: Vector,
    keys: Mapping[str, PublicKeys],
    survivors: Sequence[str],
    dropped: Sequence[str],
    shares: Mapping[str, Mapping[str, bytes]],
) -> Vector:
    """Return the sum of the survivors' updates, from the sum of what they sent.

    keys: public keys of all clients that shares were made for, in that order. dropped: clients in whose masks the
    survivors took part and who sent no update. shares: by survivor what it revealed, of `threshold` or more of them.
    """
    places = {name: place for place, name in enumerate(keys)}

    def joined(name: str) -> bytes:
        return join_shares({places[holder]: revealed[name] for holder, revealed in shares.items()})

    for name in survivors:
        total = add_mask(total, joined(name), plus=False)
    for name in dropped:
        private = joined(name)
        for other in survivors:
            common = agree(private, keys[other].mask, "mask")
            total = add_mask(total, common, plus=other > name)
    return np.asarray(total, np.uint32)
