"""`flcav release shadow`, `rollout`, `deliver`, `rehearse`, `rollback`: staged roll-out of a release to a fleet."""

from pathlib import Path

import typer

from flcav.cli.network import read_radio_settings
from flcav.cli.options import check_finite
from flcav.cli.releases.candidates import (
    CANDIDATE,
    DRIVING,
    KEYS,
    NUMBER,
    REVOKE,
    TASK,
    describe_candidate,
    draw_page,
    tell_signatures,
)
from flcav.cli.terminal import Answer, answer_json, echo, only_writer_of, when_interrupted
from flcav.config import InputError
from flcav.interface.wording import plural

POLES = typer.Option([], "--pole", min=0, help="Pole with a roadside unit; by default all that record.")
NETWORK = typer.Option(None, "--network", help="Settings of the network (YAML).")
SEED = typer.Option(0, "--seed", min=0, help="Seed of shadowing and losses.")


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
    from flcav.releases.candidate import WEIGHTS
    from flcav.releases.rollout.stages import run_shadow
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
            echo(f"{name}: disagreement {found.disagreement:.3f} over {plural(found.frames, 'frame')}")


@when_interrupted()
@only_writer_of("repository")
def rollout(
    repository: Path = typer.Argument(help="The customer's folder."),
    key: list[Path] = KEYS,
    shadows: Path | None = typer.Option(
        None, "--shadows", help="Folder of shadow reports: they decide on the next share, 1, 5, 20 and 100 %, or stop."
    ),
    share: float | None = typer.Option(
        None,
        "--share",
        min=0,
        max=1,
        callback=check_finite,
        help="Share of the fleet, without shadow reports; with --fleet, to begin with.",
    ),
    revoke: list[str] = REVOKE,
    fleet: Path | None = typer.Option(
        None, "--fleet", help="Folder of a fleet that is up: its vehicles update and report, and decide on each share."
    ),
    provider: Path | None = typer.Option(None, "--provider", help="--fleet: the provider's folder."),
    data: Path | None = typer.Option(
        None, "--data", help="--fleet: dataset whose drives stand for what the vehicles on this machine meet."
    ),
    wait: float | None = typer.Option(
        None,
        "--wait",
        min=1,
        callback=check_finite,
        help="--fleet: seconds that the vehicles of a share have to report; by default 600.",
    ),
    out: Path | None = typer.Option(None, "--out", help="--fleet: ledger of the downlinks (Parquet)."),
    task: str = TASK,
) -> None:
    """Widen a roll-out, or stop it: sign another share of the fleet that installs the release; `publish` follows.

    With --fleet, the whole roll-out to a fleet that is up: every share is published, canaries first, until all vehicles
    drive the release or shadow runs stop it. Exit 1 where it is stopped, or not complete.
    """
    if fleet is None:
        given = {"--provider": provider, "--data": data, "--wait": wait, "--out": out}
        if odd := [name for name, value in given.items() if value is not None]:
            raise InputError(f"{odd[0]}: is for a roll-out to a fleet, and --fleet is missing")
        _widen(repository, key, shadows, share, revoke, task)
        return
    from flcav.interface.progress import show_progress
    from flcav.network.ledger import Ledger, LinkMegabytes
    from flcav.releases.rollout.deployed import TASK as ROLLED_OUT
    from flcav.releases.rollout.deployed import roll_out

    if provider is None or shadows is not None or revoke or task != ROLLED_OUT:
        raise InputError(f"--fleet: takes --provider, no --shadows, no --revoke, and the task {ROLLED_OUT}")
    ledger = Ledger(LinkMegabytes(0, 0))
    with show_progress("rollout") as report:
        found = roll_out(
            fleet, provider, repository, key, ledger, share=share, data=data, patience_s=wait or 600.0, progress=report
        )
    if out is not None:
        ledger.save(out)
    echo("\n".join(found.lines()))
    if found.stopped or not found.complete:
        raise typer.Exit(1)


def _widen(
    repository: Path, key: list[Path], shadows: Path | None, share: float | None, revoke: list[str], task: str
) -> None:
    from flcav.releases.repositories.metadata import read_weights
    from flcav.releases.rollout.stages import change_share, judge_shadows, next_share, read_directive, read_shadow

    if (shadows is None) == (share is None):
        raise InputError("either --shadows or --share: who decides on the next share of the fleet?")
    wanted, stopped = share, False
    if shadows is not None:
        paths = sorted(shadows.glob("*.json"))
        runs, now = [read_shadow(path) for path in paths], read_directive(repository, task)
        if any(run.candidate != read_weights(repository, task, now.release) for run in runs):
            raise InputError(f"{shadows}: has shadow runs of other weights than those of release {now.release}")
        decision = judge_shadows(runs)
        echo(decision.describe())
        wanted = next_share(now.share, decision)
        stopped = decision.judgement == "stop"
    assert wanted is not None
    directive, state = change_share(repository, task, wanted, key, revoke)
    echo(f"release {directive.release} of {task}: {directive.share:.0%} of the fleet")
    tell_signatures(repository, state)
    if stopped:
        raise typer.Exit(1)


