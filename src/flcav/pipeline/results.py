"""Records of the results of a run and of its steps, saved to and loaded from JSON in their folders."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self

import numpy as np

from flcav.config import InputError, read_json
from flcav.files import write_json
from flcav.intervals import Estimate, MeanOverSeeds, Spread
from flcav.network.plan import Price
from flcav.pipeline.provenance import Provenance
from flcav.pipeline.recipe import RunRecipe
from flcav.records import LEFT_OUT, Record
from flcav.verdicts import Judged

RESULT, PROBLEM = "result.json", "problem.json"  # the latter: the allocation problem of a plan
WEIGHTS, LEDGER, ERRORS, OUTCOMES = "weights.safetensors", "ledger.parquet", "errors.parquet", "outcomes.npz"


class Saved(Record):
    """A record that is saved as JSON in a folder."""

    def save(self, folder: Path, name: str = RESULT) -> None:
        """Write the record to `folder`, atomically; tasks and regions stay in their order."""
        write_json(folder / name, self.as_json(), sort=False)

    @classmethod
    def load(cls, folder: Path, name: str = RESULT) -> Self:
        """Return what `save` wrote; raises `InputError` where it is not there, or of another version."""
        return cls.from_json(read_json(folder / name), str(folder / name))


@dataclass(frozen=True)
class Recorded(Saved):
    """A data split: the folder of its dataset, and its frames by who recorded them."""

    folder: str  # relative to the step's own, or absolute
    vehicles: tuple[int, ...]  # numbers of the vehicles' frames
    poles: Mapping[int, tuple[int, ...]]  # numbers of each roadside sensor's frames, by pole
    scenes: int


@dataclass(frozen=True)
class TaskPlan:
    """The plan of one task: its samples and rounds, and their price on both uplinks."""

    samples: int
    edge_rounds: int
    cloud_rounds: int
    wireless_mb: float  # uplink, all stages
    wireline_mb: float
    sample_mb: float  # of one sample
    model_mb: float  # of one model update
    predicted: Mapping[str, float] | None  # score after each stage, by the learning curve; None: a fixed plan
    joins: Annotated[Mapping[str, tuple[int, ...]] | None, LEFT_OUT] = (
        None  # by vehicle the rounds it joins, of 1 … edge rounds + k · cloud rounds; None: every vehicle joins all
    )

    uploads: Annotated[Mapping[str, int] | None, LEFT_OUT] = (
        None  # samples that each vehicle of the pretraining regions uploads; None: drawn from the frames of all
    )

    def joins_after(self, rounds: int) -> Mapping[str, tuple[int, ...]]:
        """Return the rounds that each vehicle joins, numbered from 1 after the first `rounds`; empty: all join all."""
        own = self.joins or {}
        return {name: tuple(each - rounds for each in joined if each > rounds) for name, joined in own.items()}


@dataclass(frozen=True)
class Plan(Saved):
    """The allocation of both budgets to tasks and stages."""

    rule: str
    tasks: Mapping[str, TaskPlan]
    after: Annotated[str | None, LEFT_OUT] = None  # stage after which it was made anew; None: before the run
    reached: Annotated[Mapping[str, float] | None, LEFT_OUT] = None  # score then, by task, which it rests on


@dataclass(frozen=True)
class RoundPlan(Record):
    """The plan of the rest of a stage of a task, made anew after one of the stage's rounds."""

    round: int  # of the stage
    reached: float | None  # score on validation frames then; None: another federation's plan is followed
    planned_mb: (
        Price  # list price of what was done until then: of stage II of the region's rounds, of III of all stages
    )
    sent_mb: Price  # what was sent upwards for it
    plan: TaskPlan  # counts in total; of stage II what the region itself sends, and its vehicles alone


@dataclass(frozen=True)
class Validated:
    """A validation during pretraining."""

    step: int  # optimiser steps taken
    loss: float  # mean since the validation before
    score: float  # on validation frames


@dataclass(frozen=True)
class Pretrained(Saved):
    """Result of stage I of a task; weights and ledger are in the same folder."""

    task: str
    network: str  # name of the configuration
    uploaded: Mapping[str, tuple[int, ...]]  # frames by region
    validated: tuple[Validated, ...]
    steps: int  # of the optimiser
    threshold: float | None  # lowest score of detections that serve as labels; None where none do


@dataclass(frozen=True)
class ErrorRegistry(Saved):
    """Number of registered errors of a pretrained network in a region; their table is in the same folder."""

    region: str
    task: str
    counts: Mapping[str, int]  # by kind
    dropped: int  # false positives without a place in the town


@dataclass(frozen=True)
class Pole:
    """A candidate site of a roadside sensor."""

    pole: int
    covered: int  # errors within range
    actors: float  # road users within range on average


