"""`flcav release`: candidates, their verification, signatures of provider and customer, roll-out and roll-back."""

from enum import StrEnum
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import check_finite, parse_axes
from flcav.cli.terminal import only_writer_of, print_json, when_interrupted
from flcav.config import InputError
from flcav.interface.extras import format_install_command
from flcav.interface.wording import plural

if TYPE_CHECKING:
    from flcav.releases.candidates.candidate import Candidate
    from flcav.releases.repositories.repository import Staged

release = typer.Typer(
    help="Releases: verify a network, let provider and customer acknowledge it, roll it out.", no_args_is_help=True
)

CANDIDATE = typer.Argument(metavar="CANDIDATE", help="Folder of the candidate.")
DRIVING = typer.Option(..., "--driving", help="Weights of the network that drives (safetensors).")
NUMBER = typer.Option(..., "--release", min=1, max=10**9, help="Number of the release; it rises, roll-backs included.")
KEYS = typer.Option(..., "--key", help="Private key of the party (PEM); several of different owners may sign at once.")
REVOKE = typer.Option([], "--revoke", help="Vehicle that installs nothing any more; may be repeated.")
IMAGE = typer.Option(..., "--image", help="The provider's repository: folder or http(s) address.")
DIRECTOR = typer.Option(..., "--director", help="The customer's repository: folder or http(s) address.")
TASK = typer.Option("objects", "--task", help="Perception task of the network.")
AS_JSON = typer.Option(False, "--json", help="Print one JSON object.")


class PartyName(StrEnum):
    """The two parties of a release."""

    provider = "provider"
    customer = "customer"


@release.callback()
def _group() -> None:
    if missing := [name for name in ("tuf", "model_signing") if find_spec(name) is None]:
        raise InputError(f"releases need {missing[0]}, which is in: {format_install_command('releases')}")


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.add_typer(release, name="release")


@release.command()
def init(
    party: PartyName = typer.Argument(metavar="PARTY", help="Whose repository: provider or customer."),
    out: Path = typer.Option(..., "--out", help="New folder of repository and keys."),
    keys: int = typer.Option(3, "--keys", min=1, max=16, help="Keys that are generated, one for each who signs."),
    threshold: int = typer.Option(2, "--threshold", min=1, max=16, help="Signatures that a release needs."),
) -> None:
    """Create a party's keys and its empty repository of The Update Framework."""
    from flcav.releases.repositories.repository import create_repository

    made = create_repository(out, party.value, keys, threshold)
    typer.echo(f"{out}: repository of the {party.value}, {threshold} of {plural(len(made), 'key')} sign a release")
    for number, key in enumerate(made, start=1):
        typer.echo(f"    {out / 'keys' / f'{number}.pem'}: {key.short}")


@release.command()
def propose(
    weights: Path = typer.Argument(help="Weights of the network with their card (safetensors)."),
    driving: Path = DRIVING,
    number: int = NUMBER,
    changes: str = typer.Option(..., "--changes", help="What changed, in words."),
    audience: str = typer.Option("all vehicles", "--for", help="For whom, in words."),
    out: Path = typer.Option(..., "--out", help="New folder of the candidate."),
    data: list[Path] = typer.Option(
        [], "--data", help="Dataset that it was trained on, for weights of a federation, which have no card."
    ),
    recipe: Path | None = typer.Option(None, "--recipe", help="Recipe of the run that trained it."),
    ledger: Path | None = typer.Option(None, "--ledger", help="Ledger of that run (Parquet)."),
    task: str = TASK,
) -> None:
    """Make a candidate of trained weights: hashes of data, recipe and ledger, the card, and what it replaces."""
    from flcav.releases.candidates.proposal import propose as make_candidate

    made = make_candidate(
        out, weights, driving, number, changes, audience, task=task, data=data, recipe=recipe, ledger=ledger
    )
    known = plural(len(made.data), "dataset")
    typer.echo(f"{out}: release {made.release} of {made.task}, weights {made.weights[:16]}, {known}")


