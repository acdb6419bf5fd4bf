"""The smallest federation: two vehicles, each with its own recorded sweeps, train one LiDAR detector together.

They learn from ground truth here, to keep it short; the demo's vehicles have none (see `flcav.fusion.labels`).
"""

import sys
from pathlib import Path

from flcav import Dataset, Ledger, Recipe, federate, record, task_named
from flcav.federation import Account, Schedule
from flcav.network import LinkMegabytes
from flcav.perception import TaskClient, build_network, from_arrays, save_network, to_arrays

RECIPE = {"town": "grid", "seed": 3, "cavs": 2, "warmup_s": 40.0, "spins_per_scene": 2, "every_s": 2.0}
SCHEDULE = Schedule(rounds=2, steps=2, learning_rate=1e-3, final_learning_rate=2e-4, seed=1)
VEHICLES = ("cav0", "cav1")
OBJECTS = task_named("objects")
TINY = OBJECTS.configurations["tiny"]


def main(out: Path) -> None:
    record(Recipe.model_validate(RECIPE), out / "data")
    data = Dataset.open(out / "data")
    network = build_network(OBJECTS, TINY, seed=0)
    clients = {
        vehicle: TaskClient(OBJECTS, TINY, OBJECTS.samples(data, TINY, data.select(agents=[vehicle])))
        for vehicle in VEHICLES
    }

    ledger = Ledger(LinkMegabytes(wireless_mb=6.0, wireline_mb=0.0))
    account = Account(ledger, stage="edge", task="objects", link="wireless")
    result = federate(
        clients,
        to_arrays(network),
        SCHEDULE,
        account,
        on_round=lambda number, weights, loss: print(f"round {number}: mean loss {loss:.3f}"),
    )
    from_arrays(network, result.weights)
    save_network(OBJECTS, network, out / "weights.safetensors")

    for entry in ledger.entries:
        print(f"round {entry.round} {entry.direction:>4} {entry.client}: {entry.bytes / 1e6:.3f} MB")
    budget = ledger.budget.wireless_mb
    print(f"wireless uplink: {ledger.used_mb('wireless'):.3f} of {budget:.0f} MB; {out / 'weights.safetensors'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/federate"))
