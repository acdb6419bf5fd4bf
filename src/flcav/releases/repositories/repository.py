"""A party's repository of The Update Framework: creation, and staging of metadata until it has enough signatures.

The provider's is Uptane's image repository, which lists every release. The customer's is Uptane's director repository,
which names the release for its vehicles, with a `Directive`. They have separate roots.

OUT/keys/{1..m,online}.pem    private keys, for their owners
OUT/repository/metadata/      metadata that vehicles fetch
OUT/repository/targets/       weights and descriptions of releases
OUT/staged/targets.json       the next targets metadata, until it has enough signatures
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from flcav.config import InputError
from flcav.releases.candidate import Candidate, check_bundle, check_files, read_candidate
from flcav.releases.keys import PublicKey, check_distinct, generate_key, read_private_key
from flcav.releases.repositories.metadata import (
    DIRECTIVE,
    LIFETIME,
    PARTY,
    Directive,
    Party,
    expiry_of,
    latest_version,
    list_releases,
    load_metadata,
    load_root,
    load_targets,
    read_party,
    root_keys,
    sign_online,
    target_names,
    write_metadata,
)
from flcav.storage.files import write_bytes

if TYPE_CHECKING:
    from tuf.api.metadata import Metadata, Root, Snapshot, TargetFile, Targets, Timestamp


@dataclass(frozen=True)
class StagedTargets:
    """The state of staged targets metadata: its signatures and their threshold."""

    version: int
    signatures: int
    threshold: int

    @property
    def complete(self) -> bool:
        """Return whether the signatures reach the threshold."""
        return self.signatures >= self.threshold


def stage_release(
    out: Path, folder: Path, keys: Sequence[Path], directive: Directive | None = None, now: datetime | None = None
) -> StagedTargets:
    """Add a candidate to the party's next targets metadata and sign it; the provider's repository gets its files, too.

    Args:
        out: the party's folder.
        folder: the candidate.
        keys: private keys of the party (PEM files) that sign now; others may follow.
        directive: of the customer; None in the provider's repository.
        now: time of the signatures; None: this machine's clock.

    Raises:
        InputError: for an unknown key or one given twice, a number that is not above the last, and a wrong clock.
    """
    from tuf.api.metadata import TargetFile

    candidate = read_candidate(folder)
    check_files(folder, candidate)
    check_bundle(folder)
    party = read_party(out)
    if (directive is None) != (party == "provider"):
        raise InputError(f"{out}: the customer's repository has a directive, and the provider's has none")
    names = target_names(candidate.task, candidate.release)
    files = {name: TargetFile.from_file(name, str(folder / name.rpartition("/")[2]), ["sha256"]) for name in names}
    if directive is not None:
        files[names[0]].unrecognized_fields["custom"] = {DIRECTIVE: directive.model_dump(mode="json")}
    _check_rising(out, candidate, files, party)
    for name, file in files.items() if directive is None else ():  # vehicles download from the provider's repository
        kept = out / "repository" / "targets" / name
        kept = kept.with_name(f"{file.hashes['sha256']}.{kept.name}")
        kept.parent.mkdir(parents=True, exist_ok=True)
        if not kept.exists():
            write_bytes(kept, (folder / name.rpartition("/")[2]).read_bytes())
    return _stage(out, files, candidate.task, directive is not None, keys, now or datetime.now(UTC))


def stage_directive(
    out: Path, task: str, directive: Directive, keys: Sequence[Path], now: datetime | None = None
) -> StagedTargets:
    """Sign a change of the customer's directive on a release that its repository already names.

    Raises `InputError` as `stage_release`, and where the repository names no such release.
    """
    from tuf.api.metadata import TargetFile

    targets = load_targets(out).signed.targets
    names = target_names(task, directive.release)
    if missing := [name for name in names if name not in targets]:
        raise InputError(f"{out}: names no release {directive.release} of {task} ({missing[0]})")
    files = {name: TargetFile.from_dict(targets[name].to_dict(), name) for name in names}
    files[names[0]].unrecognized_fields["custom"] = {DIRECTIVE: directive.model_dump(mode="json")}
    return _stage(out, files, task, True, keys, now or datetime.now(UTC))


def publish(out: Path, now: datetime | None = None) -> int:
    """Make the staged targets metadata current; return its version.

    Without staged metadata, snapshot and timestamp are renewed. Raises `InputError` where signatures are missing.
    """
    from tuf.api.metadata import Metadata

    at = now or datetime.now(UTC)
    metadata = out / "repository" / "metadata"
    staged = _staged_path(out)
    _check_clock(out, at)
    version = load_targets(out).signed.version
    online = read_private_key(key := out / "keys" / f"{ONLINE}.pem")
    if online.public not in root_keys(load_root(out).signed, "timestamp"):
        raise InputError(f"{key}: is not the online key, by the root of {out}")
    if staged.is_file():
        targets = load_metadata(staged)
        state = _count(out, targets)
        if not state.complete:
            raise InputError(f"{out}: {state.signatures} of {state.threshold} signatures of the {read_party(out)}")
        version = targets.signed.version
        write_metadata(targets, metadata / f"{version}.targets.json")
    timestamp: Metadata[Timestamp] = load_metadata(metadata / "timestamp.json")
    snapshot: Metadata[Snapshot] = load_metadata(metadata / f"{timestamp.signed.snapshot_meta.version}.snapshot.json")
    sign_online(metadata, snapshot, timestamp, online, at, version)
    staged.unlink(missing_ok=True)
    return version


def read_staged(out: Path) -> StagedTargets | None:
    """Return the state of the staged targets metadata; None if there is none."""
    return _count(out, load_metadata(_staged_path(out))) if _staged_path(out).is_file() else None


def _stage(
    out: Path,
    files: Mapping[str, "TargetFile"],
    task: str,
    alone: bool,
    keys: Sequence[Path],
    at: datetime,
) -> StagedTargets:
    """Sign the next targets metadata with `files`; `alone` (customer) removes the task's other releases."""
    _check_clock(out, at)
    owned = [read_private_key(path) for path in keys]
    party = read_party(out)
    check_distinct([key.public for key in owned], f"the keys of the {party}")
    known = root_keys(load_root(out).signed)
    if strangers := [path for path, key in zip(keys, owned, strict=True) if key.public not in known]:
        raise InputError(f"{strangers[0]}: is no key of the {party}, by the root of {out}")
    current = load_targets(out)
    wanted = {
        name: file for name, file in current.signed.targets.items() if not (alone and name.startswith(f"{task}/"))
    }
    wanted |= files
    path = _staged_path(out)
    staged = load_metadata(path) if path.is_file() else None
    if staged is None or staged.signed.version <= current.signed.version or staged.signed.targets != wanted:
        staged = current
        staged.signed.targets = dict(wanted)
        staged.signed.version += 1
        staged.signed.expires = expiry_of("targets", at)
        staged.signatures.clear()
    for key in owned:
        staged.sign(key.signer(), append=True)
    write_metadata(staged, path)
    return _count(out, staged)


