"""Loss of the weather classifier: cross entropy."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from flcav.perception.weather.model import Classifier
from flcav.perception.weather.predict import tensor_of
from flcav.perception.weather.samples import Sample


def batch_loss(network: Classifier, samples: Sequence[Sample]) -> Tensor:
    """Return the mean cross entropy of `network` on a batch of samples, differentiable in the network's parameters."""
    logits = network(tensor_of(network, [sample.picture for sample in samples]))
    return functional.cross_entropy(logits, torch.tensor([s.label for s in samples], device=logits.device))


def imitation_loss(network: Classifier, samples: Sequence[Sample], targets: Sequence[NDArray[np.float32]]) -> Tensor:
    """Return the mean cross entropy of `network` with class probabilities (1, classes) of each sample for targets."""
    logits = network(tensor_of(network, [sample.picture for sample in samples]))
    return functional.cross_entropy(logits, torch.from_numpy(np.concatenate(targets)).to(logits))
