"""Overhead of Flower's messages and the ledger: CPU time of federated averaging against a bare loop, in one run.

Two clients of `second_tiny` take 20 local steps on the same sweeps, once as functions called in a loop and averaged,
once as nodes of the in-process federation.
"""

import statistics
import time

import torch

from flcav.federation.runtimes.metered import Account
from flcav.federation.stages import Schedule, federate
from flcav.federation.strategies.fedavg import average
from flcav.network.ledger import Budget, Ledger
from flcav.perception.client import TaskClient
from flcav.perception.objects.model import second_tiny
from flcav.perception.objects.samples import sample_from_frame
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import to_arrays
from flcav.seeds import derive_seed
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

STEPS, REPEATS = 20, 3


def bare(clients: dict[str, TaskClient], weights, schedule: Schedule) -> None:
    work = schedule.work(1)
    updates = [
        client.train(weights, steps=work.steps, learning_rate=work.learning_rate, seed=derive_seed(work.seed, name))
        for name, client in clients.items()
    ]
    average([update.weights for update in updates], [update.samples for update in updates])


def main() -> None:
    torch.set_num_threads(1)
    network = second_tiny()
    source = EmbeddedSource(Recipe(town="suburb", seed=1, cavs=2, spins_per_scene=4))
    samples = [sample_from_frame(frame, network.config) for frame in source.frames(source.scenes()[0])]
    weights = to_arrays(network)
    clients = {f"cav{i}": TaskClient(OBJECTS, network.config, samples[i::2]) for i in range(2)}
    schedule = Schedule(rounds=1, steps=STEPS, learning_rate=1e-3, final_learning_rate=1e-3, seed=0)
    account = Account(Ledger(Budget(1e6, 1e6)), "edge", "objects", "wireless")
    federate(clients, weights, schedule, account)  # warm-up
    times: dict[str, list[float]] = {"bare loop": [], "federation": []}
    for _ in range(REPEATS):
        for name, run in (
            ("bare loop", lambda: bare(clients, weights, schedule)),
            ("federation", lambda: federate(clients, weights, schedule, account)),
        ):
            start = time.process_time()
            run()
            times[name].append(time.process_time() - start)
    medians = {name: statistics.median(values) for name, values in times.items()}
    ratio = statistics.median(f / b for f, b in zip(times["federation"], times["bare loop"], strict=True))
    print(f"one round, 2 clients x {STEPS} local steps of second_tiny, CPU-s (median of {REPEATS})")
    for name, value in medians.items():
        print(f"  {name:<12} {value:6.2f}")
    print(f"  federation / bare loop {ratio:.3f} (aim <= 1.15)")


if __name__ == "__main__":
    main()
