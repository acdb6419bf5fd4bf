"""Runs that measure a task's learning history: the score after different numbers of samples, edge and cloud rounds.

For each seed and number of samples one run pretrains on so many samples and then runs the same numbers of edge and
cloud rounds; validation after every round gives a point of the history. Towns, sizes and training are those of a
recipe, but for test frames, of which a history has no use; budgets are as large as the runs need. Take other seeds than
those of the runs that are planned by the history.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from flcav.config import InputError, parse_config
from flcav.pipeline.provenance import Provenance
from flcav.pipeline.recipe import RunRecipe
from flcav.pipeline.results.run import Run
from flcav.pipeline.results.saved import Saved
from flcav.pipeline.sizes import Split

AMPLE_MB = 1e6
UNUSED = Split(scenes=2, spins=1, cavs=1)  # test frames
ORIGIN = "history.json"


@dataclass(frozen=True)
class HistoryOrigin(Saved):
    """Origin of a learning history: what was run, by which code."""

    task: str
    recipe: RunRecipe
    samples: tuple[int, ...]  # of the runs of each seed
    edge_rounds: int
    cloud_rounds: int
    seeds: tuple[int, ...]
    provenance: Provenance


def history_recipes(
    recipe: RunRecipe, task: str, samples: Sequence[int], edge_rounds: int, cloud_rounds: int, seeds: Sequence[int]
) -> dict[str, RunRecipe]:
    """Return the recipe of each run by the name of its folder.

    Raises `InputError` for a task that `recipe` lacks, and for a seed or a count that a recipe cannot have.
    """
    if task not in recipe.tasks:
        raise InputError(f"'{task}' is none of the recipe's tasks: {', '.join(recipe.tasks)}")
    return {
        f"seed{seed}-{count}": _fix_plan(recipe, task, seed, count, edge_rounds, cloud_rounds)
        for seed, count in product(seeds, samples)
    }


def _fix_plan(recipe: RunRecipe, task: str, seed: int, samples: int, edge_rounds: int, cloud_rounds: int) -> RunRecipe:
    """Return the recipe with this task alone, a fixed plan, ample budgets, and no arms."""
    asked = recipe.model_dump(mode="json")
    plan = {"samples": samples, "edge_rounds": edge_rounds, "cloud_rounds": cloud_rounds}
    placed = {} if task in recipe.placement.tasks else {"rule": "none", "tasks": []}
    splits = recipe.sized_splits.model_copy(update={"test": UNUSED})
    return parse_config(
        RunRecipe,
        asked
        | {
            "seed": seed,
            "retrainings": 0,
            "splits": splits.model_dump(mode="json"),
            "tasks": {task: asked["tasks"][task] | {"history": None, "plan": plan}},
            "budgets_mb": {"wireless": AMPLE_MB, "wireline": AMPLE_MB},
            "placement": asked["placement"] | placed,
            "arms": {},
        },
        f"the run of seed {seed} with {samples} samples",
    )


def save_origin(recipe: RunRecipe, task: str, runs: Sequence[Run], out: Path) -> None:
    """Write the origin of the history that `runs` made, beside it in `out`."""
    plans = [run.arms["main"].plan.tasks[task] for run in runs]
    HistoryOrigin(
        task=task,
        recipe=recipe,
        samples=tuple(sorted({plan.samples for plan in plans})),
        edge_rounds=plans[0].edge_rounds,
        cloud_rounds=plans[0].cloud_rounds,
        seeds=tuple(sorted({run.recipe.seed for run in runs})),
        provenance=runs[0].provenance,
    ).save(out, ORIGIN)
