"""`flcav release propose` and `verify`: a candidate, and its comparison with the driving network."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import check_finite, parse_axes
from flcav.cli.terminal import Answer, answer_json, echo, only_writer_of, when_interrupted
from flcav.interface.wording import plural

if TYPE_CHECKING:
    from flcav.releases.candidate import Candidate
    from flcav.releases.repositories.repository import StagedTargets

CANDIDATE = typer.Argument(metavar="CANDIDATE", help="Folder of the candidate.")
DRIVING = typer.Option(..., "--driving", help="Weights of the network that drives (safetensors).")
NUMBER = typer.Option(..., "--release", min=1, max=10**9, help="Number of the release; it rises, roll-backs included.")
KEYS = typer.Option(..., "--key", help="Private key of the party (PEM); several of different owners may sign at once.")
REVOKE = typer.Option([], "--revoke", help="Vehicle that installs nothing any more; may be repeated.")
TASK = typer.Option("objects", "--task", help="Perception task of the network.")
AS_JSON = typer.Option(False, "--json", help="Print one JSON object.")


def describe_candidate(folder: Path) -> "Candidate":
    """Return the description of a candidate, after a check of its files against it."""
    from flcav.releases.candidate import check_files, read_candidate

    described = read_candidate(folder)
    check_files(folder, described)
    return described


def tell_signatures(repository: Path, state: "StagedTargets") -> None:
    """Print the number of signatures of a party's next metadata."""
    more = "publish it" if state.complete else "another owner's is missing"
    echo(
        f"{repository}: {state.signatures} of {plural(state.threshold, 'signature')} of version {state.version}; {more}"
    )


def draw_page(folder: Path, repositories: list[Path]) -> None:
    """Draw the candidate's page with the signatures of the repositories' parties."""
    from flcav.releases.candidate import REPORT, read_candidate, write_candidate_page
    from flcav.releases.repositories.status import read_acknowledgements
    from flcav.releases.verification.verify import read_verification
    from flcav.report.pages.release_page import release_page
    from flcav.storage.files import sha256

    files = [path for path in sorted(folder.iterdir()) if path.is_file() and path.name != REPORT]
    hashes = {path.name: sha256(path) for path in files}
    signed = read_acknowledgements(folder, repositories)
    write_candidate_page(folder, release_page(read_candidate(folder), read_verification(folder), hashes, signed))


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
    from flcav.releases.proposal import propose as make_candidate

    made = make_candidate(
        out, weights, driving, number, changes, audience, task=task, data=data, recipe=recipe, ledger=ledger
    )
    known = plural(len(made.data), "dataset")
    echo(f"{out}: release {made.release} of {made.task}, weights {made.weights[:16]}, {known}")


@when_interrupted()
@only_writer_of("candidate")
@answer_json
def verify(
    candidate: Path = CANDIDATE,
    driving: Path = DRIVING,
    data: list[Path] = typer.Option(
        ..., "--data", help="Dataset of scenes that no network was trained on; repeatable."
    ),
    margin: float = typer.Option(
        0.05, "--margin", min=1e-4, max=0.5, callback=check_finite, help="By which AP50 may be lower on the whole."
    ),
    frames: int | None = typer.Option(None, "--frames", min=1, help="Most frames of each dataset; by default all."),
    odd: str = typer.Option(
        "urban", "--odd", help="Operational design domain, by name or as an OpenODD file: how much of it is tested."
    ),
    by: str = typer.Option(
        "junction,visibility", "--by", metavar="X,Y", help="Two attributes of the domain, whose cells are slices."
    ),
    jobs: int = typer.Option(2, "--jobs", min=1, help="Processes, of one thread each."),
) -> Answer:
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
    draw_page(candidate, [])
    yield found.as_json()
    yield from found.lines()
    if not found.accepted:
        raise typer.Exit(1)
