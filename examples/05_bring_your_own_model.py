"""Bring your own model: a residual network takes LeNet's place in the weather task, and two vehicles train it."""

import sys
from pathlib import Path

from torch import Tensor, nn

from flcav.dataset.recorder import record
from flcav.dataset.store import Dataset
from flcav.federation.runtimes.metered import Account
from flcav.federation.stages import Schedule, federate
from flcav.network.ledger import Budget, Ledger
from flcav.perception.client import TaskClient
from flcav.perception.task import fresh
from flcav.perception.weather.config import LeNetConfig
from flcav.perception.weather.model import Classifier
from flcav.perception.weather.task import WeatherTask
from flcav.perception.weights import from_arrays, to_arrays
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

CONFIG = LeNetConfig(classes=("clear", "fog", "night"))
RIG = {"cameras": {"front": {"mount": {"x": 0.5, "z": 1.5}, "settings": {"width": 160, "height": 96}}}}
RECIPE = {"town": "grid", "cavs": 3, "spins_per_scene": 6, "every_s": 2.0, "vehicle_rig": RIG}
WEATHER = {"classes": CONFIG.classes * 2, "turn_s": 2.0}


class Residual(Classifier):
    def __init__(self, config: LeNetConfig) -> None:
        super().__init__(config)
        self.blocks = nn.ModuleList(nn.Conv2d(16, 16, 3, padding=1) for _ in range(3))
        self.stem, self.head = nn.Conv2d(3, 16, 5, stride=4), nn.Linear(16, len(config.classes))

    def forward(self, pictures: Tensor) -> Tensor:
        maps = self.stem(pictures)
        for block in self.blocks:
            maps = maps + block(maps).relu()
        return self.head(maps.mean((2, 3)))


class ResidualWeather(WeatherTask):
    family = "residual"

    def build(self, config: LeNetConfig) -> Residual:
        return Residual(config)


def main(out: Path) -> None:
    record(EmbeddedSource(Recipe.model_validate({**RECIPE, "weather": WEATHER})), out)
    data, task, clients = Dataset.open(out), ResidualWeather(), {}
    for vehicle in ("cav0", "cav1"):
        clients[vehicle] = TaskClient(task, CONFIG, task.samples(data, CONFIG, data.select(agents=[vehicle])))
    network, account = fresh(task, CONFIG, seed=1), Account(Ledger(Budget(2.0, 0.0)), "edge", task.name, "wireless")
    schedule = Schedule(rounds=3, steps=20, learning_rate=4e-3, final_learning_rate=1e-3, seed=1)
    from_arrays(network, federate(clients, to_arrays(network), schedule, account).weights)
    print("a third vehicle's", *task.evaluation_lines(task.evaluate(network, data, data.select(agents=["cav2"])))[:1])


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/own_model"))
