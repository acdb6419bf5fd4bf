"""Task generation: {data, labels, network} per scenario, more of them where a scenario is complex (Wang et al., 2023).

A scenario is a kind of place of one town. Its complexity is the mean of four components in [0, 1): the occlusion of
road users, their density, the conflict points of the junction, and the density of a network's errors, if that is known.
The number of tasks rises with it, and so with each component: one task, and a further one from each of `LEVELS` on.
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

LEVELS = (0.2, 0.35, 0.5)  # of complexity, from which a scenario has one more task
HALF_AGENTS, HALF_CONFLICTS, HALF_ERRORS = 15.0, 32.0, 2.0  # at which a component is one half
ORDER = ("objects", "trajectory", "weather", "signs")  # tasks in the order in which scenarios get them
PLANS: Mapping[str, Mapping[str, Json]] = {  # how a run plans each task: by a history of the package, or by hand
    "objects": {"history": "objects"},
    "weather": {"history": "weather"},
    "signs": {"history": "signs"},
    "trajectory": {"plan": {"samples": 400, "edge_rounds": 3, "cloud_rounds": 2}},
}


@dataclass(frozen=True)
class Complexity(Record):
    """The complexity of a scenario, by component, each in [0, 1)."""

    occlusion: float  # mean occlusion of road users for the LiDARs
    density: float  # of moving road users within 50 m
    conflicts: float  # conflict points of the junction
    errors: float  # of a network, per frame; 0 where they are not known

    @property
    def total(self) -> float:
        """Return the mean of the components."""
        return float(np.mean([getattr(self, field.name) for field in fields(self)]))


@dataclass(frozen=True)
class ScenarioTask(Record):
    """A task of a scenario: which data, which labels, which network."""

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
    """Return the number of tasks of a scenario: 1 + the levels that its complexity reaches."""
    return 1 + sum(complexity.total >= level for level in LEVELS)


def saturate(amount: float, half: float) -> float:
    """Return an amount of 0 or more on a scale from 0 to below 1, on which `half` is one half."""
    return amount / (amount + half)


def generate_tasks(folder: Path, errors: Sequence[tuple[str, float, float]] = ()) -> tuple[ScenarioTasks, ...]:
    """Return the scenarios of a recording with their tasks, the most complex first.

    errors: scene and x, y [m] of a network's errors; those of other recordings are left out. Raises `InputError` where
    the recording's town is not known.
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
    found = []
    for name in dict.fromkeys(kind.tolist()):
        own = frames[kind == name]
        conflicts = [place.conflicts for place in places if place.kind == name]
        complexity = Complexity(
            float(np.nanmean(hidden[own])) if not np.isnan(hidden[own]).all() else 0.0,
            saturate(float(agents[kind == name].mean()), HALF_AGENTS),
            saturate(float(np.mean(conflicts)) if conflicts else 0.0, HALF_CONFLICTS),
            saturate(mistaken.get(name, 0) / len(own), HALF_ERRORS),
        )
        tasks = tuple(_task(each, folder) for each in ORDER[: count_tasks(complexity)])
        found.append(ScenarioTasks(scenery.town.name, name, len(own), complexity, tasks))
    return tuple(sorted(found, key=lambda each: -each.complexity.total))


def make_run(
    scenarios: Sequence[ScenarioTasks], towns: Mapping[str, str], pretrain: str, wireless_mb: float, wireline_mb: float
) -> dict[str, Json]:
    """Return the fields of a run recipe of all tasks, which `RunRecipe` takes.

    A task's weight in the plan, in the first layer of MLGRA's graph, is the share of the scenarios that have it.
    `towns` are the recorded ones, which federate, by region; `pretrain` is the town of stage I. Raises `InputError`
    where no other town than that is recorded.
    """
    federate = {region: town for region, town in towns.items() if region != name_region(pretrain)}
    if not federate:
        raise InputError(f"--pretrain {pretrain}: no other town is recorded, and one is to federate")
    has = {name: sum(any(task.task == name for task in each.tasks) for each in scenarios) for name in ORDER}
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
    """Return the name of a town's region: letters, digits and _."""
    return re.sub(r"\W", "_", Path(town).name)


def town_of(folder: Path) -> str:
    """Return the town of a recording as a recipe names it: a name of flcav's, or the folder kept in the recording."""
    data = Dataset.open(folder)
    name = str(data.manifest.recipe.get("town", ""))
    town = data.town()
    return name if town is None or name in PACKAGED else str(town.net.parent)


def _task(name: str, folder: Path) -> ScenarioTask:
    network = next(iter(task_named(name).configurations))
    return ScenarioTask(str(folder), choose_labels(name, None), network, name)


def _occlusion(data: Dataset) -> Array:
    """Return the mean occlusion of the road users in each frame; NaN where there are none, or it is not known."""
    table, frame = data.rows("annotations")
    hidden = table["occlusion"].to_numpy()
    known = ~np.isnan(hidden)
    count = np.bincount(frame[known], minlength=len(data))
    total = np.bincount(frame[known], weights=hidden[known], minlength=len(data))
    return np.divide(total, count, out=np.full(len(data), np.nan), where=count > 0)


def _count_errors(data: Dataset, scenery: Scenery, errors: Sequence[tuple[str, float, float]]) -> dict[str, int]:
    """Return the number of a recording's errors at each kind of place."""
    scenes = {key.scene for key in data.keys}
    own = np.array([(x, y) for scene, x, y in errors if scene in scenes]).reshape(-1, 2)
    if not len(own):
        return {}
    kinds, counts = np.unique(scenery.measure(own, np.zeros(len(own)))["junction"], return_counts=True)
    return dict(zip(kinds.tolist(), counts.tolist(), strict=True))
