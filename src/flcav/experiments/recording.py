"""Steps that make a study's frames."""

from typing import Any

from flcav.config import parse_config
from flcav.dataset.recorder import record
from flcav.dataset.store import Dataset
from flcav.pipeline.steps import Work
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe

DATA = "data"


def record_split(work: Work, recipe: dict[str, Any]) -> dict[str, int]:
    """Record one split."""
    source = EmbeddedSource(parse_config(Recipe, recipe, work.folder.name))
    record(source, work.folder / DATA, progress=work.report)
    return {"frames": len(Dataset.open(work.folder / DATA))}


def opened(work: Work, step: str) -> Dataset:
    """Return what `record_split` made in the step `step`."""
    return Dataset.open(work.inputs[step] / DATA)
