"""Scenarios, each with a network that its tasks train: recordings, pretraining, complexity, and rounds of edge FL.

A scenario is a kind of place in one town. A task of it is a vehicle with its sweeps at such places and their ground
truth. All tasks of a scenario train its network together in rounds of edge FL (stage II), from one pretrained network.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError, Json
from flcav.dataset.store import Dataset
from flcav.experiments.study import open_split
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.trainable import Weights
from flcav.network.ledger import BYTES_PER_MB, Ledger, LinkMegabytes
from flcav.odd.measure import measure_domain
from flcav.odd.scenario_tasks import Complexity, count_tasks, generate_tasks
from flcav.perception.client import TaskClient
from flcav.perception.objects.config import pillars_config
from flcav.perception.objects.model import Second
from flcav.perception.objects.task import OBJECTS
from flcav.perception.study import RecipeFields, read_recipe
from flcav.perception.task import build_network
from flcav.perception.training.loop import train
from flcav.perception.weights import from_arrays, to_arrays
from flcav.runs.engine import Work
from flcav.runs.recipe import EDGE
from flcav.statistics.streams import derive_seed, stream
from flcav.storage.records import Record

PRETRAINED = "suburb"
SCENARIOS = (("grid", "crossroad"), ("ring", "roundabout"), ("arterial", "none"), ("arterial", "t_junction"))
TOWNS = ("grid", "ring", "arterial")
TASKS = 3 * len(SCENARIOS)  # of all scenarios together
EVEN, RULE, REVERSED = "even split", "by complexity", "by complexity, reversed"
SPLITS = (EVEN, RULE, REVERSED)


@dataclass(frozen=True)
class Size(Record):
    """Size of the study: of recordings, trainings and tests."""

    scenes: int = 10
    spins: int = 5  # per scene
    samples: int = 48  # of stage I
    pretrain_steps: int = 600
    sweeps: int = 10  # per task
    rounds: int = 3
    steps: int = 12  # per task and round
    tested: int = 60  # most frames per scenario


FULL, TOY = Size(), Size(scenes=3, spins=2, samples=4, pretrain_steps=2, sweeps=1, rounds=1, steps=1, tested=3)
RATE, FINAL_RATE = 1.0, 0.1  # multiples of the task's learning rate in the first and the last round, as in the demo


@dataclass(frozen=True)
class TriedScenario(Record):
    """A scenario in one seed: its complexity, its numbers of tasks, and its network's AP50 and uplink with them."""

    town: str
    kind: str  # of place, as in `SCENARIOS`
    complexity: Complexity
    by_rule: int  # number of tasks by the rule of `flcav.odd.scenario_tasks`
    tasks: Mapping[str, int]  # by split
    ap50: Mapping[str, float]  # by number of tasks; 0: the pretrained network
    up_mb: Mapping[str, float]  # uplink of all its tasks, by their number

    @property
    def name(self) -> str:
        """Return the name of the scenario, as "arterial, straight road"."""
        return name_scenario(self.town, self.kind)


def name_scenario(town: str, kind: str) -> str:
    """Return the town and the kind of place, as "arterial, straight road"."""
    return f"{town}, {'straight road' if kind == 'none' else kind.replace('_', '-')}"


def list_recordings(size: Size) -> Mapping[str, RecipeFields]:
    """Return the recording recipes of all towns, to train on and to test, by the names of their steps."""
    changes = {"cavs": 5, "scenes": size.scenes, "spins_per_scene": size.spins}
    whole = {**read_recipe(PRETRAINED), **changes}
    train_on = {town: {**whole, "town": town, "seed": 3501} for town in (PRETRAINED, *TOWNS)}
    test = {f"test-{town}": {**whole, "town": town, "seed": 3502, "split": "test"} for town in TOWNS}
    return train_on | test


def share_out(counts: Sequence[int], total: int) -> tuple[int, ...]:
    """Return integer shares of `total` in proportion to `counts`, at least 1 each, by Webster's method.

    Of counts with equal claims to the next unit, the first gets it.
    """
    shares = [1] * len(counts)
    for _ in range(total - len(counts)):
        quotients = [count / (2 * share + 1) for count, share in zip(counts, shares, strict=True)]
        shares[int(np.argmax(quotients))] += 1
    return tuple(shares)


def split_tasks(by_rule: Sequence[int]) -> dict[str, tuple[int, ...]]:
    """Return the number of tasks of each scenario by split; `by_rule`: from the most to the least complex scenario."""
    shares = share_out(by_rule, TASKS)
    return {EVEN: share_out([1] * len(by_rule), TASKS), RULE: shares, REVERSED: shares[::-1]}


def find_frames(data: Dataset, kind: str) -> NDArray[np.int64]:
    """Return the numbers of the frames at places of a kind."""
    measured = measure_domain(data)
    return np.array(measured.frames)[measured.columns["junction"] == kind]


