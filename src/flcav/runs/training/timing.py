"""Training times of clients, measured where they train and kept in the folder of their federation's checkpoints.

They are CPU times, as on a machine on which nothing else runs. No result depends on them.
"""

import contextlib
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flcav.federation.trainable import Trainable, Update, Weights, count_samples
from flcav.runs.results.saved import Saved

TIMES = "train_s.csv"  # in the folder of a federation


@dataclass(frozen=True)
class TrainTimes(Saved):
    """Times of local training, and relative speeds of vehicles, as a run recipe takes them."""

    train_s: Mapping[str, float]  # by task: median over all trainings of all vehicles [s]
    vehicle_train_s: Mapping[str, Mapping[str, float]]  # by task and "region/vehicle": median over its trainings [s]
    speed: Mapping[str, Mapping[str, float]]  # by region and vehicle: ratio of `train_s` to its time, summed over tasks


@dataclass(frozen=True)
class TimedClient:
    """A client that appends the CPU times of its local trainings [s] to a file."""

    name: str
    client: Trainable
    path: Path

    def train(self, weights: Weights, **how: Any) -> Update:
        """Train the client, record the CPU time, and return its update."""
        begun = time.process_time()
        update = self.client.train(weights, **how)
        spent = time.process_time() - begun
        with contextlib.suppress(OSError), self.path.open("a") as file:  # of a full disk the checkpoint reports
            file.write(f"{self.name},{spent:.6f}\n")
        return update

    def count_samples(self, steps: int) -> int:
        """Return the client's number of samples; raises TypeError if the client cannot count them."""
        return count_samples(self.client, steps)


def time_clients(clients: Mapping[str, Trainable], folder: Path) -> dict[str, TimedClient]:
    """Return clients whose training times are kept in `folder`; an incomplete last line there is removed."""
    folder.mkdir(parents=True, exist_ok=True)
    path = (folder / TIMES).resolve()  # actors may have another working directory
    if path.exists():
        os.truncate(path, path.read_bytes().rfind(b"\n") + 1)
    return {name: TimedClient(name, client, path) for name, client in clients.items()}


def read_times(folder: Path) -> dict[str, list[float]]:
    """Read the times of all trainings of a federation [s], by client; empty where they were not measured."""
    if not (folder / TIMES).exists():
        return {}
    times: dict[str, list[float]] = {}
    *whole, _ = (
        (folder / TIMES).read_text().split("\n")
    )  # an incomplete line was being written when the process was killed
    for line in whole:
        name, _, spent = line.rpartition(",")
        times.setdefault(name, []).append(float(spent))
    return times


def summarise_times(measured: Mapping[str, Mapping[str, Sequence[float]]]) -> TrainTimes:
    """Return medians and relative speeds from the times of trainings [s], by task and "region/vehicle".

    A vehicle of speed 0.5 takes twice the `train_s` for a round. Tasks without a training are left out.
    """
    medians = {
        task: {name: float(np.median(times)) for name, times in sorted(clients.items())}
        for task, clients in measured.items()
        if clients
    }
    typical = {
        task: float(np.median([spent for times in measured[task].values() for spent in times])) for task in medians
    }
    speed: dict[str, dict[str, float]] = {}
    for client in sorted({name for clients in medians.values() for name in clients}):
        tasks = [task for task in medians if client in medians[task]]
        region, _, vehicle = client.rpartition("/")
        taken = sum(medians[task][client] for task in tasks)
        speed.setdefault(region, {})[vehicle] = sum(typical[task] for task in tasks) / taken
    return TrainTimes(typical, medians, speed)
