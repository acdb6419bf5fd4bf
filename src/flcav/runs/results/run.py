"""Records of a finished run, of its arms, and of the means over several seeds."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, ClassVar

from flcav.interface.notebook import Displayed
from flcav.runs.arms import Names, name_steps
from flcav.runs.provenance import Provenance
from flcav.runs.recipe import RunRecipe
from flcav.runs.registry import SECTIONS, PageSection, RunRows, load_all
from flcav.runs.results.plans import Placed, Plan
from flcav.runs.results.saved import Saved
from flcav.runs.results.tests import Difference, HomeCost, RegionalTest, RunFinding, Test, Tested
from flcav.runs.results.training import Pretrained, PrivacySpent, StageResult, Watched
from flcav.statistics.estimates import Estimate
from flcav.statistics.seeds import MeanOverSeeds
from flcav.statistics.verdicts import Judged
from flcav.storage.records import LEFT_OUT, Record, select


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
    retrained: Annotated[tuple[StageResult, ...] | None, LEFT_OUT] = (
        None  # stage III of each retraining, in their order
    )
    privacy: Annotated[PrivacySpent | None, LEFT_OUT] = None  # all tasks and retrainings together; None: no noise

    @property
    def plans(self) -> tuple[Plan, ...]:
        """Return all plans in the order in which they were made."""
        return (*(self.earlier or ()), self.plan)

    def sent_mb(self, task: str, link: str) -> float:
        """Return the uplink traffic of a task on a link, over all stages [MB]."""
        return sum(row.mb for row in select(self.spent, task=task, link=link))


@dataclass(frozen=True)
class ArmCost(Record):
    """Costs and gain of a task in an arm, in the mean over the regions that federate in it."""

    arm: str
    task: str
    regions: tuple[str, ...]
    measure: str
    stage: str  # the last one that was tested
    wireless_mb: float  # uplink of stages II and III
    wireline_mb: float
    edge_rounds: int  # of a region, the most
    cloud_rounds: int
    epsilon: float | None  # of a vehicle, all tasks and trainings together; None: no noise
    before: float  # the measure after pretraining
    after: Estimate  # and after the last stage, with its interval
    gain: float  # how much it rose
    gain_per_mb: float | None  # for a megabyte of uplink on both links; None: nothing was sent

    @property
    def uplink_mb(self) -> float:
        """Uplink of stages II and III on both links [MB]."""
        return self.wireless_mb + self.wireline_mb


@dataclass(frozen=True)
class _RunFigures(Saved):
    """Fields of a run's results, without those of extras."""

    recipe: RunRecipe
    arms: Mapping[str, ArmResult]
    pretrained: tuple[Pretrained, ...]  # of the run itself
    watched: tuple[Watched, ...]  # of the run itself
    tested: tuple[Test, ...]
    differences: tuple[Difference, ...]
    findings: tuple[RunFinding, ...]
    gap_closed: Mapping[str, float]  # fraction closed of the gap to centralised training
    caveats: tuple[str, ...]  # of the kinds of labels, and of rigs unlike those of the training
    provenance: Provenance
    elapsed_s: float = 0.0  # wall time of all starts together
    costs: Annotated[tuple[ArmCost, ...] | None, LEFT_OUT] = None  # of each arm and task
    home: Annotated[tuple[HomeCost, ...] | None, LEFT_OUT] = None  # of further measures than the tasks' own


@dataclass(frozen=True)
class Run(Displayed, RunRows, _RunFigures):
    """Results of a finished run; `Run.load(folder)` reads them back."""

    file: ClassVar[str] = "results.json"

    @property
    def steps(self) -> Names:
        """Return the names of the run's steps, whose folders, in its folder `work`, hold all artefacts."""
        return name_steps(self.recipe)

    def list_sections(self) -> list[PageSection]:
        """Return the sections of extras on the run's page."""
        found = [describe(self) for describe in load_all(SECTIONS)]
        return [section for section in found if section is not None]

    def describe_rows(self) -> list[str]:
        """Return the rows of extras in words, each with its name and task."""
        rows = [(each.name, row) for each in fields(RunRows) for row in getattr(self, each.name) or ()]
        return [f"{name}, {row.task}, {row.describe()}" for name, row in rows]

    def test(self, *, stage: str, region: str, task: str, arm: str = "main") -> Tested:
        """Return the result of a test; raises `KeyError` for one that was not made."""
        return {each.key: each.result for each in self.tested}[arm, stage, region, task]


@dataclass(frozen=True)
class Mean:
    """The mean of a number over seeds, with its 95 % interval."""

    name: str
    estimate: MeanOverSeeds
    judged: Annotated[Judged | None, LEFT_OUT] = None  # of the run's own differences: the claim that they are positive
    kind: Annotated[str | None, LEFT_OUT] = None  # of this claim: primary or secondary, where the recipe names some


@dataclass(frozen=True)
class ClaimCount:
    """Verdicts on one claim over the runs of several seeds: how many runs come to each."""

    question: str
    place: str  # region, or regions, and task
    kind: Annotated[str | None, LEFT_OUT]  # primary | secondary, where the recipe names primary claims
    held: int
    did_not_hold: int
    undecided: int

    def describe(self) -> str:
        """Return the counts in words."""
        named = f" ({self.kind} claim)" if self.kind else ""
        seeds = self.held + self.did_not_hold + self.undecided
        rest = f"did not hold in {self.did_not_hold}, undecided in {self.undecided}"
        return f"{self.place}: {self.question}{named}: held in {self.held} of {seeds} seeds, {rest}"


@dataclass(frozen=True)
class Summary(Saved):
    """Means over several seeds of a recipe; verdicts are corrected together, on primary claims apart from others."""

    file: ClassVar[str] = "summary.json"
    seeds: tuple[int, ...]
    measures: tuple[Mean, ...]
    differences: tuple[Mean, ...]
    gap_closed: tuple[Mean, ...]
    claims: tuple[ClaimCount, ...] = ()
