"""What Flower's messages, the ledger and client processes cost beside a bare loop, in one run.

Two clients take 20 local steps of LeNet and of `second_tiny`: as functions called in a loop and averaged, as nodes of
the in-process federation, in two bare processes, and as a federation's client processes. CPU time is of all processes
together; wall time says something on idle cores alone.
"""

import os
import statistics
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from flcav.federation.links.metered import Account
from flcav.federation.links.processes import ClientProcesses
from flcav.federation.loop import Schedule, federate
from flcav.federation.strategies.fedavg import average
from flcav.federation.trainable import Update, Weights
from flcav.machine.threads import use_threads
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.client import TaskClient
from flcav.perception.objects.model import second_tiny
from flcav.perception.objects.samples import sample_from_frame
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import build_network
from flcav.perception.weather.model import SIDE, LeNetConfig
from flcav.perception.weather.samples import Sample
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import to_arrays
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.statistics.streams import derive_seed

STEPS, REPEATS = 20, 5
SCHEDULE = Schedule(rounds=1, steps=STEPS, learning_rate=1e-3, final_learning_rate=1e-3, seed=0)


@dataclass(frozen=True)
class Work:
    """A task's clients by name, and the weights that they begin with."""

    clients: Mapping[str, TaskClient]
    weights: Weights


_held: list[Work] = []  # of a bare process


def train(client: TaskClient, name: str, weights: Weights) -> Update:
    work = SCHEDULE.work(1)
    seed = derive_seed(work.seed, name)
    return client.train(weights, steps=work.steps, learning_rate=work.learning_rate, seed=seed)


def combine(updates: list[Update]) -> None:
    average([update.weights for update in updates], [update.samples for update in updates])


def hold(work: Work) -> None:
    use_threads(1)
    _held.append(work)


def train_held(name: str, weights: Weights) -> Update:
    return train(_held[0].clients[name], name, weights)


def lenet() -> Work:
    config, rng = LeNetConfig(), np.random.default_rng(0)
    pictures = rng.integers(0, 256, (200, SIDE, SIDE, 3), np.uint8)
    samples = [Sample(picture, i % len(config.classes)) for i, picture in enumerate(pictures)]
    clients = {f"cav{i}": TaskClient(WEATHER, config, samples[i::2]) for i in range(2)}
    return Work(clients, to_arrays(build_network(WEATHER, config, 0)))


def tiny() -> Work:
    network = second_tiny()
    source = EmbeddedSource(Recipe(town="suburb", seed=1, cavs=2, spins_per_scene=4))
    samples = [sample_from_frame(frame, network.config) for frame in source.frames(source.scenes()[0])]
    clients = {f"cav{i}": TaskClient(OBJECTS, network.config, samples[i::2]) for i in range(2)}
    return Work(clients, to_arrays(network))


def spent(pids: list[int]) -> float:
    """Return the CPU time of these processes [s]."""
    ticks = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def compare(name: str, work: Work, rounds: int) -> None:
    """Time `rounds` rounds of each way in turns, and print medians and ratios."""
    account = Account(Ledger(LinkMegabytes(1e6, 1e6)), "edge", name, "wireless")
    context, clients, weights = get_context("spawn"), work.clients, work.weights
    with ClientProcesses(clients, 2) as several, ProcessPoolExecutor(2, context, hold, (work,)) as pool:
        ways: dict[str, Callable[[], object]] = {
            "bare loop": lambda: combine([train(client, each, weights) for each, client in clients.items()]),
            "federation": lambda: federate(clients, weights, SCHEDULE, account),
            "two bare processes": lambda: combine([*pool.map(train_held, clients, [weights] * len(clients))]),
            "two client processes": lambda: federate(clients, weights, SCHEDULE, account, runtime=several),
        }
        for way in ways.values():
            way()  # starts processes
        pids = [os.getpid(), *pool._processes, *several.pids]
        cpu, wall = ({way: [] for way in ways} for _ in range(2))
        for _ in range(REPEATS):
            for way, do in ways.items():
                used, start = spent(pids), time.perf_counter()
                for _ in range(rounds):
                    do()
                wall[way].append((time.perf_counter() - start) / rounds)
                cpu[way].append((spent(pids) - used) / rounds)
    print(f"one round, 2 clients x {STEPS} local steps of {name}, median of {REPEATS}: CPU-s, wall s")
    for way in ways:
        print(f"  {way:<21} {statistics.median(cpu[way]):7.3f} {statistics.median(wall[way]):7.3f}")

    def ratio(times: dict[str, list[float]], one: str, other: str) -> float:
        return statistics.median(a / b for a, b in zip(times[one], times[other], strict=True))

    print(f"  federation / bare loop, CPU: {ratio(cpu, 'federation', 'bare loop'):.3f} (aim <= 1.05)")
    pair = "two bare processes", "two client processes"
    by_cpu, by_wall = ratio(cpu, *pair), ratio(wall, *pair)
    print(f"  speed of client processes / bare ones: CPU {by_cpu:.3f}, wall {by_wall:.3f} (aim >= .95)")


def main() -> None:
    use_threads(1)
    compare("LeNet", lenet(), rounds=8)
    compare("second_tiny", tiny(), rounds=1)


if __name__ == "__main__":
    main()
