"""Comparison of what the cloud does with the regions' networks, as the arms of recipes/runs/cloud.yaml.

Every arm continues the same edge FL. Its network is compared with that of edge FL in each region, in an unseen town
with the better of both on validation frames there, and in the town of pretraining with the pretrained one. Each seed
has its own recordings, so that intervals over seeds cover training and traffic. The claims are those of one arm, chosen
on other seeds; all are corrected together.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flcav.config import Json
from flcav.experiments.comparison import average_arms
from flcav.experiments.experiment import Experiment, Options, Outcome, list_works, shrink_recipe
from flcav.perception.objects.task import OBJECTS
from flcav.perception.outcomes import as_measurable, compute_measure, score_network
from flcav.report import style
from flcav.runs.frames import Frames
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import CLOUD, EDGE, MAIN, PRETRAIN, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.results.tests import Tested
from flcav.runs.training.learning import load_stage_network
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.verdicts import REACHED, Claim, describe_aims, judge, signed
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

TASK, HOME, UNSEEN = "objects", "suburb", "arterial"
REGIONS = ("grid", "ring")
TOWNS = (HOME, *REGIONS, UNSEEN)
PRETRAINED = "pretrained"
EDGES = {region: f"edge FL in {region}" for region in REGIONS}  # by region
ARMS: Mapping[str, str] = {  # name in the tables -> arm
    "averaging": MAIN,
    "replay": "replay",
    "half pretrained": "half",
    "ensemble distillation": "taught",
}
CHOSEN = "ensemble distillation"
AIMS: Mapping[str, float] = {  # the least change that is aimed at
    "grid, AP50": -0.02,
    "ring, AP50": -0.02,
    "unseen town, AP50": 0.03,
    "home, AP50": -0.02,
    "home, AP70": -0.05,
}


@dataclass(frozen=True)
class Score:
    """AP of a network in a town."""

    ap50: float
    ap70: float


@dataclass(frozen=True)
class CloudSeed:
    """Results of one seed."""

    scores: Mapping[str, Mapping[str, Score]]  # by town and network
    preferred: str  # region whose edge FL is the best on validation frames of the unseen town

    def change(self, arm: str, aim: str) -> float:
        """Return the change of an arm's AP against the network that an aim compares it with."""
        place, measure = aim.split(", ")
        town = {"unseen town": UNSEEN, "home": HOME}.get(place, place)
        rival = {UNSEEN: EDGES[self.preferred], HOME: PRETRAINED}.get(town) or EDGES[town]
        after, before = (getattr(self.scores[town][name], measure.lower()) for name in (arm, rival))
        return after - before


@dataclass(frozen=True)
class CloudResult(Record):
    """Results of the comparison: numbers by seed, and means over seeds."""

    seeds: Mapping[str, CloudSeed]
    ap50: Mapping[str, Mapping[str, MeanOverSeeds]]  # by town and network
    ap70: Mapping[str, Mapping[str, MeanOverSeeds]]
    changes: Mapping[str, Mapping[str, MeanOverSeeds]]  # by aim and arm
    recipe: Mapping[str, Json]
    provenance: Provenance

    def sentences(self) -> list[str]:
        """Return the verdicts on the aims of the chosen arm, in words."""
        return describe_aims(self.claims())

    def claims(self) -> dict[str, Claim]:
        """Return the claims that the chosen arm reaches the aims, by aim."""
        return {aim: Claim(self.changes[aim][CHOSEN], than=least) for aim, least in AIMS.items()}


def read_seed(run: Run, work: Path) -> CloudSeed:
    """Return the results of a run whose steps are in the folder `work`; edge FL is tested in the other towns, too."""
    steps = run.steps

    def tested(arm: str, stage: str, town: str) -> Score:
        found = Tested.load(work / steps.test(steps.stage(arm, stage, town, TASK), town))
        return Score(found.estimate.mean, found.numbers["AP70"] or 0.0)

    def edge(region: str, town: str) -> Score:
        if region == town:
            return tested(MAIN, EDGE, town)
        network = load_stage_network(OBJECTS, work / steps.edge(MAIN, region, TASK))
        split = Frames.open(work / steps.recording(town, "test", TASK))
        outcomes = as_measurable(OBJECTS).outcomes(network, split.data, split.vehicles)
        return Score(compute_measure(OBJECTS, outcomes), as_measurable(OBJECTS).numbers(outcomes)["AP70"] or 0.0)

    def valid(region: str) -> float:
        network = load_stage_network(OBJECTS, work / steps.edge(MAIN, region, TASK))
        split = Frames.open(work / steps.recording(UNSEEN, "validation", TASK))
        return score_network(OBJECTS, network, split.data, split.vehicles)

    return CloudSeed(
        {
            town: {
                PRETRAINED: tested(MAIN, PRETRAIN, town),
                **{name: edge(region, town) for region, name in EDGES.items()},
                **{name: tested(arm, CLOUD, town) for name, arm in ARMS.items()},
            }
            for town in TOWNS
        },
        max(REGIONS, key=valid),
    )


