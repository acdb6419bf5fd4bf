"""Stage II of a run recipe alone: the federations of the regions' vehicles, with the steps that they depend on.

The steps are those of `flcav run`: each command continues the folder of the other, and the weights are the same. Here
every round is validated as it ends, and vehicles train in several processes.
"""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from flcav.config import InputError
from flcav.interface.progress import DAMAGED
from flcav.runs.arm_checks import check_federations
from flcav.runs.engine import Notify, Stale, Step, print_steps, run_steps
from flcav.runs.frames import Frames
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import EDGE, MAIN, RunRecipe
from flcav.runs.results.saved import WEIGHTS, Saved
from flcav.runs.results.training import PrivacySpent, ScoredRound, StageResult, Watched
from flcav.runs.rigs import tell_rigs
from flcav.runs.stages.deployment import check_clients
from flcav.runs.stages.federating import EdgeSettings, federate_step
from flcav.runs.stages.graph import Graph
from flcav.runs.stages.settings import make_step
from flcav.runs.training.checkpoints import LAST, LOSS, Checkpoint
from flcav.runs.training.private_rounds import PrivateTraining, compose_trainings, count_private_rounds
from flcav.runs.training.timing import TrainTimes, read_times, summarise_times
from flcav.storage.files import atomic_path
from flcav.storage.records import LEFT_OUT

WORK = "work"
TRAIN_TIMES = "times.json"
FEDERATE = "federate"  # in the names of the steps


@dataclass(frozen=True)
class RegionFederation:
    """The federation of a region's vehicles: its result, and the scores of its network after every round."""

    result: StageResult
    watched: tuple[Watched, ...]  # by region of the validation frames
    weights: str  # file of the weights after the last round (safetensors), in the folder of the results


@dataclass(frozen=True)
class Federations(Saved):
    """Results of stage II alone."""

    recipe: RunRecipe
    arm: str
    federations: tuple[RegionFederation, ...]
    provenance: Provenance
    privacy: Annotated[PrivacySpent | None, LEFT_OUT] = None  # all tasks together; None: no noise


def federate_regions(
    recipe: RunRecipe,
    out: Path | str,
    *,
    arm: str = MAIN,
    beside: Path | str | None = None,
    jobs: int = 2,
    runtime: str = "embedded",
    fleet: Path | None = None,
    notify: Notify = print_steps,
    stale: Stale = "refuse",
) -> Federations:
    """Run or resume stage II of a recipe's arm in the folder `out`; return its results, see `name_results`.

    Vehicles of all federating regions and tasks train where the `runtime` (one of `RUNTIMES`) says: in `jobs` processes
    of one thread each, in as many actors ("ray"), or on the vehicles of a deployed `fleet` ("flower"; None: a fleet is
    brought up for the duration). The weights do not depend on it, except for rounding on Ray. The other arguments are
    those of `flcav.run`. Raises `InputError` where a part of the recipe cannot be used or the arm does not federate,
    `ClientFailed` where fewer vehicles are left in a round than required.
    """
    out = Path(out)
    graph = Graph(recipe, Path(beside or "."))
    if arm not in graph.settings:
        raise InputError(f"--arm {arm}: the recipe has {', '.join(graph.settings)}")
    if graph.settings[arm].central:
        raise InputError(f"--arm {arm}: it trains centrally, without a federation")
    check_federations(recipe, graph.settings.values())
    check_clients(graph, [arm], runtime)
    tell_rigs([graph], notify)
    asked = list_federations(graph, arm)
    means = {"processes": jobs, "runtime": runtime, "timed": 1, "fleet": "" if fleet is None else str(fleet)}
    alone = {name: _federation_step(graph, *about, means) for name, about in asked.items()}
    before = list_needed(graph.steps, alone.values())
    run_steps(before, out / WORK, jobs=jobs, notify=notify, stale=stale)

    def tell(step: str, done: int, total: int, note: str) -> None:
        if step in alone:
            notify(step, done, total, note)

    # One federation after another: the vehicles of one use all `jobs` processes.
    run_steps([*before, *alone.values()], out / WORK, jobs=1, notify=tell, stale=stale)
    found = tuple(_collect(graph, out, name, about[1]) for name, about in asked.items())
    trained = [federation.result for federation in found]
    how = graph.settings[arm].federation
    rounds = [count_private_rounds(how, {EDGE: result}, result.region or "") for result in trained]
    about = zip(trained, rounds, strict=True)
    trainings = [PrivateTraining(result.region or "", result.clients, number, result.noise) for result, number in about]
    spent = compose_trainings(how, trainings)
    results = Federations(recipe, arm, found, provenance(recipe.seed), spent)
    results.save(out, name_results(arm))
    return results


