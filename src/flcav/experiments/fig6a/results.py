"""Records of the comparison of two plans: predictions of the learning curve, and scores after training."""

from collections.abc import Mapping
from dataclasses import dataclass

from flcav.config import Json
from flcav.runs.provenance import Provenance
from flcav.runs.results.run import LinkUse
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import MeanOverSeeds
from flcav.storage.records import Record

EQUAL, JOINT = "equal-stages", "joint"  # the plans
MEAN = "mean of towns"  # place of what the planner's history measures: the mean of the federating towns
COUNTS = ("samples", "edge_rounds", "cloud_rounds")


@dataclass(frozen=True)
class Planned:
    """A plan, and the error that its curve predicts after the last stage."""

    samples: int
    edge_rounds: int
    cloud_rounds: int
    wireless_mb: float
    wireline_mb: float
    predicted_error: float

    @property
    def counts(self) -> dict[str, int]:
        """Return samples, edge rounds and cloud rounds by name."""
        return dict(zip(COUNTS, (self.samples, self.edge_rounds, self.cloud_rounds), strict=True))


@dataclass(frozen=True)
class StageAP:
    """AP50 after a stage."""

    ap50: float


@dataclass(frozen=True)
class AllocationSeed:
    """Results of one seed. Plans are `EQUAL` and `JOINT`; stages are pretrain, edge and cloud."""

    seed: int
    plans: Mapping[str, Planned]
    predicted: Mapping[str, Mapping[str, float]]  # AP50 by plan and stage
    realised: Mapping[str, Mapping[str, Mapping[str, StageAP]]]  # by `MEAN` or town, plan and stage
    differences: Mapping[str, Mapping[str, Estimate]]  # joint - equal by `MEAN` or town, and stage, over test scenes
    poles: Mapping[str, Mapping[str, int]]  # by plan and town
    ledger: Mapping[str, Mapping[str, LinkUse]]  # by plan and link

    @property
    def coincide(self) -> bool:
        """Return whether both plans are the same: as many samples and rounds."""
        return self.plans[EQUAL].counts == self.plans[JOINT].counts


@dataclass(frozen=True)
class AllocationSummary:
    """Means over seeds; differences are joint minus equal stages, paired by seed."""

    predicted: Mapping[str, Mapping[str, float]]  # AP50 by plan and stage
    realised: Mapping[str, Mapping[str, Mapping[str, MeanOverSeeds]]]  # by `MEAN` or town, plan and stage
    predicted_difference: Mapping[str, float]  # by stage
    realised_difference: Mapping[str, Mapping[str, MeanOverSeeds]]  # by `MEAN` or town, and stage


@dataclass(frozen=True)
class PlanFinding:
    """The verdict on one claim."""

    question: str
    verdict: str
    sentence: str  # with the numbers behind it


@dataclass(frozen=True)
class AtBudgets:
    """Both plans under one pair of budgets: numbers by seed, means over seeds, and findings."""

    factor: float  # of the recipe's budgets
    seeds: tuple[AllocationSeed, ...]
    summary: AllocationSummary
    findings: tuple[PlanFinding, ...] = ()

    @property
    def name(self) -> str:
        """Return the budgets in words: x 0.25, x 1."""
        return f"x {self.factor:g}"

    @property
    def coincide(self) -> bool:
        """Return whether both plans are the same in every seed."""
        return all(seed.coincide for seed in self.seeds)


@dataclass(frozen=True)
class AllocationResult(Record):
    """Results of the comparison, under several multiples of the recipe's budgets."""

    history: Mapping[str, tuple[float, float]]  # least and most of each count in the planner's history
    budgets: tuple[AtBudgets, ...]
    recipe: Mapping[str, Json]
    provenance: Provenance
