"""Tests of the networks of the run, and of the packaged network after as many further steps on simulated sweeps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import ConcatDataset

from flcav.config import Json
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import HowToRun
from flcav.experiments.study import open_split, record_split
from flcav.perception.metrics.detection import weighted_precision
from flcav.perception.objects.evaluate import read_matches
from flcav.perception.objects.task import OBJECTS, TOWNS
from flcav.perception.outcomes import Outcomes, compute_interval, compute_measure
from flcav.perception.study import read_recipe
from flcav.perception.weights import find_shipped, load_network
from flcav.reproductions.real.regions import VEHICLES
from flcav.runs.analysis.differences import compare_tests, mean_over_trainings
from flcav.runs.arms import name_repeat
from flcav.runs.engine import Step, Work, run_steps
from flcav.runs.recipe import CENTRAL, CLOUD, EDGE, MAIN, PRETRAIN, RunRecipe, Training
from flcav.runs.results.run import Run
from flcav.runs.results.saved import OUTCOMES
from flcav.runs.stages.centralised import train_centrally
from flcav.runs.training.learning import Learning
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.statistics.streams import derive_seed

TASK = OBJECTS.name
PRETRAINED, SIMULATED, TRACKS, ANNOTATED, JOINED, CENTRALISED = (
    "simulation alone",
    "more simulation",
    "edge FL on tracks",
    "edge FL on annotated labels",
    "edge + cloud FL on annotated labels",
    "centralised on uploaded sweeps",
)
OF_RUN: Mapping[str, tuple[str, str]] = {  # name -> arm, stage
    PRETRAINED: (MAIN, PRETRAIN),
    TRACKS: ("tracks", EDGE),
    ANNOTATED: (MAIN, EDGE),
    JOINED: (MAIN, CLOUD),
    CENTRALISED: ("central", CENTRAL),
}
NETWORKS = (PRETRAINED, SIMULATED, TRACKS, ANNOTATED, JOINED, CENTRALISED)
COMPARED = (  # (after, before)
    (SIMULATED, PRETRAINED),
    (TRACKS, PRETRAINED),
    (ANNOTATED, PRETRAINED),
    (ANNOTATED, SIMULATED),
    (ANNOTATED, TRACKS),
    (JOINED, ANNOTATED),
    (CENTRALISED, ANNOTATED),
)
STREETS = {**read_recipe("wide_streets"), "scenes": 1}  # 30 sweeps of a town, by LiDARs of 16 to 128 beams
STREETS_SEED = 61  # whose streets no training had
Tests = Mapping[str, Sequence[Path]]  # folders of a network's tests in a region by training, by network


@dataclass(frozen=True)
class Reached:
    """Accuracy of a network on the test frames of a region, means over trainings."""

    ap50: Estimate  # with its interval over scenes and trainings
    cars: float  # AP in 3D at IoU 0.5 of cars alone
    found: float  # targets found, at the score from which detections count
    false: float  # detections of nothing, likewise
    targets: int
    trainings: int


def test_reached(run: Run, folders: Sequence[Path]) -> Reached:
    """Return what a network reaches, by the folders of its tests, one per training."""
    outcomes = [Outcomes.load(folder / OUTCOMES) for folder in folders]
    values = [compute_measure(OBJECTS, each) for each in outcomes]
    over_scenes = Estimate(values[0], *compute_interval(OBJECTS, outcomes[0], run.recipe.seed))
    places = [(folder,) for folder in folders]
    mean = mean_over_trainings(TASK, over_scenes, values, places, run.recipe.seed, share=True)
    counted = [OBJECTS.count(each) for each in outcomes]
    return Reached(
        ap50=over_scenes if mean is None else mean.as_estimate(),
        cars=float(np.mean([score_cars(each) for each in outcomes])),
        found=float(np.mean([each.found for each in counted])),
        false=float(np.mean([each.false or 0 for each in counted])),
        targets=counted[0].targets,
        trainings=len(folders),
    )


def score_cars(outcomes: Outcomes) -> float:
    """Return the AP in 3D at IoU 0.5 of cars alone; NaN without any."""
    once = np.ones((1, len(outcomes.scene)), dtype=np.int64)
    return float(weighted_precision(read_matches(outcomes, "Car"), once)[0])


def subtract_tests(run: Run, after: Sequence[Path], before: Sequence[Path]) -> MeanOverSeeds:
    """Return the difference in AP50 of two networks on the same frames, by the folders of their tests by training.

    A network of one training is compared with each training of the other.
    """
    pairs = [(after[n % len(after)], before[n % len(before)]) for n in range(max(len(after), len(before)))]
    measured = [[compute_measure(OBJECTS, Outcomes.load(folder / OUTCOMES)) for folder in pair] for pair in pairs]
    values = [later - earlier for later, earlier in measured]
    over_scenes = compare_tests(TASK, pairs[0][1], pairs[0][0], run.recipe.seed)
    mean = mean_over_trainings(TASK, over_scenes, values, pairs, run.recipe.seed, share=False)
    return mean_over_seeds(values) if mean is None else mean


def list_tests(run: Run, work: Path, region: str) -> dict[str, list[Path]]:
    """Return the folders of the tests in a region, by network and training; `work` is the folder of the run's steps."""
    tested = {(test.arm, test.stage) for test in run.tested if test.region == region}
    repeats = range(1 + run.recipe.retrainings)

    def folders(arm: str, stage: str) -> list[Path]:
        stages = [run.steps.stage(name_repeat(arm, n), stage, region, TASK) for n in repeats]
        return [work / run.steps.test(trained, region) for trained in dict.fromkeys(stages)]

    return {name: folders(*about) for name, about in OF_RUN.items() if about in tested}


