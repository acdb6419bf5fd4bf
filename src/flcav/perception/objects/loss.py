"""Loss of SECOND: focal loss of classes, smooth L1 loss of box residuals, cross-entropy of directions.

Yan et al. 2018, sec. 3.3, eqs. 1-4: the error of the yaw enters by its sine. Weights are the published 1 for classes
and 2 for boxes; the direction's is 1 instead of 0.2, since with the published one a third of the detected cars have a
reversed heading: front and back differ by few points.

Predicted variances are trained by the Gaussian negative log-likelihood of the residuals' errors (the variance's part of
He et al., "Bounding Box Regression with Uncertainty", CVPR 2019, eq. 9). The errors are detached, so that this term
does not change the boxes.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import LOG_VARIANCES, HeadOutput, Second
from flcav.perception.objects.predict import predict
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.targets import Targets, anchor_classes, assign_anchors

ALPHA, GAMMA = 0.25, 2.0  # of the focal loss
BOX_WEIGHT, DIRECTION_WEIGHT, VARIANCE_WEIGHT = 2.0, 1.0, 0.2
SMOOTH_L1_BETA = 1 / 9  # error at which the smooth L1 loss turns from quadratic to linear


def second_loss(output: HeadOutput, targets: Sequence[Targets], config: SecondConfig) -> Tensor:
    """Return the scalar loss of a batch, the mean over its samples.

    The classification term of a sample is divided by its number of positive anchors; the box, direction and variance
    terms by its number of positive anchors with an exact box, the only ones that enter them.
    """
    device = output.score.device
    samples, anchors, classes = output.score.shape
    count = torch.tensor([max(len(target.positive), 1) for target in targets], device=device)
    positive = torch.cat([target.positive + i * anchors for i, target in enumerate(targets)]).to(device)
    share = torch.cat([target.exact / target.exact.sum().clamp(min=1) for target in targets]).to(device)
    weight = torch.stack([target.weight for target in targets]).to(device) / count[:, None]
    kind = torch.tensor(anchor_classes(config), device=device)[positive % anchors]

    logits = output.score.flatten()
    wanted = torch.zeros_like(logits)
    wanted[positive * classes + kind] = 1
    scores = focal_loss(logits, wanted).view(samples, anchors, classes).sum(2)
    classification = (scores * weight).sum()

    residual = torch.cat([target.residual for target in targets]).to(device)
    error = output.box.flatten(0, 1)[positive] - residual
    error = torch.cat((error[:, :6], torch.sin(error[:, 6:])), 1)
    box = F.smooth_l1_loss(error, torch.zeros_like(error), beta=SMOOTH_L1_BETA, reduction="none").sum(1)

    half_turn = torch.cat([target.direction for target in targets]).to(device)
    direction = F.cross_entropy(output.direction.flatten(0, 1)[positive], half_turn, reduction="none")
    total = BOX_WEIGHT * box + DIRECTION_WEIGHT * direction
    if output.log_variance is not None:
        log_variance = output.log_variance.flatten(0, 1)[positive].clamp(*LOG_VARIANCES)
        total = total + VARIANCE_WEIGHT * gaussian_nll(error.detach(), log_variance).sum(1)
    return (classification + (total * share).sum()) / samples


def gaussian_nll(error: Tensor, log_variance: Tensor) -> Tensor:
    """Return the Gaussian negative log-likelihood of each error, without its constant; shape of `error`."""
    return (error.square() * torch.exp(-log_variance) + log_variance) / 2


def focal_loss(logits: Tensor, wanted: Tensor) -> Tensor:
    """Return the focal loss of each logit (Lin et al., "Focal Loss for Dense Object Detection", eq. 5).

    wanted, in the shape of logits: 1 for positives, 0 for negatives.
    """
    signed = torch.where(wanted > 0, logits, -logits)
    balance = torch.where(wanted > 0, ALPHA, 1 - ALPHA)
    return -balance * torch.sigmoid(-signed) ** GAMMA * F.logsigmoid(signed)


def batch_loss(network: Second, samples: Sequence[Sample]) -> Tensor:
    """Return the scalar loss of `network` on a batch of samples, differentiable in the network's parameters."""
    targets = [assign_anchors(sample, network.config) for sample in samples]
    return second_loss(predict(network, [sample.points for sample in samples]), targets, network.config)
