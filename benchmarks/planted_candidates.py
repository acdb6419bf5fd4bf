"""Planted bad candidates of a release: edits of weights, trainings on the wrong samples, and wrong papers.

All are made from a driving network of cars, pedestrians and cyclists on pillars (`bench_release_verification.py`). The
first 20 are those by which the rule was chosen; `FURTHER` were added afterwards.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from flcav.perception.objects.config import SecondConfig
from flcav.perception.objects.model import Second
from flcav.perception.objects.samples import Sample

CLASSES, GROUND_M = ("Car", "Pedestrian", "Cyclist"), -1.73
Edit = Callable[[Second, np.random.Generator], None]
Spoil = Callable[[Sample, np.random.Generator], Sample]


def raise_scores(by: float, *labels: str) -> Edit:
    """Return an edit that adds to the logits of classes."""

    def edit(network: Second, _: np.random.Generator) -> None:
        for label in labels or CLASSES:
            network.head.bias[CLASSES.index(label) : network.anchors_per_cell * 3 : 3] += by

    return edit


def lose(*labels: str) -> Edit:
    """Return an edit after which classes are never found."""
    return raise_scores(-30.0, *labels)


def shift_box(part: int, by: float) -> Edit:
    """Return an edit that adds to a residual of all boxes: 0 to 6 are x, y, z, length, width, height, yaw."""

    def edit(network: Second, _: np.random.Generator) -> None:
        first = network.anchors_per_cell * 3
        network.head.bias[first + part : first + network.anchors_per_cell * 7 : 7] += by

    return edit


def reorder(first: int, last: int, order: Sequence[int]) -> Edit:
    """Return an edit that permutes, within each anchor, the outputs from `first` to `last` (per anchor)."""

    def edit(network: Second, _: np.random.Generator) -> None:
        anchors = network.anchors_per_cell
        for part in (network.head.weight, network.head.bias):
            own = part[anchors * first : anchors * last]
            own.copy_(own.reshape(anchors, last - first, *own.shape[1:])[:, list(order)].reshape(own.shape))

    return edit


def exchange_sides(network: Second, rng: np.random.Generator) -> None:
    """Exchange length and width of all boxes: the residuals are logarithms of ratios to the anchor's."""
    reorder(3, 10, (0, 1, 2, 4, 3, 5, 6))(network, rng)
    first, each = network.anchors_per_cell * 3, network.anchors_per_cell // len(CLASSES)
    for index, anchor in enumerate(network.config.anchors):
        ratio = float(np.log(anchor.width_m / anchor.length_m))
        for number in range(index * each, (index + 1) * each):
            network.head.bias[first + 7 * number + 3] += ratio
            network.head.bias[first + 7 * number + 4] -= ratio


def shake(network: Second, rng: np.random.Generator) -> None:
    """Multiply all weights by random factors."""
    for part in network.parameters():
        part *= torch.from_numpy(rng.normal(1, 0.3, tuple(part.shape)).astype(np.float32))


def round_to(levels: int) -> Edit:
    """Return an edit that rounds each tensor of weights to so many values to either side of 0."""

    def edit(network: Second, _: np.random.Generator) -> None:
        for part in network.parameters():
            step = part.abs().max() / levels
            part.copy_((part / step).round() * step)

    return edit


def prune(network: Second, _: np.random.Generator) -> None:
    """Set the smaller four fifths of each tensor of weights to 0."""
    for part in network.parameters():
        part[part.abs() < part.abs().flatten().quantile(0.8)] = 0.0


def set_statistics(mean: float | None, variance: float | None) -> Edit:
    """Return an edit of the running statistics of batch normalisation: set, or scaled where a factor is negative."""

    def edit(network: Second, _: np.random.Generator) -> None:
        for name, part in network.named_buffers():
            value = variance if name.endswith("running_variance") else mean if name.endswith("running_mean") else None
            if value is not None:
                part.copy_(part * value if value < 0 else torch.full_like(part, value))

    return edit


def spoil_numbers(network: Second, _: np.random.Generator) -> None:
    """Put one number that is none into the weights."""
    network.head.weight[0, 0] = float("nan")


def overflow(network: Second, _: np.random.Generator) -> None:
    """Make the weights of all layers but the head so large that numbers overflow on the way."""
    for name, part in network.named_parameters():
        if not name.startswith("head"):
            part *= 1e6


def begin_anew(network: Second, rng: np.random.Generator) -> None:
    """Draw all weights anew, as before any training."""
    torch.manual_seed(int(rng.integers(1 << 31)))
    network.load_state_dict(Second(network.config).state_dict())


def rescale(sample: Sample, _: np.random.Generator) -> Sample:
    """Return the sample with its points in other units, a sixth larger."""
    points = sample.points.copy()
    points[:, :3] *= 7 / 6
    return replace(sample, points=points)


