"""Imitation: a detector learns new labels, and keeps the boxes that the network it began with sees on the same sweeps.

It is knowledge distillation against forgetting (Li and Hoiem, "Learning without Forgetting", ECCV 2016; of detectors
Shmelkov, Schmid, Alahari, "Incremental Learning of Object Detectors without Catastrophic Forgetting", ICCV 2017). To
the loss on labels it adds the distance of box residuals and headings from those of the earlier network, the teacher,
where that sees an object. It needs no samples of what was learned before.
"""

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor

from flcav.perception.objects.loss import (
    BOX_WEIGHT,
    DIRECTION_WEIGHT,
    assign_anchors,
    residual_errors,
    second_loss,
    smooth_l1,
)
from flcav.perception.objects.model import HeadOutput, Second
from flcav.perception.objects.predict import voxels_of
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.task import ObjectsTask

SEEN = 0.1  # score from which on the teacher sees an object


class ImitatingObjects(ObjectsTask):
    """3D object detection that learns from labels, and from the boxes of a `teacher` with a `weight`."""

    def __init__(self, teacher: Second, weight: float) -> None:
        super().__init__()
        self.teacher, self.weight = teacher.eval().requires_grad_(False), weight

    def loss(self, network: Second, samples: Sequence[Sample]) -> Tensor:
        """Return the loss of SECOND on a batch and that of imitation, differentiable in the network's parameters."""
        voxels = voxels_of(network, [sample.points for sample in samples])
        output, seen = network(voxels), self.teacher(voxels)
        targets = [assign_anchors(sample, network.config) for sample in samples]
        return second_loss(output, targets, network.config) + self.weight * imitation_loss(output, seen)


def imitation_loss(output: HeadOutput, teacher: HeadOutput) -> Tensor:
    """Return the scalar distance of a batch's boxes from the teacher's, over the anchors where it sees an object.

    That is smooth L1 of the residuals and cross-entropy of the headings, means by the teacher's scores, with the
    weights of the loss on labels; 0 where it sees nothing.
    """
    score = teacher.score.sigmoid().amax(2)  # (B, A)
    where = score >= SEEN
    if not where.any():
        return output.box.sum() * 0
    share = score[where] / score[where].sum()
    box = smooth_l1(residual_errors(output.box[where], teacher.box[where])).sum(1)
    direction = F.cross_entropy(output.direction[where], teacher.direction[where].softmax(1), reduction="none")
    return ((BOX_WEIGHT * box + DIRECTION_WEIGHT * direction) * share).sum()
