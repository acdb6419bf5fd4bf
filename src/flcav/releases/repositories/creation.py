"""Creation of a party's repository with keys and root of its own, and the replacement of its online key.

OUT/keys/{1..m,online}.pem    private keys, to be given to their owners
OUT/repository/metadata/      what vehicles fetch
OUT/repository/targets/       weights and descriptions of releases
OUT/staged/targets.json       the next targets metadata, while it lacks signatures
"""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from flcav.config import InputError
from flcav.releases.keys import PublicKey, check_distinct, generate_key, read_private_key
from flcav.releases.repositories.metadata import (
    PARTY,
    Party,
    expiry_of,
    latest_version,
    load_metadata,
    load_root,
    read_party,
    sign_online,
    write_metadata,
)

if TYPE_CHECKING:
    from tuf.api.metadata import Metadata, Root, Snapshot, Timestamp

ONLINE = "online"
MOST_KEYS = 16


def create_repository(
    out: Path, party: Party, keys: int = 3, threshold: int = 2, own: Sequence[Path] = (), now: datetime | None = None
) -> tuple[PublicKey, ...]:
    """Create a party's keys and its empty repository at `out`; return its public keys.

    Args:
        out: the folder, which may not exist yet.
        party: whose it is.
        keys: number of keys m that are generated, unless `own` are given.
        threshold: number of signatures n that root and targets want.
        own: private keys of the party (PEM files).
        now: time of the signatures; None: by this machine's clock.

    Raises:
        InputError: for a folder that exists, a threshold above the number of keys, or a key given twice.
    """
    from tuf.api.metadata import Metadata, Root, Snapshot, Targets, Timestamp

    if out.exists():
        raise InputError(f"{out}: exists already; a repository is a new folder")
    owned = [read_private_key(path) for path in own]
    check_distinct([key.public for key in owned], f"the keys of the {party}")
    count = len(owned) or keys
    if not 1 <= threshold <= count <= MOST_KEYS:
        raise InputError(f"{threshold} of {count} signatures: at least 1 of at most {MOST_KEYS} keys is wanted")
    owned = owned or [generate_key(out / "keys" / f"{number}.pem") for number in range(1, count + 1)]
    online = generate_key(out / "keys" / f"{ONLINE}.pem")
    at = now or datetime.now(UTC)
    root = Root(expires=expiry_of("root", at), consistent_snapshot=True, unrecognized_fields={PARTY: party})
    for role in ("root", "targets"):
        for key in owned:
            root.add_key(key.signer().public_key, role)
        root.roles[role].threshold = threshold
    for role in ("snapshot", "timestamp"):
        root.add_key(online.signer().public_key, role)
    signed = Metadata(root)
    targets = Metadata(Targets(expires=expiry_of("targets", at)))
    for key in owned[:threshold]:
        signed.sign(key.signer(), append=True)
        targets.sign(key.signer(), append=True)
    metadata = out / "repository" / "metadata"
    write_metadata(signed, metadata / "1.root.json")
    write_metadata(targets, metadata / "1.targets.json")
    (out / "repository" / "targets").mkdir()
    snapshot, timestamp = Metadata(Snapshot(expires=expiry_of("snapshot", at))), Metadata(Timestamp())
    sign_online(metadata, snapshot, timestamp, online, at, targets_version=1, first=True)
    return tuple(key.public for key in owned)


def replace_online_key(out: Path, keys: Sequence[Path], now: datetime | None = None) -> None:
    """Replace the online key by a new root, signed by the party's keys, and sign snapshot and timestamp anew.

    What a thief of the old key signed is worth nothing from then on, high version numbers included. Raises `InputError`
    for fewer keys than the root's threshold, keys of nobody, and one given twice.
    """
    at, metadata = now or datetime.now(UTC), out / "repository" / "metadata"
    owned, party = [read_private_key(path) for path in keys], read_party(out)
    check_distinct([key.public for key in owned], f"the keys of the {party}")
    signed = load_root(out)
    root: Root = signed.signed
    lost = root.roles["timestamp"].keyids[0]
    (out / "keys" / f"{ONLINE}.pem").unlink(missing_ok=True)
    online = generate_key(out / "keys" / f"{ONLINE}.pem")
    for role in ("snapshot", "timestamp"):
        root.revoke_key(lost, role)
        root.add_key(online.signer().public_key, role)
    root.version, root.expires = root.version + 1, expiry_of("root", at)
    signed.signatures.clear()
    for key in owned:
        signed.sign(key.signer(), append=True)
    if (
        len(root.get_verification_result("root", signed.signed_bytes, signed.signatures).signed)
        < root.roles["root"].threshold
    ):
        raise InputError(f"{out}: fewer signatures of the {party} than its root wants")
    version = latest_version(metadata, "targets")
    write_metadata(signed, metadata / f"{root.version}.root.json")
    timestamp: Metadata[Timestamp] = load_metadata(metadata / "timestamp.json")
    snapshot: Metadata[Snapshot] = load_metadata(metadata / f"{timestamp.signed.snapshot_meta.version}.snapshot.json")
    sign_online(metadata, snapshot, timestamp, online, at, version)
