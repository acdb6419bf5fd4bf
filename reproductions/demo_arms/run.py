"""Ablation: each stage and sensor against its alternatives, as the arms of recipes/runs/arms.yaml on the same frames.

Centralised arms continue pretraining for as many optimiser steps as the vehicles of stage II take together; the arm
with further edge rounds takes as many as stages II and III. Arms have separate ledgers. Within a seed, intervals are a
bootstrap over test scenes; seeds have different recordings, so that intervals over seeds cover training and traffic as
well. The verdicts on all differences are corrected together.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flcav.config import Json
from flcav.experiments.experiment import Experiment, Options, Outcome, use_demo_size
from flcav.report import style
from flcav.report.charts import figures
from flcav.runs.analysis.histories import gap_closed
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN, RunRecipe
from flcav.runs.results.plans import Pole
from flcav.runs.results.run import Run
from flcav.runs.results.tests import name_stage
from flcav.statistics.estimates import Estimate
from flcav.statistics.power import MOST_SEEDS, plan_seeds
from flcav.statistics.seeds import LEVEL, MeanOverSeeds, half_width, mean_over_seeds
from flcav.statistics.verdicts import ESTIMATE, HELD, NOT_HELD, UNDECIDED, Judged, judge_means, verdict
from flcav.storage.markdown import format_table
from flcav.storage.records import Record, select

TASK = "objects"
FURTHER = "edge FL, as many more rounds"  # instead of those of cloud FL
IDEAL = "edge FL, VRCSP pole, ideal road detector"
EFFECT = 0.02  # difference in AP50 that the comparison should detect
ARMS: dict[str, dict[str, tuple[str, str]]] = {  # by town: name in the tables -> arm, stage
    "grid": {
        "pretrained": (MAIN, PRETRAIN),
        "more pretraining": ("more", CENTRAL),
        "edge FL, no road sensor": ("no_pole", EDGE),
        "edge FL, densest pole": ("densest", EDGE),
        "edge FL, VRCSP pole": (MAIN, EDGE),
        IDEAL: ("ideal", EDGE),
        FURTHER: ("further", MORE_EDGE),
        "edge + cloud FL": (MAIN, CLOUD),
        "oracle": ("oracle", CENTRAL),
    },
    "ring": {
        "pretrained": (MAIN, PRETRAIN),
        "more pretraining": ("more", CENTRAL),
        "edge FL, VRCSP pole": (MAIN, EDGE),
        FURTHER: ("further", MORE_EDGE),
        "edge + cloud FL": (MAIN, CLOUD),
    },
}
COMPARED = (  # (after, before): claims of the article and controls
    ("edge FL, VRCSP pole", "pretrained"),
    ("edge FL, VRCSP pole", "more pretraining"),
    ("edge FL, VRCSP pole", "edge FL, no road sensor"),
    ("edge FL, VRCSP pole", "edge FL, densest pole"),
    ("edge FL, VRCSP pole", IDEAL),
    ("edge + cloud FL", "edge FL, VRCSP pole"),
    ("edge + cloud FL", FURTHER),
)


@dataclass(frozen=True)
class ReachedAP:
    """AP of a network at IoU 0.5, with its interval over test scenes, and at IoU 0.7."""

    ap50: float
    ap50_low: float | None
    ap50_high: float | None
    ap70: float | None


@dataclass(frozen=True)
class PlannedCounts:
    """The plan's samples and rounds."""

    samples: int
    edge_rounds: int
    cloud_rounds: int


@dataclass(frozen=True)
class Pretraining:
    """Stage I: optimiser steps, threshold of pseudo-labels, and the training curve."""

    steps: int
    threshold: float | None  # lowest score of detections that serve as labels
    curve: tuple[Mapping[str, float], ...]  # step, loss and score of every validation


@dataclass(frozen=True)
class PlacedSensor:
    """Placement of a region's roadside sensor, and its coverage of errors."""

    chosen: int
    densest: int  # pole of the densest traffic
    coverage: tuple[Pole, ...]
    errors: int
    covered: int
    range_m: float


@dataclass(frozen=True)
class ArmsSeed:
    """Results of one seed; arms are named as in `ARMS`."""

    seed: int
    plan: PlannedCounts
    pretraining: Pretraining
    placement: Mapping[str, PlacedSensor]  # by town
    ap: Mapping[str, Mapping[str, ReachedAP]]  # by town and arm
    differences: Mapping[str, Estimate]  # "town: after - before", over test scenes
    gap_closed: Mapping[str, float]  # by arm
    used_mb: Mapping[str, Mapping[str, float]]  # by arm and link


@dataclass(frozen=True)
class ArmsSummary:
    """Means over seeds."""

    ap50: Mapping[str, Mapping[str, MeanOverSeeds]]  # by town and arm
    ap70: Mapping[str, Mapping[str, MeanOverSeeds]]
    differences: Mapping[str, MeanOverSeeds]
    gap_closed: Mapping[str, MeanOverSeeds]
    road_share: MeanOverSeeds  # share of the gain with the ideal road detector


