"""What one training sample and one inference of each SECOND cost, on sweeps in the suburb.

CPU milliseconds at one thread, median over steps of two samples: augmentation, targets, voxels, forward, loss, backward
and optimiser. `tiny` and `pillars` see 32 beams, the others KITTI's 64; their training is also told as a share of
that of `tiny`. The reference, 106 for a training step of `tiny`, is a prototype on another machine, on sweeps that
cover 90 degrees ahead; ours are timed on the same sector and on the whole spin, of which the network uses what lies
ahead of the sensor. `--paper` times the published widths too: minutes.

`--device cuda` times the published widths on a GPU instead, in seconds that pass: sweeps trained on per second with
float32 and with bfloat16, and how often the host waits for the GPU in one forward pass.
"""

import argparse
import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch

from flcav.perception.device import select_device
from flcav.perception.objects import Sample, Second, detect, sample_from_frame
from flcav.perception.objects.predict import predict
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import build_network
from flcav.perception.training import AdamW, step
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.statistics.streams import stream

T = TypeVar("T")

REFERENCE_MS = 106
FRAMES, BATCH = 8, 2
GPU_BATCH, GPU_STEPS = 4, 20
RULE_SETS = 8  # of a forward pass: four scales, and the four steps between them and to the map
STEPS = {"tiny": 24, "pillars": 24, "small": 12, "paper": 2}
RIGS = {"tiny": "lidar32", "pillars": "lidar32", "small": "kitti_lidar", "paper": "kitti_lidar"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paper", action="store_true", help="the published widths too")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    asked = parser.parse_args()
    if asked.device == "cuda":
        time_on_gpu()
    else:
        time_on_cpu(("tiny", "pillars", "small", "paper") if asked.paper else ("tiny", "pillars", "small"))


def time_on_cpu(names: tuple[str, ...]) -> None:
    torch.set_num_threads(1)
    reference: dict[str, float] = {}  # CPU-ms of a training step of tiny, by part of the spin
    print(f"SECOND, CPU-ms per sample (median; reference {REFERENCE_MS} for a training step of tiny, 90 degrees)")
    for name in names:
        network = build_network(OBJECTS, OBJECTS.configurations[name], 0)
        whole = _sweeps(network, RIGS[name])
        sector = [replace(s, points=s.points[s.points[:, 0] > np.abs(s.points[:, 1])]) for s in whole]
        for part, samples in (("90 degrees", sector), ("whole spin", whole)):
            training = _time(network, f"{name}, {part}", samples, STEPS[name])
            if RIGS[name] == RIGS["tiny"]:
                print(f"    of tiny: {training / reference.setdefault(part, training):.2f}", flush=True)


def time_on_gpu() -> None:
    device = select_device("cuda")
    print(f"paper on {torch.cuda.get_device_name(device)}, torch {torch.__version__}, batches of {GPU_BATCH}")
    for bfloat16 in (False, True):
        config = replace(OBJECTS.configurations["paper"], bfloat16=bfloat16)
        _time_on_gpu(build_network(OBJECTS, config, 0).to(device).train(), device)


def _time_on_gpu(network: Second, device: torch.device) -> None:
    batch = (_sweeps(network, RIGS["paper"]) * GPU_BATCH)[:GPU_BATCH]
    optimizer = AdamW(network, 1e-3)
    trained = GPU_BATCH / _median_seconds(lambda: step(OBJECTS, network, optimizer, batch))
    seen = GPU_BATCH / _median_seconds(lambda: predict(network, [sample.points for sample in batch]))
    points, sample = (tensor.to(device) for tensor in _alone(batch[0]))
    voxels, before = _waits(lambda: network.voxels(points, sample, 1))
    _, after = _waits(lambda: network(voxels))
    print(
        f"  {'bfloat16' if network.config.bfloat16 else 'float32'}: {trained:.1f} sweeps trained on a second, ", end=""
    )
    print(f"{seen:.1f} passed forward; waits: {before} for voxels, {after} for {RULE_SETS} sets of rules and the rest")


def _median_seconds(run: Callable[[], object]) -> float:
    times = []
    for _ in range(GPU_STEPS + 3):  # the first ones warm up
        torch.cuda.synchronize()
        start = time.perf_counter()
        run()
        torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return statistics.median(times[3:])


def _waits(run: Callable[[], T]) -> tuple[T, int]:
    """Return what `run` returns and how often it made the host wait for the GPU."""
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as waits:
        warnings.simplefilter("always")
        result = run()
    torch.cuda.set_sync_debug_mode("default")
    return result, len(waits)


def _sweeps(network: Second, rig: str) -> list[Sample]:
    recipe = {"town": "suburb", "seed": 1, "cavs": 2, "spins_per_scene": FRAMES // 2, "vehicle_rig": rig}
    source = EmbeddedSource(Recipe.model_validate(recipe))
    return [sample_from_frame(frame, network.config) for frame in source.frames(source.scenes()[0])]


def _time(network: Second, title: str, samples: list[Sample], steps: int) -> float:
    """Return the CPU time [ms] of a training step, after printing it."""
    cells = statistics.mean(_count_cells(network, sample) for sample in samples)
    network.train()
    optimizer = AdamW(network, 1e-3)
    training = _median_ms(lambda i: _step(network, optimizer, samples, i), steps) / BATCH
    inference = _median_ms(lambda i: detect(network, samples[i % FRAMES].points), steps)
    print(f"  {title:<18} {cells:6.0f} cells, training step {training:7.1f}, inference {inference:7.1f}", flush=True)
    return training


def _count_cells(network: Second, sample: Sample) -> int:
    """Return how many voxels, or pillars, of a sample hold returns."""
    cells = network.voxels(*_alone(sample), 1)
    return int((cells[:, 0] > 0).sum()) if isinstance(cells, torch.Tensor) else len(cells.keys)


def _alone(sample: Sample) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(sample.points), torch.zeros(len(sample.points), dtype=torch.int64)


def _step(network: Second, optimizer: AdamW, samples: list[Sample], number: int) -> None:
    places = range(BATCH * number, BATCH * (number + 1))
    drawn = [
        OBJECTS.draw(samples, place % FRAMES, network.config, stream(0, "augment", number, place)) for place in places
    ]
    step(OBJECTS, network, optimizer, drawn)


def _median_ms(run: Callable[[int], object], steps: int) -> float:
    times = []
    for number in range(steps + 2):  # the first ones warm up
        start = time.process_time()
        run(number)
        times.append(1000 * (time.process_time() - start))
    return statistics.median(times[2:])


if __name__ == "__main__":
    main()
