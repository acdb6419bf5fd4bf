"""Data splits of an experiment: a step that records one by its recipe, and the dataset in such a step's folder."""

from pathlib import Path

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.perception.study import RecipeFields
from flcav.runs.engine import Work
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

DATA = "data"


def record_split(work: Work, recipe: RecipeFields) -> dict[str, int]:
    """Record one split by its recipe; return its number of frames, by the name "frames"."""
    source = EmbeddedSource(parse_config(Recipe, recipe, work.folder.name))
    record(source, work.folder / DATA, progress=work.report)
    return {"frames": len(open_split(work.folder))}


def open_split(step: Path) -> Dataset:
    """Return the dataset that `record_split` recorded in the folder of its step."""
    return Dataset.open(step / DATA)
