"""The partition of a region's labelled samples in the steps of stages II and III, and its record."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from flcav.arrays import Array
from flcav.config import InputError
from flcav.federation.strategies import Strategy
from flcav.optimization.quality import label_distribution_distance
from flcav.perception.task import Task, find_configuration
from flcav.perception.tasks import task_named
from flcav.runs.arms import Setting
from flcav.runs.engine import Work
from flcav.runs.extras.groups.members import Picked, count_sample_labels
from flcav.runs.extras.partition.dealing import (
    deal_by_amount,
    deal_by_class,
    deal_by_dirichlet,
    deal_by_place,
    give_each_one,
)
from flcav.runs.extras.partition.rows import Partitioned, VehicleHolding
from flcav.runs.extras.partition.settings import ALPHA, BY_AMOUNT, BY_CLASS, BY_DIRICHLET, BY_PLACE, SHARDS, Partition
from flcav.runs.frames import Frames, Joined
from flcav.runs.label_sources import LABEL_SOURCES
from flcav.runs.recipe import RunRecipe
from flcav.runs.stages.regions import select_group
from flcav.runs.stages.settings import FederationSettings, RegionInputs
from flcav.statistics.streams import stream

NO_LABEL = "none"  # class of a sample without labels

Samples = Mapping[str, Sequence[Any]]  # by "region/vehicle"


def check_partition(recipe: RunRecipe, setting: Setting, strategy: Strategy) -> None:
    """Raise `InputError` where an arm's samples are to be partitioned, and this conflicts with its other settings."""
    how = setting.federation.partition
    field = "federation.partition"
    if how is None or setting.central:
        return
    if averaged := [task for task, kind in setting.labels.items() if LABEL_SOURCES[kind].averaged]:
        raise InputError(
            f"{field}: the labels '{setting.labels[averaged[0]]}' are made anew by who recorded the frames"
        )
    if setting.federation.requests is not None or getattr(recipe, "lifelong", None) is not None:
        raise InputError(
            f"{field}: vehicles of a group learn from what they recorded; leave out 'requests' and 'lifelong'"
        )
    for task in recipe.tasks if how.by in (BY_CLASS, BY_DIRICHLET) else ():
        if not getattr(find_configuration(task_named(task), recipe.tasks[task].network), "classes", ()):
            raise InputError(
                f"{field}: the task '{task}' has no classes to deal by; take '{BY_PLACE}' or '{BY_AMOUNT}' instead of "
                f"'{how.by}'"
            )


def deal_region(
    work: Work, settings: FederationSettings, inputs: RegionInputs, samples: Samples
) -> tuple[Samples, dict[str, Partitioned]]:
    """Return a region's samples as they are dealt to its vehicles, and the row of the stage's result.

    The draw depends on the recording's seed alone: it is the same in all stages, arms and retrainings. Raises
    `InputError` where samples without classes are to be dealt by class.
    """
    how = settings.federation.partition
    if how is None:
        return samples, {}
    learning = settings.learning.resolve()
    split = Frames.open(work.inputs[inputs.frames])
    rng = stream(0, "partition", str(split.data.manifest.recipe.get("seed")), inputs.region)
    counts = count_labels(samples, getattr(learning.config, "classes", ()))
    positions = None
    if how.by == BY_PLACE:
        about = (learning.task, learning.config, split, select_group(work, split, inputs), inputs.region)
        positions = np.array([*locate_samples(*about, samples)]).reshape(-1, 2)
    dealt = deal_samples(how, samples, counts, positions, rng)
    return dealt[0], {"partition": dealt[1]} if inputs.edge is None else {}


def count_labels(samples: Samples, classes: Sequence[str]) -> list[dict[str, int]]:
    """Return the numbers of labels by class of all samples, vehicle by vehicle; labels may be indices of `classes`."""
    return [
        {classes[int(label)] if label.isdecimal() else label: count for label, count in found.items() if label}
        for held in samples.values()
        for found in (count_sample_labels([held[place]]) for place in range(len(held)))
    ]


