"""Objects of other samples put into a sample: the ground-truth sampling of SECOND, sec. 3.2.1.

An object comes with its returns, at the place it was seen at, so that their density is that of its distance. It is left
out where its footprint meets another's; returns of the scene within it are taken out.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.geometry import Boxes, concatenate, points_in_boxes
from flcav.perception.objects.samples import MIN_RETURNS, Sample
from flcav.perception.ops.rotated import iou


def pasted(sample: Sample, donors: Sequence[Sample], most: int, rng: np.random.Generator) -> Sample:
    """Return the sample with up to `most` objects of each class from `donors`, drawn by `rng`, free of collisions."""
    candidates = concatenate([donor.boxes for donor in donors])
    if not len(candidates):
        return sample
    source = np.repeat(np.arange(len(donors)), [len(donor.boxes) for donor in donors])
    drawn = rng.permutation(len(candidates))
    candidates, source = candidates[drawn], source[drawn]
    taken = fitting(candidates, concatenate([sample.boxes, sample.ignore]), most)
    objects, points = [], []
    for number, donor in enumerate(donors):
        own = candidates[taken[source[taken] == number]]
        inside = points_in_boxes(donor.points, own)
        enough = inside.sum(1) >= MIN_RETURNS
        objects.append(own[enough])
        points.append(donor.points[inside[enough].any(0)])
    added = concatenate(objects)
    kept = sample.points[~points_in_boxes(sample.points, added).any(0)]
    exact = None if sample.exact is None else np.append(sample.exact, np.ones(len(added), dtype=bool))
    cloud = np.concatenate((kept, *points))
    return replace(sample, points=cloud, boxes=concatenate([sample.boxes, added]), exact=exact)


def fitting(candidates: Boxes, there: Boxes, most: int) -> NDArray[np.int64]:
    """Return the numbers of up to `most` candidates of each class, the first first, that meet nothing from above."""
    everything = torch.from_numpy(np.concatenate((there.array(), candidates.array())))
    meets = (iou(torch.from_numpy(candidates.array()), everything, "bev") > 0).numpy()
    blocked = np.asarray(meets[:, : len(there)].any(axis=1))
    taken: list[int] = []
    for number, label in enumerate(candidates.label):
        if not blocked[number] and np.count_nonzero(candidates.label[taken] == label) < most:
            taken.append(number)
            blocked |= meets[:, len(there) + number]
    return np.array(taken, dtype=np.int64)
