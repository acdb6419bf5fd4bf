"""Ground truth with one fault of the vehicles' own labels at a time, which shows what each fault costs."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.geometry import Boxes, concatenate
from flcav.perception.objects.model import SecondConfig
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.truth import ground_truth
from flcav.perception.ops.boxes import iou
from flcav.runs.frames import Frames
from flcav.runs.recipe import Fault

OVERLAP = 0.3  # bird's-eye IoU from which on a label is of an object, however wrong its box
FAR_M = 24.0  # distance from which on an object is far: half of what the demo's network reaches
OCCLUDED = 0.5  # hidden share from which on an object is occluded

Occlusion = NDArray[np.float64]  # (B,) hidden share of each object of a sample in [0, 1]; NaN: not known


def read_occlusion(
    split: Frames, frames: Sequence[int], region: str, config: SecondConfig
) -> dict[str, list[Occlusion]]:
    """Return the hidden share of the objects of each of `frames`, in the order of `annotated_samples`, by vehicle."""
    found: dict[str, list[Occlusion]] = {}
    for i in frames:
        frame = split.data.frame(i)
        hidden = frame.annotations.occlusion[ground_truth(frame, config).enough].astype(float)
        found.setdefault(f"{region}/{split.data.keys[i].agent}", []).append(hidden)
    return found


def give_fault(
    truth: Mapping[str, Sequence[Sample]],
    labelled: Mapping[str, Sequence[Sample]],
    hidden: Mapping[str, Sequence[Occlusion]],
    fault: Fault,
) -> dict[str, list[Sample]]:
    """Return samples with ground truth as labels but for one fault of `labelled`, the same frames; all by vehicle.

    hidden: shares of the objects of `truth`, see `read_occlusion`.
    """
    return {
        name: [change_labels(*each, fault) for each in zip(own, labelled[name], hidden[name], strict=True)]
        for name, own in truth.items()
    }


def change_labels(truth: Sample, labelled: Sample, hidden: Occlusion, fault: Fault) -> Sample:
    """Return the sample of `truth` with one fault of the labels of the same sweep.

    missed: objects without a label are background; unsure: they are neutral; range, occlusion: those of them are
    background that are far, or occluded; false: labels of nothing are added; boxes: labelled objects have the boxes of
    their labels; presence: size and pose of no object are learned.
    """
    if fault == "presence":
        return replace(truth, exact=np.zeros(len(truth.boxes), bool))
    objects, labels = truth.boxes, labelled.boxes
    overlap = iou(torch.from_numpy(labels.array()), torch.from_numpy(objects.array()), "bev").numpy()
    overlap = overlap.reshape(len(labels), len(objects))
    found = overlap.max(axis=0, initial=0.0) >= OVERLAP
    if fault == "missed":
        return replace(truth, boxes=objects[found])
    if fault == "range":
        return replace(truth, boxes=objects[found | (np.linalg.norm(objects.center[:, :2], axis=1) < FAR_M)])
    if fault == "occlusion":
        return replace(truth, boxes=objects[found | ~(hidden >= OCCLUDED)])
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
