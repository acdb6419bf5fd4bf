"""A network of trajectories on samples."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.perception.trajectory.batch import inputs_of
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.samples import Sample
from flcav.progress import Report, silent

Array = NDArray[np.float64]

RASTERS, VIEWS = 256, 16  # samples at once, of one kind and the other


def predict(network: TrajectoryNetwork, samples: Sequence[Sample], progress: Report = silent) -> tuple[Array, Array]:
    """Return paths (N, K, FUTURE, 2) [m] in the samples' frames and probabilities (N, K)."""
    training = network.training
    network.eval()
    paths, probabilities = [], []
    size = VIEWS if network.config.cameras else RASTERS
    with torch.inference_mode():
        for first in range(0, len(samples), size):
            batch = [samples[i] for i in range(first, min(first + size, len(samples)))]
            forecast = network(inputs_of(batch, network))
            paths.append(forecast.paths.double().cpu().numpy())
            probabilities.append(forecast.logits.softmax(dim=1).double().cpu().numpy())
            progress(first + len(batch), len(samples), "")
    network.train(training)
    return np.concatenate(paths), np.concatenate(probabilities)


def single(paths: Array, probabilities: Array) -> NDArray[np.int64]:
    """Return (N,) which of the modes is given where only one is asked for: the medoid of the forecast.

    Of all modes it has the least expected distance, over all steps, to the way that is taken, as far as the forecast
    itself knows; several that go much the same way count together, which the likeliest alone would not.
    """
    apart = np.linalg.norm(paths[:, :, None] - paths[:, None], axis=4).mean(axis=3)  # (N, K, K)
    return (apart * probabilities[:, None]).sum(axis=2).argmin(axis=1)
