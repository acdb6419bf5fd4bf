"""Comparison of what the cloud does with the regions' networks, as the arms of recipes/runs/cloud.yaml.

Every arm continues the same edge FL. Its network is compared with that of edge FL in each region, in an unseen town
with the better of both on validation frames there, and in the town of pretraining with the pretrained one. Each seed
has its own recordings, so that intervals over seeds cover training and traffic. The claims are those of one arm, chosen
on other seeds; all are corrected together.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

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
from flcav.statistics.verdicts import Claim, describe_aims
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

TASK, HOME, UNSEEN = "objects", "suburb", "arterial"
REGIONS = ("grid", "ring")
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
        return describe_aims({aim: Claim(self.changes[aim][CHOSEN], than=least) for aim, least in AIMS.items()})


def read_seed(run: Run, work: Path) -> CloudSeed:
    """Return the results of a run whose steps are in the folder `work`; edge FL is tested in the other towns, too."""
    steps, towns = run.steps, (*run.recipe.regions,)

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
            for town in towns
        },
        max(REGIONS, key=valid),
    )


def compare_cloud(recipe: RunRecipe, seeds: Mapping[str, CloudSeed]) -> CloudResult:
    """Return the results of the arms of `recipe`, from those of each seed."""
    networks = (PRETRAINED, *EDGES.values(), *ARMS)
    towns = {town: {name: seed.scores[town] for name, seed in seeds.items()} for town in recipe.regions}
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
    figure = style.canvas(11.0, 1.1 + 0.36 * len(ARMS))
    panels = figure.subplots(1, len(AIMS), sharey=True)
    for axes, (aim, least) in zip(panels, AIMS.items(), strict=True):
        for y, arm in enumerate(ARMS):
            change = results.changes[aim][arm]
            colour = style.BLUE if change.mean >= least else style.VERMILLION
            if change.low is not None and change.high is not None:
                axes.plot([change.low, change.high], [y, y], color=colour, linewidth=2)
            axes.plot(change.mean, y, "s", color=colour, markersize=6)
        axes.axvline(0, color=style.RULE, linewidth=0.8)
        axes.axvline(least, color=style.INK, linewidth=1, linestyle=(0, (4, 3)))
        axes.axvspan(min(axes.get_xlim()[0], least - 0.01), least, color=style.SIDEWALK, zorder=0)
        axes.set_title(f"{aim}\naim: {least:+.2f} or more", fontweight="bold")
        axes.grid(axis="x")
    panels[0].set_yticks(range(len(ARMS)), list(ARMS))
    panels[0].set_ylim(len(ARMS) - 0.5, -0.5)
    figure.supxlabel("change in AP against edge FL, at home against pretraining (95 % intervals over seeds)")
    return style.png(figure)


def cloud_tables(results: CloudResult) -> dict[str, str]:
    """Return Markdown by name: changes, towns, seeds."""
    changes = [[arm, *(results.changes[aim][arm].describe(sign=True) for aim in AIMS)] for arm in ARMS]
    towns = [*results.recipe["regions"]]  # type: ignore[misc]
    networks = (PRETRAINED, *EDGES.values(), *ARMS)
    return {
        "changes": format_table(("arm", *(f"{aim}, aim {least:+.2f}" for aim, least in AIMS.items())), changes),
        "aims": "\n".join(f"- {sentence}" for sentence in results.sentences()),
        "towns": format_table(
            ("AP50, AP70", *towns),
            [
                [name, *(f"{results.ap50[town][name].mean:.3f}, {results.ap70[town][name].mean:.3f}" for town in towns)]
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


EXPERIMENT = Experiment(CloudResult, _run, cloud_tables)
