"""CPU time of one training sample and one prediction of the trajectory networks, and of extracting a sample.

CPU milliseconds at one thread, median over steps of 16 samples: batch, forward, loss, backward and optimiser. The
reference, 2.9 to 5.8, is a prototype (an LSTM with small convolutions on one raster of 64 x 64) on another machine,
46 to 92 ms for 16 samples. Pictures are noise, of the sizes of the camera networks.
"""

import numpy as np
import torch
from cpu_time import cpu_ms

from flcav.dataset.layout import FrameKey
from flcav.perception.task import build_network
from flcav.perception.training import AdamW, step
from flcav.perception.trajectory.config import CONFIGURATIONS, FUTURE, PAST, TrajectoryConfig
from flcav.perception.trajectory.predict import predict_paths
from flcav.perception.trajectory.rasters import LAYERS, road_map
from flcav.perception.trajectory.samples import Columns, Sample, Surround, extract_columns
from flcav.perception.trajectory.task import TRAJECTORY
from flcav.perception.trajectory.tracks import tracks_around
from flcav.world.map.town import load_town
from flcav.world.traffic.traffic import simulate

REFERENCE_MS = (2.9, 5.8)
BATCH, REPEATS, CAMERAS = 16, 7, 6


def main() -> None:
    torch.set_num_threads(1)
    print(f"CPU-ms per sample (median of {REPEATS} batches of {BATCH}; reference {REFERENCE_MS} for a training step)")
    print(f"  extraction: {extraction_ms():.2f}")
    for name, config in CONFIGURATIONS.items():
        network = build_network(TRAJECTORY, config, 0)
        batch = 1 if name == "paper-cameras" else BATCH  # a gigabyte of attention for 16
        samples = [made_sample(config)] * batch
        optimizer = AdamW(network, 1e-3)
        repeats = REPEATS if name.startswith("tiny") else 2
        training, inference = cpu_ms(
            (lambda: step(TRAJECTORY, network, optimizer, samples), lambda: predict_paths(network, samples)),  # noqa: B023
            repeats,
        )
        count = sum(parameter.numel() for parameter in network.parameters())
        print(f"  {name}: {count} parameters, training {training / batch:.1f}, prediction {inference / batch:.1f}")


def extraction_ms() -> float:
    """Return the CPU-ms per sample of histories, futures and rasters from the traffic of a town."""
    town = load_town("grid")
    trace = simulate(town, seed=1, cavs=1, times_s=np.arange(60.0, 70.1, 0.5))
    roads, patch = road_map(town), CONFIGURATIONS["tiny"].patch
    wanted = np.ones(len(trace.actor), np.bool_)
    key = FrameKey("scene", 0, "cav0", 65.0)

    def extract() -> Columns:
        return extract_columns(trace, tracks_around(trace, key.time_s), key, 0, roads, patch, wanted)

    return cpu_ms((extract,), REPEATS)[0] / len(extract().past)


def made_sample(config: TrajectoryConfig) -> Sample:
    """Return a sample of random numbers with the configuration's shapes."""
    random = np.random.default_rng(0)
    cells, cameras = config.patch.cells, config.cameras
    surround = cameras and Surround(
        random.integers(0, 255, (CAMERAS, cameras.height_px, cameras.width_px, 3), dtype=np.uint8),
        np.tile(np.array([[60.0, 0, 63.5], [0, 60.0, 31.5], [0, 0, 1]]), (CAMERAS, 1, 1)),
        np.tile(np.eye(4), (CAMERAS, 1, 1)),
    )
    return Sample(
        past=random.normal(size=(PAST + 1, 4)).astype(np.float32),
        future=random.normal(size=(FUTURE, 2)).astype(np.float32),
        raster=random.integers(0, 255, (len(LAYERS), cells, cells // 8), dtype=np.uint8),
        pose=np.zeros(3),
        actor=np.array(0),
        at_junction=np.array(False),
        scene=np.array("none"),
        frame=np.array(0),
        surround=surround,
    )


if __name__ == "__main__":
    main()