@answer_json
def deliver(
    candidate: Path = CANDIDATE,
    data: Path = typer.Option(..., "--data", help="Dataset whose traffic drives through the radio's coverage."),
    pole: list[int] = POLES,
    scene: str | None = typer.Option(None, "--scene", help="Scene of the dataset; by default its first."),
    network: Path | None = NETWORK,
    seed: int = SEED,
    out: Path | None = typer.Option(None, "--out", help="Ledger of the delivery (Parquet)."),
) -> Answer:
    """Simulate who gets a release when, over the radio of a recording, and price the downlink in a ledger."""
    from dataclasses import asdict

    from flcav.dataset.store import Dataset
    from flcav.network.ledger import Ledger, LinkMegabytes
    from flcav.network.radio.recorded import link_scene
    from flcav.releases.candidate import WEIGHTS
    from flcav.releases.rollout.simulated_fleet import deliver_release

    described = describe_candidate(candidate)
    settings = read_radio_settings(network)
    links = link_scene(Dataset.open(data), settings.radio, pole, scene, seed).links
    ledger = Ledger(LinkMegabytes(0, 0))
    size = sum((candidate / name).stat().st_size for name in (WEIGHTS, "candidate.json"))
    found = deliver_release(links, links.vehicle, described.release, size, settings, ledger, described.task)
    if out is not None:
        ledger.save(out)
    yield {"vehicles": [asdict(delivery) for delivery in found], "bytes": size}
    for delivery in found:
        at_s = delivery.at_s
        arrival = f"has it at {at_s:.2f} s" if at_s is not None else f"has it not: {delivery.reason}"
        yield f"{delivery.vehicle}: {arrival}, {plural(delivery.attempts, 'attempt')}, {delivery.bytes / 1e6:.2f} MB"
    down = {link: ledger.used_mb(link, direction="down") for link in ("wireless", "wireline")}
    yield f"downlink: {down['wireless']:.2f} MB wireless, {down['wireline']:.2f} MB wireline"


@when_interrupted()
@answer_json
def rehearse(
    candidate: Path = CANDIDATE,
    earlier: Path = typer.Option(..., "--earlier", help="Folder of the candidate that drives now."),
    data: Path = typer.Option(..., "--data", help="Dataset whose vehicles' drives the fleet drives."),
    out: Path = typer.Option(..., "--out", help="New folder: repositories, ledger.parquet and rehearsal.json."),
    vehicles: int = typer.Option(200, "--vehicles", min=2, max=10_000, help="Vehicles of the simulated fleet."),
    pole: list[int] = POLES,
    network: Path | None = NETWORK,
    seed: int = SEED,
) -> Answer:
    """Rehearse a roll-out on a simulated fleet; exit 1 where it is stopped and rolled back, or not complete.

    Vehicles download over the radio of their drives and install as real ones do; shadow runs decide on each share.
    """
    from flcav.interface.progress import show_progress
    from flcav.machine.threads import use_threads
    from flcav.network.ledger import Ledger, LinkMegabytes
    from flcav.releases.rollout.rehearsal import rehearse as rehearse_release
    from flcav.storage.files import write_json

    use_threads(1)
    settings = read_radio_settings(network)
    ledger = Ledger(LinkMegabytes(0, 0))
    with show_progress("rehearse") as report:
        found = rehearse_release(
            candidate,
            earlier,
            data,
            out,
            ledger,
            vehicles=vehicles,
            poles=pole,
            settings=settings,
            seed=seed,
            progress=report,
        )
    ledger.save(out / "ledger.parquet")
    write_json(out / "rehearsal.json", found.as_json(), sort=False)
    yield found.as_json()
    yield from found.lines()
    if found.stopped or not found.complete:
        raise typer.Exit(1)


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
    from flcav.releases.verification.verify import read_verification
    from flcav.storage.files import sha256

    check_is_file(driving)
    read_verification(earlier)
    made = roll_back(earlier, number, reason, out, sha256(driving))
    draw_page(out, [])
    echo(f"{out}: release {made.release} of {made.task}, weights {made.weights[:16]}; sign and publish it")
