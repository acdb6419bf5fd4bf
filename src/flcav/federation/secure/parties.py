"""Clients and server of secure aggregation (Bonawitz et al., "Practical Secure Aggregation", CCS 2017, figure 4).

The server is honest but curious: it follows the protocol, and reads everything it receives. A round has four exchanges.
Keys: clients send public keys. Shares: every client sends, sealed for every peer, a share of its seed and of its
private mask key. Masked: every client trains, and sends its update plus the self-mask of its seed plus a pairwise mask
per peer; pairwise masks cancel in the sum. Unmask: the surviving clients send their shares of the seeds of clients that
sent an update, and of the mask keys of clients that did not. The server thus never removes both kinds of masks of one
client.

On a fleet a client signs its public keys of a round with its key certified by the fleet's authority: a server that
replaced the keys of clients by keys it knows could remove the pairwise masks. Clients therefore share secrets only with
certified vehicles. A replayed signature of an older round does no harm: masks are added only for peers whose shares
open, and these are sealed for the keys of this round.
"""

import contextlib
import json
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np
from cryptography import x509
from cryptography.exceptions import InvalidSignature, InvalidTag, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import decode_dss_signature, encode_dss_signature
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID

from flcav.config import shorten
from flcav.federation.secure.primitives import (
    SHARE_BYTES,
    Vector,
    agree,
    draw_keys,
    expand,
    find_wrong_shares,
    join_shares,
    public_key,
    seal,
    split_secret,
    unseal,
)

SEALED_BYTES = 2 * SHARE_BYTES + 16  # shares of both secrets, and the authentication tag


class SumLost(OSError):
    """The sum of a round cannot be unmasked from the shares that clients revealed."""


@dataclass(frozen=True)
class PublicKeys:
    """Public keys of a client for one round."""

    cipher: bytes  # for sealing shares to the client
    mask: bytes  # for agreeing on pairwise masks


