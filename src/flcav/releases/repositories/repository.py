"""A party's repository of The Update Framework: its creation, and a stage for signatures that come one after another.

The provider's is Uptane's image repository: it names every release. The customer's is Uptane's director repository: it
names the release that its vehicles are to run, with a `Directive`. Both have roots of their own.

OUT/keys/{1..m,online}.pem    private keys, to be given to their owners
OUT/repository/metadata/      what vehicles fetch
OUT/repository/targets/       weights and descriptions of releases
OUT/staged/targets.json       the next targets metadata, while it lacks signatures
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
    """Targets metadata on its way: how many of the wanted signatures it has."""

    version: int
    signatures: int
    threshold: int

    @property
    def complete(self) -> bool:
        """Return whether it has as many signatures as its threshold wants."""
        return self.signatures >= self.threshold


def stage_release(
    out: Path, folder: Path, keys: Sequence[Path], directive: Directive | None = None, now: datetime | None = None
) -> StagedTargets:
    """Add a candidate to the party's next targets metadata and sign it; the provider keeps its files, too.

    Args:
        out: the party's folder.
        folder: the candidate.
        keys: private keys of the party (PEM files) that sign now; others may follow.
        directive: the customer's; None in the provider's repository.
        now: time of the signatures; None: by this machine's clock.

    Raises:
        InputError: for a stranger's key or one given twice, a number that does not rise, and a clock that is off.
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
    for name, file in files.items() if directive is None else ():  # vehicles download from the provider
        kept = out / "repository" / "targets" / name
        kept = kept.with_name(f"{file.hashes['sha256']}.{kept.name}")
        kept.parent.mkdir(parents=True, exist_ok=True)
        if not kept.exists():
            write_bytes(kept, (folder / name.rpartition("/")[2]).read_bytes())
    return _stage(out, files, candidate.task, directive is not None, keys, now or datetime.now(UTC))


def stage_directive(
    out: Path, task: str, directive: Directive, keys: Sequence[Path], now: datetime | None = None
) -> StagedTargets:
    """Change the customer's directive on the release that its repository names already, and sign the change.

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
    """Make the staged targets metadata the repository's current one; return its version.

    Without a staged one, snapshot and timestamp are renewed. Raises `InputError` where signatures are missing.
    """
    from tuf.api.metadata import Metadata

    at = now or datetime.now(UTC)
    metadata, staged = out / "repository" / "metadata", _staged_path(out)
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
    """Return the state of the staged targets metadata; None without one."""
    return _count(out, load_metadata(_staged_path(out))) if _staged_path(out).is_file() else None


def _stage(
    out: Path,
    files: Mapping[str, "TargetFile"],
    task: str,
    alone: bool,
    keys: Sequence[Path],
    at: datetime,
) -> StagedTargets:
    """Sign the next targets metadata with `files`; of the customer's, the task's other releases leave (`alone`)."""
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
    """Raise `InputError` for a number that does not rise, and for earlier weights that are no roll-back to them.

    Nor is a roll-back to other weights than those of the release that it names; the provider's repository knows them.
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
    """Raise `InputError` where the clock is behind the repository's latest signatures."""
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