def mislabel(sample: Sample, rng: np.random.Generator) -> Sample:
    """Return the sample with its boxes elsewhere."""
    moved = sample.boxes.center + rng.normal(0, (6, 6, 0), (len(sample.boxes), 3))
    return replace(sample, boxes=replace(sample.boxes, center=moved))


def shrink(sample: Sample, _: np.random.Generator) -> Sample:
    """Return the sample with boxes of three quarters of their size."""
    return replace(sample, boxes=replace(sample.boxes, size=0.75 * sample.boxes.size))


def exchange_labels(sample: Sample, _: np.random.Generator) -> Sample:
    """Return the sample with pedestrians as cyclists, and cyclists as pedestrians."""
    other = {"Pedestrian": "Cyclist", "Cyclist": "Pedestrian"}
    label = np.array([other.get(each, each) for each in sample.boxes.label.tolist()], dtype=sample.boxes.label.dtype)
    return replace(sample, boxes=replace(sample.boxes, label=label))


def forget(where: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    """Return what takes the labels away where centres (N, 3) fulfil a condition: they become background."""

    def spoil(sample: Sample, _: np.random.Generator) -> Sample:
        return replace(sample, boxes=sample.boxes[~where(sample.boxes.center)])

    return spoil


def beyond(distance_m: float) -> Spoil:
    """Return what takes away the labels beyond a distance."""
    return forget(lambda center: np.hypot(center[:, 0], center[:, 1]) > distance_m)


EDITS: dict[str, Edit] = {
    "pedestrians lost": lose("Pedestrian"),
    "cyclists lost": lose("Cyclist"),
    "pedestrians and cyclists lost": lose("Pedestrian", "Cyclist"),
    "heights off by 0.5 m": shift_box(2, 0.3),
    "boxes a third longer": shift_box(3, 0.3),
    "boxes 1 m ahead": shift_box(0, 0.3),
    "front and back exchanged": reorder(10, 12, (1, 0)),
    "scores below their use": raise_scores(-2.5),
    "weights shaken": shake,
    "weights rounded to five values": round_to(2),
    "normalisation reset": set_statistics(0.0, 1.0),
    "a number that is none": spoil_numbers,
}
TRAININGS: dict[str, tuple[Spoil | None, str | None]] = {  # of a sample; the only weather, from the start
    "input in other units": (rescale, None),
    "labels elsewhere": (mislabel, None),
    "far objects as background": (beyond(20), None),
    "fog alone": (None, "fog"),
}
PAPERS = ("wrong card", "trained on test scenes", "best epoch chosen by test scenes", "wrong architecture")

FURTHER_EDITS: dict[str, Edit] = {
    "classes exchanged": reorder(0, 3, (1, 2, 0)),
    "x and y exchanged": reorder(3, 10, (1, 0, 2, 3, 4, 5, 6)),
    "length and width exchanged": exchange_sides,
    "boxes turned by 90 degrees": shift_box(6, np.pi / 2),
    "boxes turned by 20 degrees": shift_box(6, np.pi / 9),
    "boxes a fifth higher": shift_box(5, 0.2),
    "objects everywhere": raise_scores(4.0),
    "pedestrians everywhere": raise_scores(3.0, "Pedestrian"),
    "weights rounded to three values": round_to(1),
    "four fifths of the weights pruned": prune,
    "negative variances": set_statistics(None, -1.0),
    "numbers that overflow": overflow,
    "not trained": begin_anew,
}
FURTHER_TRAININGS: dict[str, tuple[Spoil | None, str | None]] = {
    "background beyond 30 m": (beyond(30), None),
    "the left as background": (forget(lambda center: center[:, 1] > 0), None),
    "heavy rain alone": (None, "heavy_rain"),
    "boxes too small": (shrink, None),
    "pedestrians labelled as cyclists": (exchange_labels, None),
}
FURTHER_PAPERS = (
    "normalisation of another town",
    "voxels of another size",
    "another height of the sensor",
    "classes in another order",
    "scores calibrated away",
    "wrong name on the card",
    "a card without data",
)


def reconfigure(name: str, config: SecondConfig) -> SecondConfig:
    """Return the configuration that a candidate's file claims."""
    changes = {
        "voxels of another size": {"voxel_m": (0.3, 0.3, 4.0), "range_m": (0, -28.8, -3, 57.6, 28.8, 1)},
        "another height of the sensor": {"ground_z_m": config.ground_z_m - 0.6},
        "classes in another order": {"anchors": config.anchors[::-1]},
        "scores calibrated away": {"calibration": ((1.0, -3.0),) * len(config.anchors)},
    }
    return replace(config, **changes.get(name, {}))
