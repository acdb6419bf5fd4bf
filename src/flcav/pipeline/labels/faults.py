"""Ground truth with one fault of the vehicles' own labels at a time, which shows what each fault costs."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from flcav.geometry import Boxes, concatenate
from flcav.perception.objects.samples import Sample
from flcav.perception.ops.rotated import iou
from flcav.pipeline.recipe import Fault

OVERLAP = 0.3  # bird's-eye IoU from which on a label is of an object, however wrong its box


def give_fault(
    truth: Mapping[str, Sequence[Sample]], labelled: Mapping[str, Sequence[Sample]], fault: Fault
) -> dict[str, list[Sample]]:
    """Return samples with ground truth as labels but for one fault of `labelled`, the same frames; both by vehicle."""
    return {
        name: [change_labels(one, other, fault) for one, other in zip(own, labelled[name], strict=True)]
        for name, own in truth.items()
    }


def change_labels(truth: Sample, labelled: Sample, fault: Fault) -> Sample:
    """Return the sample of `truth` with one fault of the labels of the same sweep.

    missed: objects without a label are background; unsure: they are neutral; false: labels of nothing are added; boxes:
    labelled objects have the boxes of their labels.
    """
    objects, labels = truth.boxes, labelled.boxes
    overlap = iou(torch.from_numpy(labels.array()), torch.from_numpy(objects.array()), "bev").numpy()
    overlap = overlap.reshape(len(labels), len(objects))
    found = overlap.max(axis=0, initial=0.0) >= OVERLAP
    if fault == "missed":
        return replace(truth, boxes=objects[found])
    if fault == "unsure":
        return replace(truth, boxes=objects[found], ignore=_join(truth.ignore, objects[~found]))
    if fault == "false":
        return replace(truth, boxes=_join(objects, labels[overlap.max(axis=1, initial=0.0) < OVERLAP]))
    rows = objects.array().copy()
    rows[found] = labels.array()[overlap.argmax(axis=0)[found]] if found.any() else rows[found]
    return replace(truth, boxes=Boxes.from_array(rows, objects.label))


def _join(first: Boxes, second: Boxes) -> Boxes:
    """Return the boxes of both, without scores."""
    return concatenate([Boxes.from_array(each.array(), np.asarray(each.label)) for each in (first, second)])
