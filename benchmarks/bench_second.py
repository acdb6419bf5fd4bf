"""What one training sample and one inference of `second_tiny` cost, on sweeps of 32 beams in the suburb.

CPU milliseconds at one thread, median over steps of two samples: augmentation, targets, voxels, forward, loss, backward
and optimiser. The reference, 106, is a prototype on another machine, on sweeps that cover 90 degrees ahead; ours are
timed on the same sector and on the whole spin, of which the network uses what lies ahead of the sensor.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from flcav.perception.objects import Sample, detect, sample_from_frame, second_tiny
from flcav.perception.objects.task import OBJECTS
from flcav.perception.training import adamw, step
from flcav.seeds import stream
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

REFERENCE_MS = 106
FRAMES, STEPS, BATCH = 8, 24, 2


def main() -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network = second_tiny()
    source = EmbeddedSource(Recipe(town="suburb", seed=1, cavs=2, spins_per_scene=FRAMES // 2))
    whole = [sample_from_frame(frame, network.config) for frame in source.frames(source.scenes()[0])]
    sector = [replace(s, points=s.points[s.points[:, 0] > np.abs(s.points[:, 1])]) for s in whole]
    print(
        f"second_tiny, CPU-ms per sample (median of {STEPS}; reference {REFERENCE_MS} for a training step, 90 degrees)"
    )
    for name, samples in (("90 degrees", sector), ("whole spin", whole)):
        voxels = statistics.mean(len(network.voxels(*_alone(sample), 1).keys) for sample in samples)
        network.train()
        optimizer = adamw(network, 1e-3)
        training = _median_ms(lambda i, o=optimizer, s=samples: _step(network, o, s, i)) / BATCH
        inference = _median_ms(lambda i, s=samples: detect(network, s[i % FRAMES].points))
        print(f"  {name}: {voxels:6.0f} voxels, training step {training:6.1f}, inference {inference:6.1f}")


def _alone(sample: Sample) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(sample.points), torch.zeros(len(sample.points), dtype=torch.int64)


def _step(network, optimizer, samples: list[Sample], number: int) -> None:
    drawn = [_drawn(network, samples, number, place) for place in range(BATCH)]
    step(OBJECTS, network, optimizer, drawn)


def _drawn(network, samples: list[Sample], number: int, place: int) -> Sample:
    random = stream(0, "augment", number, place)
    return OBJECTS.draw(samples, (BATCH * number + place) % FRAMES, network.config, random)


def _median_ms(run: Callable[[int], object]) -> float:
    times = []
    for number in range(STEPS + 3):  # the first ones warm up
        start = time.process_time()
        run(number)
        times.append(1000 * (time.process_time() - start))
    return statistics.median(times[3:])


if __name__ == "__main__":
    main()
