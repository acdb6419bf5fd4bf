"""The steps that test networks, validate rounds, and compare detections in a sweep before and after training."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from flcav.arrays import Ints
from flcav.config import InputError
from flcav.geometry import Boxes
from flcav.perception.errors import THRESHOLD, RegistersErrors, is_among, load_errors
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
from flcav.runs.results.saved import ERRORS, OUTCOMES
from flcav.runs.results.tests import ErrorsAfter, SweepComparison, SweepDetections, SweepTotal, Tested
from flcav.runs.results.training import Pretrained, ScoredRound, StageResult, Watched
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


class RemainingSettings(StepSettings):
    """Settings of the comparison of a region's registered errors with those after a stage."""

    task: str
    region: str
    pretrained: str  # step whose threshold counts
    errors: str  # step that registered the errors of the pretrained network
    trained: str  # step that trained the later network
    registry: str  # recording of the frames that errors are registered in

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the steps whose results it takes."""
        return (self.pretrained, self.errors, self.trained, self.registry)


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


def detect_before_after(before: Path, after: Path, split: Frames) -> SweepComparison:
    """Return the detections of two networks in the test frame that `choose_sweep` takes, and the numbers in all frames.

    `before`, `after`: folders of the steps that trained the networks. Detections score `THRESHOLD` or more.
    """
    networks = [load_stage_network(OBJECTS, folder) for folder in (before, after)]
    looks = []
    for i in split.vehicles:
        frame = split.data.frame(i)
        truth = asked_of(frame, networks[0].config)
        seen = [_matched(detect_in(network, [frame], score_threshold=THRESHOLD)[0], truth) for network in networks]
        looks.append(SweepComparison(i, _rows(truth.targets), seen[0], seen[1]))
    counts = np.array([_count(look) for look in looks])
    targets, *numbers = counts.sum(axis=0).tolist()
    total = SweepTotal(len(looks), targets, (numbers[0], numbers[1]), (numbers[2], numbers[3]))
    return replace(looks[choose_sweep(counts)], total=total)


def choose_sweep(counts: Ints) -> int:
    """Return the row of the sweep that is most like all sweeps together.

    `counts` (N, 5) are targets, those found before and after, and false detections before and after. Sweeps count whose
    numbers of found and of false objects changed in the same direction as their sums, or if there are none, those of
    which one did, else all with targets. Of these it is the sweep with the least squared distance of its four shares of
    the targets from those of the sums; among ties the first.
    """
    targets = np.maximum(counts[:, :1], 1)
    alike = np.sign(np.diff(counts[:, 1:].reshape(-1, 2, 2), axis=2)[..., 0])  # (N, 2) of found and of false
    sums = counts.sum(axis=0)
    agreed = (alike == np.sign([sums[2] - sums[1], sums[4] - sums[3]])).sum(axis=1)
    agreed = np.where(counts[:, 0] > 0, agreed, -1)
    distance = ((counts[:, 1:] / targets - sums[1:] / max(sums[0], 1)) ** 2).sum(axis=1)
    return int(np.where(agreed == agreed.max(), distance, np.inf).argmin())


def _count(look: SweepComparison) -> tuple[int, ...]:
    """Return the numbers of targets, of those found before and after, and of false detections before and after."""
    seen = (look.before, look.after)
    false = (len(each.hit) - sum(each.hit) for each in seen)
    return (len(look.targets), *(sum(each.found) for each in seen), *false)


def remaining_step(work: Work, settings: RemainingSettings) -> None:
    """Register the errors of a later network in the frames of the registry, and compare them with the registered ones.

    They are compared as if there were no messages: nothing of this is sent.
    """
    task, drive = task_named(settings.task), Frames.open(work.inputs[settings.registry])
    assert isinstance(task, RegistersErrors)
    threshold = Pretrained.load(work.inputs[settings.pretrained]).threshold
    network = load_stage_network(task, work.inputs[settings.trained])
    lowest = THRESHOLD if threshold is None else threshold
    later = task.register_errors(network, drive.data, drive.vehicles, lowest, work.report)
    registered = load_errors(work.inputs[settings.errors] / ERRORS)
    new = [error for error in later if not is_among(error, registered, standing=later.standing)]
    ErrorsAfter(
        settings.region,
        settings.task,
        tuple(is_among(error, later, standing=later.standing) for error in registered),
        tuple((error.x, error.y, error.z) for error in new),
        tuple(error.kind for error in new),
    ).save(work.folder)


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
        yield from _list_remaining(outline, arm)
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
        names, region, stage = outline.names, main.regions[0], main.stages[0]
        before, after = (names.stage(MAIN, at, region, OBJECTS.name) for at in (PRETRAIN, stage))
        frames = names.recording(region, "test", OBJECTS.name)
        yield make_step(LOOK, look_step, LookSettings(before=before, after=after, frames=frames))


def _list_remaining(outline: Outline, main: Setting) -> Iterator[Step]:
    """Yield the comparisons of registered errors with those after edge FL, by region and task of the placement."""
    names = outline.names
    for region in main.regions if EDGE in main.stages else ():
        for task in main.placement.tasks:
            settings = RemainingSettings(
                task=task,
                region=region,
                pretrained=names.pretrain(MAIN, task),
                errors=names.errors(MAIN, region, task),
                trained=names.edge(MAIN, region, task),
                registry=names.recording(region, "registry", task),
            )
            yield make_step(names.remaining(region, task), remaining_step, settings)
