"""Vehicles with a network of some weathers that meet the others: samples for pretraining, training and held-back tests.

The drives are those of `federation/drives.py`. Stage I uses all pictures of common weathers in the first scenes; the
other scenes are what vehicles meet afterwards.
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

PRETRAIN_SCENES = 3  # number of first scenes for pretraining
RARE = (6, 7)  # classes of weather missing in pretraining
MEET = 3  # number of vehicles that meet them, if not all do
STEPS, BATCH, LEARNING_RATE = 400, 16, 0.05  # of pretraining


@dataclass(frozen=True)
class Fleet:
    """The vehicles of a seed after stage I, by name."""

    start: Weights  # of the pretrained network, with which all drive
    loss: float  # at the end of pretraining
    train: Mapping[str, Pictures]  # for training, without those held back
    held: Mapping[str, Pictures]  # held back
    whole: Mapping[str, Pictures]  # both
    meet: tuple[str, ...]  # vehicles that meet the rare weathers


def open_fleet(drives: Drives, seed: int, *, alike: bool, held_back: float) -> Fleet:
    """Return the fleet after stage I; unless vehicles are `alike`, only `MEET` of them meet the weathers `RARE`."""
    scenes = list(dict.fromkeys(next(iter(drives.vehicles.values())).scenes))
    before = scenes[:PRETRAIN_SCENES]
    names = [*drives.vehicles]
    drawn: list[int] = stream(seed, "meet").permutation(len(names)).tolist()
    meet = tuple(names) if alike else tuple(sorted(names[number] for number in drawn[:MEET]))
    known = [
        pick(pictures, np.isin(pictures.scenes, before) & ~np.isin(pictures.labels, RARE))
        for pictures in drives.vehicles.values()
    ]
    start, loss = pretrain(join(known), seed)
    whole = {
        name: pick(pictures, ~np.isin(pictures.scenes, before) & (~np.isin(pictures.labels, RARE) | (name in meet)))
        for name, pictures in drives.vehicles.items()
    }
    parts = {name: hold_back(len(pictures.labels), held_back) for name, pictures in whole.items()}
    return Fleet(
        start=start,
        loss=loss,
        train={name: pick(pictures, parts[name][0]) for name, pictures in whole.items()},
        held={name: pick(pictures, parts[name][1]) for name, pictures in whole.items()},
        whole=whole,
        meet=meet,
    )


def pretrain(pictures: Pictures, seed: int) -> tuple[Weights, float]:
    """Return the weights after stage I on `pictures`, and their mean loss there."""
    work = {"steps": STEPS, "learning_rate": LEARNING_RATE, "seed": derive_seed(seed, "pretrain")}
    reached = Vehicle(pictures, BATCH).train(draw_head(seed), **work)
    return reached.weights, float(measure_losses(reached.weights, pictures).mean())


def pick(pictures: Pictures, places: Sequence[int] | np.ndarray) -> Pictures:
    """Return the pictures at the indices `places`, or in the mask `places`."""
    kept = np.arange(len(pictures.labels))[np.asarray(places)]
    scenes = tuple(pictures.scenes[number] for number in kept.tolist())
    return Pictures(pictures.features[kept], pictures.labels[kept], scenes)


def join(parts: Sequence[Pictures]) -> Pictures:
    """Concatenate pictures."""
    scenes = tuple(scene for part in parts for scene in part.scenes)
    return Pictures(np.concatenate([p.features for p in parts]), np.concatenate([p.labels for p in parts]), scenes)


def make_offer(pictures: Pictures, weights: Weights, seed: int) -> Offer:
    """Return a vehicle's offer of its pictures to a group."""
    labels, counts = np.unique(pictures.labels, return_counts=True)
    seen = dict(zip(map(str, labels.tolist()), counts.tolist(), strict=True))
    gradient = differentiate(weights, pictures.features, pictures.labels)
    return Offer(len(pictures.labels), seen, sketch_gradient(gradient, derive_seed(seed, "offer")))
