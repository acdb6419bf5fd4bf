"""Atomic installation of a release in a vehicle, safe against power failure at any time.

FOLDER/metadata/{image,director}/     trusted metadata
FOLDER/incoming/                      files being downloaded
FOLDER/networks/HASH.safetensors      weights by their hash
FOLDER/current.json                   the driving network; replaced last, by a rename
"""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from flcav.config import InputError, read_json
from flcav.releases.candidate import hash_card
from flcav.releases.checking import (
    Approved,
    CheckedRelease,
    ReleaseRefused,
    RepositorySources,
    check_release,
    refuse_release,
)
from flcav.storage.files import atomic_path, sha256, write_json
from flcav.storage.records import Record, from_json

CURRENT = "current.json"


@dataclass(frozen=True)
class Installed(Record):
    """The driving network of a vehicle."""

    task: str
    release: int
    weights: str  # SHA-256


def read_installed(folder: Path) -> Installed | None:
    """Return the driving network; None before the first. Raises `ReleaseRefused` where its file has changed.

    A vehicle calls it when it starts, so that weights modified on its disk are not loaded.
    """
    path = folder / CURRENT
    if not path.is_file():
        return None
    installed = from_json(Installed, read_json(path), str(path))
    weights = weights_path(folder, installed)
    if not weights.is_file() or sha256(weights) != installed.weights:
        raise ReleaseRefused(f"{weights}: is not the network that was installed")
    return installed


def weights_path(folder: Path, installed: Installed) -> Path:
    """Return the file of an installed network's weights."""
    return folder / "networks" / f"{installed.weights}.safetensors"


@dataclass(frozen=True)
class Fetched:
    """The result of a fetch: the driving network, and a newer one."""

    driving: Installed | None
    newer: Approved | None  # will replace it; its verified weights are in the vehicle's folder


def update_vehicle(
    folder: Path, vehicle: str, sources: RepositorySources, task: str = "objects", now: datetime | None = None
) -> Installed | None:
    """Install the release of a task that both parties sign for `vehicle`; return the driving network.

    Without a newer one it is unchanged. now: the vehicle's clock. Raises `ReleaseRefused` as `fetch_release`.
    """
    found = fetch_release(folder, vehicle, sources, task, now)
    return found.driving if found.newer is None else install_release(folder, found.newer)


def fetch_release(
    folder: Path, vehicle: str, sources: RepositorySources, task: str = "objects", now: datetime | None = None
) -> Fetched:
    """Fetch and verify the release of a task that both parties sign for `vehicle`, without installing it.

    now: the vehicle's clock. Raises `ReleaseRefused` for anything that both parties did not sign, a number that is not
    above the installed one, and a wrong clock.
    """
    driving = read_installed(folder)
    checked = check_release(folder, vehicle, sources, task, now)
    approved = checked.approved
    if approved is None or driving == Installed(task, approved.release, approved.weights):
        return Fetched(driving, None)
    if driving is not None and driving.task == task and approved.release <= driving.release:
        raise ReleaseRefused(
            f"release {approved.release} of {task}: does not rise above {driving.release}, which drives"
        )
    download(folder, checked, approved)
    return Fetched(driving, approved)


def download(folder: Path, checked: CheckedRelease, approved: Approved) -> None:
    """Download the weights of an approved release, unless the vehicle has them.

    Raises `ReleaseRefused` where the file is not the approved one, or its card not that of the description.
    """
    kept = weights_path(folder, Installed(approved.task, approved.release, approved.weights))
    if kept.is_file() and sha256(kept) == approved.weights:
        return
    assert checked.target is not None
    with atomic_path(kept) as temporary:
        with refuse_release(f"weights of release {approved.release}"):
            checked.updater.download_target(checked.target, str(temporary))
        if sha256(temporary) != approved.weights:
            raise ReleaseRefused(f"weights of release {approved.release}: have another SHA-256 than was approved")
        check_card(temporary, approved)


def install_release(folder: Path, approved: Approved) -> Installed:
    """Make an approved release, whose weights are in a vehicle's folder, its driving network."""
    # an atomic rename: until it, the old network drives, and from it on the new one
    installed = Installed(approved.task, approved.release, approved.weights)
    write_json(folder / CURRENT, installed.as_json())
    return installed


def check_card(weights: Path, approved: Approved) -> None:
    """Raise `ReleaseRefused` where the card in the weights is not the acknowledged one."""
    try:
        known = hash_card(weights)
    except InputError as error:
        raise ReleaseRefused(str(error)) from None
    if known != approved.candidate.card:
        raise ReleaseRefused(f"weights of release {approved.release}: hold a card of other weights")
