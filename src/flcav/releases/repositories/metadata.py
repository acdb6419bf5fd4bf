"""Metadata of a party's repository: reads, writes and online signatures of The Update Framework's roles.

Root and targets are signed by n of the party's m keys, snapshot and timestamp by its online key (TUF specification
1.0.34, sections 4 and 6). The customer's targets contain a `Directive` on which vehicles install a release, as those of
Uptane's director repository.
"""

import hashlib
from collections.abc import Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from flcav.config import Config, InputError, check_is_file
from flcav.releases.candidate import CANDIDATE, WEIGHTS, Candidate, parse_candidate
from flcav.releases.keys import PrivateKey, PublicKey, check_distinct, parse_public_key
from flcav.storage.files import write_bytes

if TYPE_CHECKING:
    from tuf.api.metadata import Metadata, Root, Snapshot, TargetFile, Targets, Timestamp

WHOLE = 2**64
MILLION = 1_000_000
Name = Annotated[str, Field(min_length=1, max_length=200)]  # of a vehicle


class Directive(Config):
    """The director's instruction on one release, signed as part of its targets metadata."""

    document: ClassVar[str | None] = None

    release: int = Field(ge=1, le=10**9)
    share_ppm: int = Field(ge=0, le=MILLION)  # share of the fleet in millionths: canonical JSON has no fractions
    vehicles: tuple[Name, ...] = Field(default=(), max_length=100_000)  # that install it besides
    revoked: tuple[Name, ...] = Field(default=(), max_length=100_000)  # that install nothing

    @property
    def share(self) -> float:
        """Return the share of the fleet that installs the release, in [0, 1], chosen by hashes of names."""
        return self.share_ppm / MILLION


def place_in_queue(vehicle: str, task: str, release: int) -> float:
    """Return a vehicle's place in the queue for a release, in [0, 1): a uniform, deterministic hash."""
    digest = hashlib.sha256(f"{task}/{release}/{vehicle}".encode()).digest()
    return int.from_bytes(digest[:8], "big") / WHOLE


def is_assigned(vehicle: str, task: str, directive: Directive) -> bool:
    """Return whether a vehicle installs the release: by name, or if its place is below the share; never if revoked.

    A larger share includes the vehicles of a smaller one.
    """
    if vehicle in directive.revoked:
        return False
    return vehicle in directive.vehicles or place_in_queue(vehicle, task, directive.release) < directive.share


Party = Literal["provider", "customer"]
LIFETIME = {  # of metadata, from the signature
    "root": timedelta(days=365),
    "targets": timedelta(days=90),
    "snapshot": timedelta(days=7),
    "timestamp": timedelta(days=1),
}
DIRECTIVE = "directive"  # key of the directive among a target's custom fields
PARTY = "flcav-party"  # key of the party's name among a root's fields


def read_root(out: Path) -> bytes:
    """Return the first root metadata of a party's repository, which vehicles are delivered with.

    Raises `InputError` where `out` is no party's repository.
    """
    path = out / "repository" / "metadata" / "1.root.json"
    if not path.is_file():
        raise InputError(f"{out}: no repository of a party, since it has no repository/metadata/1.root.json")
    return path.read_bytes()


def read_party(out: Path) -> Party:
    """Return the party that a repository belongs to; raises `InputError` if it names none."""
    party = load_root(out).signed.unrecognized_fields.get(PARTY)
    if party not in ("provider", "customer"):
        raise InputError(f"{out}: a repository of nobody: neither the provider's nor the customer's")
    return party


def load_root(out: Path) -> "Metadata[Root]":
    """Return the repository's latest root.

    Raises `InputError` where `out` is no party's repository, and for keys that `root_keys` refuses.
    """
    read_root(out)
    metadata = out / "repository" / "metadata"
    found = load_metadata(metadata / f"{latest_version(metadata, 'root')}.root.json")
    root_keys(found.signed)
    return found


def latest_version(metadata: Path, role: str) -> int:
    """Return the highest version of a role's files in a folder of metadata; 0 if there are none."""
    numbers = (path.name.partition(".")[0] for path in metadata.glob(f"*.{role}.json"))
    return max((int(number) for number in numbers if number.isdecimal()), default=0)


def load_timestamp(out: Path) -> "Metadata[Timestamp]":
    """Return the repository's timestamp."""
    return load_metadata(out / "repository" / "metadata" / "timestamp.json")


def load_snapshot(out: Path) -> "Metadata[Snapshot]":
    """Return the repository's current snapshot."""
    version = load_timestamp(out).signed.snapshot_meta.version
    return load_metadata(out / "repository" / "metadata" / f"{version}.snapshot.json")


