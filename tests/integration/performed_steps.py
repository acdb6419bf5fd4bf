"""Steps of a recipe performed alone, on what a run of the same regions has left."""

from collections.abc import Sequence
from pathlib import Path

from flcav.interface.progress import ignore_progress
from flcav.network.ledger import LedgerEntry
from flcav.runs.engine import Work
from flcav.runs.recipe import RunRecipe
from flcav.runs.stages.graph import Graph


def perform(recipe: RunRecipe, made: Path, out: Path, names: Sequence[str]) -> None:
    """Perform the steps `names` of a recipe in `out`; what they need is there, or in the steps of the run `made`."""
    steps = {step.name: step for step in Graph(recipe, made).steps}
    for name in names:
        (out / name).mkdir()
        needed = {need: out / need if need in names else made / "work" / need for need in steps[name].needs}
        steps[name].run(Work(out / name, needed, ignore_progress), **steps[name].arguments)


def uplinks(entries: Sequence[LedgerEntry], link: str) -> list[LedgerEntry]:
    """Return the entries of messages towards the cloud on a link."""
    return [each for each in entries if (each.link, each.direction) == (link, "up")]


def in_mb(entries: Sequence[LedgerEntry]) -> float:
    """Return the megabytes of ledger entries."""
    return sum(each.bytes for each in entries) / 1e6
