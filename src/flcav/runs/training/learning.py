"""Settings of a task's training in a run, the clients of its federations, and the networks that stages result in."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors.numpy import load_file, save

from flcav.config import Config, InputError, shorten
from flcav.federation.loop import Schedule
from flcav.federation.rules import Rules
from flcav.federation.strategies import Strategy
from flcav.federation.trainable import Weights, statistics_names
from flcav.perception.client import OutputClient, SharedSamples, TaskClient
from flcav.perception.outcomes import score_network
from flcav.perception.task import Task, build_network, find_configuration
from flcav.perception.weights import PACKAGED, find_shipped, from_arrays, load_network, to_arrays
from flcav.runs.frames import Frames
from flcav.runs.recipe import TaskRecipe, Training, find_path
from flcav.runs.results.saved import WEIGHTS
from flcav.runs.results.training import StatisticsScore
from flcav.statistics.streams import derive_seed
from flcav.storage.files import sha256, write_bytes


@dataclass(frozen=True)
class Learning:
    """Settings of a task's training in a run: network configuration, schedule, and seed."""

    task: Task
    network: str | None  # name of the configuration
    training: Training
    seed: int

    @property
    def batch(self) -> int:
        """The batch size: number of samples in an optimiser step."""
        return self.training.batch or self.task.practice.batch

    @property
    def config(self) -> Any:
        """The network's configuration."""
        return find_configuration(self.task, self.network)

    def build_network(self) -> Any:
        """Build a network with initial weights drawn from the seed."""
        return build_network(self.task, self.config, self.seed)

    def schedule(
        self, rounds: int, steps: int, *names: str, earlier: int = 0, restart: float | None = None
    ) -> Schedule:
        """Return the clients' schedule of `rounds` rounds with `steps` local steps; `names` seed the stream.

        The learning rate decays over the first rounds after pretraining; after `earlier` rounds it stays at its final
        value. `restart`: share of the task's rate to restart at, which loses what the earlier rounds reached
        (reproductions/runs/demo, spread of retraining).
        """
        rate = self.task.practice.learning_rate
        training = self.training
        first = restart or (training.final_rate if earlier else training.local_rate)
        return Schedule(rounds, steps, first * rate, training.final_rate * rate, derive_seed(self.seed, *names))


def regional_weights(region: str) -> str:
    """Return the file name of a region's personalised model after a stage III with personal arrays."""
    return f"weights-{region}.safetensors"


def load_stage_network(task: Task, folder: Path, region: str | None = None) -> Any:
    """Load the trained network of the stage in `folder`; with `region`, that region's personalised model."""
    return load_network(task, folder / (WEIGHTS if region is None else regional_weights(region)))


@dataclass(frozen=True)
class Strategies:
    """Strategies of stage III: of edge servers with their vehicles, and of the cloud with edge servers."""

    edge: Strategy
    cloud: Strategy


def make_clients(learning: Learning, config: Any, samples: Mapping[str, Sequence[Any]]) -> dict[str, TaskClient]:
    """Return a federation's clients by vehicle; vehicles without samples are left out."""
    return {
        name: TaskClient(learning.task, config, samples[name], batch=learning.batch)
        for name in sorted(samples)
        if len(samples[name])
    }


def give_outputs(clients: Mapping[str, TaskClient], shared: SharedSamples, start: Weights) -> dict[str, OutputClient]:
    """Return clients that send outputs on `shared` samples, and whose networks begin with the weights `start`."""
    return {name: OutputClient(client, shared, start) for name, client in clients.items()}


def describe_federation(strategy: Strategy | Strategies, rules: Rules) -> str:
    """Describe strategies and rules that differ from the defaults: the identity of a checkpoint."""
    changed = rules.model_dump(mode="json", include=set(Rules.model_fields), exclude_defaults=True)
    return f"{strategy} by {json.dumps(changed)}" if changed else str(strategy)


def keep_statistics(weights: Weights, folder: Path, region: str) -> None:
    """Write a region's batch-normalisation statistics to the folder of stage III, replacing earlier ones."""
    write_bytes(_path(folder, region), save({name: weights[name] for name in statistics_names(weights)}))


def score_statistics(
    task: Task, network: Any, folder: Path, validation: Mapping[str, Frames]
) -> tuple[StatisticsScore, ...]:
    """Return the scores of `network` on the regions' validation frames, with averaged and with regional statistics.

    The averaged statistics of batch normalisation are in `network`, the regional ones were written to `folder` by
    `keep_statistics`. Without a cloud round there are none, and the result is empty.
    """
    arrays = to_arrays(network)
    scores = []
    for region, split in validation.items():
        if not _path(folder, region).exists():
            continue
        regional = task.build(network.config)
        from_arrays(regional, {**arrays, **load_file(_path(folder, region))})
        averaged, kept = (
            score_network(task, model, split.data, split.vehicles) for model in (network, regional.eval())
        )
        scores.append(StatisticsScore(region, len(split.vehicles), averaged, kept))
    return tuple(scores)


def _path(folder: Path, region: str) -> Path:
    return folder / f"statistics-{region}.safetensors"


SHIPPED = ("shipped", PACKAGED)  # names of the weights that come with the package


class StartingWeights(Config):
    """A file of weights at which stage I starts."""

    path: str
    version: str  # SHA-256 of the file


def find_start(task: Task, own: TaskRecipe, beside: Path) -> StartingWeights | None:
    """Return the weights at which a task starts, None for random ones.

    Raises `InputError` where the file is not in `beside`, or its network has other arrays than the recipe's.
    """
    if own.weights is None:
        return None
    path = find_shipped(task) if own.weights in SHIPPED else find_path(own.weights, beside)
    if path is None:
        raise InputError(f"tasks.{task.name}.weights: there is no file {shorten(own.weights)} in {beside}")
    held = load_network(task, path)
    wanted = build_network(task, find_configuration(task, own.network), 0)
    if _shapes(held) != _shapes(wanted):
        network = own.network or next(iter(task.configurations))
        raise InputError(f"{path}: weights of another network than '{network}', which the recipe has for '{task.name}'")
    return StartingWeights(path=str(path.absolute()), version=sha256(path))


def load_start(task: Task, start: StartingWeights) -> Any:
    """Load the network at which stage I starts; raises `InputError` where its file has changed since `find_start`."""
    path = Path(start.path)
    if sha256(path) != start.version:
        raise InputError(f"{path}: the weights were changed while the run was under way")
    return load_network(task, path)


def _shapes(network: Any) -> dict[str, tuple[int, ...]]:
    return {name: array.shape for name, array in to_arrays(network).items()}
