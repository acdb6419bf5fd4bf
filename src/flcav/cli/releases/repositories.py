"""`flcav release init`, `sign`, `publish`, `install`, `status`: the repositories of both parties, and a vehicle."""

from enum import StrEnum
from pathlib import Path

import typer

from flcav.cli.options import check_finite
from flcav.cli.releases.candidates import (
    CANDIDATE,
    KEYS,
    REVOKE,
    TASK,
    describe_candidate,
    draw_page,
    tell_signatures,
)
from flcav.cli.terminal import Answer, answer_json, echo, only_writer_of
from flcav.config import InputError, parse_config
from flcav.interface.wording import plural

IMAGE = typer.Option(..., "--image", help="The provider's repository: folder or http(s) address.")
DIRECTOR = typer.Option(..., "--director", help="The customer's repository: folder or http(s) address.")


class PartyName(StrEnum):
    """The two parties of a release."""

    provider = "provider"
    customer = "customer"


def init(
    party: PartyName = typer.Argument(metavar="PARTY", help="Whose repository: provider or customer."),
    out: Path = typer.Option(..., "--out", help="New folder of repository and keys."),
    keys: int = typer.Option(3, "--keys", min=1, max=16, help="Keys that are generated, one for each who signs."),
    threshold: int = typer.Option(2, "--threshold", min=1, max=16, help="Signatures that a release needs."),
) -> None:
    """Create a party's keys and its empty repository of The Update Framework."""
    from flcav.releases.repositories.repository import create_repository

    made = create_repository(out, party.value, keys, threshold)
    echo(f"{out}: repository of the {party.value}, {threshold} of {plural(len(made), 'key')} sign a release")
    for number, key in enumerate(made, start=1):
        echo(f"    {out / 'keys' / f'{number}.pem'}: {key.short}")


@only_writer_of("repository")
def sign(
    candidate: Path = CANDIDATE,
    repository: Path = typer.Option(..., "--repository", help="Folder of the party that signs."),
    key: list[Path] = KEYS,
    share: float = typer.Option(
        0.01,
        "--share",
        min=0,
        max=1,
        callback=check_finite,
        help="customer: share of the fleet that installs it first.",
    ),
    vehicle: list[str] = typer.Option([], "--vehicle", help="customer: vehicle that installs it besides; repeatable."),
    revoke: list[str] = REVOKE,
) -> None:
    """Acknowledge a verified candidate, and sign its place in the party's repository; `publish` makes it current."""
    from flcav.releases.candidate import acknowledge
    from flcav.releases.repositories.metadata import MILLION, Directive, read_party
    from flcav.releases.repositories.repository import stage_release
    from flcav.releases.verification.verify import read_verification

    found, party = read_verification(candidate), read_party(repository)
    if not found.accepted:
        raise InputError(f"{candidate}: was refused by its verification, so nobody signs it")
    if party == "provider" and (vehicle or revoke):
        raise InputError("--vehicle and --revoke are the customer's: the provider does not choose vehicles")
    directive = None
    if party == "customer":
        values = {
            "release": describe_candidate(candidate).release,
            "share_ppm": round(share * MILLION),
            "vehicles": vehicle,
            "revoked": revoke,
        }
        directive = parse_config(Directive, values, "the directive")
    state = stage_release(repository, candidate, key, directive)
    for private in key:
        acknowledge(candidate, private)
    draw_page(candidate, [repository])
    tell_signatures(repository, state)


@only_writer_of("repository")
def publish(repository: Path = typer.Argument(help="Folder of a party.")) -> None:
    """Make what a party has signed its repository's current state; without anything, renew its timestamp."""
    from flcav.releases.repositories.repository import publish as publish_staged

    echo(f"{repository}: version {publish_staged(repository)} of its targets is current")


@only_writer_of("folder")
def install(
    folder: Path = typer.Argument(metavar="VEHICLE", help="Folder of the vehicle."),
    name: str = typer.Option(..., "--name", help="The vehicle's name."),
    image: str = IMAGE,
    director: str = DIRECTOR,
    image_root: Path | None = typer.Option(None, "--image-root", help="First call: root.json of the provider."),
    director_root: Path | None = typer.Option(None, "--director-root", help="First call: root.json of the customer."),
    task: str = TASK,
) -> None:
    """Install in a vehicle what both repositories name with the same hash; refuse anything else."""
    from flcav.config import check_is_file
    from flcav.releases.checking import open_sources, trust_roots
    from flcav.releases.installation import update_vehicle

    if not name.isprintable() or not name:
        raise InputError("--name: a vehicle's name has letters, digits and signs")
    if (image_root is None) != (director_root is None):
        raise InputError("--image-root and --director-root: a vehicle is delivered with both")
    if image_root is not None and director_root is not None:
        for path in (image_root, director_root):
            check_is_file(path)
        trust_roots(folder, image_root.read_bytes(), director_root.read_bytes())
    driving = update_vehicle(folder, name, open_sources(image, director), task)
    echo(
        f"{name}: "
        + ("drives no network" if driving is None else f"drives release {driving.release} of {driving.task}")
    )


def equip(
    folder: Path = typer.Argument(metavar="VEHICLE", help="Folder of the vehicle, on the vehicle."),
    image_root: Path | None = typer.Option(None, "--image-root", help="1.root.json of the provider."),
    director_root: Path | None = typer.Option(None, "--director-root", help="1.root.json of the customer."),
    data: Path | None = typer.Option(None, "--data", help="Dataset of what it meets, for shadow runs."),
    drive: str | None = typer.Option(
        None, "--drive", metavar="SCENE/AGENT", help="--data: whose frames; by default the first vehicle's."
    ),
) -> None:
    """On a vehicle of a fleet: trust both parties, and follow the releases that the fleet offers."""
    from flcav.config import check_is_file
    from flcav.dataset.store import Dataset
    from flcav.releases.rollout.simulated_fleet import list_drives
    from flcav.releases.rollout.updater import RecordedDrive, equip_vehicle

    if (image_root is None) != (director_root is None):
        raise InputError("--image-root and --director-root: a vehicle is delivered with both")
    if drive is not None and data is None:
        raise InputError("--drive: is one of a dataset's, and --data is missing")
    roots = recorded = None
    if image_root is not None and director_root is not None:
        for path in (image_root, director_root):
            check_is_file(path)
        roots = image_root.read_bytes(), director_root.read_bytes()
    if data is not None:
        known = {one.name: one for one in list_drives(Dataset.open(data))}
        chosen = known.get(next(iter(known)) if drive is None else drive)
        if chosen is None:
            raise InputError(f"--drive {drive}: is not in {data}, which has {', '.join([*known][:5])}")
        recorded = RecordedDrive(str(data.resolve()), chosen.scene, chosen.agent)
    equip_vehicle(folder, roots, recorded)
    echo(f"{folder}: follows the releases of its fleet")


@answer_json
def status(
    repository: list[Path] = typer.Argument(help="Folders of parties."),
    candidate: Path | None = typer.Option(
        None, "--candidate", help="Folder of a candidate: its page is drawn anew with the signatures of these parties."
    ),
    task: str = TASK,
) -> Answer:
    """Show what repositories name: releases, the customer's directive, signatures on their way, times of expiry."""
    from flcav.releases.repositories.status import read_repository_status

    found = [read_repository_status(folder, task) for folder in repository]
    if candidate is not None:
        draw_page(candidate, repository)
    yield {"repositories": [shown.as_json() for shown in found]}
    for shown in found:
        yield "\n".join(shown.lines())
