"""Further losses of a detector: federated distillation from the road average, imitation, and ensemble distillation.

Wang et al. (IEEE Network 37(3), 2023), "federated distillation": each vehicle updates itself by a contrastive loss
between its boxes and those of the road average. The loss of a batch is the sum of

- classification: the focal loss of SECOND, in which anchors count as negatives only in the sample's `free` cells;
- regression: smooth L1 of the residuals and cross-entropy of directions, weighted over the batch by the inverse
  variance of the labels, component by component;
- InfoNCE (van den Oord et al., "Representation Learning with Contrastive Predictive Coding", 2018, eq. 4) of
  bird's-eye features pooled in boxes: the query is a box that the vehicle detected, its positive the matching box of
  the road average, its negatives are the other boxes of the sweep, from the road average or the vehicle.

Imitation is knowledge distillation against forgetting (Li and Hoiem, "Learning without Forgetting", ECCV 2016; for
detectors Shmelkov, Schmid, Alahari, "Incremental Learning of Object Detectors without Catastrophic Forgetting", ICCV
2017). It adds to the loss on labels the distance of box residuals and headings from those of the earlier network, the
teacher, where that detects an object. It needs no samples of what was learned before.

Ensemble distillation (FedDF: Lin et al., "Ensemble Distillation for Robust Model Fusion in Federated Learning", NeurIPS
2020) adds to the loss on labels the divergence of the scores from those of an ensemble of networks, whose logits are
averaged. Boxes are learned from the labels alone: those of the teachers fit the objects of other places.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from flcav.arrays import Ints
from flcav.geometry import Boxes, concatenate, spread_over_footprints
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.loss import (
    BOX_WEIGHT,
    DIRECTION_WEIGHT,
    VARIANCE_WEIGHT,
    Targets,
    assign_anchors,
    box_losses,
    classification_loss,
    residual_errors,
    second_loss,
    smooth_l1,
)
from flcav.perception.objects.model import HeadOutput, Second
from flcav.perception.objects.predict import voxels_of
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import ObjectsTask

MATCH_M = 2.0  # largest distance in bird's-eye view of a vehicle's box from the box of the road average
POOL = (5, 3)  # points along and across a box at which features are sampled
YAW = 6  # column of a residual


@dataclass(frozen=True)
class DistillationTerms:
    """Terms of the distillation loss in addition to classification."""

    regression: bool = True
    contrastive: bool = True
    contrastive_weight: float = 0.1
    temperature: float = 0.1  # of InfoNCE


class DistilledObjects(ObjectsTask):
    """3D object detection that learns by federated distillation."""

    def __init__(self, terms: DistillationTerms) -> None:
        super().__init__()
        self.terms = terms

    def loss(self, network: Second, samples: Sequence[Sample]) -> Tensor:
        """Return the distillation loss of a batch, differentiable in the network's parameters."""
        return distillation_loss(network, samples, self.terms)


def distillation_loss(network: Second, samples: Sequence[Sample], terms: DistillationTerms) -> Tensor:
    """Return the scalar distillation loss of a batch, see the module's description."""
    targets = [assign_anchors(sample, network.config) for sample in samples]
    features = network.map_features(voxels_of(network, [sample.points for sample in samples]))
    output = network.answer(features)
    total = classification_loss(output, targets, network.config) / len(samples)
    if terms.regression:
        total = total + regression_loss(output, targets)
    if terms.contrastive:
        total = total + terms.contrastive_weight * contrastive_loss(
            features.to(output.score.dtype), samples, network.config, terms.temperature
        )
    return total


def regression_loss(output: HeadOutput, targets: Sequence[Targets]) -> Tensor:
    """Return the scalar loss of box residuals, directions and variances of a batch, weighted by inverse variance.

    For each component it is the mean over the positive anchors with weights 1 / variance; a direction has the weight of
    its yaw. It is 0 without a positive anchor. Without variances all anchors have the same weight.
    """
    box, direction, nll = box_losses(output, targets)
    known = [torch.ones_like(target.residual) if target.variance is None else target.variance for target in targets]
    weight = 1 / torch.cat(known).to(box.device)
    weight = weight / weight.sum(0).clamp(min=torch.finfo(weight.dtype).tiny)
    total = BOX_WEIGHT * (box * weight).sum() + DIRECTION_WEIGHT * (direction * weight[:, YAW]).sum()
    return total if nll is None else total + VARIANCE_WEIGHT * (nll * weight).sum()


def contrastive_loss(features: Tensor, samples: Sequence[Sample], config: SecondConfig, temperature: float) -> Tensor:
    """Return the mean InfoNCE over the matched boxes of the vehicles in a batch; 0 without any.

    `features` (B, C, H, W) are those of the head's grid.
    """
    losses = []
    for map_features, sample in zip(features, samples, strict=True):
        detected = Boxes.empty() if sample.own is None else sample.own
        mine, road = match_boxes(detected, sample.boxes)
        if not len(mine):
            continue
        others = detected[np.setdiff1d(np.arange(len(detected)), mine)]
        queries = pool_boxes(map_features, detected[mine], config)
        keys = pool_boxes(map_features, concatenate([sample.boxes, others]), config)
        losses.append(info_nce(queries, keys, torch.from_numpy(road).to(keys.device), temperature))
    return torch.cat(losses).mean() if losses else features.sum() * 0


