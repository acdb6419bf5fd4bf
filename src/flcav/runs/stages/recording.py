"""The steps that record a region's data splits, or take them from recorded datasets."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from flcav.config import InputError
from flcav.runs.engine import Step, Work
from flcav.runs.frames import deal_frames, hash_manifest, hash_town, make_recording_recipe, record_frames
from flcav.runs.recipe import EDGE, SPLITS_OF, Role, SplitName
from flcav.runs.results.plans import Placed
from flcav.runs.stages.outline import Outline
from flcav.runs.stages.settings import StepSettings, make_step
from flcav.sources.recipe import CarlaRecipe, Recipe


class RecordSettings(StepSettings):
    """Settings of the recording of a split."""

    recipe: CarlaRecipe | Recipe  # without poles
    beside: str  # folder in which the town is searched; "" for a town of the package
    places: tuple[str, ...]  # steps that chose the poles to record from
    version: Mapping[str, str]  # SHA-256 of the town's files, by name

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return self.places


class DealSettings(StepSettings):
    """Settings of the division of a recorded dataset."""

    path: str  # of the dataset
    split: SplitName  # to take
    role: Role  # of the region
    seed: int  # by which scenes are shuffled
    whole: bool  # whether all its scenes are of this split
    version: str  # SHA-256 of its manifest


def record_step(work: Work, settings: RecordSettings) -> None:
    """Record one split, also from the poles that other steps chose; raises `InputError` where the town has changed."""
    recipe = settings.recipe
    beside = Path(settings.beside)
    if hash_town(recipe.town, beside) != settings.version:
        raise InputError(f"{recipe.town}: the town was changed while the run was under way")
    poles = {pole for step in settings.places for pole in Placed.load(work.inputs[step]).chosen}
    with_poles = recipe.model_copy(update={"poles": tuple(sorted(poles))})
    record_frames(with_poles, beside, work.folder, work.report).save(work.folder)


def deal_step(work: Work, settings: DealSettings) -> None:
    """Take one split from a recorded dataset; raises `InputError` where its manifest has changed."""
    path = Path(settings.path)
    if hash_manifest(path) != settings.version:
        raise InputError(f"{path}: the dataset was changed while the run was under way")
    deal_frames(path, settings.split, settings.role, settings.seed, settings.whole).save(work.folder)


def list_recordings(outline: Outline) -> Iterator[Step]:
    """Yield the recordings of all splits except the vehicles' training data, which need the placement of sensors."""
    for region, place in outline.recipe.regions.items():
        for split in SPLITS_OF[place.role]:
            for task in outline.recipe.tasks:
                placing = task in outline.recipe.placement.tasks or task == outline.placing_task
                if split != EDGE and (split != "registry" or placing):
                    yield make_recording(outline, region, split, task)


def make_recording(outline: Outline, region: str, split: SplitName, task: str, places: tuple[str, ...] = ()) -> Step:
    """Return the step that records a split of a region for a task, also from the poles that the steps `places` chose.

    For a recorded dataset it is the step that takes the split from it.
    """
    recipe, beside, name = outline.recipe, outline.beside, outline.names.recording(region, split, task)
    place = recipe.regions[region]
    if place.data is not None:
        path, whole = outline.find_data(place, split), isinstance(place.data, Mapping)
        about = {"split": split, "role": place.role, "seed": recipe.seed, "whole": whole}
        return make_step(name, deal_step, DealSettings(path=str(path), version=hash_manifest(path), **about))
    recording = make_recording_recipe(recipe, region, split, task, name, outline.window(task, place.role, split))
    version = hash_town(recording.town, beside)
    looked = str(beside) if version else ""  # a town of the package depends on no folder
    seen = places if outline.helped(task) else ()
    return make_step(name, record_step, RecordSettings(recipe=recording, beside=looked, places=seen, version=version))