@dataclass(frozen=True)
class ArmsResult(Record):
    """Results of the comparison of arms: numbers by seed, and means over seeds."""

    seeds: tuple[ArmsSeed, ...]
    summary: ArmsSummary
    recipe: Mapping[str, Json]
    provenance: Provenance


def compare_arms(recipe: RunRecipe, runs: Sequence[Run]) -> ArmsResult:
    """Return the results of the arms of `recipe`, from a run of each seed.

    Raises `InputError` where no sensor was placed in a region.
    """
    rows = tuple(one_seed(run) for run in runs)
    return ArmsResult(rows, summarise(rows), recipe.model_dump(mode="json", exclude={"seed"}), provenance())


def one_seed(run: Run) -> ArmsSeed:
    """Return the results of one seed's run."""
    main, pretrained = run.arms[MAIN], run.pretrained[0]
    plan = main.plan.tasks[TASK]
    ap = {town: {arm: _tested(run, town, *stage) for arm, stage in arms.items()} for town, arms in ARMS.items()}
    compared = {
        (change.region, change.arm, change.stage, change.before_arm, change.before_stage): change.over_scenes
        for change in run.differences
    }
    differences = {
        f"{town}: {after} - {before}": compared[town, *arms[after], *arms[before]]
        for town, arms in ARMS.items()
        for after, before in COMPARED
        if {after, before} <= set(arms)
    }
    closed = {
        arm: run.gap_closed[name]
        for arm, stage in ARMS["grid"].items()
        if (name := f"grid, {TASK}: {name_stage(*stage)}") in run.gap_closed
    }
    curve = tuple(vars(validation) for validation in pretrained.validated)
    return ArmsSeed(
        seed=run.recipe.seed,
        plan=PlannedCounts(plan.samples, plan.edge_rounds, plan.cloud_rounds),
        pretraining=Pretraining(pretrained.steps, pretrained.threshold, curve),
        placement={placed.region: _placed(run, placed.region) for placed in main.placed},
        ap=ap,
        differences=differences,
        gap_closed=closed,
        used_mb={"edge + cloud FL": {link: use.used_mb for link, use in main.links.items()}},
    )


def _tested(run: Run, town: str, arm: str, stage: str) -> ReachedAP:
    test = run.test(arm=arm, stage=stage, region=town, task=TASK)
    return ReachedAP(test.estimate.mean, test.estimate.low, test.estimate.high, test.numbers["AP70"])


def _placed(run: Run, town: str) -> PlacedSensor:
    (placed,) = select(run.arms[MAIN].placed, region=town)
    return PlacedSensor(placed.first, placed.densest, placed.poles, placed.errors, placed.covered, placed.range_m)


def summarise(seeds: Sequence[ArmsSeed]) -> ArmsSummary:
    """Return means over seeds with their 95 % intervals."""

    def means(number: Callable[[ReachedAP], float | None]) -> dict[str, dict[str, MeanOverSeeds]]:
        return {
            town: {
                arm: mean_over_seeds([_known(number(seed.ap[town][arm])) for seed in seeds], share=True) for arm in arms
            }
            for town, arms in seeds[0].ap.items()
        }

    return ArmsSummary(
        ap50=means(lambda reached: reached.ap50),
        ap70=means(lambda reached: reached.ap70),
        differences={
            name: mean_over_seeds([seed.differences[name].mean for seed in seeds]) for name in seeds[0].differences
        },
        gap_closed={arm: mean_over_seeds([seed.gap_closed[arm] for seed in seeds]) for arm in seeds[0].gap_closed},
        road_share=mean_over_seeds([_road_share(seed.ap["grid"]) for seed in seeds]),
    )


def _road_share(reached: Mapping[str, ReachedAP]) -> float:
    """Return the gain of edge FL with the trained road detector as a share of that with an ideal one."""
    return gap_closed(*(reached[arm].ap50 for arm in ("pretrained", "edge FL, VRCSP pole", IDEAL)))


def judge_differences(summary: ArmsSummary) -> dict[str, Judged]:
    """Return the verdicts on the claims that the differences are positive, corrected together.

    The difference to the ideal road detector is no claim, only an estimate.
    """
    return judge_means({name: mean for name, mean in summary.differences.items() if not name.endswith(f" - {IDEAL}")})


def describe_arms(summary: ArmsSummary) -> list[str]:
    """Return gaps closed and differences in words."""
    judged = judge_differences(summary)
    return [
        *(f"{arm}: closes of the gap {closed.describe()}" for arm, closed in summary.gap_closed.items()),
        f"share of the gain with an ideal road detector: {summary.road_share.describe()}",
        *(
            f"{name}: {summary.differences[name].describe(sign=True)}, {one.verdict}: {one.describe()}"
            for name, one in judged.items()
        ),
    ]