def name_results(arm: str) -> str:
    """Return the name of the results file of an arm."""
    return "federation.json" if arm == MAIN else f"federation-{arm}.json"


def measure_times(results: Federations, out: Path) -> TrainTimes:
    """Return the training times of vehicles and their speeds in the folder `out` of `results`; writes times.json there.

    Tasks that were federated without time measurement are left out.
    """
    measured: dict[str, dict[str, list[float]]] = {}
    for federation in results.federations:
        measured.setdefault(federation.result.task, {}).update(read_times(out / WORK / Path(federation.weights).stem))
    times = summarise_times(measured)
    times.save(out, TRAIN_TIMES)
    return times


def tells_of_round(step: str, note: str) -> bool:
    """Return whether a step's note reports a federated round or a damaged checkpoint."""
    return FEDERATE in step and (note.startswith(LOSS) or DAMAGED in note)


def list_federations(graph: Graph, arm: str) -> dict[str, tuple[str, str, str]]:
    """Return the federations of an arm as (arm, region, task), by the name of the step."""
    setting = graph.settings[arm]
    named = {(region, task): f"{region}-{FEDERATE}-{task}" for task in graph.recipe.tasks for region in setting.regions}
    return {name if arm == MAIN else f"{name}-{arm}": (arm, *about) for about, name in named.items()}


def list_needed(steps: Sequence[Step], last: Iterable[Step]) -> list[Step]:
    """Return those of `steps` that the steps `last` need, directly or indirectly, in their order."""
    needs = {step.name: step.needs for step in steps}
    wanted = set()
    open_ = [name for step in last for name in step.needs]
    while open_:
        name = open_.pop()
        if name not in wanted:
            wanted.add(name)
            open_ += needs[name]
    return [step for step in steps if step.name in wanted]


def _federation_step(graph: Graph, arm: str, region: str, task: str, means: Mapping[str, int | str]) -> Step:
    """Return a run's step of stage II with validation after every round, and in several processes."""
    edge = next(step for step in graph.steps if step.name == graph.names.edge(arm, region, task))
    frames = {region_: graph.names.recording(region_, "validation", task) for region_ in graph.recipe.regions}
    name = next(name for name, about in list_federations(graph, arm).items() if about == (arm, region, task))
    asked: EdgeSettings = edge.arguments["settings"]
    scored = make_step(name, federate_step, asked.model_copy(update={"validation": frames}))
    return replace(scored, means=means)


def _collect(graph: Graph, out: Path, step: str, region: str) -> RegionFederation:
    """Return the results of a finished federation, and copy its weights into their folder."""
    folder = out / WORK / step
    result = StageResult.load(folder)
    scores = Checkpoint.read(folder, LAST).scores if result.rounds else ()
    frames = {
        name: len(Frames.open(out / WORK / graph.names.recording(name, "validation", result.task)).vehicles)
        for name in graph.recipe.regions
    }
    watched = tuple(
        Watched(
            EDGE,
            result.task,
            name,
            count,
            tuple(ScoredRound(i, score[name]) for i, score in enumerate(scores, start=1)),
        )
        for name, count in frames.items()
    )
    weights = f"{step}.safetensors"
    with atomic_path(out / weights) as temporary:
        shutil.copyfile(folder / WEIGHTS, temporary)
    return RegionFederation(result, watched, weights)
