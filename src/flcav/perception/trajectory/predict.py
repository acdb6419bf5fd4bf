"""Inference of the trajectory network on samples: input and target tensors, batches, and the single path."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from flcav.perception.trajectory.cross_view import Inputs
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.samples import Sample
from flcav.progress import Report, ignore_progress


def inputs_of(samples: Sequence[Sample], network: nn.Module) -> Inputs:
    """Return the input tensors of samples on the network's device; with rasters if the samples have no images."""
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
    """Return the rasters (B, LAYERS, cells, cells) of samples, of zeros and ones in float32."""
    bits = np.unpackbits(np.stack([sample.raster for sample in samples]), axis=-1)
    return torch.from_numpy(bits).to(device).float()


def futures_of(samples: Sequence[Sample], device: torch.device) -> Tensor:
    """Return the ground-truth futures (B, FUTURE, 2) [m] of samples."""
    return torch.from_numpy(np.stack([sample.future for sample in samples])).to(device)


def _floats(arrays: list[NDArray[np.float64]], device: torch.device) -> Tensor:
    return torch.from_numpy(np.stack(arrays).astype(np.float32)).to(device)


Array = NDArray[np.float64]

RASTERS, VIEWS = 256, 16  # batch sizes of inference with rasters and with cameras


def predict(
    network: TrajectoryNetwork, samples: Sequence[Sample], progress: Report = ignore_progress
) -> tuple[Array, Array]:
    """Return the forecasts of N samples: paths (N, K, FUTURE, 2) [m] in the samples' frames and probabilities (N, K).

    The network's training mode is left as it was.
    """
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


def find_medoid(paths: Array, probabilities: Array) -> NDArray[np.int64]:
    """Return the index (N,) of the mode that is given as the single path: the medoid of the forecast.

    The medoid is the mode with the least expected average distance to the other modes under the predicted
    probabilities. Unlike the likeliest mode it takes similar modes together. `paths` are (N, K, FUTURE, 2) [m],
    `probabilities` (N, K).
    """
    apart = np.linalg.norm(paths[:, :, None] - paths[:, None], axis=4).mean(axis=3)  # (N, K, K)
    return (apart * probabilities[:, None]).sum(axis=2).argmin(axis=1)