@dataclass
class SecureClient:
    """A client during one round, which reveals shares once, and never both shares of one client."""

    name: str
    cipher: bytes  # private key for opening sealed shares
    private: bytes  # private key of the pairwise masks
    seed: bytes  # of the self-mask
    keys: PublicKeys
    peers: dict[str, PublicKeys] = field(default_factory=dict)  # of all clients of the round
    threshold: int = 0  # shares that determine a secret
    own_shares: bytes = b""
    opened: dict[str, bytes] = field(default_factory=dict)  # shares for this client, by peer
    revealed: bool = False

    @classmethod
    def draw(cls, name: str) -> "SecureClient":
        """Return a client with new keys and a new seed, from the operating system's randomness."""
        (cipher, cipher_public), (private, mask_public) = draw_keys(), draw_keys()
        return cls(name, cipher, private, secrets.token_bytes(32), PublicKeys(cipher_public, mask_public))

    def share(self, peers: Mapping[str, PublicKeys], threshold: int) -> dict[str, bytes]:
        """Return the sealed shares of this client's seed and mask key, by peer.

        peers: public keys of all clients of the round, including this one. Raises ValueError where this client's keys
        differ, and where `threshold` is not more than half of the clients: two disjoint groups of survivors could then
        reveal both secrets of a client.
        """
        if peers[self.name] != self.keys:
            raise ValueError("another public key in the place of this client's own")
        if not len(peers) / 2 < threshold <= len(peers):
            raise ValueError(f"a threshold of {threshold} of {len(peers)} clients: more than half of them is wanted")
        self.peers = dict(peers)
        self.threshold = threshold
        parts = (split_secret(secret, threshold, len(peers)) for secret in (self.seed, self.private))
        both = {name: seed + key for name, seed, key in zip(peers, *parts, strict=True)}
        self.own_shares = both.pop(self.name)
        return {name: seal(self._sealing_key(self.name, name), shares) for name, shares in both.items()}

    def take(self, sealed: Mapping[str, bytes]) -> list[str]:
        """Open and keep the shares of the peers; return the names of those whose shares do not open.

        sealed: shares for this client, by peer. Raises ValueError where there are too few.
        """
        if len(sealed) + 1 < self.threshold:
            raise ValueError(f"{len(sealed) + 1} clients are left, and {self.threshold} are needed")
        self.opened = {}
        for name, shares in sealed.items():
            with contextlib.suppress(InvalidTag):
                self.opened[name] = unseal(self._sealing_key(name, self.name), shares)
        return [name for name in sealed if name not in self.opened]

    def mask(self, update: Vector) -> Vector:
        """Return the masked update (coordinates,): plus the self-mask, plus or minus pairwise masks, modulo 2^32."""
        total = update + expand(self.seed, len(update))  # self-mask, whose seed is secret-shared
        for name in self.opened:
            common = agree(self.private, self.peers[name].mask, "mask")
            total = add_mask(total, common, self.name < name)  # one of a pair adds it, the other subtracts it
        return total

    def reveal(self, survivors: Sequence[str], dropped: Sequence[str]) -> dict[str, bytes]:
        """Return this client's shares of the survivors' seeds, and of the mask keys of clients that dropped out.

        A server that sends clients different lists could remove all masks of a client with `threshold` - 1 peers if it
        got `threshold` shares of all their mask keys. A client therefore reveals shares of at most as many mask keys as
        there are clients beyond the threshold: the survivors are at least `threshold`. Raises ValueError where both
        shares of a client would be revealed, at a second call, or with too few survivors.
        """
        if self.revealed or set(survivors) & set(dropped) or len(set(survivors)) < self.threshold:
            raise ValueError("shares are revealed once, one of each client, to a server that has enough updates")
        if self.name not in survivors or not {*survivors, *dropped} <= {self.name, *self.opened}:
            raise ValueError("shares are revealed of the clients of the round alone")
        self.revealed = True
        found = {}
        for name in (*survivors, *dropped):
            both = self.own_shares if name == self.name else self.opened[name]
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
    """Return the sum of the survivors' updates (coordinates,), given the sum of their masked updates.

    keys: public keys of all clients that took part in the secret sharing, in that order. dropped: clients with pairwise
    masks in the sum that sent no update. shares: revealed shares by survivor, of at least `threshold` survivors. Raises
    OverflowError where the shares are inconsistent, `SumLost` where a client that dropped out had shared a wrong key.
    """
    places = {name: place for place, name in enumerate(keys)}

    def joined(name: str) -> bytes:
        return join_shares({places[holder]: revealed[name] for holder, revealed in shares.items()})

    for name in survivors:  # their pairwise masks cancel, and their self-masks are left
        total = add_mask(total, joined(name), plus=False)
    for name in dropped:  # its pairwise masks with survivors have no counterpart in the sum
        private = joined(name)
        if public_key(private) != keys[name].mask:
            raise SumLost(f"{name} dropped out, and had shared a key that is not its own")
        for other in survivors:
            common = agree(private, keys[other].mask, "mask")
            total = add_mask(total, common, plus=other > name)
    return np.asarray(total, np.uint32)


def find_liars(
    keys: Mapping[str, PublicKeys], shares: Mapping[str, Mapping[str, bytes]], threshold: int
) -> dict[str, str]:
    """Return the clients whose revealed shares are inconsistent, with the reason; arguments as for `unmask_sum`.

    A client that distributed inconsistent shares cannot be distinguished from the receivers of the wrong ones. Raises
    `SumLost` where no `threshold` shares of a secret are consistent, or fewer clients than that are left.
    """
    places = {name: place for place, name in enumerate(keys)}
    liars: dict[str, str] = {}
    for owner in next(iter(shares.values())):
        try:
            wrong = find_wrong_shares(
                {places[holder]: revealed[owner] for holder, revealed in shares.items()}, threshold
            )
        except ValueError as error:
            raise SumLost(f"of the secrets of {owner} {error}") from None
        liars |= {
            holder: f"reveals a share of {owner} that does not fit" for holder in shares if places[holder] in wrong
        }
    if len(shares) - len(liars) < threshold:
        raise SumLost(f"{', '.join(liars)} reveal shares that do not fit")
    return liars