def compare_cloud(recipe: RunRecipe, seeds: Mapping[str, CloudSeed]) -> CloudResult:
    """Return the results of the arms of `recipe`, from those of each seed."""
    networks = (PRETRAINED, *EDGES.values(), *ARMS)
    towns = {town: {name: seed.scores[town] for name, seed in seeds.items()} for town in TOWNS}
    return CloudResult(
        seeds=seeds,
        ap50={town: average_arms(own, networks, lambda score: score.ap50) for town, own in towns.items()},
        ap70={town: average_arms(own, networks, lambda score: score.ap70) for town, own in towns.items()},
        changes={
            aim: {arm: mean_over_seeds([seed.change(arm, aim) for seed in seeds.values()]) for arm in ARMS}
            for aim in AIMS
        },
        recipe=recipe.model_dump(mode="json", exclude={"seed"}),
        provenance=provenance(),
    )


@style.styled
def draw_cloud(results: CloudResult) -> bytes:
    """Return the changes of all arms as a PNG: a panel for each aim, in which what misses it is shaded."""
    figure = style.canvas(11.0, 1.5 + 0.42 * len(ARMS))
    panels = figure.subplots(1, len(AIMS), sharey=True)
    for axes, (aim, least) in zip(panels, AIMS.items(), strict=True):
        rows = [[seed.change(arm, aim) for seed in results.seeds.values()] for arm in ARMS]
        low, high = min(least, *map(min, rows)), max(0.0, least, *map(max, rows))
        room = 0.25 * (high - low)  # for the numbers
        axes.set_xlim(low - room, high + room)
        axes.axvspan(low - room, least, color=style.SIDEWALK, zorder=0)
        axes.axvline(least, color=style.INK, linewidth=1, linestyle=(0, (4, 3)))
        axes.axvline(0, color=style.MUTED, linewidth=0.8)
        for y, by_seed in enumerate(rows):
            mean = sum(by_seed) / len(by_seed)
            colour = style.BLUE if mean >= least else style.VERMILLION
            axes.plot(by_seed, [y] * len(by_seed), "o", color=colour, markersize=5, markerfacecolor="white")
            axes.plot(mean, y, "s", color=colour, markersize=7)
            where: Any = {"textcoords": "offset points", "ha": "center", "fontsize": style.SMALL}
            axes.annotate(signed(mean), (mean, y), (0, 8), bbox={"fc": "white", "ec": "none", "pad": 0.8}, **where)
        axes.set_title(f"{aim}\naim: at least {signed(least, 2)}", fontweight="bold")
        axes.locator_params(axis="x", nbins=3)
        axes.grid(axis="x")
    panels[0].set_yticks(range(len(ARMS)), list(ARMS))
    panels[0].set_ylim(len(ARMS) - 0.5, -0.7)
    figure.supxlabel(
        "change in AP against edge FL (unseen town: against the better of both), at home against pretraining; "
        "circles: seeds, squares: means; shaded: the aim is missed",
        fontsize=style.SMALL,
        color=style.MUTED,
    )
    return style.png(figure)


def cloud_tables(results: CloudResult) -> dict[str, str]:
    """Return Markdown by name: changes, aims, towns."""
    own = {aim: results.changes[aim][CHOSEN] for aim in AIMS}
    changes = [[arm, *(results.changes[aim][arm].describe(sign=True) for aim in AIMS)] for arm in ARMS]
    networks = (PRETRAINED, *EDGES.values(), *ARMS)
    return {
        "changes": format_table(("arm", *(f"{aim}, aim {signed(least, 2)}" for aim, least in AIMS.items())), changes),
        "aims": format_table(
            (f"aim of {CHOSEN}", "change", "p, corrected", "aim", "if undecided: seeds that decide"),
            [
                [
                    f"{aim}, at least {signed(least, 2)}",
                    own[aim].describe(sign=True),
                    one.p_cell,
                    REACHED[one.verdict],
                    one.takes_cell,
                ]
                for (aim, least), one in zip(AIMS.items(), judge([*results.claims().values()]), strict=True)
            ],
        ),
        "towns": format_table(
            ("AP50, AP70", *TOWNS),
            [
                [name, *(f"{results.ap50[town][name].mean:.3f}, {results.ap70[town][name].mean:.3f}" for town in TOWNS)]
                for name in networks
            ],
        ),
    }


def _run(out: Path, options: Options) -> Outcome[CloudResult]:
    recipe = options.load("cloud", shrink_recipe)
    runs = options.run_seeds(recipe, out)
    seeds = {str(run.recipe.seed): read_seed(run, work) for run, work in zip(runs, list_works(runs, out), strict=True)}
    results = compare_cloud(recipe, seeds)
    return Outcome(results, {"arms.png": draw_cloud(results)}, results.sentences())


EXPERIMENT = Experiment(CloudResult, _run, cloud_tables, recipe="cloud")
