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
from flcav.runs.results.tests import Difference, FoundCount, HomeCost, RegionalTest, RunFinding, Test, Tested
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
    mb: float  # [MB]


@dataclass(frozen=True)
class LinkUse:
    """Budget, planned traffic and actual traffic of one uplink [MB]."""

    budget_mb: float  # of the recipe
    planned_mb: float  # of the last plan, all tasks
    used_mb: float  # in the ledger


@dataclass(frozen=True)
class ArmResult:
    """Results of one arm: its plans, placements, stages, and uplink traffic."""

    plan: Plan  # the last plan, which was carried out
    placed: tuple[Placed, ...]
    stages: tuple[StageResult, ...]
    links: Mapping[str, LinkUse]
    spent: tuple[Spent, ...]
    regional: Annotated[tuple[RegionalTest, ...] | None, LEFT_OUT] = None  # of stage III, where regions keep arrays
    earlier: Annotated[tuple[Plan, ...] | None, LEFT_OUT] = None  # plans that were replaced, oldest first
    retrained: Annotated[tuple[StageResult, ...] | None, LEFT_OUT] = (
        None  # stage III of all retrainings, in their order
    )
    privacy: Annotated[PrivacySpent | None, LEFT_OUT] = None  # all tasks and retrainings together; None: no noise

    @property
    def plans(self) -> tuple[Plan, ...]:
        """All plans in the order in which they were made."""
        return (*(self.earlier or ()), self.plan)

    def sent_mb(self, task: str, link: str) -> float:
        """Return the uplink traffic of a task on a link, over all stages [MB]."""
        return sum(row.mb for row in select(self.spent, task=task, link=link))


@dataclass(frozen=True)
class ArmCost(Record):
    """Costs and gain of a task in an arm; scores are means over the regions that federate in it."""

    arm: str
    task: str
    regions: tuple[str, ...]
    measure: str
    stage: str  # the last one that was tested
    wireless_mb: float  # uplink of stages II and III [MB]
    wireline_mb: float  # likewise [MB]
    edge_rounds: int  # of the region with the most
    cloud_rounds: int
    epsilon: float | None  # of a vehicle, all tasks and trainings together; None: no noise
    before: float  # the measure after pretraining
    after: Estimate  # the measure after the last stage, with its interval
    gain: float  # after - before
    gain_per_mb: float | None  # gain per megabyte of uplink on both links [1/MB]; None: nothing was sent

    @property
    def uplink_mb(self) -> float:
        """The uplink traffic of stages II and III on both links [MB]."""
        return self.wireless_mb + self.wireline_mb


@dataclass(frozen=True)
class _RunFigures(Saved):
    """The fields of a run's results, without those of extras."""

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
    elapsed_s: float = 0.0  # wall time of all starts together [s]
    costs: Annotated[tuple[ArmCost, ...] | None, LEFT_OUT] = None  # by arm and task
    home: Annotated[tuple[HomeCost, ...] | None, LEFT_OUT] = None  # in the tasks' further measures
    counts: Annotated[tuple[FoundCount, ...] | None, LEFT_OUT] = None  # of the tests of tasks that count


@dataclass(frozen=True)
class Run(Displayed, RunRows, _RunFigures):
    """Results of a finished run; `Run.load(folder)` reads them back."""

    file: ClassVar[str] = "results.json"

    @property
    def steps(self) -> Names:
        """The names of the run's steps, whose folders below `work` hold all artefacts."""
        return name_steps(self.recipe)

    def list_sections(self) -> list[PageSection]:
        """Return the sections of extras on the run's page."""
        found = [describe(self) for describe in load_all(SECTIONS)]
        return [section for section in found if section is not None]

    def describe_rows(self) -> list[str]:
        """Return the rows of extras as lines of text, with their names and tasks."""
        rows = [(field.name, row) for field in fields(RunRows) for row in getattr(self, field.name) or ()]
        return [f"{name}, {row.task}, {row.describe()}" for name, row in rows]

    def test(self, *, stage: str, region: str, task: str, arm: str = "main") -> Tested:
        """Return the result of a test; raises `KeyError` for one that was not made."""
        return {test.key: test.result for test in self.tested}[arm, stage, region, task]


@dataclass(frozen=True)
class Mean:
    """The mean of a number over seeds, with its 95 % interval."""

    name: str
    estimate: MeanOverSeeds
    judged: Annotated[Judged | None, LEFT_OUT] = None  # on the claim that a difference of the run itself is positive
    kind: Annotated[str | None, LEFT_OUT] = None  # of this claim: primary or secondary, where the recipe names some


@dataclass(frozen=True)
class ClaimCount:
    """Number of runs of several seeds by their verdict on one claim."""

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
    """Means over several seeds of a recipe; verdicts are corrected jointly, on primary claims apart from others."""

    file: ClassVar[str] = "summary.json"
    seeds: tuple[int, ...]
    measures: tuple[Mean, ...]
    differences: tuple[Mean, ...]
    gap_closed: tuple[Mean, ...]
    claims: tuple[ClaimCount, ...] = ()
