"""Settings of a task's training in a run, and the networks that stages end with."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flcav.federation.rounds import Schedule
from flcav.perception.task import Task, build_network, find_configuration
from flcav.perception.weights import load_network
from flcav.pipeline.results.saved import WEIGHTS
from flcav.pipeline.sizes import Training
from flcav.statistics.streams import derive_seed


@dataclass(frozen=True)
class Learning:
    """Settings of a task's training in a run: network configuration, schedule, and seed."""

    task: Task
    network: str | None  # name of the configuration
    training: Training
    seed: int

    @property
    def batch(self) -> int:
        """Return the batch size: samples of an optimiser step."""
        return self.training.batch or self.task.practice.batch

    @property
    def config(self) -> Any:
        """Return the network's configuration."""
        return find_configuration(self.task, self.network)

    def build_network(self) -> Any:
        """Return a network with initial weights drawn from the seed."""
        return build_network(self.task, self.config, self.seed)

    def schedule(self, rounds: int, steps: int, *names: str, earlier: int = 0, anew: float | None = None) -> Schedule:
        """Return the clients' schedule of `rounds` rounds with `steps` local steps; `names` seed the stream.

        The learning rate falls over the first rounds after pretraining; where there were `earlier` ones, it stays at
        its end. Begun anew, at `anew`, it costs what the earlier rounds reached: reproductions/runs/retraining.
        """
        rate, training = self.task.practice.learning_rate, self.training
        first = anew or (training.final_rate if earlier else training.local_rate)
        return Schedule(rounds, steps, first * rate, training.final_rate * rate, derive_seed(self.seed, *names))


def regional_weights(region: str) -> str:
    """Return the name of the file of a region's own model, of a stage III with personal arrays."""
    return f"weights-{region}.safetensors"


def load_stage_network(task: Task, folder: Path, region: str | None = None) -> Any:
    """Return the trained network of the stage in `folder`; with a `region` its own model."""
    return load_network(task, folder / (WEIGHTS if region is None else regional_weights(region)))