def settle_complaints(complaints: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return a small set of clients that explains all complaints, with reasons: greedily those in most of them.

    complaints: by client, the peers whose sealed shares it says do not open. If one client complains about one other,
    either may be lying, and both are returned.
    """
    pairs = [(accuser, accused) for accuser, several in complaints.items() for accused in several]
    liars: dict[str, str] = {}
    while pairs:
        every = [name for pair in pairs for name in pair]
        most = max(map(every.count, every))
        for name in [each for each in dict.fromkeys(every) if every.count(each) == most]:
            others = [b if a == name else a for a, b in pairs if name in (a, b)]
            liars[name] = f"shares between it and {', '.join(others)} that do not open"
        pairs = [pair for pair in pairs if not liars.keys() & {*pair}]
    return liars


SignedKeys = tuple[PublicKeys, bytes, bytes]  # with certificate (DER) and signature (ECDSA)
HALF_BYTES = 48  # of a signature by a key on NIST's curve P-384


@dataclass(frozen=True)
class Identity:
    """A client's certified key, its certificate and that of the authority of its fleet (X.509)."""

    key: ec.EllipticCurvePrivateKey = field(repr=False)
    certificate: x509.Certificate
    authority: x509.Certificate

    def sign(self, name: str, round_: int, keys: PublicKeys) -> tuple[bytes, bytes]:
        """Return the certificate (DER) and the signature (ECDSA, 96 bytes) of a client's public keys in a round."""
        signed = decode_dss_signature(self.key.sign(_signed(name, round_, keys), ec.ECDSA(hashes.SHA384())))
        return self.certificate.public_bytes(Encoding.DER), b"".join(each.to_bytes(HALF_BYTES) for each in signed)


def find_vehicle(authority: x509.Certificate, round_: int, name: str, signed: SignedKeys) -> str:
    """Return the certified vehicle that signed a client's public keys of a round.

    Raises ValueError where there is none.
    """
    try:
        return _verify(authority, round_, name, *signed)
    except (InvalidSignature, UnsupportedAlgorithm, TypeError, ValueError) as error:
        why = str(error) or "another signature"
        raise ValueError(f"keys that no certified vehicle has signed: {why}") from None


def check_certified(authority: x509.Certificate, round_: int, clients: Mapping[str, SignedKeys]) -> None:
    """Raise ValueError unless the keys of a round are signed by certified vehicles, a different one per client."""
    vehicles: dict[str, str] = {}
    for name, signed in clients.items():
        try:
            vehicle = find_vehicle(authority, round_, name, signed)
        except ValueError as error:
            raise ValueError(f"{shorten(name)} takes part with {error}") from None
        if (other := vehicles.setdefault(vehicle, name)) != name:
            raise ValueError(f"{shorten(name)} takes part with keys of the vehicle of {shorten(other)}")


def _verify(
    authority: x509.Certificate, round_: int, name: str, keys: PublicKeys, certificate: bytes, signature: bytes
) -> str:
    if not certificate or len(signature) != 2 * HALF_BYTES:
        raise ValueError("a certificate or a signature is missing")
    found = x509.load_der_x509_certificate(certificate)
    found.verify_directly_issued_by(authority)
    if not found.not_valid_before_utc <= datetime.now(UTC) <= found.not_valid_after_utc:
        raise ValueError("the certificate is not in force")
    key = found.public_key()
    uses = [each.value for each in found.extensions if isinstance(each.value, x509.ExtendedKeyUsage)]
    if not (isinstance(key, ec.EllipticCurvePublicKey) and uses and ExtendedKeyUsageOID.CLIENT_AUTH in uses[0]):
        raise ValueError("the certificate is no vehicle's")
    halves = (int.from_bytes(each) for each in (signature[:HALF_BYTES], signature[HALF_BYTES:]))
    key.verify(encode_dss_signature(*halves), _signed(name, round_, keys), ec.ECDSA(hashes.SHA384()))
    return found.subject.rfc4514_string()


def _signed(name: str, round_: int, keys: PublicKeys) -> bytes:
    return json.dumps(["flcav masks", name, round_]).encode() + keys.cipher + keys.mask
