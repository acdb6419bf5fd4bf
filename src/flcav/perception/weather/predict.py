"""Inference of the weather classifier: class probabilities of images, in batches, and the JSON record of one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from flcav.interface.progress import Report, ignore_progress
from flcav.perception.images import Picture
from flcav.perception.task import Result
from flcav.perception.weather.model import Classifier
from flcav.perception.weather.samples import stack_pictures
from flcav.storage.records import Class

BATCH = 256  # images of a batch of inference


@dataclass(frozen=True)
class Named(Result):
    """Classification of one image: the likeliest class, and the probability of each class."""

    label: Class
    probabilities: Mapping[str, float]  # by class

    def lines(self) -> list[str]:
        """Return one line with the class and its probability."""
        return [f"{self.label} ({self.probabilities[self.label]:.2f})"]


def predict_probabilities(
    network: Classifier, small_pictures: Sequence[Picture], progress: Report = ignore_progress
) -> np.ndarray:
    """Return the class probabilities (N, classes) of images of 32 x 32 pixels.

    The network's training mode is left as it was.
    """
    training = network.training
    network.eval()
    parts = []
    with torch.inference_mode():
        for first in range(0, len(small_pictures), BATCH):
            logits = network(tensor_of(network, list(small_pictures[first : first + BATCH])))
            parts.append(logits.softmax(1).cpu().numpy())
            progress(min(first + BATCH, len(small_pictures)), len(small_pictures), "")
    network.train(training)
    return np.concatenate(parts)


def tensor_of(network: Classifier, small_pictures: list[Picture]) -> Tensor:
    """Return images as the network's input tensor (N, 3, 32, 32) in [-1, 1], on its device."""
    return torch.from_numpy(stack_pictures(small_pictures)).to(next(network.parameters()).device)
