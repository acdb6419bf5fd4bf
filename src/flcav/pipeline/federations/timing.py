"""Time that clients train in a round, measured where they train and kept beside the checkpoints of their federation.

It is CPU time: that of a machine on which nothing else runs. No result depends on it.
"""

import contextlib
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flcav.federation.trainable import Trainable, Update, Weights

TIMES = "train_s.csv"  # in the folder of a federation


@dataclass(frozen=True)
class TimedClient:
    """A client that appends the CPU time of each of its trainings [s] to a file."""

    name: str
    client: Trainable
    path: Path

    def train(self, weights: Weights, **how: Any) -> Update:
        """Return the client's update."""
        begun = time.process_time()
        update = self.client.train(weights, **how)
        spent = time.process_time() - begun
        with contextlib.suppress(OSError), self.path.open("a") as file:  # a full disk is the checkpoint's to tell
            file.write(f"{self.name},{spent:.6f}\n")
        return update


def time_clients(clients: Mapping[str, Trainable], folder: Path) -> dict[str, TimedClient]:
    """Return clients whose times of training are kept in `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    return {name: TimedClient(name, client, folder / TIMES) for name, client in clients.items()}


def read_times(folder: Path) -> list[float]:
    """Return the times of all trainings of a federation [s]; none where they were not measured."""
    if not (folder / TIMES).exists():
        return []
    *whole, _ = (folder / TIMES).read_text().split("\n")  # a line that is cut off was being written at a kill
    return [float(line.rpartition(",")[2]) for line in whole]
