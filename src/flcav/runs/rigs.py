"""Sensor rigs of recorded datasets in a run, where they differ from those that its networks are trained with."""

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

RIG = "rig"  # reported in the place of a step


def tell_rigs(outlines: Iterable[Outline], notify: Notify) -> None:
    """Report by `notify`, as notes of `RIG`, what `compare_rigs` finds in any of several runs, each sentence once."""
    for sentence in dict.fromkeys(told for outline in outlines for told in compare_rigs(outline)):
        notify(RIG, 0, 0, sentence)


def compare_rigs(outline: Outline) -> tuple[str, ...]:
    """Return how the rigs of recorded datasets differ from those of the networks' training, by region and task.

    Each is a sentence that begins with the region and the task, such as "street, objects: unlike in the network's
    training the LiDAR has 64 beams, not 32". Regions that are recorded in the run itself have none.
    """
    found = (
        f"{region}, {task}: {rig}"
        for region, own in outline.recipe.regions.items()
        if own.data is not None
        for folder in dict.fromkeys(outline.find_data(own, split) for split in SPLITS_OF[own.role])
        for task in outline.recipe.tasks
        if (rig := _compare(outline, folder, task))
    )
    return tuple(dict.fromkeys(found))


def _compare(outline: Outline, folder: Path, name: str) -> str:
    """Return how the vehicles' rig in a dataset differs from the one that a task's network is trained with."""
    task = task_named(name)
    known = join_lidars([find_recorded_lidar(recipe) for recipe in _list_pools(outline, name)])
    config = find_configuration(task, outline.recipe.tasks[name].network)
    return choose_frames(task, config, Dataset.open(folder), "vehicles", trained=known).rig


def _list_pools(outline: Outline, task: str) -> Iterator[Mapping[str, Json]]:
    """Yield the recording recipes of the data that a task is or was pretrained on."""
    for region, step in outline.pools(task).items():
        own = outline.recipe.regions[region]
        if own.data is not None:
            yield read_manifest(outline.find_data(own, "pool")).recipe
        else:
            yield make_recording_recipe(outline.recipe, region, "pool", task, step).model_dump(mode="json")