def info_nce(queries: Tensor, keys: Tensor, positive: Tensor, temperature: float) -> Tensor:
    """Return the InfoNCE (Q,) of queries (Q, C) against keys (K, C); `positive` (Q,) is the index of each query's key.

    - log( exp(s_p / t) / sum_k exp(s_k / t) ), with s the cosine of two features and t the temperature.
    """
    cosine = F.normalize(queries, dim=1) @ F.normalize(keys, dim=1).T
    return F.cross_entropy(cosine / temperature, positive, reduction="none")


def pool_boxes(features: Tensor, boxes: Boxes, config: SecondConfig) -> Tensor:
    """Return the features (N, C) of N boxes, LiDAR frame: means of a map (C, H, W) over a grid in each footprint.

    The map has the head's grid, rows along y, columns along x. It is interpolated bilinearly at the centres of `POOL`
    parts of the box, along and across; it is 0 outside the range.
    """
    low, high = np.array(config.range_m[:2]), np.array(config.range_m[3:5])
    place = torch.from_numpy(2 * (spread_over_footprints(boxes, *POOL) - low) / (high - low) - 1).to(features)
    sampled = F.grid_sample(features[None], place[None], align_corners=False)  # (1, C, N, points)
    return sampled[0].mean(2).T


def match_boxes(own: Boxes, road: Boxes) -> tuple[Ints, Ints]:
    """Return the rows of `own` and of `road` that show the same object: one to one, of least total distance.

    Matched boxes are of the same class and at most `MATCH_M` apart in bird's-eye view.
    """
    apart = np.linalg.norm(own.center[:, None, :2] - road.center[None, :, :2], axis=2)
    fits = (apart <= MATCH_M) & (own.label[:, None] == road.label[None])
    mine, theirs = linear_sum_assignment(np.where(fits, apart, 1e6))
    paired = fits[mine, theirs]
    return mine[paired], theirs[paired]


SEEN = 0.1  # score from which the teacher counts as detecting an object


class ImitatingObjects(ObjectsTask):
    """3D object detection that learns from labels and, with a `weight`, from the boxes of a `teacher`."""

    def __init__(self, teacher: Second, weight: float) -> None:
        super().__init__()
        self.teacher, self.weight = teacher.eval().requires_grad_(False), weight

    def loss(self, network: Second, samples: Sequence[Sample]) -> Tensor:
        """Return SECOND's loss on a batch plus that of imitation, differentiable in the network's parameters."""
        voxels = voxels_of(network, [sample.points for sample in samples])
        output, seen = network(voxels), self.teacher(voxels)
        targets = [assign_anchors(sample, network.config) for sample in samples]
        return second_loss(output, targets, network.config) + self.weight * imitation_loss(output, seen)


def imitation_loss(output: HeadOutput, teacher: HeadOutput) -> Tensor:
    """Return the scalar distance of a batch's boxes from the teacher's, over the anchors where it detects an object.

    It is smooth L1 of the residuals and cross-entropy of the headings, averaged by the teacher's scores, with the
    weights of the loss on labels; 0 where the teacher detects nothing.
    """
    score = teacher.score.sigmoid().amax(2)  # (B, A)
    where = score >= SEEN
    if not where.any():
        return output.box.sum() * 0
    share = score[where] / score[where].sum()
    box = smooth_l1(residual_errors(output.box[where], teacher.box[where])).sum(1)
    direction = F.cross_entropy(output.direction[where], teacher.direction[where].softmax(1), reduction="none")
    return ((BOX_WEIGHT * box + DIRECTION_WEIGHT * direction) * share).sum()


class TaughtObjects(ObjectsTask):
    """3D object detection that learns from labels and, with a `weight`, from the mean scores of `teachers`."""

    def __init__(self, teachers: Sequence[Second], weight: float) -> None:
        super().__init__()
        self.teachers = [teacher.eval().requires_grad_(False) for teacher in teachers]
        self.weight = weight

    def loss(self, network: Second, samples: Sequence[Sample]) -> Tensor:
        """Return SECOND's loss on a batch plus that of the ensemble, differentiable in the network's parameters."""
        voxels = voxels_of(network, [sample.points for sample in samples])
        output, seen = network(voxels), [teacher(voxels).score for teacher in self.teachers]
        targets = [assign_anchors(sample, network.config) for sample in samples]
        return second_loss(output, targets, network.config) + self.weight * ensemble_loss(output.score, seen)


def ensemble_loss(score: Tensor, teachers: Sequence[Tensor]) -> Tensor:
    """Return the scalar divergence KL(p || q) of a batch's scores from those of an ensemble; all are logits (B, A, K).

    q is the sigmoid of `score`, p that of the teachers' mean. It is summed over the anchors, and divided by the number
    of those where the ensemble detects an object, or 1.
    """
    mean = torch.stack([*teachers]).mean(0)
    wanted = mean.sigmoid()
    cross, entropy = (F.binary_cross_entropy_with_logits(each, wanted, reduction="sum") for each in (score, mean))
    return (cross - entropy) / (wanted >= SEEN).sum().clamp(min=1)
