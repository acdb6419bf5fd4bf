"""A learning curve of Astyx: AP of cars by number of annotated sweeps, its fit, and a plan by it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from flcav.config import Json, parse_config
from flcav.dataset.store import Dataset
from flcav.experiments.experiment import HowToRun
from flcav.network.ledger import BYTES_PER_MB
from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.curves.curves import Additive
from flcav.optimization.curves.fitting import fit
from flcav.optimization.problem import Problem
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import find_shipped, load_network
from flcav.reproductions.real.networks import TASK, score_cars
from flcav.reproductions.real.regions import EDGE, VALIDATION, VEHICLES
from flcav.runs.engine import Step, Work, run_steps
from flcav.runs.recipe import RunRecipe, Training
from flcav.runs.stages.centralised import train_centrally
from flcav.runs.training.learning import Learning
from flcav.statistics.streams import derive_seed, stream
from flcav.storage.records import write_any_table

SIZES = (8, 15, 30, 60, 120)  # annotated sweeps
DRAWS = 1  # of them, with a training each
HISTORY = "history.csv"
UPLINK_MB = (1.0, 3.0)  # budgets of the wireless uplink that are planned for
MODEL_MB = 1.5  # of an update, of which the plans have none


@dataclass(frozen=True)
class Planned:
    """The plan for a budget of the wireless uplink: sweeps, and the AP of cars that the curve predicts."""

    budget_mb: float
    sweeps: int
    predicted: float


@dataclass(frozen=True)
class LearningCurve:
    """AP of cars on validation frames by number of sweeps: accuracy = 1 - floor - a n^(-b)."""

    before: float  # of the packaged network, of no sweep
    points: Mapping[str, tuple[float, ...]]  # by number of sweeps, by draw
    a: float
    b: float
    floor: float
    rmse: float
    warnings: tuple[str, ...]  # of the fit
    plans: tuple[Planned, ...]


def measure_curve(recipe: RunRecipe, splits: Mapping[str, Path], out: Path, how: HowToRun) -> LearningCurve:
    """Train the packaged network on few and more sweeps of a region, fit the curve, and plan by it.

    `splits`: folders of the region's datasets by split. AP is that on validation frames. All trainings take as many
    steps as edge FL of the region, at the same rates. Writes the points to `history.csv` in `out`.
    """
    plan = recipe.tasks[TASK].plan
    assert plan is not None
    learned: dict[str, Json] = {
        "network": recipe.tasks[TASK].network,
        "training": recipe.training_of(TASK).model_dump(mode="json"),
        "rounds": plan.edge_rounds,
        "edge": str(splits[EDGE].resolve()),
        "validation": str(splits[VALIDATION].resolve()),
    }
    seeds = {draw: derive_seed(recipe.seed, "curve", draw) for draw in range(DRAWS)}
    asked = {(size, draw): {**learned, "sweeps": size, "seed": seeds[draw]} for size in SIZES for draw in seeds}
    steps = [Step("start", train_on, {**learned, "sweeps": 0, "seed": seeds[0]})]
    steps += [Step(f"sweeps-{size}-{draw}", train_on, about) for (size, draw), about in asked.items()]
    values = run_steps(steps, out, **how)
    points = {str(size): tuple(values[f"sweeps-{size}-{draw}"]["cars"] for draw in seeds) for size in SIZES}
    return fit_points(values["start"]["cars"], points, values[f"sweeps-{SIZES[-1]}-0"]["mb"], out / HISTORY)


def train_on(
    work: Work,
    *,
    network: str,
    training: Mapping[str, Json],
    rounds: int,
    edge: str,
    validation: str,
    sweeps: int,
    seed: int,
) -> dict[str, float]:
    """Train the packaged network on drawn sweeps; return the AP of cars, and the megabytes of a compressed sweep."""
    learning = Learning(OBJECTS, network, Training.model_validate(training), seed)
    trained = load_network(OBJECTS, find_shipped(OBJECTS))
    held, tested = Dataset.open(Path(edge)), Dataset.open(Path(validation))
    frames = np.sort(stream(seed, "sweeps").permutation(len(held))[:sweeps]).tolist()
    mb = 0.0
    if frames:
        messages = [*OBJECTS.compress_samples(OBJECTS.pack_samples(held, trained.config, frames))]
        mb = sum(map(len, messages)) / len(messages) / BYTES_PER_MB
        samples = OBJECTS.samples(held, trained.config, frames)
        train_centrally(learning, trained, [samples[i] for i in range(len(samples))], rounds, VEHICLES, "curve")
    return {"cars": score_cars(OBJECTS.outcomes(trained, tested, range(len(tested)))), "mb": mb}


def fit_points(before: float, points: Mapping[str, Sequence[float]], sweep_mb: float, history: Path) -> LearningCurve:
    """Return the curve of the points, with the plans of `UPLINK_MB`; writes them to `history` for `flcav fit`.

    `points`: AP of cars by number of sweeps and draw; `sweep_mb`: of a compressed sweep.
    """
    rows = [(int(size), each, draw) for size, found in points.items() for draw, each in enumerate(found)]
    samples, accuracy, seed = zip(*rows, strict=True)
    columns = {
        "task": [TASK] * len(rows),
        "samples": samples,
        "edge_rounds": [0] * len(rows),
        "cloud_rounds": [0] * len(rows),
        "accuracy": accuracy,
        "seed": seed,
    }
    write_any_table(pa.table(columns), history)
    fitted = fit(history)
    curve = fitted.curve
    assert isinstance(curve, Additive)

    def plan(budget_mb: float) -> Planned:
        problem = {
            "budgets_mb": {"wireless": budget_mb, "wireline": budget_mb},
            "tasks": [
                {
                    "name": TASK,
                    "sample_mb": sweep_mb,
                    "model_mb": MODEL_MB,
                    "edge_groups": [VEHICLES],
                    "limits": {"samples": [SIZES[0], SIZES[-1]], "edge_rounds": [0, 0], "cloud_rounds": [0, 0]},
                    "curve": curve.model_dump(mode="json"),
                }
            ],
        }
        (found,) = allocate(parse_config(Problem, problem, "the plan of the curve")).tasks
        return Planned(budget_mb, found.samples, 1 - found.predicted_error)

    decay = curve.pretrain
    return LearningCurve(
        before=before,
        points={size: tuple(found) for size, found in points.items()},
        a=decay.a,
        b=decay.b,
        floor=curve.floor,
        rmse=fitted.rmse,
        warnings=fitted.warnings,
        plans=tuple(map(plan, UPLINK_MB)),
    )
