"""A task's learning history, by runs whose plans are chosen by hand: what so many samples and rounds reached.

    python tools/make_history.py recipes/runs/demo.yaml objects 101:320,6,3 102:80,6,3 101:80,0,0 102:320,0,0 \\
        --runs out/history --out history.csv

A plan is SEED:SAMPLES,EDGE_ROUNDS,CLOUD_ROUNDS. Take other seeds than those of the figures that are planned by the
history, a much and a little pretrained network, and each with rounds and without. Towns, sizes and training are the
recipe's but for test frames, which a history has no part of; the budgets are as large as the plans need. The table is
what a recipe's `history:` names: a file beside it, or, put into src/flcav/pipeline/histories, one of the package. The
same command goes on where it was stopped.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Self

from flcav.config import InputError
from flcav.pipeline.recipe import RunRecipe, load_run_recipe
from flcav.pipeline.running import make_history_points, run
from flcav.pipeline.tables import append_records

AMPLE_MB = 1e6


class Chosen(NamedTuple):
    """A plan chosen by hand, and the seed of its run."""

    seed: int
    samples: int
    edge_rounds: int
    cloud_rounds: int

    @classmethod
    def read(cls, text: str) -> Self:
        """Parse SEED:SAMPLES,EDGE_ROUNDS,CLOUD_ROUNDS; raises `InputError` for other text."""
        try:
            return cls(*map(int, text.replace(":", ",").split(",")))
        except (TypeError, ValueError):
            raise InputError(
                f"'{text}' is no plan: SEED:SAMPLES,EDGE_ROUNDS,CLOUD_ROUNDS, such as 101:320,6,3"
            ) from None


def recipe_of(recipe: RunRecipe, task: str, chosen: Chosen) -> RunRecipe:
    """Return the recipe of one plan's run: `recipe` with this task alone and without arms."""
    if task not in recipe.tasks:
        raise InputError(f"'{task}' is none of the recipe's tasks: {', '.join(recipe.tasks)}")
    asked = recipe.model_dump(mode="json")
    plan = {"samples": chosen.samples, "edge_rounds": chosen.edge_rounds, "cloud_rounds": chosen.cloud_rounds}
    placed = {} if task in recipe.placement.tasks else {"rule": "none", "tasks": []}
    splits = recipe.sized_splits.model_dump(mode="json") | {"test": {"scenes": 2, "spins": 1, "cavs": 1}}
    return RunRecipe.model_validate(
        asked
        | {
            "seed": chosen.seed,
            "splits": splits,
            "tasks": {task: asked["tasks"][task] | {"history": None, "plan": plan}},
            "budgets_mb": {"wireless": AMPLE_MB, "wireline": AMPLE_MB},
            "placement": asked["placement"] | placed,
            "arms": {},
        }
    )


def main(arguments: Sequence[str]) -> None:
    """Run each plan in a folder of its own, and write the history."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", type=Path)
    parser.add_argument("task")
    parser.add_argument("plans", nargs="+", type=str)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--out", type=Path, required=True, help="the table (CSV)")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args(arguments)
    recipe = load_run_recipe(options.recipe)
    chosen = [Chosen.read(text) for text in options.plans]
    asked = {"-".join(map(str, each)): recipe_of(recipe, options.task, each) for each in chosen}
    for name, each in asked.items():
        result = run(each, options.runs / name, beside=options.recipe.parent, jobs=options.jobs, notify=_print)
        append_records(options.out, make_history_points(result, f"seed{each.seed}"))


def _print(step: str, done: int, total: int, note: str) -> None:
    if note.startswith("done"):
        print(step, note, file=sys.stderr)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        sys.exit(str(error))
