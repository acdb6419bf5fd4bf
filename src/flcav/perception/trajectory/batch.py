"""Samples as the tensors that the network takes and is compared with."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from flcav.perception.trajectory.samples import Sample
from flcav.perception.trajectory.views import Inputs


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