def name_classes(counts: Sequence[Mapping[str, int]]) -> list[str]:
    """Return the classes by which samples are dealt: among the labels of a sample the rarest one in the region."""
    total: dict[str, int] = {}
    for by_class in counts:
        for label, count in by_class.items():
            total[label] = total.get(label, 0) + count
    return [min(by_class, key=lambda label: (total[label], label), default=NO_LABEL) for by_class in counts]


def deal_samples(
    how: Partition,
    samples: Samples,
    counts: Sequence[Mapping[str, int]],
    positions: Array | None,
    rng: np.random.Generator,
) -> tuple[dict[str, Sequence[Any]], Partitioned]:
    """Return the samples by vehicle after dealing, and the record of the partition.

    `counts`: numbers of labels by class, by sample, one vehicle after another. `positions`: (N, 2) of these, world
    frame [m], where they are dealt by place. Raises `InputError` where no sample has a label, and they are dealt by
    class.
    """
    number = len(samples)
    if how.by in (BY_CLASS, BY_DIRICHLET):
        if not any(counts):
            raise InputError(
                f"federation.partition: no sample has a label to deal by; take '{BY_PLACE}' or '{BY_AMOUNT}'"
            )
        labels = np.array(name_classes(counts))
        owner = (
            deal_by_class(labels, number, how.shards or SHARDS, rng)
            if how.by == BY_CLASS
            else deal_by_dirichlet(labels, number, how.alpha or ALPHA, rng)
        )
    elif how.by == BY_PLACE:
        assert positions is not None
        owner = deal_by_place(positions, number)
    else:
        owner = deal_by_amount(len(counts), number, how.alpha or ALPHA, rng)
    owner = give_each_one(owner, number)
    places = {name: np.flatnonzero(owner == vehicle).tolist() for vehicle, name in enumerate(samples)}
    classes = sorted({label for by_class in counts for label in by_class})
    table = np.array([[sum(counts[i].get(label, 0) for i in dealt) for label in classes] for dealt in places.values()])
    distances = label_distribution_distance(table).tolist() if table.sum() else [None] * number
    held = {
        name: VehicleHolding(len(dealt), dict(zip(classes, map(int, row), strict=True)), distance)
        for (name, dealt), row, distance in zip(places.items(), table, distances, strict=True)
    }
    return {name: _take([*samples.values()], dealt) for name, dealt in places.items()}, Partitioned(how.by, held)


def _take(parts: Sequence[Sequence[Any]], places: Sequence[int]) -> Joined:
    """Return the samples at `places` in the concatenation of all parts; lists are copied, so that the rest is freed."""
    ends = np.cumsum([len(part) for part in parts])
    taken = []
    for part, end in zip(parts, ends.tolist(), strict=True):
        inside = [place - (end - len(part)) for place in places if end - len(part) <= place < end]
        taken.append([part[place] for place in inside] if isinstance(part, list) else Picked(part, inside))
    return Joined(taken)


def locate_samples(
    task: Task, config: Any, split: Frames, frames: Sequence[int], region: str, samples: Samples
) -> Iterator[Array]:
    """Yield the positions (2,) of the samples of a split's `frames`, world frame [m], one vehicle after another.

    A frame may have several samples, or none: they are counted frame by frame. Raises `InputError` where their sum is
    not the vehicle's number of samples.
    """

    def count(i: int) -> int:
        try:
            return len(task.samples(split.data, config, (i,)))
        except InputError:  # a frame without a sample of the task
            return 0

    for name, held in samples.items():
        recorded = [i for i in frames if f"{region}/{split.data.keys[i].agent}" == name]
        numbers = [count(i) for i in recorded]
        if sum(numbers) != len(held):
            raise InputError(f"federation.partition: frames of {name} do not tell where its samples are from")
        for i, number in zip(recorded, numbers, strict=True):
            yield from [split.data.frame(i).world_from_agent[:2, 3]] * number
