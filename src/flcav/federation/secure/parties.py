"""Clients and server of secure aggregation (Bonawitz et al., "Practical Secure Aggregation", CCS 2017, figure 4).

The server is honest but curious: it follows the protocol and reads all that it gets. Four exchanges make a round.
Keys: clients send public keys. Shares: each sends, sealed for every other client, shares of its seed and of its private
key of masks. Masked: each trains, and sends its update plus the mask of its seed plus masks that it has in common with
every other client, which cancel in the sum. Unmask: those who are left send their shares of the seeds of clients who
sent an update, and of the keys of clients who did not, so that no client's both masks can be taken off.

On a fleet a client signs its public keys of a round with the key that the fleet's authority has certified, since a
server that puts keys of its own in the place of clients' could take off the masks that it then has in common with them.
So clients share secrets with certified vehicles alone. A signature of an older round does no harm: masks are added for
those whose shares open, which they have sealed for the keys of this round.
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

SEALED_BYTES = 2 * SHARE_BYTES + 16  # of the shares of both secrets, and their authentication


class SumLost(OSError):
    """The sum of a round cannot be unmasked from the shares that clients revealed."""


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
    opened: dict[str, bytes] = field(default_factory=dict)  # by other client, its shares for this one
    revealed: bool = False

    @classmethod
    def draw(cls, name: str) -> "SecureClient":
        """Return a client with new keys and a new seed, from the operating system's randomness."""
        (cipher, cipher_public), (private, mask_public) = draw_keys(), draw_keys()
        return cls(name, cipher, private, secrets.token_bytes(32), PublicKeys(cipher_public, mask_public))

    def share(self, peers: Mapping[str, PublicKeys], threshold: int) -> dict[str, bytes]:
        """Return by name of every other client, sealed for it, a share of this one's seed and of its key of masks.

        peers: public keys of all clients of the round, this one included. Raises ValueError where its own are
        others, and where `threshold` is not more than half of them: two halves could then reveal both of a client's
        masks.
        """
        if peers[self.name] != self.keys:
            raise ValueError("another public key in the place of this client's own")
        if not len(peers) / 2 < threshold <= len(peers):
            raise ValueError(f"a threshold of {threshold} of {len(peers)} clients: more than half of them is wanted")
        self.peers, self.threshold = dict(peers), threshold
        parts = (split_secret(secret, threshold, len(peers)) for secret in (self.seed, self.private))
        both = {name: seed + key for name, seed, key in zip(peers, *parts, strict=True)}
        self.own_shares = both.pop(self.name)
        return {name: seal(self._sealing_key(self.name, name), shares) for name, shares in both.items()}

    def take(self, sealed: Mapping[str, bytes]) -> list[str]:
        """Open and keep the shares of those who take part in the masks; return the names of those whose do not open.

        sealed: by name of the other clients, the shares that they sealed for this one. Raises ValueError where they are
        too few.
        """
        if len(sealed) + 1 < self.threshold:
            raise ValueError(f"{len(sealed) + 1} clients are left, and {self.threshold} are needed")
        self.opened = {}
        for name, shares in sealed.items():
            with contextlib.suppress(InvalidTag):
                self.opened[name] = unseal(self._sealing_key(name, self.name), shares)
        return [name for name in sealed if name not in self.opened]

    def mask(self, update: Vector) -> Vector:
        """Return the update with its masks: its own, and those in common with the clients whose shares it has."""
        total = update + expand(self.seed, len(update))  # its own mask, whose seed is shared with all others
        for name in self.opened:
            common = agree(self.private, self.peers[name].mask, "mask")
            total = add_mask(total, common, self.name < name)  # of each pair one adds and one subtracts it
        return total

    def reveal(self, survivors: Sequence[str], dropped: Sequence[str]) -> dict[str, bytes]:
        """Return this client's shares: of the survivors' seeds, and of the keys of masks of those who dropped out.

        A server that tells clients different lists takes off all masks of one which has them in common with `threshold`
        - 1 others, where it gets `threshold` shares of each of their keys. A client reveals shares of no more keys than
        there are clients beyond the threshold. Raises ValueError where this would reveal both of a client, where it was
        done before, or with too few survivors.
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
    """Return the sum of the survivors' updates, from the sum of what they sent.

    keys: public keys of all clients that shares were made for, in that order. dropped: clients in whose masks the
    survivors took part and who sent no update. shares: by survivor what it revealed, of `threshold` or more of them.
    Raises OverflowError where these do not fit together, `SumLost` where one who dropped out shared a key that is not
    its own.
    """
    places = {name: place for place, name in enumerate(keys)}

    def joined(name: str) -> bytes:
        return join_shares({places[holder]: revealed[name] for holder, revealed in shares.items()})

    for name in survivors:
        total = add_mask(total, joined(name), plus=False)
    for name in dropped:  # the masks that survivors have in common with it have no counterpart in the sum
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
    """Return who reveals shares that do not fit those of the others, with the reason; arguments as of `unmask_sum`.

    A client that dealt inconsistent shares cannot be distinguished from those that it dealt wrong ones. Raises
    `SumLost` where no `threshold` shares of a secret fit, or fewer clients than that are left.
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
    """Return the fewest clients whose lies explain all complaints, with the reason: those in most of them.

    complaints: by client who, as it says, sealed shares for it that do not open. Where one client complains about one
    other, it cannot be told which of the two lies, and both are returned.
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
    """Return the vehicle, certified by the authority, that has signed a client's public keys of a round.

    Raises ValueError where none has.
    """
    try:
        return _verify(authority, round_, name, *signed)
    except (InvalidSignature, UnsupportedAlgorithm, TypeError, ValueError) as error:
        why = str(error) or "another signature"
        raise ValueError(f"keys that no certified vehicle has signed: {why}") from None


def check_certified(authority: x509.Certificate, round_: int, clients: Mapping[str, SignedKeys]) -> None:
    """Raise ValueError where the keys of a round are not signed by certified vehicles, another one for each client."""
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
