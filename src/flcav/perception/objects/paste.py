"""Objects of all samples put into a sample: the ground-truth database and sampling of SECOND, sec. 3.2.1.

An object comes with its returns, at the place it was seen at, so that their density is that of its distance. It is left
out where its footprint meets another's; returns of the scene within it are taken out.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.geometry import Boxes, concatenate, points_in_boxes
from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.truth import MIN_RETURNS, in_range
from flcav.perception.ops.rotated import iou


@dataclass(frozen=True)
class Cutouts:
    """Objects with the returns in their boxes, LiDAR frame."""

    boxes: Boxes  # label = detection class
    points: tuple[NDArray[np.float32], ...]  # of each box (N, 4) x, y, z [m], intensity [0, 1]


def cut(samples: Iterable[Sample], config: SecondConfig) -> Cutouts:
    """Return the objects in range of all samples: those whose pose is known, with enough returns."""
    boxes, points = [Boxes.empty()], []
    for sample in samples:
        known = np.ones(len(sample.boxes), dtype=bool) if sample.exact is None else sample.exact
        own = sample.boxes[known & in_range(sample.boxes, config)]
        inside = points_in_boxes(sample.points, own)
        enough = inside.sum(1) >= MIN_RETURNS
        boxes.append(own[enough])
        points += [sample.points[row] for row in inside[enough]]
    return Cutouts(concatenate(boxes), tuple(points))


def pasted(sample: Sample, cutouts: Cutouts, most: int, rng: np.random.Generator) -> Sample:
    """Return the sample filled up to `most` objects of each class with cut-outs drawn by `rng` that meet nothing."""
    drawn = []
    for label in np.unique(cutouts.boxes.label):
        known = np.flatnonzero(cutouts.boxes.label == label)
        missing = max(most - np.count_nonzero(sample.boxes.label == label), 0)
        drawn.append(rng.permutation(known)[:missing])
    numbers = np.concatenate([np.zeros(0, dtype=np.int64), *drawn])
    taken = numbers[free(cutouts.boxes[numbers], concatenate([sample.boxes, sample.ignore]))]
    added = cutouts.boxes[taken]
    kept = sample.points[~points_in_boxes(sample.points, added).any(0)]
    exact = None if sample.exact is None else np.append(sample.exact, np.ones(len(added), dtype=bool))
    cloud = np.concatenate((kept, *(cutouts.points[number] for number in taken)))
    return replace(sample, points=cloud, boxes=concatenate([sample.boxes, added]), exact=exact)


def free(candidates: Boxes, there: Boxes) -> NDArray[np.int64]:
    """Return the numbers of the candidates that meet nothing from above, the first first: nor one another."""
    everything = torch.from_numpy(np.concatenate((there.array(), candidates.array())))
    meets = (iou(torch.from_numpy(candidates.array()), everything, "bev") > 0).numpy()
    blocked = np.asarray(meets[:, : len(there)].any(axis=1))
    taken: list[int] = []
    for number in range(len(candidates)):
        if not blocked[number]:
            taken.append(number)
            blocked |= meets[:, len(there) + number]
    return np.array(taken, dtype=np.int64)