@dataclass(frozen=True)
class Placed(Saved):
    """Placement of a region's roadside sensors."""

    region: str
    rule: str
    chosen: tuple[int, ...]  # poles
    errors: int  # registered
    covered: int  # errors within range of a chosen pole
    range_m: float
    poles: tuple[Pole, ...]  # all candidates

    @property
    def first(self) -> int:
        """Return the pole that was chosen first; raises `InputError` where no sensor was placed."""
        if not self.chosen:
            found = f"candidate poles: {len(self.poles)}, errors to cover: {self.errors}"
            raise InputError(f"region {self.region!r}: no sensor was placed ({found})")
        return self.chosen[0]

    @property
    def densest(self) -> int:
        """Return the pole with the most road users within range on average."""
        return max(self.poles, key=lambda site: site.actors).pole


@dataclass(frozen=True)
class Round:
    """A round of a federation and the validation score after it."""

    round: int
    score: float


@dataclass(frozen=True)
class FederatedRound(Record):
    """One round of a federation: whose updates were combined, who failed and why, what was sent, loss and epsilon."""

    server: str  # region of the edge server, or "cloud"
    round: int  # from 1 in its stage
    clients: tuple[str, ...]  # whose updates were combined
    failed: Mapping[str, str]  # by client what was wrong
    samples: int  # of the clients together
    loss: float  # mean training loss, weighted by samples
    up_bytes: int  # of all clients' messages, on their link
    down_bytes: int
    epsilon: float | None  # of differential privacy, of all rounds so far; None: without noise
    seconds: float | None = None  # of the simulated network; None: without one


@dataclass(frozen=True)
class LabelQuality(Record):
    """Precision and recall of the labels that vehicles train on, against ground truth that they do not know.

    A label is right that matches a target at IoU 0.5 in 3D; labels on neutral objects do not count.
    """

    round: int  # of stage II that they are made before, from 1
    labels: int
    targets: int
    precision: float | None  # None: no labels
    recall: float | None  # None: no targets


@dataclass(frozen=True)
class LabelHistory(Saved):
    """Quality of the labels before each round of a stage."""

    rounds: tuple[LabelQuality, ...] = ()


@dataclass(frozen=True)
class StageResult(Saved):
    """Result of a federated stage of a task, or of centralised training; the weights are in the same folder."""

    stage: str
    task: str
    region: str | None  # None: all federating regions together
    rounds: int
    samples: int  # of all clients together
    clients: int
    poles: tuple[int, ...]  # whose sensors contributed labels
    losses: tuple[float, ...] = ()  # mean training loss of each round
    records: Annotated[tuple[FederatedRound, ...] | None, LEFT_OUT] = None  # of all servers; None: no federation
    plans: Annotated[tuple[RoundPlan, ...] | None, LEFT_OUT] = None  # after each round; None: not made anew by rounds
    labels: Annotated[tuple[LabelQuality, ...] | None, LEFT_OUT] = None  # before each round; None: not measured


@dataclass(frozen=True)
class Watched(Saved):
    """Validation scores of a federation in a region after each round; of a pretrained network, as round 0."""

    stage: str
    task: str
    region: str
    frames: int
    rounds: tuple[Round, ...]


def average_regions(watched: Sequence[Watched]) -> tuple[Round, ...]:
    """Return the mean score over regions of each round that all of `watched` have, weighted by frames."""
    frames = [each.frames for each in watched]
    return tuple(
        Round(at[0].round, float(np.average([each.score for each in at], weights=frames)))
        for at in zip(*(each.rounds for each in watched), strict=False)
    )


def average_last(watched: Sequence[Watched]) -> float:
    """Return the mean over regions of the score after each one's last round, weighted by frames."""
    return float(np.average([each.rounds[-1].score for each in watched], weights=[each.frames for each in watched]))


@dataclass(frozen=True)
class Tested(Saved):
    """Test of a network on a region's test frames; the outcome of each frame is in the same folder."""

    region: str
    task: str
    measure: str  # name of what is estimated
    estimate: Estimate
    numbers: Mapping[str, float | None]  # other numbers of the task, by name
    frames: int
    scenes: int


@dataclass(frozen=True)
class Test:
    """A test with the arm, stage, region and task that it is of."""

    arm: str
    stage: str
    region: str
    task: str
    step: str  # its folder holds the outcomes
    result: Tested  # its interval is over scenes alone
    estimate: Estimate  # the interval is over scenes and, where the spread is known, over retrainings
    spread: Spread | None  # over retrainings: of this run's own, or of the recipe's table; None: not known
    retrained: tuple[float, ...] = ()  # the measure of each retraining of the arm, on the same frames