@release.command()
@when_interrupted()
@only_writer_of("candidate")
def verify(
    candidate: Path = CANDIDATE,
    driving: Path = DRIVING,
    data: list[Path] = typer.Option(
        ..., "--data", help="Dataset of scenes that no network was trained on; repeatable."
    ),
    margin: float = typer.Option(
        0.03, "--margin", min=1e-4, max=0.5, callback=check_finite, help="By which AP50 may be lower on the whole."
    ),
    frames: int | None = typer.Option(None, "--frames", min=1, help="Most frames of each dataset; by default all."),
    odd: str = typer.Option(
        "urban", "--odd", help="Operational design domain, by name or as an OpenODD file: how much of it is tested."
    ),
    by: str = typer.Option(
        "junction,visibility", "--by", metavar="X,Y", help="Two attributes of the domain, whose cells are slices."
    ),
    jobs: int = typer.Option(2, "--jobs", min=1, help="Processes, of one thread each."),
    as_json: bool = AS_JSON,
) -> None:
    """Verify a candidate beside the network that drives; exit 1 where it is refused, or the frames do not tell.

    Writes verification.json and report.html into the candidate's folder.
    """
    from flcav.interface.progress import show_progress
    from flcav.machine.threads import use_threads
    from flcav.releases.verification.verify import verify as verify_candidate
    from flcav.releases.verification.verify import write_verification

    use_threads(1)
    with show_progress("verify") as report:
        found = verify_candidate(
            candidate,
            driving,
            data,
            margin=margin,
            most=frames,
            odd=odd,
            by=parse_axes(by),
            jobs=jobs,
            progress=report,
        )
    write_verification(candidate, found)
    _draw_page(candidate, [])
    if as_json:
        print_json(found.as_json())
    else:
        typer.echo("\n".join(found.lines()))
    if not found.accepted:
        raise typer.Exit(1)


@release.command()
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
    from flcav.releases.candidates.acknowledgement import acknowledge
    from flcav.releases.repositories.directive import MILLION, Directive
    from flcav.releases.repositories.repository import read_party, stage_release
    from flcav.releases.verification.verify import read_verification

    found, party = read_verification(candidate), read_party(repository)
    if not found.accepted:
        raise InputError(f"{candidate}: was refused by its verification, so nobody signs it")
    if party == "provider" and (vehicle or revoke):
        raise InputError("--vehicle and --revoke are the customer's: the provider does not choose vehicles")
    directive = None
    if party == "customer":
        directive = Directive(
            release=_describe(candidate).release,
            share_ppm=round(share * MILLION),
            vehicles=tuple(vehicle),
            revoked=tuple(revoke),
        )
    state = stage_release(repository, candidate, key, directive)
    for each in key:
        acknowledge(candidate, each)
    _draw_page(candidate, [repository])
    _tell(repository, state)


@release.command()
@only_writer_of("repository")
def publish(repository: Path = typer.Argument(help="Folder of a party.")) -> None:
    """Make what a party has signed its repository's current state; without anything, renew its timestamp."""
    from flcav.releases.repositories.repository import publish as publish_staged

    typer.echo(f"{repository}: version {publish_staged(repository)} of its targets is current")


@release.command()
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
    from flcav.releases.vehicles.checking import open_sources, trust_roots
    from flcav.releases.vehicles.installation import update_vehicle

    if (image_root is None) != (director_root is None):
        raise InputError("--image-root and --director-root: a vehicle is delivered with both")
    if image_root is not None and director_root is not None:
        for path in (image_root, director_root):
            check_is_file(path)
        trust_roots(folder, image_root.read_bytes(), director_root.read_bytes())
    driving = update_vehicle(folder, name, open_sources(image, director), task)
    typer.echo(
        f"{name}: " + ("drives no network" if driving is None else f"drives release {driving.release} of {task}")
    )


