"""Predicted paths of samples, batch by batch."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from flcav.perception.trajectory.cross_view import Inputs
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.samples import Sample
from flcav.progress import Report, silent


def inputs_of(samples: Sequence[Sample], network: nn.Module) -> Inputs:
    """Return a batch of inputs on the network's device."""
    device = next(network.parameters()).device
    past = torch.from_numpy(np.stack([sample.past for sample in samples])).to(device)
    seen = [sample.surround for sample in samples if sample.surround is not None]
    if not seen:
        return Inputs(past, raster=rasters_of(samples, device))
    pictures = np.stack([one.pictures for one in seen]).transpose(0, 1, 4, 2, 3)
    return Inputs(
        past,
        pictures=torch.from_numpy(np.ascontiguousarray(pictures)).to(device).float() / 127.5 - 1,
        intrinsics=_floats([one.intrinsics for one in seen], device),
        camera_from_frame=_floats([one.camera_from_frame for one in seen], device),
    )


def rasters_of(samples: Sequence[Sample], device: torch.device) -> Tensor:
    """Return (B, LAYERS, cells, cells) rasters of zeros and ones."""
    bits = np.unpackbits(np.stack([sample.raster for sample in samples]), axis=-1)
    return torch.from_numpy(bits).to(device).float()


def futures_of(samples: Sequence[Sample], device: torch.device) -> Tensor:
    """Return (B, FUTURE, 2) where the road users went."""
    return torch.from_numpy(np.stack([sample.future for sample in samples])).to(device)


def _floats(arrays: list[NDArray[np.float64]], device: torch.device) -> Tensor:
    return torch.from_numpy(np.stack(arrays).astype(np.float32)).to(device)


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
