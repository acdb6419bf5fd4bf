"""Task generation: {data, labels, network} per scenario, with more tasks for complex scenarios (Wang et al., 2023).

A scenario is a kind of place in a town. Its complexity is the mean of four components in [0, 1): the occlusion of road
users, their density, the conflict points of the junction, and the density of a network's errors, if known. A scenario
has one task, and another one for each of `LEVELS` that its complexity reaches.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from flcav.config import InputError, Json, parse_config
from flcav.dataset.store import Dataset
from flcav.geometry import Array
from flcav.odd.measure import measure_domain, scenery_of
from flcav.odd.scenery import Scenery
from flcav.perception.tasks import task_named
from flcav.runs.label_sources import choose_labels
from flcav.runs.recipe import RunRecipe
from flcav.storage.records import Record
from flcav.world.map.town import PACKAGED

LEVELS = (0.2, 0.35, 0.5)  # of complexity, each of which adds a task
HALF_AGENTS, HALF_CONFLICTS, HALF_ERRORS = 15.0, 32.0, 2.0  # amounts at which a component is one half
ORDER = ("objects", "trajectory", "weather", "signs")  # tasks in the order of assignment
PLANS: Mapping[str, Mapping[str, Json]] = {  # plan of each task in a run: a history of the package, or fixed
    "objects": {"history": "objects"},
    "weather": {"history": "weather"},
    "signs": {"history": "signs"},
    "trajectory": {"plan": {"samples": 400, "edge_rounds": 3, "cloud_rounds": 2}},
}


@dataclass(frozen=True)
class Complexity(Record):
    """The complexity of a scenario: its components, all in [0, 1)."""

    occlusion: float  # mean occlusion of road users for the LiDARs
    density: float  # of moving road users within 50 m
    conflicts: float  # conflict points of the junction
    errors: float  # of a network, per frame; 0 where unknown

    @property
    def total(self) -> float:
        """Return the mean of the components."""
        return float(np.mean([getattr(self, field.name) for field in fields(self)]))


@dataclass(frozen=True)
class ScenarioTask(Record):
    """A task of a scenario: its data, labels and network."""

    data: str  # dataset folder
    labels: str  # kind of labels in stages II and III
    network: str  # name of the task's network configuration
    task: str  # name of the perception task


@dataclass(frozen=True)
class ScenarioTasks(Record):
    """A scenario with its tasks."""

    town: str
    kind: str  # of place
    frames: int
    complexity: Complexity
    tasks: tuple[ScenarioTask, ...]


def count_tasks(complexity: Complexity) -> int:
    """Return the number of tasks of a scenario: 1 + the number of `LEVELS` that its complexity reaches."""
    return 1 + sum(complexity.total >= level for level in LEVELS)


def saturate(amount: float, half: float) -> float:
    """Map an amount of at least 0 to [0, 1): amount / (amount + half)."""
    return amount / (amount + half)


def generate_tasks(folder: Path, errors: Sequence[tuple[str, float, float]] = ()) -> tuple[ScenarioTasks, ...]:
    """Return the scenarios of a recording with their tasks, the most complex first.

    `errors` are the scene and world position x, y [m] of a network's errors; those of other recordings are ignored.
    Raises `InputError` where the recording's town is unknown.
    """
    data = Dataset.open(folder)
    scenery = scenery_of(data)
    if scenery is None:
        raise InputError(f"{folder}: its town is not known, so that its scenarios are not")
    measured = measure_domain(data, scenery=scenery)
    kind, frames = measured.columns["junction"], np.array(measured.frames)
    agents = np.asarray(measured.columns["agents"], dtype=np.float64)
    hidden = _occlusion(data)
    mistaken = _count_errors(data, scenery, errors)
    places = scenery.places()
    scenarios = []
    for name in dict.fromkeys(kind.tolist()):
        at_kind = frames[kind == name]
        conflicts = [place.conflicts for place in places if place.kind == name]
        complexity = Complexity(
            float(np.nanmean(hidden[at_kind])) if not np.isnan(hidden[at_kind]).all() else 0.0,
            saturate(float(agents[kind == name].mean()), HALF_AGENTS),
            saturate(float(np.mean(conflicts)) if conflicts else 0.0, HALF_CONFLICTS),
            saturate(mistaken.get(name, 0) / len(at_kind), HALF_ERRORS),
        )
        tasks = tuple(_task(task, folder) for task in ORDER[: count_tasks(complexity)])
        scenarios.append(ScenarioTasks(scenery.town.name, name, len(at_kind), complexity, tasks))
    return tuple(sorted(scenarios, key=lambda scenario: -scenario.complexity.total))


def make_run(
    scenarios: Sequence[ScenarioTasks], towns: Mapping[str, str], pretrain: str, wireless_mb: float, wireline_mb: float
) -> dict[str, Json]:
    """Return the fields of a run recipe (`RunRecipe`) with the tasks of all scenarios.

    A task's weight in the plan, in the first layer of MLGRA's graph, is the share of the scenarios that have it.
    `towns` are the recorded towns, by region; all but `pretrain`, the town of stage I, federate under uplink budgets of
    `wireless_mb` and `wireline_mb` [MB]. Raises `InputError` where no town other than `pretrain` is recorded.
    """
    federate = {region: town for region, town in towns.items() if region != name_region(pretrain)}
    if not federate:
        raise InputError(f"--pretrain {pretrain}: no other town is recorded, and one is to federate")
    has = {name: sum(any(task.task == name for task in scenario.tasks) for scenario in scenarios) for name in ORDER}
    values: dict[str, Json] = {
        "tasks": {
            name: {**PLANS[name], "labels": choose_labels(name, None), "weight": round(has[name] / len(scenarios), 4)}
            for name in ORDER
            if has[name]
        },
        "regions": {name_region(pretrain): {"role": "pretrain", "town": pretrain}}
        | {region: {"role": "federate", "town": town} for region, town in federate.items()},
        "budgets_mb": {"wireless": wireless_mb, "wireline": wireline_mb},
    }
    parse_config(RunRecipe, values, "the run recipe")
    return values


def name_region(town: str) -> str:
    """Return the name of a town's region, with _ for characters that are no letters or digits."""
    return re.sub(r"\W", "_", Path(town).name)


