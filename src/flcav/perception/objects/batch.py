"""What one training step of the detector does with its samples."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flcav.perception.objects.loss import second_loss
from flcav.perception.objects.model import HeadOutput, Second
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.targets import assign


def batch_loss(network: Second, samples: Sequence[Sample]) -> Tensor:
    """Return the loss of a batch, differentiable in the network's parameters."""
    targets = [assign(sample, network.config) for sample in samples]
    return second_loss(predict(network, [sample.points for sample in samples]), targets, network.config)


def predict(network: Second, clouds: Sequence[NDArray[np.float32]]) -> HeadOutput:
    """Return the raw predictions for a batch of point clouds (N_i, 4), LiDAR frame."""
    device = network.head.weight.device
    points = torch.from_numpy(np.concatenate(clouds)).to(device)
    sizes = torch.tensor([len(cloud) for cloud in clouds], device=device)
    sample = torch.repeat_interleave(torch.arange(len(clouds), device=device), sizes)
    return network(network.voxels(points, sample, len(clouds)))
