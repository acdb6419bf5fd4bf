"""What each step buys, against its alternatives: the arms of recipes/runs/arms.yaml on the same frames, over seeds.

Every arm takes as many optimiser steps as the vehicles of stage II take together, and has a ledger of its own. Within a
seed, intervals redraw test scenes; over seeds, they are Student's t, so they hold what training and traffic vary too.
"""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from flcav.config import read_config
from flcav.intervals import mean_over_seeds
from flcav.pipeline.findings import in_words
from flcav.pipeline.provenance import provenance
from flcav.pipeline.recipe import CENTRAL, CLOUD, EDGE, MAIN, PRETRAIN, RunRecipe
from flcav.pipeline.results import Run
from flcav.pipeline.running import run_seeds
from flcav.pipeline.steps import Notify, Stale
from flcav.report import figures, style
from flcav.sources.recipe import recipe_path

TASK = "objects"
ARMS: dict[str, dict[str, tuple[str, str]]] = {  # by town: what the page calls an arm's stage
    "grid": {
        "pretrained": (MAIN, PRETRAIN),
        "more pretraining": ("more", CENTRAL),
        "edge FL, no road sensor": ("no_pole", EDGE),
        "edge FL, densest pole": ("densest", EDGE),
        "edge FL, VRCSP pole": (MAIN, EDGE),
        "edge + cloud FL": (MAIN, CLOUD),
        "oracle": ("oracle", CENTRAL),
    },
    "ring": {
        "pretrained": (MAIN, PRETRAIN),
        "more pretraining": ("more", CENTRAL),
        "edge FL, VRCSP pole": (MAIN, EDGE),
        "edge + cloud FL": (MAIN, CLOUD),
    },
}
COMPARED = (  # (after, before): claims of the article and controls
    ("edge FL, VRCSP pole", "pretrained"),
    ("edge FL, VRCSP pole", "more pretraining"),
    ("edge FL, VRCSP pole", "edge FL, no road sensor"),
    ("edge FL, VRCSP pole", "edge FL, densest pole"),
    ("edge + cloud FL", "edge FL, VRCSP pole"),
)


def study_recipe(name: str, scale: str) -> RunRecipe:
    """Return the committed recipe of a comparison: "paper" as it stands, "quick" of the demo's size."""
    recipe = read_config(RunRecipe, recipe_path(f"runs/{name}"))
    return recipe if scale == "paper" else recipe.model_copy(update={"size": "demo"})


def run_arms(
    recipe: RunRecipe,
    out: Path,
    *,
    seeds: int,
    jobs: int,
    notify: Notify,
    stale: Stale = "refuse",
    engine: str = "processes",
) -> dict[str, Any]:
    """Run or finish all arms of each seed in folders below `out` and return the results."""
    runs, _ = run_seeds(recipe, out, seeds=seeds, jobs=jobs, notify=notify, stale=stale, engine=engine)
    rows = [one_seed(run) for run in runs]
    return {
        "recipe": recipe.model_dump(mode="json", exclude={"seed"}),
        "seeds": rows,
        "summary": summarise(rows),
        "provenance": asdict(provenance()),
        "note": "road labels come from an ideal road detector: arms with a pole are upper bounds",
    }


def one_seed(run: Run) -> dict[str, Any]:
    """Return what the page tells of a seed."""
    main, pretrained = run.arms[MAIN], run.pretrained[0]
    own, plan = main.links, main.plan.tasks[TASK]
    ap = {town: {arm: _tested(run, town, *stage) for arm, stage in arms.items()} for town, arms in ARMS.items()}
    found = {
        (each.region, each.arm, each.stage, each.before_arm, each.before_stage): each.estimate
        for each in run.differences
    }
    differences = {
        f"{town}: {after} - {before}": vars(found[town, *arms[after], *arms[before]])
        for town, arms in ARMS.items()
        for after, before in COMPARED
        if {after, before} <= set(arms)
    }
    closed = {
        arm: run.gap_closed[name]
        for arm, stage in ARMS["grid"].items()
        if (name := f"grid, {TASK}: {in_words(*stage)}") in run.gap_closed
    }
    return {
        "seed": run.recipe.seed,
        "plan": {name: getattr(plan, name) for name in ("samples", "edge_rounds", "cloud_rounds")},
        "pretraining": {
            "steps": pretrained.steps,
            "threshold": pretrained.threshold,
            "curve": [vars(block) for block in pretrained.blocks],
        },
        "placement": {placed.region: _placed(run, placed.region) for placed in main.placed},
        "ap": ap,
        "differences": differences,
        "gap_closed": closed,
        "used_mb": {"edge + cloud FL": {link: use.used_mb for link, use in own.items()}},
    }


def _tested(run: Run, town: str, arm: str, stage: str) -> dict[str, float | None]:
    test = run.test(arm=arm, stage=stage, region=town, task=TASK)
    estimate, more = test.estimate, test.numbers
    return {"ap50": estimate.mean, "ap50_low": estimate.low, "ap50_high": estimate.high, "ap70": more["AP70"]}


def _placed(run: Run, town: str) -> dict[str, Any]:
    placed = next(each for each in run.arms[MAIN].placed if each.region == town)
    coverage = [{"pole": pole.pole, "covered": pole.covered, "actors": pole.actors} for pole in placed.poles]
    more = {"errors": placed.errors, "covered": placed.covered, "range_m": placed.range_m}
    return {"chosen": placed.chosen[0], "densest": placed.densest, "coverage": coverage, **more}


def summarise(seeds: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return means over seeds with their 95 % intervals."""
    first = seeds[0]
    return {
        **{
            number: {
                town: {arm: mean_over_seeds([seed["ap"][town][arm][number] for seed in seeds]) for arm in arms}
                for town, arms in first["ap"].items()
            }
            for number in ("ap50", "ap70")
        },
        "differences": {
            name: mean_over_seeds([seed["differences"][name]["mean"] for seed in seeds])
            for name in first["differences"]
        },
        "gap_closed": {
            arm: mean_over_seeds([seed["gap_closed"][arm] for seed in seeds]) for arm in first["gap_closed"]
        },
    }


def draw_arms(results: dict[str, Any]) -> bytes:
    """Return the forest plot of all arms' AP over seeds as a PNG."""
    rows = [
        {"arm": arm, "town": town, "ap50": ap["mean"], "low": ap["low"], "high": ap["high"]}
        for town, arms in results["summary"]["ap50"].items()
        for arm, ap in arms.items()
    ]
    return style.png(figures.arms(rows))