@release.command()
@when_interrupted()
def shadow(
    candidate: Path = CANDIDATE,
    driving: Path = DRIVING,
    data: Path = typer.Option(..., "--data", help="Dataset of what the vehicles meet; its labels are not used."),
    out: Path = typer.Option(..., "--out", help="Folder of the reports, one per vehicle (JSON)."),
) -> None:
    """Run a candidate beside the driving network on each vehicle's frames, and report how far they disagree."""
    from flcav.dataset.store import Dataset
    from flcav.interface.progress import show_progress
    from flcav.machine.threads import use_threads
    from flcav.perception.agents import kind_of
    from flcav.perception.objects.task import OBJECTS
    from flcav.perception.weights import load_network
    from flcav.releases.candidates.candidate import WEIGHTS
    from flcav.releases.rollout.shadow import run_shadow
    from flcav.storage.files import sha256, write_json

    use_threads(1)
    opened = Dataset.open(data)
    files = (driving, candidate / WEIGHTS)
    networks = [(load_network(OBJECTS, path), sha256(path)) for path in files]
    agents = [name for name in dict.fromkeys(key.agent for key in opened.keys) if kind_of(name) == "vehicle"]
    with show_progress("shadow") as report:
        for done, name in enumerate(agents, start=1):
            found = run_shadow(name, map(opened.frame, opened.select(agents=[name])), networks[0], networks[1])
            write_json(out / f"{name}.json", found.as_json())
            report(done, len(agents), f"{name} {found.disagreement:.3f}")
            typer.echo(f"{name}: disagreement {found.disagreement:.3f} over {plural(found.frames, 'frame')}")


@release.command()
@only_writer_of("repository")
def rollout(
    repository: Path = typer.Argument(help="The customer's folder."),
    key: list[Path] = KEYS,
    shadows: Path | None = typer.Option(
        None, "--shadows", help="Folder of shadow reports: they decide on the next share, 1, 5, 20 and 100 %, or stop."
    ),
    share: float | None = typer.Option(
        None, "--share", min=0, max=1, callback=check_finite, help="Share of the fleet, without shadow reports."
    ),
    revoke: list[str] = REVOKE,
    task: str = TASK,
) -> None:
    """Widen a roll-out, or stop it: sign another share of the fleet that installs the release; `publish` follows."""
    from flcav.config import read_json
    from flcav.releases.rollout.shadow import ShadowReport, judge_shadows
    from flcav.releases.rollout.stages import change_share, next_share, read_directive

    if (shadows is None) == (share is None):
        raise InputError("either --shadows or --share: who decides on the next share of the fleet?")
    wanted, stopped = share, False
    if shadows is not None:
        paths = sorted(shadows.glob("*.json"))
        decision = judge_shadows([ShadowReport.from_json(read_json(path), str(path)) for path in paths])
        typer.echo(decision.describe())
        wanted = next_share(read_directive(repository, task).share, decision)
        stopped = decision.judgement == "stop"
    assert wanted is not None
    directive, state = change_share(repository, task, wanted, key, revoke)
    typer.echo(f"release {directive.release} of {task}: {directive.share:.0%} of the fleet")
    _tell(repository, state)
    if stopped:
        raise typer.Exit(1)


