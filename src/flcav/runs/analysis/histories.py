"""Learning histories: points of a finished run, the runs that measure a task's history, and gaps that stages close.

Per seed and number of samples, one run pretrains on so many samples and then performs the same numbers of edge and
cloud rounds; validation after every round gives a point of the history. Towns, sizes and training are those of a
recipe, except for test frames, which a history does not need; budgets are as large as the runs need. Choose other seeds
than those of the runs that are planned by the history.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from flcav.config import InputError, parse_config
from flcav.runs.provenance import Provenance
from flcav.runs.recipe import CENTRAL, CLOUD, EDGE, MAIN, PRETRAIN, RunRecipe, Split
from flcav.runs.results.run import Run
from flcav.runs.results.saved import Saved
from flcav.runs.results.tests import Test
from flcav.runs.results.training import average_regions
from flcav.runs.tables import HistoryPoint
from flcav.storage.records import select

AMPLE_MB = 1e6  # budgets that no run exhausts [MB]
UNUSED = Split(scenes=2, spins=2, cavs=3)  # test frames: so many that they hold something to find
ORIGIN = "history.json"


@dataclass(frozen=True)
class HistoryOrigin(Saved):
    """Origin of a learning history: what was run, by which code."""

    task: str
    recipe: RunRecipe
    samples: tuple[int, ...]  # of the runs of a seed
    edge_rounds: int
    cloud_rounds: int
    seeds: tuple[int, ...]
    provenance: Provenance


def history_recipes(
    recipe: RunRecipe, task: str, samples: Sequence[int], edge_rounds: int, cloud_rounds: int, seeds: Sequence[int]
) -> dict[str, RunRecipe]:
    """Return the recipes of the runs that measure a history, by the name of the folder.

    Raises `InputError` for a task that `recipe` lacks, and for a seed or a count that a recipe cannot have.
    """
    if task not in recipe.tasks:
        raise InputError(f"'{task}' is none of the recipe's tasks: {', '.join(recipe.tasks)}")
    return {
        f"seed{seed}-{count}": _fix_plan(recipe, task, seed, count, edge_rounds, cloud_rounds)
        for seed, count in product(seeds, samples)
    }


def _fix_plan(recipe: RunRecipe, task: str, seed: int, samples: int, edge_rounds: int, cloud_rounds: int) -> RunRecipe:
    """Return the recipe with this task alone, a fixed plan, ample budgets and time, and no arms."""
    values = recipe.model_dump(mode="json")
    plan = {"samples": samples, "edge_rounds": edge_rounds, "cloud_rounds": cloud_rounds}
    placed = {} if task in recipe.placement.tasks else {"rule": "none", "tasks": []}
    splits = recipe.sized_splits.model_copy(update={"test": UNUSED})
    return parse_config(
        RunRecipe,
        values
        | {
            "seed": seed,
            "retrainings": 0,
            "splits": splits.model_dump(mode="json"),
            "tasks": {task: values["tasks"][task] | {"history": None, "plan": plan}},
            "budgets_mb": {"wireless": AMPLE_MB, "wireline": AMPLE_MB},
            "placement": values["placement"] | placed,
            "arms": {},
            "primary_claims": (),
            "horizon_s": None,
            "stragglers": values["stragglers"] if recipe.federation.network else None,
        },
        f"the run of seed {seed} with {samples} samples",
    )


def save_origin(recipe: RunRecipe, task: str, runs: Sequence[Run], out: Path) -> None:
    """Write the origin of a history, measured by `runs`, to its folder `out`."""
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


def gap_closed(start: float, reached: float, end: float) -> float:
    """Return the fraction (reached - start) / (end - start) of a gap that was closed; 0 where there is no gap."""
    return (reached - start) / (end - start) if end != start else 0.0


def gaps_closed(tests: Sequence[Test], recipe: RunRecipe) -> dict[str, float]:
    """Return the fractions of the gap from pretraining to centralised training that stages close, by name of the test.

    The reference trains on the ground truth of the same region; regions without such an arm are left out.
    """
    values = {test.key: test.estimate.mean for test in tests}
    oracle = next((name for name, arm in recipe.arms.items() if arm.central == "federate"), None)
    closed = {}
    for test in tests:
        place = (test.region, test.task)
        end = values.get((oracle or "", CENTRAL, *place))
        if end is not None and test.stage != PRETRAIN and test.arm != oracle:
            start = values.get((test.arm, PRETRAIN, *place), values[MAIN, PRETRAIN, *place])
            closed[test.name] = gap_closed(start, test.estimate.mean, end)
    return closed


def make_history_points(result: Run, run: str) -> list[HistoryPoint]:
    """Return a run's points of the learning history: samples, rounds, and the score that they reached.

    The score is the mean over regions on validation frames, weighted by the numbers of frames.
    """
    points: list[HistoryPoint] = []
    for task, planned in result.arms[MAIN].plan.tasks.items():
        for stage in (PRETRAIN, EDGE, CLOUD):
            regions = select(result.watched, task=task, stage=stage)
            frames = sum(watched.frames for watched in regions)
            for at in average_regions(regions):
                counts = (planned.edge_rounds, at.round) if stage == CLOUD else (at.round, 0)
                points.append(HistoryPoint(task, planned.samples, *counts, at.score, frames, run, result.recipe.seed))
    return points