def town_of(folder: Path) -> str:
    """Return the town of a recording for a recipe: the name of a town of flcav, or the folder within the recording."""
    data = Dataset.open(folder)
    name = str(data.manifest.recipe.get("town", ""))
    town = data.town()
    return name if town is None or name in PACKAGED else str(town.net.parent)


def _task(name: str, folder: Path) -> ScenarioTask:
    network = next(iter(task_named(name).configurations))
    return ScenarioTask(str(folder), choose_labels(name, None), network, name)


def _occlusion(data: Dataset) -> Array:
    """Return the mean occlusion (frames,) in [0, 1] of the road users in each frame; NaN where none is known."""
    table, frame = data.rows("annotations")
    hidden = table["occlusion"].to_numpy()
    known = ~np.isnan(hidden)
    count = np.bincount(frame[known], minlength=len(data))
    total = np.bincount(frame[known], weights=hidden[known], minlength=len(data))
    return np.divide(total, count, out=np.full(len(data), np.nan), where=count > 0)


def _count_errors(data: Dataset, scenery: Scenery, errors: Sequence[tuple[str, float, float]]) -> dict[str, int]:
    """Return the number of errors in a recording's scenes by kind of place."""
    scenes = {key.scene for key in data.keys}
    places = np.array([(x, y) for scene, x, y in errors if scene in scenes]).reshape(-1, 2)
    if not len(places):
        return {}
    kinds, counts = np.unique(scenery.measure(places, np.zeros(len(places)))["junction"], return_counts=True)
    return dict(zip(kinds.tolist(), counts.tolist(), strict=True))
