"""Records of tests: of networks on test frames, of differences between them, and of findings from these."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from flcav.runs.recipe import CENTRAL, CLOUD, EDGE, MAIN, MORE_EDGE, PRETRAIN
from flcav.runs.results.saved import Saved
from flcav.statistics.estimates import Estimate, Spread
from flcav.statistics.seeds import MeanOverSeeds
from flcav.storage.records import LEFT_OUT, Record

WORDS = {  # names of stages in reports
    PRETRAIN: "pretrained",
    EDGE: "edge FL",
    MORE_EDGE: "further edge FL",
    CLOUD: "edge + cloud FL",
    CENTRAL: "central training",
}


def name_stage(arm: str, stage: str) -> str:
    """Return the name of an arm's stage in reports, such as "edge FL (densest)"."""
    return WORDS[stage] if arm == MAIN else f"{WORDS[stage]} ({arm})"


@dataclass(frozen=True)
class Tested(Saved):
    """Test of a network on a region's test frames; the outcomes by frame are in the same folder."""

    region: str
    task: str
    measure: str  # name of the measure, such as AP50
    estimate: Estimate  # in [0, 1] for AP and accuracy
    numbers: Mapping[str, float | None]  # other numbers of the task, by name
    frames: int
    scenes: int


@dataclass(frozen=True)
class Test:
    """Test of an arm's network after a stage, in a region, with its interval over scenes and trainings."""

    arm: str
    stage: str
    region: str
    task: str
    step: str  # whose folder holds the outcomes
    result: Tested  # of the first training; its interval is over scenes alone
    estimate: Estimate  # of `over_trainings`; else of one training, with the spread of retraining where it is known
    spread: Spread | None  # over the retrainings of this run, or from the recipe's table; None: not known
    retrained: tuple[float, ...] = ()  # the measure by retraining of the arm, on the same frames
    over_trainings: Annotated[MeanOverSeeds | None, LEFT_OUT] = None  # mean over this run's trainings, same scenes
    retrained_steps: Annotated[tuple[str, ...] | None, LEFT_OUT] = None  # their folders, in the order of `retrained`
    averaged: Annotated[Mapping[str, float | None] | None, LEFT_OUT] = (
        None  # `result.numbers`, as means over the same trainings as `estimate`
    )

    @property
    def key(self) -> tuple[str, str, str, str]:
        """Arm, stage, region and task."""
        return self.arm, self.stage, self.region, self.task

    @property
    def network(self) -> str:
        """The name of the network in reports, by its arm and stage."""
        return name_stage(self.arm, self.stage)

    @property
    def name(self) -> str:
        """The name of the test in reports."""
        return f"{self.region}, {self.task}: {self.network}"

    @property
    def measure(self) -> str:
        """The name of the measure, such as AP50."""
        return self.result.measure

    @property
    def numbers(self) -> Mapping[str, float | None]:
        """The task's other numbers: means over trainings, or in results of earlier versions of the first training."""
        return self.result.numbers if self.averaged is None else self.averaged

    @property
    def over_scenes(self) -> Estimate:
        """The estimate of the first training; its interval is over scenes alone."""
        return self.result.estimate

    @property
    def steps(self) -> tuple[str, ...]:
        """The folders of the tests of all trainings whose outcomes are known, the first training first."""
        return (self.step, *(self.retrained_steps or ()))

    @property
    def trainings(self) -> tuple[float, ...]:
        """The measure by training, the first training first."""
        return (self.over_scenes.mean, *self.retrained)


@dataclass(frozen=True)
class RegionalTest:
    """A test of the personalised model of a region, by `federation.personal`."""

    model: str  # region whose model it is
    region: str  # whose test frames
    task: str
    measure: str
    estimate: Estimate  # the interval is over scenes


