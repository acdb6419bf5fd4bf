"""Comparison of the sensor rigs of recorded datasets with those that a run's networks are trained with."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from flcav.config import Json
from flcav.dataset.layout import read_manifest
from flcav.dataset.store import Dataset
from flcav.perception.agents import choose_frames
from flcav.perception.task import find_configuration
from flcav.perception.tasks import task_named
from flcav.perception.weights import find_recorded_lidar, join_lidars
from flcav.runs.engine import Notify
from flcav.runs.frames import make_recording_recipe
from flcav.runs.recipe import SPLITS_OF
from flcav.runs.stages.outline import Outline

RIG = "rig"  # reported in place of a step's name


def tell_rigs(outlines: Iterable[Outline], notify: Notify) -> None:
    """Report what `compare_rigs` finds in several runs by `notify`, without repeats, as notes of `RIG`."""
    for sentence in dict.fromkeys(difference for outline in outlines for difference in compare_rigs(outline)):
        notify(RIG, 0, 0, sentence)


def compare_rigs(outline: Outline) -> tuple[str, ...]:
    """Describe how the rigs of recorded datasets differ from those that the networks are trained with.

    A sentence begins with region and task, such as "street, objects: unlike in the network's training the LiDAR has 64
    beams, not 32". There is none for regions that are recorded in the run itself.
    """
    found = (
        f"{region}, {task}: {rig}"
        for region, place in outline.recipe.regions.items()
        if place.data is not None
        for folder in dict.fromkeys(outline.find_data(place, split) for split in SPLITS_OF[place.role])
        for task in outline.recipe.tasks
        if (rig := _compare(outline, folder, task))
    )
    return tuple(dict.fromkeys(found))


def _compare(outline: Outline, folder: Path, name: str) -> str:
    """Describe how the vehicles' rig in a dataset differs from the one that a task's network is trained with."""
    task = task_named(name)
    known = join_lidars([find_recorded_lidar(recipe) for recipe in _list_pools(outline, name)])
    config = find_configuration(task, outline.recipe.tasks[name].network)
    return choose_frames(task, config, Dataset.open(folder), "vehicles", trained=known).rig


def _list_pools(outline: Outline, task: str) -> Iterator[Mapping[str, Json]]:
    """Yield the recording recipes of a task's pretraining data."""
    for region, step in outline.pools(task).items():
        place = outline.recipe.regions[region]
        if place.data is not None:
            yield read_manifest(outline.find_data(place, "pool")).recipe
        else:
            yield make_recording_recipe(outline.recipe, region, "pool", task, step).model_dump(mode="json")