def learn_more(recipe: RunRecipe, datasets: Mapping[str, Path], out: Path, how: HowToRun) -> dict[str, list[Path]]:
    """Return the folders of tests, by region and training, of the packaged network trained on simulated sweeps.

    It takes as many optimiser steps as edge FL of a region, at the same rates. `datasets`: of test frames, by region.
    """
    plan = recipe.tasks[TASK].plan
    assert plan is not None
    learned: dict[str, Any] = {
        "network": recipe.tasks[TASK].network,
        "training": recipe.training_of(TASK).model_dump(mode="json"),
        "rounds": plan.edge_rounds,
        "datasets": {region: str(path.resolve()) for region, path in datasets.items()},
    }
    streets = {f"streets-{town}": {**STREETS, "town": town, "seed": STREETS_SEED} for town in TOWNS}
    seeds = {
        f"simulated-{n}": derive_seed(recipe.seed, "retraining", n) if n else recipe.seed
        for n in range(1 + recipe.retrainings)
    }
    steps = [
        *(Step(name, record_split, {"recipe": fields}) for name, fields in streets.items()),
        *(Step(name, train_more, {**learned, "seed": seed}, tuple(streets)) for name, seed in seeds.items()),
    ]
    run_steps(steps, out, **how)
    return {region: [out / name / region for name in seeds] for region in datasets}


def train_more(
    work: Work, *, network: str, training: Mapping[str, Json], rounds: int, datasets: Mapping[str, str], seed: int
) -> dict[str, float]:
    """Train the packaged network on simulated sweeps; write its outcomes in each region, and return its AP50 there."""
    learning = Learning(OBJECTS, network, Training.model_validate(training), seed)
    trained = load_network(OBJECTS, find_shipped(OBJECTS))
    parts = [OBJECTS.samples(open_split(folder), trained.config) for folder in work.inputs.values()]
    held: Any = ConcatDataset(parts)  # pyright: ignore[reportArgumentType]
    samples = [held[i] for i in range(len(held))]  # in memory: samples are drawn many times
    train_centrally(learning, trained, samples, rounds, VEHICLES, PRETRAIN)
    found = {}
    for region, path in datasets.items():
        data = Dataset.open(Path(path))
        outcomes = OBJECTS.outcomes(trained, data, range(len(data)))
        (work.folder / region).mkdir(exist_ok=True)
        outcomes.save(work.folder / region / OUTCOMES)
        found[region] = compute_measure(OBJECTS, outcomes)
    return found
