"""CPU time [ms] of one training sample and one inference of every network of every task, at one thread.

A training sample is augmentation, forward, loss, backward and optimiser, the median of some steps of the task's batch
but for the paper's networks, whose batches are of two. An inference is what `flcav infer` does with one input, reading
included, the mean over a short drive: pictures of 320 x 192, sweeps of 64 beams, all road users around a vehicle.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from cpu_time import cpu_ms

from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.perception.task import Task, build_network
from flcav.perception.tasks import TASKS, task_named
from flcav.perception.training import AdamW, step
from flcav.sensors.rig import RIGS
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.statistics.streams import stream

REPEATS = 5
RING = {"front": 0, "front_left": 60, "front_right": -60, "back_left": 120, "back_right": -120, "back": 180}
CAMERA = {"width": 320, "height": 192, "fov_deg": 90.0}
RECIPE = {
    "town": "suburb",
    "seed": 1,
    "cavs": 1,
    "spins_per_scene": 13,
    "every_s": 0.5,
    "vehicle_rig": {
        "lidars": RIGS["kitti_lidar"].model_dump(mode="json")["lidars"],
        "cameras": {name: {"mount": {"z": 1.7, "yaw_deg": yaw}, "settings": CAMERA} for name, yaw in RING.items()},
    },
}


def main(names: list[str]) -> None:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        record(EmbeddedSource(Recipe.model_validate(RECIPE)), Path(name) / "data")
        data = Dataset.open(Path(name) / "data")
        for task in map(task_named, names):
            print(f"{task.name}, CPU-ms")
            for network, config in task.configurations.items():
                time_network(task, network, config, data)


def time_network(task: Task, name: str, config: Any, data: Dataset) -> None:
    network = build_network(task, config, 0)
    samples = task.samples(data, config)
    batch = 2 if name.startswith("paper") else min(task.practice.batch, len(samples))
    [trained] = cpu_ms([training(task, network, samples, batch)], 1 if name.startswith("paper") else REPEATS)
    start = time.process_time()
    inputs = sum(1 for _ in task.infer(network.eval(), data.folder, 0.3))
    inferred = 1e3 * (time.process_time() - start) / inputs
    million = sum(parameter.numel() for parameter in network.parameters()) / 1e6
    told = f"a training sample {trained / batch:8.1f} in batches of {batch}, an inference {inferred:8.1f}"
    print(f"  {name:<14}{million:6.2f} M parameters: {told}", flush=True)


def training(task: Task, network: Any, samples: Any, batch: int) -> Callable[[], float]:
    optimizer = AdamW(network.train(), task.practice.learning_rate)

    def work() -> float:
        drawn = [task.draw(samples, i, network.config, stream(0, "augment", i)) for i in range(batch)]
        return step(task, network, optimizer, drawn)

    return work


if __name__ == "__main__":
    main(sys.argv[1:] or list(TASKS))
