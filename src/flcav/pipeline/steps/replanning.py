"""Re-planning after each round, in the steps of stages II and III."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from flcav.config import read_config
from flcav.network.ledger import BYTES_PER_MB, LINKS, Budget, Ledger
from flcav.network.plan import Price
from flcav.optimization.problem import Problem
from flcav.pipeline.engine import Work
from flcav.pipeline.planning.course import Course
from flcav.pipeline.planning.rounds import Follower, Planner, restrict_problem
from flcav.pipeline.planning.terms import Terms
from flcav.pipeline.recipe import CLOUD, EDGE
from flcav.pipeline.results.plans import Plan, TaskPlan
from flcav.pipeline.results.saved import PROBLEM
from flcav.pipeline.results.training import StageResult
from flcav.pipeline.steps.budgets import read_entries, share_plan_budget
from flcav.pipeline.steps.settings import FederationSettings, RoundPlans


@dataclass(frozen=True)
class Rest:
    """The rest of a stage of one task, which is planned anew after each of its rounds."""

    work: Work
    settings: FederationSettings
    how: RoundPlans  # those of the settings
    plan: Plan  # at the beginning of the stage
    book: Ledger  # of the stage

    def open_edge(self, region: str, pretrained: str) -> Course:
        """Return the course of a region's stage II, after the step `pretrained`."""
        terms = self._edge_terms(region, pretrained)
        if self.how.first is None:
            return self._follow(terms)
        problem = restrict_problem(self._problem(self.how.first), self.settings.vehicles, region)
        return Course(self._own, Planner(problem, self.plan, self._task, terms), self.book)

    def open_cloud(self, regions: Iterable[str]) -> Course:
        """Return the course of stage III of these regions."""
        whole, kept = self._share, 1 - self.how.headroom
        terms = Terms(
            CLOUD,
            tuple(self.settings.vehicles[region] for region in regions),
            self._k,
            Price(kept * whole.wireless_mb, kept * whole.wireline_mb),
            Price(whole.wireless_mb, whole.wireline_mb),
        )
        if self.how.first is None:
            return self._follow(terms)
        return Course(self._own, Planner(self._problem(self.how.first), self.plan, self._task, terms), self.book)

    def count_further(self, region: str, pretrained: str) -> int:
        """Return the number of further edge rounds in a region: those of the stage III followed, if they are paid."""
        rounds = self._followed().rounds * self._k
        further = replace(self._own, edge_rounds=rounds, cloud_rounds=0)
        return self._edge_terms(region, pretrained).cut(further, 0, _sum_sent(self.book)).edge_rounds

    @property
    def _own(self) -> TaskPlan:
        return self.plan.tasks[self._task]

    @property
    def _task(self) -> str:
        return self.settings.learning.task

    @property
    def _k(self) -> int:
        return self.settings.federation.edge_rounds_per_cloud_round

    @property
    def _share(self) -> Budget:
        return share_plan_budget(self.plan, self.settings.budgets_mb, self._task)

    def _problem(self, first: str) -> Problem:
        return read_config(Problem, self.work.inputs[first] / PROBLEM)

    def _edge_terms(self, region: str, pretrained: str) -> Terms:
        """Return the terms of a region: its part of the wireless budget by vehicles, an equal part of the wireline."""
        vehicles, headroom, whole = self.settings.vehicles, self.how.headroom, self._share
        spent = read_entries(self.work, pretrained)
        uploaded = sum(entry.bytes for entry in spent if (entry.link, entry.direction) == ("wireline", "up"))
        part = vehicles[region] / sum(vehicles.values())
        wireline = whole.wireline_mb - uploaded / BYTES_PER_MB
        budget = Price(self.book.budget.wireless_mb, wireline / len(vehicles))
        kept = Price(headroom * whole.wireless_mb * part, headroom * whole.wireline_mb / len(vehicles))
        allowed = Price(budget.wireless_mb - kept.wireless_mb, budget.wireline_mb - kept.wireline_mb)
        return Terms(EDGE, (vehicles[region],), self._k, allowed, budget)

    def _follow(self, terms: Terms) -> Course:
        """Return the course that keeps to the plans of another federation, no longer than that went on."""
        other = self._followed()
        follower = Follower({made.round: made.plan for made in other.plans or ()}, terms)
        return Course(terms.cut(self._own, 0, _sum_sent(self.book)), follower, self.book, other.rounds)

    def _followed(self) -> StageResult:
        assert self.how.follows is not None  # where there is no first plan
        return StageResult.load(self.work.inputs[self.how.follows])


def _sum_sent(book: Ledger) -> Price:
    wireless, wireline = (book.used_mb(link) for link in LINKS)
    return Price(wireless, wireline)
