"""A federation of real vehicles: a network from simulation, and vehicles of two regions with different LiDARs.

The regions are imported datasets (`regions.py`), the run is that of `real.yaml`. Beside its networks stands one with as
many further steps on simulated sweeps (`networks.py`); bytes and seconds are by vehicle (`fleet.py`). Without a claim:
the errors of a drive (`drive.py`) and a learning curve (`curve.py`). Intervals are over test scenes and trainings.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flcav.config import InputError, Json
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.report import style
from flcav.report.charts import figures
from flcav.reproductions.real.curve import LearningCurve, measure_curve
from flcav.reproductions.real.drive import DriveErrors, measure_drive
from flcav.reproductions.real.fleet import Vehicle, measure_vehicles
from flcav.reproductions.real.networks import (
    ANNOTATED,
    CENTRALISED,
    COMPARED,
    JOINED,
    NETWORKS,
    PRETRAINED,
    SIMULATED,
    TASK,
    TRACKS,
    Reached,
    learn_more,
    list_tests,
    subtract_tests,
    test_reached,
)
from flcav.reproductions.real.regions import ASTYX, KARLSRUHE, TEST, prepare_regions
from flcav.runs.provenance import Provenance, provenance
from flcav.runs.recipe import RunRecipe, load_run_recipe
from flcav.runs.results.run import Run
from flcav.runs.results.training import LabelQuality
from flcav.runs.running import WORK, run
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.verdicts import Claim, describe_aims
from flcav.storage.markdown import format_table
from flcav.storage.records import Record

DATA = "FLCAV_REAL_DATA"  # environment variable: the folder whose `real` holds the data
RECIPE = Path(__file__).with_name("real.yaml")
TITLES = {KARLSRUHE: "Karlsruhe (KITTI)", ASTYX: "Astyx"}
GAIN, ALIKE = 0.20, 0.05  # AP50: that the claim is about; within which one network serves as well as another
Compared = tuple[str, str, str]  # region, network, network before
EXPECTED: Mapping[Compared, tuple[float, float]] = {  # bounds of the difference in AP50
    (ASTYX, ANNOTATED, PRETRAINED): (0.0, 0.12),
    (ASTYX, SIMULATED, PRETRAINED): (-0.05, 0.05),
    (ASTYX, CENTRALISED, ANNOTATED): (-0.05, 0.05),
    (ASTYX, JOINED, ANNOTATED): (-ALIKE, ALIKE),
    (KARLSRUHE, JOINED, ANNOTATED): (-ALIKE, ALIKE),
    (KARLSRUHE, ANNOTATED, PRETRAINED): (-0.05, 0.10),
    (KARLSRUHE, TRACKS, PRETRAINED): (-0.08, 0.05),
}


@dataclass(frozen=True)
class Split:
    """Numbers of a split of a region."""

    sweeps: int
    scenes: int
    vehicles: int


@dataclass(frozen=True)
class Expectation:
    """The interval in which a difference in AP50 was expected before the run, and the measured mean."""

    low: float
    high: float
    came: float

    @property
    def right(self) -> bool:
        """Whether the mean lies within the bounds."""
        return self.low <= self.came <= self.high


@dataclass(frozen=True)
class RealResult(Record):
    """Results of the federation, of the drive and of the learning curve."""

    splits: Mapping[str, Mapping[str, Split]]  # by region and split
    reached: Mapping[str, Mapping[str, Reached]]  # by region and network
    differences: Mapping[str, Mapping[str, MeanOverSeeds]]  # in AP50, by region and "after - before"
    labels: LabelQuality  # by tracks of the drive
    vehicles: tuple[Vehicle, ...]
    drive: DriveErrors
    curve: LearningCurve
    recipe: Mapping[str, Json]
    provenance: Provenance

    def claims(self) -> dict[str, Claim]:
        """Return the claim: what annotated labels gain over simulation alone on Astyx."""
        gained = self.differences[ASTYX][f"{ANNOTATED} - {PRETRAINED}"]
        return {f"on Astyx, {ANNOTATED} gains {GAIN:.2f} AP50 over {PRETRAINED}": Claim(gained, than=GAIN)}

    def expectations(self) -> dict[Compared, Expectation]:
        """Return the expectations with what came of them."""
        return {
            (region, after, before): Expectation(*bounds, self.differences[region][f"{after} - {before}"].mean)
            for (region, after, before), bounds in EXPECTED.items()
        }

    def sentences(self) -> list[str]:
        """Return the verdict on the claim, and the differences, in words."""
        differences = [
            f"{region}: {name}: {mean.describe(sign=True)}"
            for region, found in self.differences.items()
            for name, mean in found.items()
        ]
        return [*describe_aims(self.claims()), *differences]


def collect_results(
    result: Run,
    work: Path,
    simulated: Mapping[str, Sequence[Path]],
    regions: Mapping[str, Mapping[str, Path]],
    drive: DriveErrors,
    curve: LearningCurve,
) -> RealResult:
    """Return the results of a run.

    Args:
        result: of the run.
        work: folder of its steps.
        simulated: folders of the tests of the network with more simulation, by region and training.
        regions: folders of the datasets, by region and split.
        drive: errors of the drive.
        curve: learning curve of Astyx.
    """
    tests = {region: {**list_tests(result, work, region), SIMULATED: simulated[region]} for region in regions}
    (tracked,) = (each for each in result.arms["tracks"].stages if each.region == KARLSRUHE)
    assert tracked.labels is not None
    return RealResult(
        splits={region: {name: count_split(path) for name, path in of.items()} for region, of in regions.items()},
        reached={
            region: {name: test_reached(result, of[name]) for name in NETWORKS if name in of}
            for region, of in tests.items()
        },
        differences={
            region: {
                f"{after} - {before}": subtract_tests(result, of[after], of[before])
                for after, before in COMPARED
                if {after, before} <= {*of}
            }
            for region, of in tests.items()
        },
        labels=tracked.labels[0],
        vehicles=measure_vehicles(result, work),
        drive=drive,
        curve=curve,
        recipe=result.recipe.model_dump(mode="json", exclude={"seed"}),
        provenance=provenance(result.recipe.seed),
    )


def count_split(folder: Path) -> Split:
    """Return the numbers of the dataset in a folder."""
    keys = Dataset.open(folder).keys
    return Split(len(keys), len({key.scene for key in keys}), len({key.agent for key in keys}))


def shrink(recipe: RunRecipe) -> RunRecipe:
    """Return the recipe with two trainings of two rounds of one local step, for a trial."""
    (task,) = recipe.tasks.values()
    assert task.plan is not None
    few = task.plan.model_copy(update={"edge_rounds": 2, "cloud_rounds": 1})
    training = recipe.training_of(TASK).model_copy(update={"local_steps": 1})
    tasks = {TASK: task.model_copy(update={"plan": few})}
    changes = {"retrainings": 1, "size": "toy", "splits": None, "training": training, "tasks": tasks}
    return recipe.model_copy(update=changes)


def find_data(options: Options) -> list[Path]:
    """Return the folders of the data: that of `--data` first; raises `InputError` where there is none."""
    known = [] if options.data is None else [options.data]
    if DATA in os.environ:
        known.append(Path(os.environ[DATA]) / "real")
    if not known:
        raise InputError(f"reproduce real: needs {DATA}, a folder whose 'real' holds the data, or --data")
    return known


def _run(out: Path, options: Options) -> Outcome[RealResult]:
    data, recipe = find_data(options), load_run_recipe(RECIPE)
    recipe = shrink(recipe) if options.quick else recipe
    regions = prepare_regions(data, out / "regions")
    with options.show_steps(options.title) as notify:
        how = options.how(notify)
        result = run(recipe, out / "run", beside=out / "regions", **how)
        tested = {region: splits[TEST] for region, splits in regions.items()}
        simulated = learn_more(recipe, tested, out / "simulated", how)
        curve = measure_curve(recipe, regions[ASTYX], out / "curve", how)
    drive = measure_drive(data, out)
    found = collect_results(result, out / "run" / WORK, simulated, regions, drive, curve)
    return Outcome(found, {"networks.png": draw_networks(found)}, found.sentences())


def draw_networks(results: RealResult) -> bytes:
    """Return AP50 of all networks by region, with intervals, as a PNG."""
    reached = {region: results.reached[region] for region in TITLES}
    panels: dict[str, dict[str, Estimate]] = {
        title: {name: reached[region][name].ap50 for name in NETWORKS if name in reached[region]}
        for region, title in TITLES.items()
    }
    counts = [each.trainings for of in reached.values() for each in of.values()]
    return style.png(figures.arms(panels, f"AP50, mean of {min(counts)} to {max(counts)} trainings"))


def tabulate_real(results: RealResult) -> dict[str, str]:
    """Return Markdown by name: claim, expectations, networks, differences, frames, vehicles, drive, curve, plans."""
    networks = [
        [
            region,
            name,
            each.trainings,
            each.ap50.describe(),
            f"{each.cars:.3f}",
            f"{each.found:.1f} of {each.targets}",
            f"{each.false / results.splits[region][TEST].sweeps:.2f}",
        ]
        for region, of in results.reached.items()
        for name, each in of.items()
    ]
    differences = [
        [region, name, mean.describe(sign=True)]
        for region, of in results.differences.items()
        for name, mean in of.items()
    ]
    expected = [
        [region, f"{after} - {before}", f"{each.low:+.2f} to {each.high:+.2f}", f"{each.came:+.3f}", _tell(each.right)]
        for (region, after, before), each in results.expectations().items()
    ]
    frames = [
        [region, name, each.sweeps, each.scenes, each.vehicles]
        for region, of in results.splits.items()
        for name, each in of.items()
    ]
    vehicles = [
        [
            f"{each.region}/{each.name}",
            each.sweeps,
            each.boxes,
            f"{each.up_mb:.2f}",
            f"{each.down_mb:.2f}",
            f"{each.train_s:.0f}",
            f"{each.sweeps_mb:.2f}",
        ]
        for each in results.vehicles
    ]
    labels, drive, curve = results.labels, results.drive, results.curve
    found = [[*name.split(" ", 1), count] for name, count in drive.counts.items()]
    poles = [
        [number, ", ".join(map(str, chosen)), f"{covered} of {sum(drive.counts.values())}"]
        for number, (chosen, covered) in enumerate(zip(drive.chosen, drive.covered, strict=True), start=1)
    ]
    points = [
        [size, *(f"{value:.3f}" for value in values)]
        for size, values in sorted(curve.points.items(), key=lambda point: int(point[0]))
    ]
    draws = max(map(len, curve.points.values()))
    plans = [[f"{each.budget_mb:g}", each.sweeps, f"{each.predicted:.3f}"] for each in curve.plans]
    rates = [["-" if rate is None else f"{rate:.3f}" for rate in (labels.precision, labels.recall)]]
    return {
        "claim": "\n".join(f"- {sentence}" for sentence in describe_aims(results.claims())),
        "expectations": format_table(("region", "difference in AP50", "expected", "mean", "as expected"), expected),
        "networks": format_table(
            ("region", "network", "trainings", "AP50", "AP of cars", "found", "false a frame"), networks
        ),
        "differences": format_table(("region", "difference in AP50", "mean over trainings"), differences),
        "frames": format_table(("region", "split", "sweeps", "scenes", "vehicles"), frames),
        "labels": format_table(("labels by tracks: precision", "recall"), rates),
        "vehicles": format_table(
            (
                *("vehicle", "sweeps", "labelled boxes", "updates sent [MB]", "networks received [MB]"),
                *("CPU seconds of training", "its sweeps as uploads [MB]"),
            ),
            vehicles,
        ),
        "errors": format_table(("kind", "class", "errors"), found),
        "poles": format_table(("sensors", "poles", "errors covered"), poles),
        "curve": format_table(("sweeps", *(f"AP of cars, draw {n + 1}" for n in range(draws))), points),
        "plans": format_table(("wireless budget [MB]", "sweeps", "AP of cars by the curve"), plans),
    }


def _tell(right: bool) -> str:
    return "yes" if right else "no"


EXPERIMENT = Experiment(RealResult, _run, tabulate_real, takes=("scale", "jobs", "engine", "stale", "data"))