@dataclass(frozen=True)
class RegionalTest:
    """A test of the model that a region keeps for itself, by `federation.personal`."""

    model: str  # region whose model it is
    region: str  # whose test frames
    task: str
    measure: str
    estimate: Estimate  # the interval is over scenes


@dataclass(frozen=True)
class Difference:
    """Paired difference of a measure on the same test frames: `arm` at `stage` minus `before_arm` at its stage."""

    name: str
    arm: str
    stage: str
    before_arm: str
    before_stage: str
    region: str
    task: str
    estimate: Estimate  # the interval is over scenes and, where the spread is known, over retrainings
    over_scenes: Estimate  # the interval is over scenes alone
    spread: Spread | None  # as in `Test`
    retrained: tuple[float, ...] = ()  # the difference in each retraining


@dataclass(frozen=True)
class Finding:
    """The verdict of a run on one claim."""

    place: str  # region and task
    question: str
    verdict: str  # held | did not hold | undecided
    sentence: str  # with the numbers behind it


@dataclass(frozen=True)
class SweepDetections:
    """Detections of one network in a sweep, matched to the targets; boxes are in the LiDAR frame."""

    boxes: tuple[tuple[float, ...], ...]  # x y z length width height yaw [m, rad]; without those of neutral objects
    hit: tuple[bool, ...]  # whether each box matches a target
    found: tuple[bool, ...]  # whether each target is matched


@dataclass(frozen=True)
class SweepComparison(Saved):
    """Detections of two networks in the same test sweep."""

    frame: int  # number in its dataset
    targets: tuple[tuple[float, ...], ...]  # boxes as in `SweepDetections`
    before: SweepDetections
    after: SweepDetections


@dataclass(frozen=True)
class Spent:
    """Uplink traffic of one stage of a task on one link."""

    stage: str
    task: str
    link: str
    mb: float


@dataclass(frozen=True)
class LinkUse:
    """Budget, planned traffic and actual traffic of one uplink [MB]."""

    budget_mb: float
    planned_mb: float
    used_mb: float


@dataclass(frozen=True)
class ArmResult:
    """Results of one arm: its plans, placements, stages, and uplink traffic."""

    plan: Plan  # carried out: the last one
    placed: tuple[Placed, ...]
    stages: tuple[StageResult, ...]
    links: Mapping[str, LinkUse]
    spent: tuple[Spent, ...]
    regional: Annotated[tuple[RegionalTest, ...] | None, LEFT_OUT] = None  # of stage III, where regions keep arrays
    earlier: Annotated[tuple[Plan, ...] | None, LEFT_OUT] = None  # plans that others took the place of, oldest first

    @property
    def plans(self) -> tuple[Plan, ...]:
        """Return all plans in the order in which they were made."""
        return (*(self.earlier or ()), self.plan)

    @property
    def round_plans(self) -> list[tuple[StageResult, RoundPlan]]:
        """Return the plans that were made after rounds, with the stage of each."""
        return [(stage, made) for stage in self.stages for made in stage.plans or ()]

    def sent_mb(self, task: str, link: str) -> float:
        """Return the uplink traffic of a task on a link, over all stages [MB]."""
        return sum(row.mb for row in self.spent if (row.task, row.link) == (task, link))


@dataclass(frozen=True)
class Run(Saved):
    """Results of a finished run."""

    recipe: RunRecipe
    arms: Mapping[str, ArmResult]
    pretrained: tuple[Pretrained, ...]  # of the run itself
    watched: tuple[Watched, ...]  # of the run itself
    tested: tuple[Test, ...]
    differences: tuple[Difference, ...]
    findings: tuple[Finding, ...]
    gap_closed: Mapping[str, float]  # fraction closed of the gap to centralised training
    caveats: tuple[str, ...]  # of the kinds of labels
    provenance: Provenance
    elapsed_s: float = 0.0  # wall time of all starts together

    def test(self, *, stage: str, region: str, task: str, arm: str = "main") -> Tested:
        """Return the result of a test; raises `KeyError` for one that was not made."""
        for each in self.tested:
            if (each.arm, each.stage, each.region, each.task) == (arm, stage, region, task):
                return each.result
        raise KeyError((arm, stage, region, task))


@dataclass(frozen=True)
class Mean:
    """The mean of a number over seeds, with its 95 % interval."""

    name: str
    estimate: MeanOverSeeds
    judged: Annotated[Judged | None, LEFT_OUT] = None  # of the run's own differences: the claim that they are positive


@dataclass(frozen=True)
class Summary(Saved):
    """Means over several seeds of a recipe; verdicts on differences are corrected together."""

    seeds: tuple[int, ...]
    measures: tuple[Mean, ...]
    differences: tuple[Mean, ...]
    gap_closed: tuple[Mean, ...]
