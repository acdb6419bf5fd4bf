"""Bring your own task: how many road users a LiDAR sweep holds. Commands take it too, in the folder of this file:
flcav train 05_bring_your_own_task:TASK --data DIR --out own --epochs 20
flcav evaluate 05_bring_your_own_task:TASK --data DIR --weights own/weights.safetensors
flcav infer 05_bring_your_own_task:TASK DIR --weights own/weights.safetensors --pictures pictures
flcav reproduce 05_bring_your_own_task:TASK --out study --seeds 2 --jobs 2"""

import sys

import numpy as np
import torch
from pydantic.dataclasses import dataclass

from flcav import Dataset, Recipe, evaluate, record, train
from flcav.perception import Bars, Evaluated, Finding, Practice, Result, StudyRecipe

SCENE = {"town": "grid", "cavs": 3, "spins_per_scene": 6, "every_s": 4.0, "warmup_s": 40.0}


@dataclass(frozen=True)
class Square:  # seen from above, around the sensor
    cells: int = 24  # on a side
    reach_m: float = 36.0  # to either side


class Counter(torch.nn.Sequential):  # cells (N, H, W) -> logarithm of the expected number (N, 1)
    def __init__(self, config: Square) -> None:
        hidden = torch.nn.Linear(config.cells**2, 32)
        super().__init__(torch.nn.Flatten(), hidden, torch.nn.ReLU(), torch.nn.Linear(32, 1))
        self.config = config

    def expected(self, samples):
        return self(torch.from_numpy(np.stack([cells for cells, _ in samples])))[:, 0].exp()


@dataclass(frozen=True)
class Counted(Evaluated):
    off_by: float  # road users, on average

    @property
    def score(self):
        return 1 / (1 + self.off_by)


@dataclass(frozen=True)
class Count(Result):
    expected: float  # road users


class CountingTask:
    name, family, configurations, practice = "counting", "counter", {"tiny": Square()}, Practice(4, learning_rate=3e-3)
    build = Counter

    def samples(self, data, config, frames=None):
        return [sample(data.frame(i), config) for i in data.numbers(frames)]

    def draw(self, samples, index, config, rng):
        return samples[index]  # as it is: nothing is augmented

    def loss(self, network, samples):
        counts = torch.tensor([float(count) for _, count in samples])
        return torch.nn.functional.poisson_nll_loss(network.expected(samples), counts, log_input=False)

    def evaluate(self, network, data, frames=None, **progress) -> Counted:
        off = [abs(network.expected([s]).item() - s[1]) for s in self.samples(data, network.config, frames)]
        return Counted(sum(off) / len(off))

    def infer(self, network, path, threshold=0.0, frames=None):
        data = Dataset.open(path)
        for frame in map(data.frame, data.numbers(frames)):
            law = torch.distributions.Poisson(network.expected([sample(frame, network.config)]).detach())
            shares = {str(count): share.item() for count, share in enumerate(law.log_prob(torch.arange(16.0)).exp())}
            yield Finding(path / frame.key, frame.lidar["lidar"], Count(law.mean.item()), (Bars(shares),))

    def study(self):  # for `reproduce`: what is recorded to learn from, to choose the epoch by, to test
        train, validation, test = ({**SCENE, "seed": seed} for seed in (1, 2, 3))
        return StudyRecipe("tiny", (train,), validation, {"other scenes": test}, epochs=20, patience=20)


def sample(frame, config):  # the logarithm of returns by cell, of what stands on the ground; who has five or more
    raised = frame.lidar["lidar"][frame.lidar["lidar"][:, 2] > -1.5, :2]
    cells = np.histogram2d(*raised.T, bins=config.cells, range=[(-config.reach_m, config.reach_m)] * 2)[0]
    return np.log1p(cells).astype(np.float32), int((frame.annotations.returns >= 5).sum())


TASK = CountingTask()

if __name__ == "__main__":
    out = sys.argv[1] if len(sys.argv) > 1 else "out/own_task"
    record(Recipe(**SCENE), f"{out}/data")
    print(evaluate(TASK, f"{out}/data", train(TASK, f"{out}/data", out=f"{out}/network", epochs=20).network))
