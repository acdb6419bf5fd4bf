"""Statistics of batch normalisation that each region ends stage III with, and their scores in the network of all.

The cloud averages running means and variances with the weights, though they are of the activations of one region's
network (Li et al., "FedBN", ICLR 2021; Andreux et al., "Siloed Federated Learning", DART 2020).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors.numpy import load_file, save

from flcav.federation.trainable import Weights, statistics_names
from flcav.perception.outcomes import score_network
from flcav.perception.task import Task
from flcav.perception.weights import from_arrays, to_arrays
from flcav.runs.frames import Frames
from flcav.runs.results.training import StatisticsScore
from flcav.storage.files import write_bytes


def keep_statistics(weights: Weights, folder: Path, region: str) -> None:
    """Write the statistics among a region's weights to the folder of stage III, in place of those of before."""
    write_bytes(_path(folder, region), save({name: weights[name] for name in statistics_names(weights)}))


def score_statistics(
    task: Task, network: Any, folder: Path, validation: Mapping[str, Frames]
) -> tuple[StatisticsScore, ...]:
    """Return the scores of `network` on each region's validation frames, by whose statistics it has.

    These are its own, and those of the region that `keep_statistics` wrote to `folder`. Without a cloud round there are
    none, and the result is empty.
    """
    arrays, scores = to_arrays(network), []
    for region, split in validation.items():
        if not _path(folder, region).exists():
            continue
        own = task.build(network.config)
        from_arrays(own, {**arrays, **load_file(_path(folder, region))})
        averaged, kept = (score_network(task, each, split.data, split.vehicles) for each in (network, own.eval()))
        scores.append(StatisticsScore(region, len(split.vehicles), averaged, kept))
    return tuple(scores)


def _path(folder: Path, region: str) -> Path:
    return folder / f"statistics-{region}.safetensors"
