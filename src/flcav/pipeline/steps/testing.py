"""Steps that test networks, validate rounds and look at a sweep before and after."""

import numpy as np

from flcav.config import InputError
from flcav.perception.outcomes import as_measurable, compute_interval, compute_measure, score_network
from flcav.perception.tasks import task_named
from flcav.pipeline.engine import Work
from flcav.pipeline.federations.rounds import load_round_network
from flcav.pipeline.frames import Frames
from flcav.pipeline.learning import load_stage_network
from flcav.pipeline.recipe import PRETRAIN
from flcav.pipeline.results.saved import OUTCOMES
from flcav.pipeline.results.tests import Tested
from flcav.pipeline.results.training import Round, StageResult, Watched
from flcav.pipeline.steps.before_after import detect_before_after
from flcav.pipeline.steps.settings import StepSettings
from flcav.statistics.estimates import Estimate


class TestSettings(StepSettings):
    """Settings of the test of a network in a region."""

    task: str
    region: str
    trained: str  # step that trained the network
    frames: str  # recording of the test frames
    seed: int  # of the bootstrap over scenes
    model: str | None  # region whose own model is tested; None: the network of all

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        return (self.trained, self.frames)


class RoundsSettings(StepSettings):
    """Settings of the validation of a federation after each of its rounds, in a region."""

    task: str
    region: str
    stage: str
    start: str  # step that pretrained the network
    trained: str  # step of the federation, or of pretraining
    frames: str  # recording of the validation frames, used for nothing else
    averaged: int  # last rounds whose mean weights a result has
    share: float  # of the pretrained weights in it

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        return (self.start, self.trained, self.frames)


class LookSettings(StepSettings):
    """Settings of the look at one test sweep."""

    before: str  # step that trained the first network
    after: str  # and the second
    frames: str  # recording of the test frames

    @property
    def needs(self) -> tuple[str, ...]:
        """Return the names of the steps whose results it takes."""
        return (self.before, self.after, self.frames)


def test_step(work: Work, settings: TestSettings) -> None:
    """Test a network on a region's test frames.

    Raises `InputError` where the frames hold no target, so that the measure is undefined.
    """
    task, split = task_named(settings.task), Frames.open(work.inputs[settings.frames])
    network, how = load_stage_network(task, work.inputs[settings.trained], settings.model), as_measurable(task)
    outcomes = how.outcomes(network, split.data, split.vehicles, work.report)
    outcomes.save(work.folder / OUTCOMES)
    mean = compute_measure(task, outcomes)
    if np.isnan(mean):
        raise InputError(
            f"{settings.region}: its {len(split.vehicles)} test frames hold nothing to find; take more scenes"
        )
    scenes = len({split.data.keys[i].scene for i in split.vehicles})
    Tested(
        region=settings.region,
        task=settings.task,
        measure=how.measure_name,
        estimate=Estimate(mean, *compute_interval(task, outcomes, settings.seed)),
        numbers=how.numbers(outcomes),
        frames=len(split.vehicles),
        scenes=scenes,
    ).save(work.folder)


def rounds_step(work: Work, settings: RoundsSettings) -> None:
    """Validate the network that a federation would end with after each of its rounds; a pretrained one as round 0."""
    task, split = task_named(settings.task), Frames.open(work.inputs[settings.frames])
    start, folder = load_stage_network(task, work.inputs[settings.start]), work.inputs[settings.trained]
    networks = {0: start}
    if settings.stage != PRETRAIN:
        how = (settings.averaged, settings.share)
        numbers = range(1, StageResult.load(folder).rounds + 1)
        networks = {each: load_round_network(task, start, folder, each, *how) for each in numbers}
    rounds = []
    for number, network in networks.items():
        rounds.append(Round(number, score_network(task, network, split.data, split.vehicles)))
        work.report(number, len(networks), "")
    Watched(settings.stage, settings.task, settings.region, len(split.vehicles), tuple(rounds)).save(work.folder)


def look_step(work: Work, settings: LookSettings) -> None:
    """Detect objects in one test sweep with the networks of two steps."""
    before, after = work.inputs[settings.before], work.inputs[settings.after]
    detect_before_after(before, after, Frames.open(work.inputs[settings.frames])).save(work.folder)
