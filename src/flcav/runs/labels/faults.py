"""Ground-truth labels with one fault of the vehicles' labels at a time, to measure what this fault costs."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.geometry import Boxes, concatenate
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.truth import ground_truth
from flcav.perception.ops.boxes import iou
from flcav.runs.frames import Frames
from flcav.runs.recipe import Fault

OVERLAP = 0.3  # bird's-eye IoU from which on a label is of an object, however wrong its box
FAR_M = 24.0  # distance from which on an object is far [m]: half of the range of the demo's network
OCCLUDED = 0.5  # hidden share from which on an object is occluded

Occlusion = NDArray[np.float64]  # (B,) hidden shares of a sample's objects in [0, 1]; NaN: not known


def read_occlusion(
    split: Frames, frames: Sequence[int], region: str, config: SecondConfig
) -> dict[str, list[Occlusion]]:
    """Read the hidden shares of the objects in `frames`, in the order of `annotated_samples`, by "region/vehicle"."""
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
    """Return the samples of `truth` with one fault of the labels in `labelled`; both have the same frames, by vehicle.

    `hidden`: hidden shares of the objects of `truth`, see `read_occlusion`.
    """
    return {
        name: [change_labels(*sample, fault) for sample in zip(samples, labelled[name], hidden[name], strict=True)]
        for name, samples in truth.items()
    }


def change_labels(truth: Sample, labelled: Sample, hidden: Occlusion, fault: Fault) -> Sample:
    """Return the sample of `truth` with one fault of the labels of the same sweep, boxes in the LiDAR frame.

    missed: objects without a label become background; unsure: they become neutral; range, occlusion: only far or
    occluded ones become background; false: labels without an object are added; boxes: labelled objects get the boxes
    of their labels; presence: the size and pose of no object is learned.
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
    """Concatenate boxes, dropping their scores."""
    return concatenate([Boxes.from_array(boxes.array(), np.asarray(boxes.label)) for boxes in (first, second)])
