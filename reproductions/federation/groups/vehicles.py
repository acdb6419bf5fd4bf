"""Vehicles that know part of the weathers and meet the rest: what they pretrain on, drive through, and hold back.

The drives are those of `federation/drives.py`. All pictures of the first scenes with the common weathers
are the samples of stage I; what vehicles meet after it is in the others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flcav.federation.trainable import Weights
from flcav.reproductions.federation.drives import (
    Drives,
    Pictures,
    Vehicle,
    differentiate,
    draw_head,
    measure_losses,
)
from flcav.runs.extras.groups.members import Offer, hold_back, sketch_gradient
from flcav.statistics.streams import derive_seed, stream

PRETRAIN_SCENES = 3  # the first ones
RARE = (6, 7)  # classes of weather that pretraining lacks
MEET = 3  # vehicles that meet them, where others do not
STEPS, BATCH, LEARNING_RATE = 400, 16, 0.05  # of pretraining


@dataclass(frozen=True)
class Fleet:
    """The vehicles of a seed after stage I, by name."""

    start: Weights  # that all drive with
    loss: float  # of it at the end of pretraining
    train: Mapping[str, Pictures]  # what they train on, where some is held back
    held: Mapping[str, Pictures]  # what they hold back
    whole: Mapping[str, Pictures]  # both
    meet: tuple[str, ...]  # those that meet the rare weathers


def open_fleet(drives: Drives, seed: int, *, alike: bool, held_back: float) -> Fleet:
    """Return the vehicles with their pictures after stage I; where they are not `alike`, `MEET` of them meet `RARE`."""
    scenes = list(dict.fromkeys(next(iter(drives.vehicles.values())).scenes))
    before = scenes[:PRETRAIN_SCENES]
    names = [*drives.vehicles]
    drawn: list[int] = stream(seed, "meet").permutation(len(names)).tolist()
    meet = tuple(names) if alike else tuple(sorted(names[number] for number in drawn[:MEET]))
    known = [pick(own, np.isin(own.scenes, before) & ~np.isin(own.labels, RARE)) for own in drives.vehicles.values()]
    start, loss = pretrain(join(known), seed)
    whole = {
        name: pick(own, ~np.isin(own.scenes, before) & (~np.isin(own.labels, RARE) | (name in meet)))
        for name, own in drives.vehicles.items()
    }
    parts = {name: hold_back(len(own.labels), held_back) for name, own in whole.items()}
    return Fleet(
        start=start,
        loss=loss,
        train={name: pick(own, parts[name][0]) for name, own in whole.items()},
        held={name: pick(own, parts[name][1]) for name, own in whole.items()},
        whole=whole,
        meet=meet,
    )


def pretrain(pictures: Pictures, seed: int) -> tuple[Weights, float]:
    """Return the network after stage I on `pictures`, and its loss in the last steps."""
    work = {"steps": STEPS, "learning_rate": LEARNING_RATE, "seed": derive_seed(seed, "pretrain")}
    reached = Vehicle(pictures, BATCH).train(draw_head(seed), **work)
    return reached.weights, float(measure_losses(reached.weights, pictures).mean())


def pick(pictures: Pictures, places: Sequence[int] | np.ndarray) -> Pictures:
    """Return some pictures, by their places or by which they are."""
    kept = np.arange(len(pictures.labels))[np.asarray(places)]
    scenes = tuple(pictures.scenes[number] for number in kept.tolist())
    return Pictures(pictures.features[kept], pictures.labels[kept], scenes)


def join(parts: Sequence[Pictures]) -> Pictures:
    """Return the pictures of all parts, one after another."""
    scenes = tuple(scene for part in parts for scene in part.scenes)
    return Pictures(np.concatenate([p.features for p in parts]), np.concatenate([p.labels for p in parts]), scenes)


def make_offer(pictures: Pictures, weights: Weights, seed: int) -> Offer:
    """Return a vehicle's offer of its pictures to a group."""
    labels, counts = np.unique(pictures.labels, return_counts=True)
    seen = dict(zip(map(str, labels.tolist()), counts.tolist(), strict=True))
    gradient = differentiate(weights, pictures.features, pictures.labels)
    return Offer(len(pictures.labels), seen, sketch_gradient(gradient, derive_seed(seed, "offer")))
