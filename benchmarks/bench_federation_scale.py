"""A federation of 100, 1,000 and 10,000 simulated vehicles with updates of LeNet's size: CPU time and peak memory.

Each number in a process of its own, one round with every vehicle, several times in turns; ratios are medians over the
turns. A vehicle is made when it is its turn; its training is one draw of random numbers, so that what is measured is
the federation itself.
"""

import json
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping

import numpy as np

from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.trainable import LocalUpdate, Trainable, Weights
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.task import build_network
from flcav.perception.weather.model import LeNetConfig
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import to_arrays

NUMBERS, REPEATS = (100, 1_000, 10_000), 5


class Vehicle:
    """A client whose update is a random step."""

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        """Return the weights plus one random number."""
        step = np.float32(learning_rate * np.random.default_rng(seed).normal())
        return LocalUpdate({name: array + step for name, array in weights.items()}, 1, 0.5)


class Fleet(Mapping[str, Trainable]):
    """Vehicles that are made when they are asked for."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __getitem__(self, name: str) -> Trainable:
        return Vehicle()

    def __iter__(self) -> Iterator[str]:
        return (f"cav{number}" for number in range(self.count))

    def __len__(self) -> int:
        return self.count


def measure(vehicles: int) -> None:
    weights = to_arrays(build_network(WEATHER, LeNetConfig(), 0))
    account = Account(Ledger(LinkMegabytes(1e6, 1e6)), "edge", "weather", "wireless")
    start = time.process_time()
    federate(Fleet(vehicles), weights, Schedule(1, 1, 1e-3, 1e-3, 0), account)
    spent = time.process_time() - start
    print(json.dumps({"cpu_s": spent, "mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3}))


def ask(vehicles: int) -> tuple[float, float]:
    """Return CPU time [s] and peak memory [MB] of a process of its own."""
    told = subprocess.run([sys.executable, __file__, str(vehicles)], check=True, capture_output=True, text=True)
    found = json.loads(told.stdout)
    return found["cpu_s"], found["mb"]


def main() -> None:
    turns = [{vehicles: ask(vehicles) for vehicles in NUMBERS} for _ in range(REPEATS)]
    print(f"one round, median of {REPEATS}")
    for vehicles in NUMBERS:
        cpu_s, mb = (statistics.median(turn[vehicles][each] for turn in turns) for each in range(2))
        print(f"{vehicles:>6} vehicles {cpu_s:7.2f} CPU-s, {1e3 * cpu_s / vehicles:.2f} ms each, peak {mb:.0f} MB")
    few, more, most = NUMBERS
    linear = statistics.median(turn[most][0] / (turn[more][0] * most / more) for turn in turns)
    memory = statistics.median(turn[most][1] / turn[few][1] for turn in turns)
    print(f"  time of 10,000 / 10 x that of 1,000: {linear:.2f} (aim: 1, linear)")
    print(f"  memory of 10,000 / that of 100: {memory:.2f} (aim <= 1.20)")


if __name__ == "__main__":
    measure(int(sys.argv[1])) if len(sys.argv) > 1 else main()