def _known(number: float | None) -> float:
    assert number is not None  # every town has targets
    return number


def draw_arms(results: ArmsResult) -> bytes:
    """Return the forest plot of all arms' AP over seeds as a PNG, in the order of `ARMS`."""
    return style.png(figures.arms(order_arms(results.summary.ap50)))


def order_arms(towns: Mapping[str, Mapping[str, MeanOverSeeds]]) -> dict[str, dict[str, MeanOverSeeds]]:
    """Return means by town and arm in the order of `ARMS`, since the keys in files are sorted."""
    return {
        town: {arm: towns[town][arm] for arm in arms if arm in towns[town]}
        for town, arms in ARMS.items()
        if town in towns
    }


def tables(results: ArmsResult) -> dict[str, str]:
    """Return Markdown by name: grid, ring, differences, power, seeds."""
    return {
        "grid": _town(results, "grid"),
        "ring": _town(results, "ring"),
        "differences": _differences(results),
        "power": _power(results),
        "seeds": _seeds(results),
    }


def _town(results: ArmsResult, town: str) -> str:
    """Return AP by arm; for grid, which has an oracle, also the share of the gap to it that an arm closes."""
    summary = results.summary
    closed = summary.gap_closed if town == "grid" else {}
    rows = [
        [arm, summary.ap50[town][arm].describe(), summary.ap70[town][arm].describe()]
        + ([closed[arm].describe() if arm in closed else ""] if closed else [])
        for arm in ARMS[town]
        if arm in summary.ap50[town]
    ]
    return format_table((f"arm on `{town}`", "AP50", "AP70", *(["gap closed"] if closed else [])), rows)


def _differences(results: ArmsResult) -> str:
    judged = judge_differences(results.summary)
    rows = []
    for name, mean in results.summary.differences.items():
        by_seed = [seed.differences[name] for seed in results.seeds]
        times = Counter(verdict(estimate.low, estimate.high) for estimate in by_seed)
        counted = " / ".join(str(times[state]) for state in (HELD, UNDECIDED, NOT_HELD))
        one = judged.get(name)
        cells = (one.p_cell, one.verdict) if one else ("", ESTIMATE)
        rows.append([name, mean.describe(sign=True), *cells, counted])
    header = (
        "difference in AP50",
        "mean over seeds",
        "p, corrected",
        "claim that it is positive",
        "seeds whose own 95 % scene interval is above 0 / contains 0 / below 0",
    )
    return format_table(header, rows)


def _power(results: ArmsResult) -> str:
    """Return the numbers of seeds that detect `EFFECT` and a difference of the observed size, after correction."""
    judged = judge_differences(results.summary)
    rows = []
    for name, mean in results.summary.differences.items():
        one = judged.get(name)
        level = LEVEL / max(one.family, 1) if one else LEVEL
        half = f"{half_width(mean.sd, mean.seeds):.3f}" if mean.seeds > 1 else ""
        wanted = plan_seeds(EFFECT, mean.sd, level) if mean.known else None
        rows.append([name, f"{mean.sd:.3f}", half, _count_cell(wanted, mean), one.takes_cell if one else ""])
    header = (
        "difference in AP50",
        "standard deviation over seeds",
        f"half width of the interval of {len(results.seeds)} seeds",
        f"seeds that detect {EFFECT}",
        "if undecided: seeds that detect a difference of the observed size",
    )
    return format_table(header, rows)


def _count_cell(seeds: int | None, mean: MeanOverSeeds) -> str:
    """Return a number of seeds as text: "" where unknown; None stands for too many."""
    if not mean.known:
        return ""
    return f"more than {MOST_SEEDS}" if seeds is None else str(seeds)


def _seeds(results: ArmsResult) -> str:
    rows = []
    for seed in results.seeds:
        placed = seed.placement["grid"]
        covered = {pole.pole: pole.covered for pole in placed.coverage}
        used = seed.used_mb["edge + cloud FL"]
        rows.append(
            [
                seed.seed,
                f"{seed.plan.samples}, {seed.plan.edge_rounds}, {seed.plan.cloud_rounds}",
                placed.errors,
                *(f"{pole}: {covered[pole]}" for pole in (placed.chosen, placed.densest)),
                *(f"{used[link]:.1f} MB" for link in ("wireless", "wireline")),
            ]
        )
    header = (
        "seed",
        "plan: samples, edge, cloud rounds",
        "errors",
        "VRCSP pole covers",
        "densest pole covers",
        "wireless used",
        "wireline used",
    )
    return format_table(header, rows)


def _run(out: Path, options: Options) -> Outcome[ArmsResult]:
    recipe = options.load("arms", use_demo_size)
    runs = options.run_seeds(recipe, out)
    results = compare_arms(recipe, runs)
    return Outcome(results, {"arms.png": draw_arms(results)}, describe_arms(results.summary))


EXPERIMENT = Experiment(ArmsResult, _run, tables, seeds=5, recipe="arms")
