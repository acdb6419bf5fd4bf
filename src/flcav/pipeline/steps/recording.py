"""Steps that record the data of a region's splits, or divide recorded ones."""

from collections.abc import Mapping
from pathlib import Path

from flcav.config import InputError
from flcav.pipeline.engine import Work
from flcav.pipeline.frames import deal_frames, hash_manifest, hash_town, record_frames
from flcav.pipeline.recipe import Role, SplitName
from flcav.pipeline.results.placement import Placed
from flcav.pipeline.steps.settings import StepSettings
from flcav.sources.recipe import Recipe


class RecordSettings(StepSettings):
    """Settings of the recording of a split."""

    recipe: Recipe  # without poles
    beside: str  # folder that the town is looked for in; "" for a town of the package
    places: tuple[str, ...]  # steps that chose the poles to record from
    version: Mapping[str, str]  # SHA-256 of each of the town's files, by name

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        return self.places


class DealSettings(StepSettings):
    """Settings of the division of a recorded dataset."""

    path: str  # of the dataset
    split: SplitName  # that is taken
    role: Role  # of the region
    seed: int  # by which scenes are shuffled
    whole: bool  # whether all its scenes are of this split
    version: str  # SHA-256 of its manifest


def record_step(work: Work, settings: RecordSettings) -> None:
    """Record one split, also from the poles that other steps chose; raises `InputError` where the town has changed."""
    recipe, beside = settings.recipe, Path(settings.beside)
    if hash_town(recipe.town, beside) != settings.version:
        raise InputError(f"{recipe.town}: the town was changed while the run was under way")
    poles = {pole for step in settings.places for pole in Placed.load(work.inputs[step]).chosen}
    asked = recipe.model_copy(update={"poles": tuple(sorted(poles))})
    record_frames(asked, beside, work.folder, work.report).save(work.folder)


def deal_step(work: Work, settings: DealSettings) -> None:
    """Take one split from a recorded dataset; raises `InputError` where its manifest has changed."""
    path = Path(settings.path)
    if hash_manifest(path) != settings.version:
        raise InputError(f"{path}: the dataset was changed while the run was under way")
    deal_frames(path, settings.split, settings.role, settings.seed, settings.whole).save(work.folder)