def _check_rising(out: Path, candidate: Candidate, files: Mapping[str, "TargetFile"], party: Party) -> None:
    """Raise `InputError` for a number that is not above the last, and for earlier weights without a roll-back.

    A roll-back must also have the weights of the release that it names, which the provider's repository checks.
    """
    known = load_targets(out).signed.targets
    if all(name in known and known[name].hashes == file.hashes for name, file in files.items()):
        return
    releases = list_releases(known, candidate.task)
    if releases and candidate.release <= releases[-1]:
        raise InputError(
            f"{out}: release {candidate.release} of {candidate.task} does not rise above {releases[-1]}, which it names"
        )
    back = candidate.rolls_back
    if back is not None and releases and party == "provider":
        earlier = known.get(target_names(candidate.task, back)[0])
        if earlier is None or earlier.hashes.get("sha256") != candidate.weights:
            raise InputError(f"{out}: release {candidate.release} rolls back to {back}, which has not its weights here")
    for number in releases:
        weights = known[target_names(candidate.task, number)[0]]
        if weights.hashes.get("sha256") == candidate.weights and back is None:
            raise InputError(
                f"{out}: release {candidate.release} has the weights of release {number}; a roll-back says so "
                "(`flcav release rollback`)"
            )


def _check_clock(out: Path, at: datetime) -> None:
    """Raise `InputError` where the clock is earlier than the repository's latest signatures."""
    timestamp = load_metadata(out / "repository" / "metadata" / "timestamp.json")
    made = timestamp.signed.expires - LIFETIME["timestamp"]
    if at < made - timedelta(minutes=5):
        raise InputError(
            f"the clock is off: it says {at:%Y-%m-%d %H:%M} UTC, before the signatures of {made:%Y-%m-%d %H:%M}"
        )


def _count(out: Path, targets: "Metadata[Targets]") -> StagedTargets:
    root = load_root(out).signed
    result = root.get_verification_result("targets", targets.signed_bytes, targets.signatures)
    return StagedTargets(targets.signed.version, len(result.signed), root.roles["targets"].threshold)


def _staged_path(out: Path) -> Path:
    return out / "staged" / "targets.json"


ONLINE = "online"
MOST_KEYS = 16


def create_repository(
    out: Path, party: Party, keys: int = 3, threshold: int = 2, own: Sequence[Path] = (), now: datetime | None = None
) -> tuple[PublicKey, ...]:
    """Create a party's keys and empty repository at `out`; return the public keys.

    Args:
        out: the folder, which may not exist yet.
        party: its owner.
        keys: number m of generated keys, unless `own` are given.
        threshold: number n of signatures that root and targets need.
        own: private keys of the party (PEM files).
        now: time of the signatures; None: this machine's clock.

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
    """Replace the online key by a new root, signed with the party's keys, and sign snapshot and timestamp again.

    Metadata signed with a stolen old key are invalid from then on, whatever their version numbers. Raises `InputError`
    for fewer keys than the root's threshold, unknown keys, and one given twice.
    """
    at = now or datetime.now(UTC)
    metadata = out / "repository" / "metadata"
    owned = [read_private_key(path) for path in keys]
    party = read_party(out)
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
    # a thief may have signed a snapshot of old targets: the latest file counts
    version = latest_version(metadata, "targets")
    write_metadata(signed, metadata / f"{root.version}.root.json")
    timestamp: Metadata[Timestamp] = load_metadata(metadata / "timestamp.json")
    snapshot: Metadata[Snapshot] = load_metadata(metadata / f"{timestamp.signed.snapshot_meta.version}.snapshot.json")
    sign_online(metadata, snapshot, timestamp, online, at, version)