def load_targets(out: Path) -> "Metadata[Targets]":
    """Return the repository's current targets metadata; raises `InputError` if its snapshot names none."""
    named = load_snapshot(out).signed.meta.get("targets.json")
    if named is None:
        raise InputError(f"{out}: its snapshot names no targets")
    return load_metadata(out / "repository" / "metadata" / f"{named.version}.targets.json")


def read_released(out: Path, task: str, release: int) -> Candidate:
    """Return the description of a release in the provider's repository; raises `InputError` if it is missing."""
    name = target_names(task, release)[1]
    target = load_targets(out).signed.targets.get(name)
    path = Path(name) if target is None else Path(name).with_name(f"{target.hashes['sha256']}.{CANDIDATE}")
    path = out / "repository" / "targets" / path
    if target is None or not path.is_file():
        raise InputError(f"{out}: has no release {release} of {task}, or is not the provider's")
    return parse_candidate(path.read_bytes(), str(path))


def read_weights(out: Path, task: str, release: int) -> str | None:
    """Return the SHA-256 of a release's weights in a party's current targets; None if they lack the release."""
    target = load_targets(out).signed.targets.get(target_names(task, release)[0])
    return None if target is None else target.hashes.get("sha256")


def load_metadata(path: Path) -> "Metadata":
    """Return the metadata in a file, with the role in its name; raises `InputError` for any other file."""
    from tuf.api.exceptions import RepositoryError
    from tuf.api.metadata import Metadata

    check_is_file(path)
    try:
        found = Metadata.from_bytes(path.read_bytes())
    except RepositoryError as error:
        raise InputError(f"{path}: no metadata of The Update Framework ({error})") from None
    if found.signed.type != (role := path.name.split(".")[-2]):
        raise InputError(f"{path}: metadata of the role {found.signed.type}, and those of {role} are wanted")
    return found


def write_metadata(metadata: "Metadata", path: Path) -> None:
    """Write metadata, atomically."""
    write_bytes(path, metadata.to_bytes())


def read_directives(targets: Mapping[str, "TargetFile"]) -> dict[str, Directive]:
    """Return the directives in a director's targets, by task; raises `InputError` if one is malformed."""
    found = {}
    for name, file in targets.items():
        task, _, rest = name.partition("/")
        custom = file.custom
        if rest.endswith(WEIGHTS) and custom is not None:
            try:
                found[task] = Directive.model_validate(custom[DIRECTIVE])
            except (ValueError, TypeError, KeyError):
                raise InputError(f"{name}: its directive is malformed") from None
    return found


def list_releases(targets: Mapping[str, "TargetFile"], task: str) -> list[int]:
    """Return the numbers of a task's releases, increasing."""
    parts = [name.split("/") for name in targets]
    return sorted({int(part[1]) for part in parts if len(part) == 3 and part[0] == task and part[1].isdecimal()})


def root_keys(root: "Root", role: str = "targets") -> list[PublicKey]:
    """Return the keys of a role in a root.

    Raises `InputError` for a key on another curve than P-256, and for a key that the root has under two names or in two
    encodings, which would count one owner's signature as two.
    """
    origin = "a root's key"
    known = {name: parse_public_key(str(key.keyval.get("public")).encode(), origin) for name, key in root.keys.items()}
    check_distinct([*known.values()], "the keys of a root")
    return [known[name] for name in root.roles[role].keyids]


def target_names(task: str, release: int) -> tuple[str, str]:
    """Return the names of a release's targets: weights and description."""
    return f"{task}/{release}/{WEIGHTS}", f"{task}/{release}/{CANDIDATE}"


def expiry_of(role: str, at: datetime) -> datetime:
    """Return the expiry of a role's metadata signed at a time."""
    return (at + LIFETIME[role]).replace(microsecond=0)


def sign_online(
    metadata: Path,
    snapshot: "Metadata[Snapshot]",
    timestamp: "Metadata[Timestamp]",
    online: PrivateKey,
    at: datetime,
    targets_version: int,
    first: bool = False,
) -> None:
    """Sign snapshot and timestamp; the timestamp is written last, so that a crash leaves the old state intact."""
    # clients start from the timestamp, so that no reader sees files that are not written yet
    snapshot.signed.meta["targets.json"].version = targets_version
    snapshot.signed.version += 0 if first else 1
    snapshot.signed.expires = expiry_of("snapshot", at)
    snapshot.sign(online.signer())
    write_metadata(snapshot, metadata / f"{snapshot.signed.version}.snapshot.json")
    timestamp.signed.snapshot_meta.version = snapshot.signed.version
    timestamp.signed.version += 0 if first else 1
    timestamp.signed.expires = expiry_of("timestamp", at)
    timestamp.sign(online.signer())
    write_metadata(timestamp, metadata / "timestamp.json")
