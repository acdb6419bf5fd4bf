"""Prices and budgets of a stage whose rest is planned anew after each round."""

from dataclasses import dataclass, replace
from typing import Literal

from flcav.network.plan import Price, StagePlan, price
from flcav.pipeline.recipe import CLOUD, EDGE
from flcav.pipeline.results.plans import TaskPlan


@dataclass(frozen=True)
class Terms:
    """Prices and budgets of a stage: what its rounds cost, and what may be sent in it and after it.

    Of stage II they are those of one region, whose part of the wireline is the same as that of each other region.
    """

    stage: Literal["edge", "cloud"]
    groups: tuple[int, ...]  # vehicles of each edge server
    k: int  # edge rounds per cloud round
    allowed_mb: Price  # by the plan, headroom left out, with what the stage's ledger begins with
    budget_mb: Price  # by the ledger

    def rounds(self, plan: TaskPlan) -> int:
        """Return the rounds of the stage by a plan."""
        return plan.edge_rounds if self.stage == EDGE else plan.cloud_rounds

    def counts(self, plan: TaskPlan, done: int) -> tuple[int, int, int]:
        """Return samples, edge rounds and cloud rounds after `done` rounds of the stage."""
        return (plan.samples, done, 0) if self.stage == EDGE else (plan.samples, plan.edge_rounds, done)

    def price(self, plan: TaskPlan, done: int) -> Price:
        """Return the list price of what the ledger holds after `done` rounds: of stage II without the samples."""
        _, edge, cloud = self.counts(plan, done)
        samples_mb = 0.0 if self.stage == EDGE else plan.samples * plan.sample_mb
        rounds = price_rounds(plan, self.groups, self.k, edge, cloud)
        return Price(rounds.wireless_mb + samples_mb, rounds.wireline_mb + samples_mb)

    def price_rest(self, plan: TaskPlan, done: int) -> Price:
        """Return the list price of what a plan does after `done` rounds of the stage, stages after it included."""
        edge = plan.edge_rounds - done if self.stage == EDGE else 0
        cloud = plan.cloud_rounds - (done if self.stage == CLOUD else 0)
        return price_rounds(self._labelled(plan), self.groups, self.k, edge, cloud)

    def cut(self, plan: TaskPlan, done: int, sent_mb: Price) -> TaskPlan:
        """Return the plan with no more rounds of the stage than the ledger pays, what comes after it included."""
        name = f"{self.stage}_rounds"
        after = self.price_rest(replace(plan, **{name: done}), done)
        unit = (int(self.stage == EDGE), int(self.stage == CLOUD))
        one = price_rounds(self._labelled(plan), self.groups, self.k, *unit)
        free = subtract(subtract(self.budget_mb, sent_mb), after)
        paid = [int(max(mb, 0.0) // cost) for mb, cost in zip(links_mb(free), links_mb(one), strict=True) if cost > 0]
        return replace(plan, **{name: min(self.rounds(plan), done + min(paid))})

    def _labelled(self, plan: TaskPlan) -> TaskPlan:
        """Return the plan as it is priced from within the stage: labels of stage III are sent before its rounds."""
        return plan if self.stage == EDGE else replace(plan, labels_mb=None)

    def settle(self, plan: TaskPlan, done: int, sent_mb: Price) -> TaskPlan:
        """Return the plan with its megabytes: what was sent, and the list price of the rest."""
        return settle(plan, self.price_rest(plan, done), sent_mb)


def price_rounds(plan: TaskPlan, groups: tuple[int, ...], k: int, edge_rounds: int, cloud_rounds: int) -> Price:
    """Return the list price of rounds of a task; `groups`: vehicles of each edge server, `k`: as in `StagePlan`."""
    return price(StagePlan(0, edge_rounds, cloud_rounds, groups, k), plan.sizes)


def settle(plan: TaskPlan, rest: Price, sent_mb: Price) -> TaskPlan:
    """Return the plan with its megabytes: what was sent, and the price of the rest."""
    wireless, wireline = (a + b for a, b in zip(links_mb(sent_mb), links_mb(rest), strict=True))
    return replace(plan, wireless_mb=wireless, wireline_mb=wireline)


def links_mb(mb: Price) -> tuple[float, float]:
    """Return the megabytes on the wireless and on the wireline uplink."""
    return mb.wireless_mb, mb.wireline_mb


def subtract(mb: Price, less: Price) -> Price:
    """Return `mb` without `less`, on each link."""
    return Price(mb.wireless_mb - less.wireless_mb, mb.wireline_mb - less.wireline_mb)
