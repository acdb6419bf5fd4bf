"""AP50 against megabytes of uplink: curves of federations by rounds, of uploaded sweeps by number, and crossings."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from flcav.interface.wording import plural
from flcav.network.ledger import BYTES_PER_MB, Ledger
from flcav.perception.objects.task import OBJECTS
from flcav.perception.outcomes import score_network
from flcav.perception.weights import load_network
from flcav.runs.frames import Frames
from flcav.runs.recipe import CENTRAL, EDGE, MAIN, PRETRAIN, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.results.saved import LEDGER, WEIGHTS
from flcav.runs.training.checkpoints import load_round_network
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds
from flcav.storage.records import LEFT_OUT

ROUNDS = (1, 2, 3, 5, 10)  # after which a federation is tested, as far as it has them


@dataclass(frozen=True)
class AtBytes:
    """AP50 on test frames, and the megabytes sent until then on the wireless uplink in a region's stage II."""

    label: str  # rounds or sweeps, as "3 rounds"
    mb: float
    ap50: float
    boxes: int | None = None  # annotated boxes that were sent as well; None: not counted


@dataclass(frozen=True)
class MeanAtBytes:
    """AP50 and megabytes at a point of a curve, as means over seeds."""

    label: str
    mb: float
    ap50: MeanOverSeeds
    boxes: Annotated[float | None, LEFT_OUT] = None  # annotated boxes; None: not counted


Curve = tuple[AtBytes, ...]
Curves = Mapping[str, Curve]  # by name


def trace_pretrained(run: Run, region: str) -> AtBytes:
    """Return the point at which all curves begin: the pretrained network."""
    (task,) = run.recipe.tasks
    return AtBytes("pretraining", 0.0, run.test(stage=PRETRAIN, region=region, task=task).estimate.mean)


def trace_federation(run: Run, work: Path, region: str, arm: str) -> Iterator[AtBytes]:
    """Yield AP50 and megabytes of an arm's stage II after each of `ROUNDS`; `work` is the folder of the run's steps."""
    (task,) = run.recipe.tasks
    settings, folder = run.recipe.training_of(task), work / run.steps.edge(arm, region, task)
    test = Frames.open(work / run.steps.recording(region, "test", task))
    start = load_network(OBJECTS, work / run.steps.pretrain(MAIN, task) / WEIGHTS)
    sent = Ledger.load(folder / LEDGER).entries
    last = max(entry.round for entry in sent)
    for number in (each for each in ROUNDS if each <= last):
        up = (
            entry.bytes
            for entry in sent
            if (entry.link, entry.direction) == ("wireless", "up") and entry.round <= number
        )
        if number == last:
            ap50 = run.test(arm=arm, stage=EDGE, region=region, task=task).estimate.mean
        else:
            ended = load_round_network(OBJECTS, start, folder, number, settings.average_rounds, settings.start_share)
            ap50 = score_network(OBJECTS, ended, test.data, test.vehicles)
        yield AtBytes(plural(number, "round"), sum(up) / BYTES_PER_MB, ap50)


def trace_uploads(run: Run, work: Path, region: str, arms: Iterable[tuple[str, int]]) -> Iterator[AtBytes]:
    """Yield AP50 and megabytes of arms that train centrally on so many sweeps (name, sweeps)."""
    (task,) = run.recipe.tasks
    for arm, sweeps in arms:
        book = Ledger.load(work / run.steps.central(arm, region, task) / LEDGER)
        ap50 = run.test(arm=arm, stage=CENTRAL, region=region, task=task).estimate.mean
        yield AtBytes(plural(sweeps, "sweep"), book.used_mb("wireless"), ap50)


def list_uploads(recipe: RunRecipe) -> list[tuple[str, int]]:
    """Return the arms that train centrally on uploaded sweeps, and how many these are, fewest first."""
    found = [(name, arm.uploads) for name, arm in recipe.arms.items() if arm.uploads is not None]
    return sorted(found, key=lambda each: each[1])


def average_curves(curves: Sequence[Curves]) -> dict[str, tuple[MeanAtBytes, ...]]:
    """Return the mean over seeds of the points of each curve."""
    return {
        name: tuple(_average_points(points) for points in zip(*(curve[name] for curve in curves), strict=True))
        for name in curves[0]
    }


def _average_points(points: Sequence[AtBytes]) -> MeanAtBytes:
    boxes = [point.boxes for point in points if point.boxes is not None]
    return MeanAtBytes(
        points[0].label,
        sum(point.mb for point in points) / len(points),
        mean_over_seeds([point.ap50 for point in points], share=True),
        sum(boxes) / len(boxes) if boxes else None,
    )


def find_crossing(curve: Sequence[tuple[float, float]], level: float) -> float | None:
    """Return where a curve of points (x, y), linear between them, first reaches y = `level`; None: it does not."""
    before: tuple[float, float] | None = None
    for x, y in curve:
        if y >= level:
            return x if before is None else before[0] + (level - before[1]) / (y - before[1]) * (x - before[0])
        before = x, y
    return None