@release.command()
def deliver(
    candidate: Path = CANDIDATE,
    data: Path = typer.Option(..., "--data", help="Dataset whose traffic drives through the radio's coverage."),
    pole: list[int] = typer.Option([], "--pole", min=0, help="Pole with a roadside unit; by default all that record."),
    scene: str | None = typer.Option(None, "--scene", help="Scene of the dataset; by default its first."),
    network: Path | None = typer.Option(None, "--network", help="Settings of the network (YAML)."),
    seed: int = typer.Option(0, "--seed", min=0, help="Seed of shadowing and losses."),
    out: Path | None = typer.Option(None, "--out", help="Ledger of the delivery (Parquet)."),
    as_json: bool = AS_JSON,
) -> None:
    """Simulate who gets a release when, over the radio of a recording, and price the downlink in a ledger."""
    from dataclasses import asdict

    from flcav.config import read_config
    from flcav.dataset.store import Dataset
    from flcav.network.clock.rounds import NetworkSettings
    from flcav.network.ledger import Ledger, LinkMegabytes
    from flcav.network.radio.recorded import link_scene
    from flcav.releases.candidates.candidate import WEIGHTS
    from flcav.releases.rollout.delivery import deliver as deliver_release

    described = _describe(candidate)
    settings = NetworkSettings() if network is None else read_config(NetworkSettings, network)
    links = link_scene(Dataset.open(data), settings.radio, pole, scene, seed).links
    ledger = Ledger(LinkMegabytes(0, 0))
    size = sum((candidate / name).stat().st_size for name in (WEIGHTS, "candidate.json"))
    found = deliver_release(links, links.vehicle, described.release, size, settings, ledger, described.task)
    if out is not None:
        ledger.save(out)
    if as_json:
        print_json({"vehicles": [asdict(each) for each in found], "bytes": size})
        return
    for each in found:
        said = f"has it at {each.at_s:.2f} s" if each.at_s is not None else f"has it not: {each.reason}"
        typer.echo(f"{each.vehicle}: {said}, {plural(each.attempts, 'attempt')}, {each.bytes / 1e6:.2f} MB")
    down = {link: ledger.used_mb(link, direction="down") for link in ("wireless", "wireline")}
    typer.echo(f"downlink: {down['wireless']:.2f} MB wireless, {down['wireline']:.2f} MB wireline")


@release.command()
def rollback(
    earlier: Path = typer.Argument(metavar="CANDIDATE", help="Folder of the candidate that is to drive again."),
    driving: Path = DRIVING,
    number: int = NUMBER,
    reason: str = typer.Option(..., "--reason", help="Why, in words."),
    out: Path = typer.Option(..., "--out", help="New folder of the roll-back's candidate."),
) -> None:
    """Make a candidate of earlier weights under a number that rises; both parties sign it like any other."""
    from flcav.config import check_is_file
    from flcav.releases.rollout.stages import roll_back
    from flcav.storage.files import sha256

    check_is_file(driving)
    made = roll_back(earlier, number, reason, out, sha256(driving))
    _draw_page(out, [])
    typer.echo(f"{out}: release {made.release} of {made.task}, weights {made.weights[:16]}; sign and publish it")


@release.command()
def status(
    repository: list[Path] = typer.Argument(help="Folders of parties."),
    candidate: Path | None = typer.Option(
        None, "--candidate", help="Folder of a candidate: its page is drawn anew with the signatures of these parties."
    ),
    task: str = TASK,
    as_json: bool = AS_JSON,
) -> None:
    """Show what repositories name: releases, the customer's directive, signatures on their way, times of expiry."""
    from flcav.releases.repositories.status import read_status

    found = [read_status(folder, task) for folder in repository]
    if candidate is not None:
        _draw_page(candidate, repository)
    if as_json:
        print_json({"repositories": [each.as_json() for each in found]})
        return
    for each in found:
        typer.echo("\n".join(each.lines()))


def _describe(folder: Path) -> "Candidate":
    from flcav.releases.candidates.candidate import check_files, read_candidate

    described = read_candidate(folder)
    check_files(folder, described)
    return described


def _tell(repository: Path, state: "Staged") -> None:
    more = "publish it" if state.complete else "another owner's is missing"
    typer.echo(
        f"{repository}: {state.signatures} of {plural(state.threshold, 'signature')} of version {state.version}; {more}"
    )


def _draw_page(folder: Path, repositories: list[Path]) -> None:
    """Draw the candidate's page with the signatures of the repositories' parties."""
    from flcav.releases.candidates.candidate import REPORT, read_candidate, write_report
    from flcav.releases.repositories.status import read_acknowledgements
    from flcav.releases.verification.verify import read_verification
    from flcav.report.pages.release_page import release_page
    from flcav.storage.files import sha256

    files = [path for path in sorted(folder.iterdir()) if path.is_file() and path.name != REPORT]
    hashes = {path.name: sha256(path) for path in files}
    signed = read_acknowledgements(folder, repositories)
    write_report(folder, release_page(read_candidate(folder), read_verification(folder), hashes, signed))
