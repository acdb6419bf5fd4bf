"""Steps that record the splits of a run's regions."""

from collections.abc import Iterator, Mapping

from flcav.pipeline.engine import Step
from flcav.pipeline.frames import hash_manifest, hash_town, make_recording_recipe
from flcav.pipeline.graph.outline import Outline
from flcav.pipeline.recipe import EDGE, SPLITS_OF, SplitName
from flcav.pipeline.steps.recording import DealSettings, RecordSettings, deal_step, record_step
from flcav.pipeline.steps.settings import make_step


def list_recordings(outline: Outline) -> Iterator[Step]:
    """Yield the recordings of all splits but the vehicles' training data, which wait for the placement of sensors."""
    for region, own in outline.recipe.regions.items():
        for split in SPLITS_OF[own.role]:
            for task in outline.recipe.tasks:
                placing = task in outline.recipe.placement.tasks or task == outline.placing_task
                if split != EDGE and (split != "registry" or placing):
                    yield make_recording(outline, region, split, task)


def make_recording(outline: Outline, region: str, split: SplitName, task: str, places: tuple[str, ...] = ()) -> Step:
    """Return the step that records a split of a region for a task, also from the poles that the steps `places` chose.

    Of a recorded dataset it is the step that takes the split from it.
    """
    recipe, beside, name = outline.recipe, outline.beside, outline.names.recording(region, split, task)
    own = recipe.regions[region]
    if own.data is not None:
        path, whole = outline.find_data(own, split), isinstance(own.data, Mapping)
        about = {"split": split, "role": own.role, "seed": recipe.seed, "whole": whole}
        return make_step(name, deal_step, DealSettings(path=str(path), version=hash_manifest(path), **about))
    window_s = outline.window_s(task) if split == EDGE else 0.0
    asked = make_recording_recipe(recipe, region, split, task, name, window_s)
    version = hash_town(asked.town, beside)
    looked = str(beside) if version else ""  # a town of the package depends on no folder
    seen = places if outline.helped(task) else ()
    return make_step(name, record_step, RecordSettings(recipe=asked, beside=looked, places=seen, version=version))
