"""The steps that test networks, validate rounds, and compare detections in a sweep before and after training."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from flcav.config import InputError
from flcav.geometry import Boxes
from flcav.perception.metrics.detection import assign_targets, on_neutral
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import FrameTruth, asked_of
from flcav.perception.outcomes import as_measurable, compute_interval, compute_measure, score_network
from flcav.perception.tasks import task_named
from flcav.runs.arms import Setting
from flcav.runs.engine import Step, Work
from flcav.runs.frames import Frames
from flcav.runs.recipe import CLOUD, EDGE, MAIN, PRETRAIN
from flcav.runs.results.saved import OUTCOMES
from flcav.runs.results.tests import SweepComparison, SweepDetections, Tested
from flcav.runs.results.training import ScoredRound, StageResult, Watched
from flcav.runs.stages.outline import Outline
from flcav.runs.stages.settings import StepSettings, make_step
from flcav.runs.training.checkpoints import load_round_network
from flcav.runs.training.learning import load_stage_network
from flcav.statistics.estimates import Estimate


class TestSettings(StepSettings):
    """Settings of the test of a network in a region."""

    task: str
    region: str
    trained: str  # step that trained the network
    frames: str  # recording of the test frames
    seed: int  # of the bootstrap over scenes
    model: str | None  # region whose personalised model is tested; None: the common network

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return (self.trained, self.frames)


class RoundsSettings(StepSettings):
    """Settings of the validation of a federation in a region after every round."""

    task: str
    region: str
    stage: str
    start: str  # step that pretrained the network
    trained: str  # step of the federation, or of pretraining
    frames: str  # recording of the validation frames, used for nothing else
    averaged: int  # number of last rounds over which the weights of the result are averaged
    share: float  # share of the pretrained weights in the result, in [0, 1]

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return (self.start, self.trained, self.frames)


class LookSettings(StepSettings):
    """Settings of the comparison of detections in one test sweep."""

    before: str  # step that trained the first network
    after: str  # step that trained the second network
    frames: str  # recording of the test frames

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
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
    """Validate the network that a federation would end with after every round; a pretrained one counts as round 0."""
    task = task_named(settings.task)
    split = Frames.open(work.inputs[settings.frames])
    start = load_stage_network(task, work.inputs[settings.start])
    folder = work.inputs[settings.trained]
    networks = {0: start}
    if settings.stage != PRETRAIN:
        how = (settings.averaged, settings.share)
        result = StageResult.load(folder)
        numbers = range(1, (result.rounds if result.kept is None else result.kept) + 1)
        networks = {round_: load_round_network(task, start, folder, round_, *how) for round_ in numbers}
    rounds = []
    for number, network in networks.items():
        rounds.append(ScoredRound(number, score_network(task, network, split.data, split.vehicles)))
        work.report(number, len(networks), "")
    Watched(settings.stage, settings.task, settings.region, len(split.vehicles), tuple(rounds)).save(work.folder)


def look_step(work: Work, settings: LookSettings) -> None:
    """Detect objects in one test sweep with the networks of two steps."""
    before, after = work.inputs[settings.before], work.inputs[settings.after]
    detect_before_after(before, after, Frames.open(work.inputs[settings.frames])).save(work.folder)


SHOWN_SCORE = 0.3  # lowest score of a detection that is shown


def detect_before_after(before: Path, after: Path, split: Frames) -> SweepComparison:
    """Return the detections of two networks in the test frame with the median gain; among ties, with most targets.

    The gain is the increase in found targets minus the increase in false boxes. `before`, `after`: folders of the steps
    that trained the networks. Detections score `SHOWN_SCORE` or more.
    """
    networks = [load_stage_network(OBJECTS, folder) for folder in (before, after)]
    looks = []
    for i in split.vehicles:
        frame = split.data.frame(i)
        truth = asked_of(frame, networks[0].config)
        seen = [_matched(detect_in(network, [frame], score_threshold=SHOWN_SCORE)[0], truth) for network in networks]
        looks.append(SweepComparison(i, _rows(truth.targets), *seen))
    gains = np.array([_right(look.after) - _right(look.before) for look in looks])
    held = np.array([len(look.targets) for look in looks])
    ranked = np.sort(gains[held >= min(1, held.max())])  # frames without targets show nothing, unless all have none
    median = ranked[len(ranked) // 2]
    return looks[int(np.where(gains == median, held, -1).argmax())]


def _right(seen: SweepDetections) -> int:
    """Return the number of found targets minus that of false boxes."""
    return sum(seen.found) - (len(seen.hit) - sum(seen.hit))


def _matched(found: Boxes, truth: FrameTruth) -> SweepDetections:
    """Match detections to targets at IoU 0.5; detections of neutral objects are left out."""
    target = assign_targets(found, truth.targets, 0.5)
    counts = (target >= 0) | ~on_neutral(found, truth.neutral)
    hits = target[counts]
    reached = np.isin(np.arange(len(truth.targets)), hits)
    return SweepDetections(_rows(found[counts]), tuple((hits >= 0).tolist()), tuple(reached.tolist()))


def _rows(boxes: Boxes) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, boxes.array().tolist()))


LOOK = "look"


def list_tests(outline: Outline, arm: Setting) -> Iterator[Step]:
    """Yield the tests of an arm; for the run itself also the comparison in a sweep, and all validations."""
    names = outline.names
    for stage, region, task in outline.tested(arm):
        trained, frames = names.stage(arm.name, stage, region, task), names.recording(region, "test", task)
        about = {"task": task, "region": region, "trained": trained, "frames": frames, "seed": outline.recipe.seed}
        for model in outline.models(arm, stage):
            yield make_step(names.test(trained, region, model), test_step, TestSettings(**about, model=model))
    if arm.name == MAIN:
        yield from _list_looks(outline, arm)
        for stage in (PRETRAIN, *arm.stages):
            for task in outline.recipe.tasks:
                yield from list_validations(outline, stage, task)


def list_validations(outline: Outline, stage: str, task: str) -> Iterator[Step]:
    """Yield the validations of a stage of the run itself, by federating region."""
    names, main = outline.names, outline.settings[MAIN]
    for region in main.regions:
        trained, training = names.stage(MAIN, stage, region, task), main.training[task]
        shares = {EDGE: training.start_share, CLOUD: main.federation.cloud_start_share}
        settings = RoundsSettings(
            task=task,
            region=region,
            stage=stage,
            start=names.pretrain(MAIN, task),
            trained=trained,
            frames=names.recording(region, "validation", task),
            averaged=training.average_rounds,
            share=shares.get(stage, 0.0),
        )
        yield make_step(names.rounds(trained, region), rounds_step, settings)


def _list_looks(outline: Outline, main: Setting) -> Iterator[Step]:
    """Yield the comparison in a sweep of the first region before and after the stages, if objects are learned."""
    if OBJECTS.name in outline.recipe.tasks:
        names, region, stage = outline.names, main.regions[0], main.stages[-1]
        before, after = (names.stage(MAIN, at, region, OBJECTS.name) for at in (PRETRAIN, stage))
        frames = names.recording(region, "test", OBJECTS.name)
        yield make_step(LOOK, look_step, LookSettings(before=before, after=after, frames=frames))
