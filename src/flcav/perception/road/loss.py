"""Loss of the road network: cross entropy by pixel, weighted by class, and one minus the soft Dice coefficient."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from flcav.dataset.road_labels import IGNORED
from flcav.perception.road.model import STRIDE, RoadNetwork, enlarge
from flcav.perception.road.predict import predict_logits
from flcav.perception.road.samples import Sample

WEIGHTS = (1.0, 6.0, 8.0, 4.0, 8.0, 3.0, 8.0)  # of the classes in the cross entropy: markings are few
DICE = 0.5  # weight of the Dice term
SMOOTH_PX = 10.0  # added to both sides of the ratio, so that a class that hardly occurs hardly counts


def segmentation_loss(network: RoadNetwork, samples: Sequence[Sample]) -> Tensor:
    """Return the loss of a batch of images of one size, whose sides are multiples of 16.

    Dice's coefficient of a class is 2 sum(p t) / (sum p + sum t) over the batch's pixels, p the predicted probability
    and t the truth (Milletari et al., "V-Net", 3DV 2016, without the squares); its mean is over the markings' classes.
    """
    logits = enlarge(predict_logits(network, [sample.picture for sample in samples]), STRIDE)
    truth = torch.from_numpy(np.stack([sample.classes for sample in samples])).long().to(logits.device)
    counted = truth != IGNORED
    weights = logits.new_tensor(WEIGHTS)
    total = functional.cross_entropy(logits, truth, weights, ignore_index=IGNORED, reduction="sum")
    entropy = total / counted.sum().clamp(min=1)
    shares = logits.softmax(1) * counted[:, None]
    wanted = functional.one_hot(truth.where(counted, 0), len(WEIGHTS)).permute(0, 3, 1, 2) * counted[:, None]
    both, either = (shares * wanted).sum((0, 2, 3)), shares.sum((0, 2, 3)) + wanted.sum((0, 2, 3))
    dice = (2 * both + SMOOTH_PX) / (either + SMOOTH_PX)
    return entropy + DICE * (1 - dice[1:]).mean()
