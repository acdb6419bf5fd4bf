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
    share = torch.cat([target.exact / target.exact.sum().clamp(min=1) for target in targets]).to(output.score.device)
    box, direction, nll = box_losses(output, targets)
    total = BOX_WEIGHT * box.sum(1) + DIRECTION_WEIGHT * direction
    if nll is not None:
        total = total + VARIANCE_WEIGHT * nll.sum(1)
    return (classification_loss(output, targets, config) + (total * share).sum()) / len(targets)


def classification_loss(output: HeadOutput, targets: Sequence[Targets], config: SecondConfig) -> Tensor:
    """Return the sum over the samples of a batch of the focal loss of each, divided by its number of positive anchors.

    Ignored anchors do not enter it.
    """
    device = output.score.device
    samples, anchors, classes = output.score.shape
    count = torch.tensor([max(len(target.positive), 1) for target in targets], device=device)
    positive = _positive(output, targets)
    weight = torch.stack([target.weight for target in targets]).to(device) / count[:, None]
    kind = torch.tensor(anchor_classes(config), device=device)[positive % anchors]
    logits = output.score.flatten()
    wanted = torch.zeros_like(logits)
    wanted[positive * classes + kind] = 1
    scores = focal_loss(logits, wanted).view(samples, anchors, classes).sum(2)
    return (scores * weight).sum()


def box_losses(output: HeadOutput, targets: Sequence[Targets]) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return the losses of a batch's P positive anchors: of residuals (P, 7), directions (P,) and variances (P, 7).

    They are smooth L1, cross-entropy and Gaussian negative log-likelihood; the last is None where none are predicted.
    """
    device, positive = output.score.device, _positive(output, targets)
    residual = torch.cat([target.residual for target in targets]).to(device)
    error = residual_errors(output.box.flatten(0, 1)[positive], residual)
    box = smooth_l1(error)
    half_turn = torch.cat([target.direction for target in targets]).to(device)
    direction = F.cross_entropy(output.direction.flatten(0, 1)[positive], half_turn, reduction="none")
    if output.log_variance is None:
        return box, direction, None
    log_variance = output.log_variance.flatten(0, 1)[positive].clamp(*LOG_VARIANCES)
    return box, direction, gaussian_nll(error.detach(), log_variance)


def residual_errors(found: Tensor, wanted: Tensor) -> Tensor:
    """Return the errors (P, 7) of residuals (P, 7): differences, of the yaw its sine."""
    error = found - wanted
    return torch.cat((error[:, :6], torch.sin(error[:, 6:])), 1)


def smooth_l1(error: Tensor) -> Tensor:
    """Return the smooth L1 loss of each error; shape of `error`."""
    return F.smooth_l1_loss(error, torch.zeros_like(error), beta=SMOOTH_L1_BETA, reduction="none")


def _positive(output: HeadOutput, targets: Sequence[Targets]) -> Tensor:
    """Return (P,) the indices of the positive anchors of a batch among the anchors of all samples."""
    anchors = output.score.shape[1]
    return torch.cat([target.positive + i * anchors for i, target in enumerate(targets)]).to(output.score.device)


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
