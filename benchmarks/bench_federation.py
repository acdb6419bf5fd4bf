"""What Flower's messages and the ledger add to federated averaging: CPU time against a bare loop, in one run.

Two clients of `second_tiny` take 20 local steps on the same sweeps, once as functions called in a loop and averaged,
once as nodes of the in-process federation.
"""

import statistics
import time

import numpy as np
import torch

from flcav.federation.runtimes.metered import Account
from flcav.federation.stages import Schedule, federate
from flcav.federation.strategies.fedavg import average
from flcav.geometry import Boxes
from flcav.network.ledger import Budget, Ledger
from flcav.perception.objects.client import ObjectsClient
from flcav.perception.objects.model import second_tiny
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.weights import to_arrays
from flcav.seeds import child_seed

STEPS, REPEATS = 20, 5


def sweep(rng: np.random.Generator) -> Sample:
    """Return 12,000 returns of flat ground with a few boxes on it."""
    ground = np.c_[rng.uniform(0, 48, 12_000), rng.uniform(-24, 24, 12_000), rng.normal(-1.8, 0.02, 12_000)]
    boxes = np.c_[rng.uniform(5, 45, (5, 1)), rng.uniform(-20, 20, (5, 1)), np.full((5, 1), -1.0)]
    rows = np.c_[boxes, np.tile([4.4, 1.8, 1.6, 0.3], (5, 1))]
    points = np.c_[ground, rng.uniform(0, 1, 12_000)].astype(np.float32)
    return Sample(points, Boxes.from_array(rows, "Car"))


def bare(clients: dict[str, ObjectsClient], weights, schedule: Schedule) -> None:
    work = schedule.work(1)
    updates = [
        client.train(weights, steps=work.steps, learning_rate=work.learning_rate, seed=child_seed(work.seed, name))
        for name, client in clients.items()
    ]
    average([update.weights for update in updates], [update.samples for update in updates])


def main() -> None:
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    network = second_tiny()
    weights = to_arrays(network)
    clients = {f"cav{i}": ObjectsClient(network.config, [sweep(rng) for _ in range(4)]) for i in range(2)}
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
