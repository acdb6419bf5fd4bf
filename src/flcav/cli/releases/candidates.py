"""`flcav release propose` and `verify`: a candidate, and its tests beside the network that drives."""

from pathlib import Path

import typer

from flcav.cli.options import check_finite, parse_axes
from flcav.cli.releases.options import AS_JSON, CANDIDATE, DRIVING, NUMBER, TASK, draw_page
from flcav.cli.terminal import echo, only_writer_of, print_json, when_interrupted
from flcav.interface.wording import plural


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
    draw_page(candidate, [])
    if as_json:
        print_json(found.as_json())
    else:
        echo("\n".join(found.lines()))
    if not found.accepted:
        raise typer.Exit(1)
