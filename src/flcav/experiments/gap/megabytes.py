"""Accuracy against uplink megabytes: federated rounds, and centralised training on uploaded, annotated sweeps.

It is the first question about federated learning: why not send the data? A sweep goes up with its annotation, which is
ground truth here and free, as it is nowhere else; in exchange vehicles label by themselves and send weights. Both take
as many optimiser steps; of updates in 8 bits there are as many more rounds, and steps, as the bytes last for. Bytes are
those of the wireless uplink; uploaded sweeps take the wireline one as well.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flcav.interface.wording import plural
from flcav.network.ledger import BYTES_PER_MB, Ledger
from flcav.perception.objects.task import OBJECTS
from flcav.perception.outcomes import score_network
from flcav.perception.weights import load_network
from flcav.runs.frames import Frames
from flcav.runs.recipe import CENTRAL, EDGE, MAIN, MORE_EDGE, RunRecipe
from flcav.runs.results.run import Run
from flcav.runs.results.saved import LEDGER, WEIGHTS
from flcav.runs.training.checkpoints import load_round_network
from flcav.statistics.seeds import MeanOverSeeds, mean_over_seeds

FEDERATED: Mapping[str, str] = {"edge FL on tracks": MAIN, "edge FL on ground truth": "truth"}  # by name: arm
IN_BYTES = "edge FL on ground truth, int8"
LONGER = (("longer", EDGE), ("longer", MORE_EDGE), ("longest", MORE_EDGE))  # arms and stages of that curve
UPLOADED = "centralised on uploaded sweeps"
ROUNDS = (1, 2, 3, 5, 10)  # after which a federation is tested; those that it has


@dataclass(frozen=True)
class AtBytes:
    """AP50 on test frames after so many megabytes [MB, wireless uplink of a region's stage II]."""

    label: str  # rounds or sweeps
    mb: float
    ap50: float


@dataclass(frozen=True)
class MeanAtBytes:
    """The mean over seeds of `AtBytes`."""

    label: str
    mb: float
    ap50: MeanOverSeeds


Curves = Mapping[str, tuple[AtBytes, ...]]  # by name


def trace_bytes(run: Run, work: Path, region: str) -> Curves:
    """Return the curves of a run whose steps lie in `work`, in one region: they begin with the pretrained network."""
    (task,) = run.recipe.tasks
    test = Frames.open(work / run.steps.recording(region, "test", task))
    start = load_network(OBJECTS, work / run.steps.pretrain(MAIN, task) / WEIGHTS)
    begun = AtBytes("pretraining", 0.0, score_network(OBJECTS, start, test.data, test.vehicles))

    def federated(arm: str) -> Iterator[AtBytes]:
        how, folder = run.recipe.training_of(task), work / run.steps.edge(arm, region, task)
        sent = Ledger.load(folder / LEDGER).entries
        for number in (each for each in ROUNDS if each <= max(entry.round for entry in sent)):
            ended = load_round_network(OBJECTS, start, folder, number, how.average_rounds, how.start_share)
            up = (
                entry.bytes
                for entry in sent
                if (entry.link, entry.direction) == ("wireless", "up") and entry.round <= number
            )
            ap50 = score_network(OBJECTS, ended, test.data, test.vehicles)
            yield AtBytes(plural(number, "round"), sum(up) / BYTES_PER_MB, ap50)

    def in_bytes() -> Iterator[AtBytes]:
        for arm, stage in LONGER:
            folder = work / run.steps.stage(arm, stage, region, task)
            number = sum(each.rounds for each in run.arms[arm].stages if each.stage in (EDGE, stage))
            ap50 = run.test(arm=arm, stage=stage, region=region, task=task).estimate.mean
            yield AtBytes(plural(number, "round"), Ledger.load(folder / LEDGER).used_mb("wireless"), ap50)

    def uploaded() -> Iterator[AtBytes]:
        for arm, own in list_uploads(run.recipe):
            book = Ledger.load(work / run.steps.central(arm, region, task) / LEDGER)
            ap50 = run.test(arm=arm, stage=CENTRAL, region=region, task=task).estimate.mean
            yield AtBytes(plural(own, "sweep"), book.used_mb("wireless"), ap50)

    curves = {name: (begun, *federated(arm)) for name, arm in FEDERATED.items()}
    return {**curves, IN_BYTES: (begun, *in_bytes()), UPLOADED: (begun, *uploaded())}


def list_uploads(recipe: RunRecipe) -> list[tuple[str, int]]:
    """Return the arms that train centrally on uploaded sweeps, and how many these are, fewest first."""
    found = [(name, arm.uploads) for name, arm in recipe.arms.items() if arm.uploads is not None]
    return sorted(found, key=lambda each: each[1])


def average_curves(curves: Sequence[Curves]) -> dict[str, tuple[MeanAtBytes, ...]]:
    """Return the mean over seeds of the points of each curve."""
    means = {}
    for name in curves[0]:
        rows = zip(*(own[name] for own in curves), strict=True)
        means[name] = tuple(
            MeanAtBytes(
                points[0].label,
                sum(point.mb for point in points) / len(points),
                mean_over_seeds([point.ap50 for point in points], share=True),
            )
            for points in rows
        )
    return means