@dataclass(frozen=True)
class Difference:
    """Paired difference of a measure on the same test frames: `arm` at `stage` minus `before_arm` at `before_stage`."""

    name: str
    arm: str
    stage: str
    before_arm: str
    before_stage: str
    region: str
    task: str
    estimate: Estimate  # as in `Test`
    over_scenes: Estimate  # of the first training; the interval is over scenes alone
    spread: Spread | None  # as in `Test`
    retrained: tuple[float, ...] = ()  # the difference by retraining
    over_trainings: Annotated[MeanOverSeeds | None, LEFT_OUT] = None  # as in `Test`
    regions: Annotated[tuple[str, ...] | None, LEFT_OUT] = None  # over which it is a mean; None: `region` alone

    @property
    def minus(self) -> str:
        """The subtrahend as arm/stage."""
        return f"{self.before_arm}/{self.before_stage}"

    @property
    def places(self) -> tuple[str, ...]:
        """The regions of the difference: several for a mean over regions."""
        return self.regions or (self.region,)

    @property
    def trainings(self) -> tuple[float, ...]:
        """The difference by training, the first training first."""
        return (self.over_scenes.mean, *self.retrained)


@dataclass(frozen=True)
class HomeCost:
    """Change of a measure in a town of pretraining by federated learning, on the same frames before and after."""

    region: str
    task: str
    measure: str
    before: float  # mean over the run's trainings, before federated learning
    after: float  # mean over the run's trainings, after it
    difference: Estimate  # after - before, paired over scenes; over trainings too, where there are several
    trainings: int  # of the run itself


@dataclass(frozen=True)
class FoundCount(Record):
    """Numbers of targets, found ones and false detections of an arm in a region after a stage, means over trainings."""

    arm: str
    stage: str
    region: str
    task: str
    noun: str  # of several targets, such as "cars"
    targets: int
    found: float
    false: float | None  # detections of nothing; None for a task without them
    trainings: int  # of which this is the mean


@dataclass(frozen=True)
class RunFinding:
    """The verdict of a run on one claim, or its estimate of a loss."""

    place: str  # region and task
    question: str
    verdict: str  # held | did not hold | undecided | estimate
    sentence: str  # with the numbers behind it
    kind: Annotated[str | None, LEFT_OUT] = None  # primary | secondary; None: the recipe names no primary claims

    @property
    def decision(self) -> str:
        """The verdict, with the kind of the claim where it is known."""
        return self.verdict if self.kind is None else f"{self.verdict}, {self.kind} claim"


@dataclass(frozen=True)
class SweepDetections:
    """Detections of one network in a sweep, matched to the targets; boxes are in the LiDAR frame."""

    boxes: tuple[tuple[float, ...], ...]  # x y z length width height yaw [m, rad]; without those of neutral objects
    hit: tuple[bool, ...]  # whether a box matches a target, by box
    found: tuple[bool, ...]  # whether a target is matched, by target


@dataclass(frozen=True)
class SweepComparison(Saved):
    """Detections of two networks in the same test sweep."""

    frame: int  # number in its dataset
    targets: tuple[tuple[float, ...], ...]  # boxes as in `SweepDetections`
    before: SweepDetections
    after: SweepDetections
    total: Annotated["SweepTotal | None", LEFT_OUT] = None  # of all sweeps it was chosen from


@dataclass(frozen=True)
class SweepTotal:
    """Numbers of detections of two networks in all test sweeps of a region, at the score of the shown ones."""

    sweeps: int
    targets: int
    found: tuple[int, int]  # before, after
    false: tuple[int, int]  # before, after


@dataclass(frozen=True)
class ErrorsAfter(Saved):
    """Errors of a pretrained network in the frames that they were registered in, and those of the network after it.

    An error remains if the later network misses the same object of the scene, or has a false positive within
    `SAME_PLACE_M` of it.
    """

    region: str
    task: str
    remains: tuple[bool, ...]  # by registered error
    new: tuple[tuple[float, float, float], ...]  # positions of errors that were not registered [m, world frame]
    new_kinds: tuple[str, ...]
