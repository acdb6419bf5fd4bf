"""Steps that test networks, validate rounds and look at a sweep before and after."""

import numpy as np

from flcav.config import InputError
from flcav.intervals import Estimate
from flcav.perception.outcomes import as_measurable, compute_interval, compute_measure, score_network
from flcav.perception.tasks import task_named
from flcav.pipeline.before_after import detect_before_after
from flcav.pipeline.federations.rounds import load_round_network
from flcav.pipeline.frames import Frames
from flcav.pipeline.recipe import PRETRAIN
from flcav.pipeline.results import OUTCOMES, Round, StageResult, Tested, Watched
from flcav.pipeline.stages import load_stage_network
from flcav.pipeline.steps import Work


def test_step(work: Work, task: str, region: str, trained: str, frames: str, seed: int, model: str | None) -> None:
    """Test the network of the step `trained`, or the own model of a region, `model`, on a region's test frames.

    Raises `InputError` where the frames hold no target, so that the measure is undefined.
    """
    learned, split = task_named(task), Frames.open(work.inputs[frames])
    network, how = load_stage_network(learned, work.inputs[trained], model), as_measurable(learned)
    outcomes = how.outcomes(network, split.data, split.vehicles, work.report)
    outcomes.save(work.folder / OUTCOMES)
    mean = compute_measure(learned, outcomes)
    if np.isnan(mean):
        raise InputError(f"{region}: its {len(split.vehicles)} test frames hold nothing to find; take more scenes")
    scenes = len({split.data.keys[i].scene for i in split.vehicles})
    Tested(
        region=region,
        task=task,
        measure=how.measure_name,
        estimate=Estimate(mean, *compute_interval(learned, outcomes, seed)),
        numbers=how.numbers(outcomes),
        frames=len(split.vehicles),
        scenes=scenes,
    ).save(work.folder)


def rounds_step(
    work: Work, task: str, region: str, stage: str, start: str, trained: str, frames: str, averaged: int, share: float
) -> None:
    """Validate a federation's network after each round on a region's validation frames, used for nothing else.

    The network is that of a federation which ends with this round: the mean of the last `averaged` rounds' weights,
    with `share` of those of the step `start`. A pretrained network is validated as round 0.
    """
    learned, split = task_named(task), Frames.open(work.inputs[frames])
    first = load_stage_network(learned, work.inputs[start])
    networks = {0: first}
    if stage != PRETRAIN:
        numbers = range(1, StageResult.load(work.inputs[trained]).rounds + 1)
        folder = work.inputs[trained]
        networks = {each: load_round_network(learned, first, folder, each, averaged, share) for each in numbers}
    rounds = []
    for number, network in networks.items():
        rounds.append(Round(number, score_network(learned, network, split.data, split.vehicles)))
        work.report(number, len(networks), "")
    Watched(stage, task, region, len(split.vehicles), tuple(rounds)).save(work.folder)


def look_step(work: Work, before: str, after: str, frames: str) -> None:
    """Detect objects in one test sweep with the networks of two steps."""
    detect_before_after(work.inputs[before], work.inputs[after], Frames.open(work.inputs[frames])).save(work.folder)
