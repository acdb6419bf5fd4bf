"""`flcav odd importance`: the driving score that is lost without a perception task."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flcav.cli.options import JOBS, check_finite
from flcav.cli.terminal import Answer, answer_json
from flcav.config import Json

if TYPE_CHECKING:
    from collections.abc import Mapping

    from flcav.config import Json

LEAST = 1e-3  # least weight, since weights have to be above 0


class Perceives(StrEnum):
    """Source of perception in a closed-loop drive."""

    model = "model"
    networks = "networks"
    truth = "truth"


class CouplingName(StrEnum):
    """Couplings of perception and driving, see `flcav.driving.seen`."""

    bare = "bare"
    cautious = "cautious"


PERCEPTION = typer.Option(
    Perceives.model,
    "--perception",
    help="model: the networks' measured errors; networks: sensors and networks, about real time; truth: ground truth.",
)
ERRORS = typer.Option(
    None, "--errors", help="JSON of the errors of networks, of `flcav drive --measure`; by default the package's."
)
FIRST_SEED = typer.Option(1, "--first-seed", min=0, help="The first seed.")
LASTS = typer.Option(12.0, "--lasts", min=1.0, max=600.0, callback=check_finite, help="Length of a drive [s].")


@answer_json
def importance(
    scenarios: int = typer.Option(20, "--scenarios", min=1, max=32, help="How many scenarios, of all towns in turn."),
    seeds: int = typer.Option(3, "--seeds", min=1, max=100, help="Seeds of each."),
    first_seed: int = FIRST_SEED,
    perception: Perceives = PERCEPTION,
    errors: Path | None = ERRORS,
    lasts: float = LASTS,
    coupling: CouplingName | None = typer.Option(
        None, "--coupling", help="Whose weights --weigh writes: bare, the default, or cautious."
    ),
    weigh: Path | None = typer.Option(
        None, "--weigh", help="An allocation problem or a run recipe (YAML): --out gets it with these weights."
    ),
    out: Path | None = typer.Option(None, "--out", help="YAML file to write; needs --weigh."),
    keep: Path | None = typer.Option(
        None, "--keep", help="File of the drives that are done: the same command goes on after a stop."
    ),
    jobs: int = JOBS,
) -> Answer:
    """Leave each task of perception out of closed-loop drives, and weigh it by the driving score that is lost.

    Drives are paired over scenarios and seeds. Beside it: the article's own rule, the loss of the joint objective.
    """
    from flcav.config import InputError, read_yaml
    from flcav.driving.jobs import Sensed
    from flcav.driving.scenarios import spread_scenarios
    from flcav.driving.studies.importance import measure_importance, read_reached
    from flcav.interface.progress import show_progress
    from flcav.storage.files import check_writable

    if weigh is None and coupling is not None:
        raise InputError("--coupling: says whose weights --weigh writes, and there is no --weigh")
    if (weigh is None) != (out is None):
        raise InputError("--weigh and --out: the file to read and the one to write go together")
    document = None if weigh is None else read_yaml(weigh)
    if weigh is not None and document is not None:
        set_weights(document, {}, str(weigh))
    if out is not None:
        check_writable(out.parent)
    sensed = Sensed(perception.value, read_model(perception, errors))
    with show_progress("importance") as report:
        chosen, numbers = spread_scenarios(scenarios), range(first_seed, first_seed + seeds)
        found = measure_importance(
            chosen, numbers, sensed, read_reached(), lasts_s=lasts, processes=jobs, progress=report, kept=keep
        )
    if weigh is not None and out is not None:
        import yaml

        from flcav.storage.files import write_bytes

        weights = {task.task: max(task.weight, LEAST) for task in found.tasks[coupling or CouplingName.bare]}
        write_bytes(out, yaml.safe_dump(set_weights(document, weights, str(weigh)), sort_keys=False).encode())
    yield found.as_json()
    yield "\n".join(found.lines())


def read_model(perception: Perceives, errors: Path | None):
    """Return the error model of modelled perception, None for others; raises `InputError` for a file that is none."""
    from flcav.config import InputError
    from flcav.driving.errors import load_error_model

    if perception != Perceives.model:
        if errors is not None:
            raise InputError(f"--errors: of no use with --perception {perception.value}")
        return None
    return load_error_model(errors)


def set_weights(document: object, weights: "Mapping[str, float]", origin: str) -> "Json":
    """Return an allocation problem or run recipe with the weights of its tasks replaced; tasks not given keep theirs.

    Raises `InputError` where the document has no tasks in either form.
    """
    from flcav.config import InputError

    tasks = document.get("tasks") if isinstance(document, dict) else None
    if not isinstance(document, dict) or not isinstance(tasks, list | dict) or not tasks:
        raise InputError(f"{origin}: has no tasks; --weigh takes an allocation problem or a run recipe")
    if isinstance(tasks, dict):
        weighted = {name: {**(task or {}), **_weight(weights, str(name))} for name, task in tasks.items()}
        return {**document, "tasks": weighted}
    if not all(isinstance(task, dict) and "name" in task for task in tasks):
        raise InputError(f"{origin}: a task has no name")
    return {**document, "tasks": [{**task, **_weight(weights, str(task["name"]))} for task in tasks]}


def _weight(weights: "Mapping[str, float]", name: str) -> dict[str, float]:
    return {"weight": round(weights[name], 4)} if name in weights else {}