def try_splits(work: Work, *, seed: int, size: Size) -> Json:
    """Pretrain, train and test each scenario's network with its tasks in every split, and save the outcomes as files.

    Return the `TriedScenario` of each scenario as JSON, in descending order of complexity.
    """
    network = pretrain(open_split(work.inputs[PRETRAINED]), seed, size)
    start = to_arrays(network)
    complexities = judge_scenarios(network, {town: work.inputs[town] for town in TOWNS})
    splits = split_tasks([count_tasks(complexity) for complexity in complexities.values()])
    tried = []
    for number, ((town, kind), complexity) in enumerate(complexities.items()):
        tasks = {split: shares[number] for split, shares in splits.items()}
        train_on, test = open_split(work.inputs[town]), open_split(work.inputs[f"test-{town}"])
        needed = max(tasks.values()) * size.sweeps
        sweeps = draw_sweeps(find_frames(train_on, kind), needed, (seed, name_scenario(town, kind)))
        frames = spread_frames(find_frames(test, kind), size.tested)
        ap50, up_mb = {}, {}
        for count in sorted({0, *tasks.values()}):
            own_sweeps = sweeps[: count * size.sweeps]
            weights, up_mb[str(count)] = train_tasks(train_on, own_sweeps, start, derive_seed(seed, town, kind), size)
            from_arrays(network, weights)
            outcomes = OBJECTS.outcomes(network, test, frames)
            outcomes.save(outcomes_file(work.folder, town, kind, count))
            ap50[str(count)] = float(OBJECTS.measure(outcomes, np.ones((1, len(frames)), np.int64))[0])
            work.report(number, len(complexities), f"{name_scenario(town, kind)}, {count} tasks")
        tried.append(TriedScenario(town, kind, complexity, count_tasks(complexity), tasks, ap50, up_mb).as_json())
    return tried


def outcomes_file(folder: Path, town: str, kind: str, tasks: int) -> Path:
    """Return the file of the outcomes of a scenario's network that a number of tasks trained."""
    return folder / f"{town}-{kind}-{tasks}.npz"


def pretrain(data: Dataset, seed: int, size: Size) -> Second:
    """Return the network after stage I on sweeps that the seed draws."""
    config = pillars_config()
    sweeps = np.sort(stream(seed, "sweeps").choice(len(data), min(size.samples, len(data)), replace=False)).tolist()
    dataset = OBJECTS.samples(data, config, sweeps)
    network = build_network(OBJECTS, config, seed)
    in_memory = [dataset[number] for number in range(len(dataset))]
    train(OBJECTS, network, in_memory, steps=size.pretrain_steps, batch=OBJECTS.practice.batch, seed=seed)
    return network


def judge_scenarios(network: Second, recorded: Mapping[str, Path]) -> dict[tuple[str, str], Complexity]:
    """Return the complexity of each of `SCENARIOS`, from the network's errors, in descending order."""
    complexities: dict[tuple[str, str], Complexity] = {}
    for town, step in recorded.items():
        data = open_split(step)
        kinds = [kind for other, kind in SCENARIOS if other == town]
        frames = np.sort(np.concatenate([find_frames(data, kind) for kind in kinds])).tolist()
        errors = OBJECTS.register_errors(network, data, frames).errors
        for tasks in generate_tasks(data.folder, [(error.scene, error.x, error.y) for error in errors]):
            if tasks.kind in kinds:
                complexities[town, tasks.kind] = tasks.complexity
    if missing := [name_scenario(*place) for place in SCENARIOS if place not in complexities]:
        raise InputError(f"{missing[0]}: no frame of the recording is at such a place")
    return dict(sorted(complexities.items(), key=lambda item: -item[1].total))


def draw_sweeps(frames: NDArray[np.int64], count: int, stream_of: tuple[int, str]) -> list[int]:
    """Return `count` frames, drawn at random for a seed and scenario; raises `InputError` where there are too few."""
    seed, name = stream_of
    if len(frames) < count:
        raise InputError(f"{name}: {len(frames)} frames were recorded there, and its tasks need {count}")
    return stream(seed, "tasks", name).permutation(frames)[:count].tolist()


def spread_frames(frames: NDArray[np.int64], most: int) -> list[int]:
    """Return at most `most` of the frames, evenly spread over the recording."""
    return frames[np.unique(np.linspace(0, len(frames) - 1, min(most, len(frames))).round().astype(int))].tolist()


def train_tasks(data: Dataset, sweeps: Sequence[int], start: Weights, seed: int, size: Size) -> tuple[Weights, float]:
    """Return the network after the rounds of tasks with these sweeps, and their uplink [MB].

    A task has `size.sweeps` of them. Without any sweeps the network remains `start`.
    """
    if not sweeps:
        return start, 0.0
    samples = OBJECTS.samples(data, pillars_config(), sweeps)
    clients = {
        f"task{number}": TaskClient(
            OBJECTS, pillars_config(), [samples[at] for at in range(first, min(first + size.sweeps, len(sweeps)))]
        )
        for number, first in enumerate(range(0, len(sweeps), size.sweeps))
    }
    ledger, rate = Ledger(LinkMegabytes(1e6, 0.0)), OBJECTS.practice.learning_rate
    schedule = Schedule(size.rounds, size.steps, RATE * rate, FINAL_RATE * rate, seed)
    trained = federate(clients, start, schedule, Account(ledger, EDGE, OBJECTS.name, "wireless"))
    return trained.weights, sum(entry.bytes for entry in ledger if entry.direction == "up") / BYTES_PER_MB
