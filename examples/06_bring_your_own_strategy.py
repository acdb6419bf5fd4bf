"""Bring your own strategy: the vehicle that errs most counts for most, so that what few have seen is learned too.

One vehicle has pictures of the day alone, another fewer of the night. Weighting by a power of the loss is the idea of
q-fair federated learning (Li et al., ICLR 2020).
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flcav import Dataset, Recipe, federate, record, task_named
from flcav.federation import FedAvg, Schedule, Update, average
from flcav.perception import TaskClient, build_network, from_arrays, to_arrays

WEATHER = task_named("weather")
CONFIG = replace(next(iter(WEATHER.configurations.values())), classes=("clear", "fog", "night"))
RIG = {"cameras": {"front": {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 160, "height": 96}}}}
SKY = {"classes": CONFIG.classes * 2, "turn_s": 2.0}
RECIPE = {"town": "grid", "cavs": 3, "spins_per_scene": 6, "every_s": 2.0, "vehicle_rig": RIG, "weather": SKY}
SCHEDULE = Schedule(rounds=10, steps=5, learning_rate=4e-3, final_learning_rate=1e-3, seed=1)


@dataclass(frozen=True)
class LossWeighted:
    power: float = 2.0

    def combine(self, start, updates: Sequence[Update]):
        return average([u.weights for u in updates], [u.samples * u.loss**self.power for u in updates])


def main(out: Path) -> None:
    record(Recipe.model_validate(RECIPE), out)
    data, clients = Dataset.open(out), {}
    for vehicle, weathers in (("cav0", ("clear", "fog")), ("cav1", ("night",))):
        samples = WEATHER.samples(data, CONFIG, data.select(agents=[vehicle]))
        seen = [sample for sample in samples if CONFIG.classes[sample.label] in weathers]
        clients[vehicle] = TaskClient(WEATHER, CONFIG, seen)
    for strategy in (FedAvg(), LossWeighted()):
        network = build_network(WEATHER, CONFIG, seed=1)
        update = federate(clients, to_arrays(network), SCHEDULE, strategy=strategy)
        from_arrays(network, update.weights)
        recall: Any = WEATHER.evaluate(network, data, data.select(agents=["cav2"])).as_json()["recall"]
        print(f"{strategy}: a third vehicle's pictures, recall", ", ".join(f"{k} {v:.2f}" for k, v in recall.items()))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/own_strategy"))
