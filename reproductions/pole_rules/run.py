"""The pole of most registered errors (VRCSP) against the pole of the densest traffic, over every seed that has both.

Fresh seeds are those of recipes/runs/poles.yaml, whose mean is the primary claim. The other studies are committed; they
differ in labels, networks and numbers of frames, so that only the signs of their differences are pooled. Studies that
share a seed of a town share its traffic: such a seed counts once, with the mean over them. Where both rules choose the
same pole there is one training for both, a difference of 0, and no sign.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.stats import binomtest

from flcav.config import Json, read_json
from flcav.experiments import FOLDER
from flcav.experiments.experiment import Experiment, Options, Outcome, shrink_recipe
from flcav.report import style
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import EDGE, MAIN
from flcav.runs.results.run import Run
from flcav.statistics.estimates import CONFIDENCE
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.verdicts import HELD, NOT_HELD, UNDECIDED, correct_p_values, format_p
from flcav.storage.markdown import format_signed, format_table
from flcav.storage.records import Record

TASK, TOWN, DENSEST = "objects", "grid", "densest"
FRESH = "fresh seeds"
EARLIER = Path("runs", "demo", "earlier")
RUNS = {"retraining": "retraining", "demo_avx2": "avx2"}  # committed runs with both poles
LEVEL = 1 - CONFIDENCE

Differences = Mapping[int, float]  # in AP50 all over the town, VRCSP's pole minus the densest, by seed


@dataclass(frozen=True)
class Study:
    """The differences of a study in a town."""

    town: str
    differences: Differences


@dataclass(frozen=True)
class PoleRules(Record):
    """Differences by study, and the two claims about them."""

    studies: Mapping[str, Study]
    fresh: MeanOverSeeds
    above: int  # seeds of a town with a positive difference in the mean over studies
    below: int
    sign_p: float  # of the sign test, two-sided
    corrected: tuple[float, float]  # p-values of the fresh seeds' mean and of the signs, after Holm
    recipe: Mapping[str, Json]  # of the fresh seeds, without their seed
    provenance: Provenance

    def verdicts(self) -> tuple[str, str]:
        """Return the verdicts on the mean of the fresh seeds and on the signs."""
        leads = (self.fresh.mean, self.above - self.below)
        return tuple(  # pyright: ignore[reportReturnType] # two of them
            UNDECIDED if p > LEVEL else HELD if lead > 0 else NOT_HELD
            for p, lead in zip(self.corrected, leads, strict=True)
        )

    def sentences(self) -> list[str]:
        """Return both claims in words."""
        fresh, signs = self.verdicts()
        return [
            f"{FRESH}: VRCSP - densest {self.fresh.describe(sign=True)}, {fresh}: p {format_p(self.corrected[0])}",
            f"all seeds: above in {self.above}, below in {self.below}, {signs}: p {format_p(self.corrected[1])}",
        ]


def read_studies(reproductions: Path) -> dict[str, Study]:
    """Return the committed studies that have both poles, from the folder of the reproductions."""

    def result(study: str) -> Any:
        return read_json(reproductions / study / "result.json")

    def ap50(seed: Any, pole: str) -> float:
        return seed[f"tracks and road labels, {pole} pole"]["ap50"]

    def gain(seed: Any, rule: str) -> float:
        return next(
            each["gain"]["all over the town"] for each in seed["choices"] if (each["rule"], each["count"]) == (rule, 1)
        )

    labelled = result("distillation")["seeds"]
    labels = {int(seed): ap50(own, "VRCSP") - ap50(own, DENSEST) for seed, own in labelled.items()}
    arms = {
        own["seed"]: own["ap"][TOWN]["edge FL, VRCSP pole"]["ap50"] - own["ap"][TOWN]["edge FL, densest pole"]["ap50"]
        for own in result("demo_arms")["seeds"]
    }
    runs = {f"{name}, {TOWN}": read_runs([Run.load(reproductions / EARLIER / folder)]) for name, folder in RUNS.items()}
    return {
        f"distillation, {TOWN}": Study(TOWN, labels),
        f"demo_arms, {TOWN}": Study(TOWN, arms),
        **{name: Study(TOWN, own) for name, own in runs.items()},
        **{
            f"placement, {town}": Study(
                town, {seed["seed"]: gain(seed, "VRCSP") - gain(seed, "traffic density") for seed in own["seeds"]}
            )
            for town, own in result("placement")["regions"].items()
        },
    }


def read_runs(runs: Sequence[Run]) -> Differences:
    """Return the differences of runs of recipes with the arm `DENSEST`, in the mean over the trainings of each."""
    key = (EDGE, EDGE, TOWN, TASK, MAIN, DENSEST)
    return {
        run.recipe.seed: next(
            each.estimate.mean
            for each in run.differences
            if (each.stage, each.before_stage, each.region, each.task, each.arm, each.before_arm) == key
        )
        for run in runs
    }


def pool_seeds(studies: Mapping[str, Study]) -> dict[tuple[str, int], float]:
    """Return the mean difference over the studies that have a seed of a town, by town and seed."""
    found: dict[tuple[str, int], list[float]] = {}
    for study in studies.values():
        for seed, difference in study.differences.items():
            found.setdefault((study.town, seed), []).append(difference)
    return {key: sum(own) / len(own) for key, own in found.items()}


def compare_rules(studies: Mapping[str, Study], fresh: Differences, recipe: Mapping[str, Json]) -> PoleRules:
    """Return both claims: the mean of the fresh seeds is above 0, and the signs of all seeds are mostly positive.

    `recipe` is that of the fresh seeds.
    """
    every = {**studies, FRESH: Study(TOWN, fresh)}
    pooled = pool_seeds(every).values()
    above, below = sum(value > 0 for value in pooled), sum(value < 0 for value in pooled)
    sign_p = float(binomtest(above, above + below).pvalue) if above + below else 1.0
    mean = mean_over_seeds([*fresh.values()])
    own_p = mean.p_value()
    first, second = correct_p_values([1.0 if own_p is None else own_p, sign_p])
    return PoleRules(every, mean, above, below, sign_p, (first, second), recipe, provenance())


def tabulate_rules(results: PoleRules) -> dict[str, str]:
    """Return Markdown by name: studies, claims."""

    def rows() -> Iterator[list[str | int]]:
        for name, study in results.studies.items():
            own = [*study.differences.values()]
            above, below = sum(value > 0 for value in own), sum(value < 0 for value in own)
            same = len(own) - above - below
            yield [name, len(own), same, above, below, mean_over_seeds(own).describe(sign=True)]

    heads = ("study", "seeds", "same pole", "VRCSP above", "VRCSP below", "VRCSP - densest, mean AP50")
    claims = zip(
        (
            f"{FRESH}: mean above 0 (primary)",
            "all studies: positive in most seeds with two poles (sign test)",
        ),
        (results.fresh.describe(sign=True), f"{results.above} of {results.above + results.below}"),
        results.corrected,
        results.verdicts(),
        strict=True,
    )
    return {
        "studies": format_table(heads, [*rows()]),
        "claims": format_table(
            ("claim", "found", "p, corrected", "verdict"),
            [[name, found, format_p(p), verdict] for name, found, p, verdict in claims],
        ),
        "seeds": format_table(
            ("study", "difference by seed"),
            [
                [name, ", ".join(f"{seed}: {format_signed(own)}" for seed, own in study.differences.items())]
                for name, study in results.studies.items()
            ],
        ),
    }


@style.styled
def draw_rules(results: PoleRules) -> bytes:
    """Return the differences of all seeds as a PNG, a row for each study."""
    figure = style.canvas(8.0, 0.9 + 0.4 * len(results.studies))
    axes = figure.add_subplot()
    axes.axvline(0, color=style.MUTED, linewidth=1)
    for y, study in enumerate(results.studies.values()):
        own = [*study.differences.values()]
        for value in own:
            colour = style.GREEN if value > 0 else style.VERMILLION if value < 0 else style.MUTED
            axes.plot(value, y, "o", color=colour, markersize=6, alpha=0.6, markeredgewidth=0)
        axes.plot(sum(own) / len(own), y, "|", color=style.INK, markersize=16, markeredgewidth=2)
    axes.set_yticks(range(len(results.studies)), list(results.studies))
    axes.set_ylim(len(results.studies) - 0.5, -0.5)
    axes.grid(axis="x")
    axes.set_xlabel("AP50, VRCSP's pole - the densest; dots: seeds (grey: the same pole), strokes: means")
    return style.png(figure)


def _run(out: Path, options: Options) -> Outcome[PoleRules]:
    recipe = options.load("poles", shrink_recipe)
    fresh = read_runs(options.run_seeds(recipe, out))
    results = compare_rules(read_studies(FOLDER), fresh, recipe.model_dump(mode="json", exclude={"seed"}))
    return Outcome(results, {"rules.png": draw_rules(results)}, results.sentences())


EXPERIMENT = Experiment(PoleRules, _run, tabulate_rules, seeds=30, recipe="poles")
