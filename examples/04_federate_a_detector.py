"""The smallest federation: two vehicles, each with its own recorded sweeps, train one LiDAR detector together.

They learn from ground truth here, to keep it short; the demo's vehicles have none (see `flcav.fusion.labels`).
"""

import sys
from pathlib import Path

import torch

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.federation.rounds import Schedule, federate
from flcav.federation.runtimes.metered import Account
from flcav.network.ledger import Budget, Ledger
from flcav.perception.client import TaskClient
from flcav.perception.objects.model import second_tiny
from flcav.perception.objects.samples import sample_from_frame
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import from_arrays, save_network, to_arrays
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

RECIPE = {"town": "grid", "seed": 3, "cavs": 2, "warmup_s": 40.0, "spins_per_scene": 2, "every_s": 2.0}
SCHEDULE = Schedule(rounds=2, steps=2, learning_rate=1e-3, final_learning_rate=2e-4, seed=1)
VEHICLES = ("cav0", "cav1")


def main(out: Path) -> None:
    record(EmbeddedSource(parse_config(Recipe, RECIPE, "this example")), out / "data")
    data = Dataset.open(out / "data")
    torch.manual_seed(0)
    network = second_tiny()
    clients = {}
    for vehicle in VEHICLES:
        frames = (data.frame(i) for i in data.select(agents=[vehicle]))
        clients[vehicle] = TaskClient(OBJECTS, network.config, [sample_from_frame(f, network.config) for f in frames])

    ledger = Ledger(Budget(wireless_mb=6.0, wireline_mb=0.0))
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
