"""What the steps of stages II and III need to plan their rest anew after each round."""

from collections.abc import Mapping
from dataclasses import replace

from flcav.config import read_config
from flcav.network.ledger import BYTES_PER_MB, LINKS, Ledger
from flcav.network.plan import Price
from flcav.optimization.problem import Problem
from flcav.pipeline.federations.replanning import Course, Follower, Planner, Terms, restrict_problem
from flcav.pipeline.recipe import CLOUD, EDGE
from flcav.pipeline.results import PROBLEM, Plan, StageResult
from flcav.pipeline.steps import Work
from flcav.pipeline.work import Fields
from flcav.pipeline.work.budgets import read_entries, share_plan_budget


def open_edge_course(
    work: Work,
    plan: Plan,
    task: str,
    region: str,
    k: int,
    budget_mb: tuple[float, float],
    replan: Fields,
    book: Ledger,
    pretrained: str,
) -> Course:
    """Return the course of a region's stage II, whose ledger is `book`; `replan` as in `edge_step`."""
    vehicles: Mapping[str, int] = replan["vehicles"]
    terms = _edge_terms(work, plan, task, region, k, budget_mb, replan, book, pretrained)
    if "follows" in replan:
        return _follow(work, plan, task, replan["follows"], terms, book)
    problem = restrict_problem(read_config(Problem, work.inputs[replan["first"]] / PROBLEM), vehicles, region)
    return Course(plan.tasks[task], Planner(problem, plan, task, terms), book)


def open_cloud_course(
    work: Work,
    plan: Plan,
    task: str,
    regions: Mapping[str, object],
    k: int,
    budget_mb: tuple[float, float],
    replan: Fields,
    book: Ledger,
) -> Course:
    """Return the course of stage III of these regions, whose ledger is `book`; `replan` as in `cloud_step`."""
    whole, rest = share_plan_budget(plan, budget_mb, task), 1 - replan["headroom"]
    terms = Terms(
        CLOUD,
        tuple(replan["vehicles"][region] for region in regions),
        k,
        Price(rest * whole.wireless_mb, rest * whole.wireline_mb),
        Price(whole.wireless_mb, whole.wireline_mb),
    )
    if "follows" in replan:
        return _follow(work, plan, task, replan["follows"], terms, book)
    problem = read_config(Problem, work.inputs[replan["first"]] / PROBLEM)
    return Course(plan.tasks[task], Planner(problem, plan, task, terms), book)


def count_further_rounds(
    work: Work,
    plan: Plan,
    task: str,
    region: str,
    k: int,
    budget_mb: tuple[float, float],
    replan: Fields,
    book: Ledger,
    pretrained: str,
) -> int:
    """Return the number of further edge rounds in a region: those of the stage III in `replan`, if they are paid."""
    terms = _edge_terms(work, plan, task, region, k, budget_mb, replan, book, pretrained)
    rounds = StageResult.load(work.inputs[replan["follows"]]).rounds * k
    further = replace(plan.tasks[task], edge_rounds=rounds, cloud_rounds=0)
    return terms.cut(further, 0, _sum_sent(book)).edge_rounds


def _edge_terms(
    work: Work,
    plan: Plan,
    task: str,
    region: str,
    k: int,
    budget_mb: tuple[float, float],
    replan: Fields,
    book: Ledger,
    pretrained: str,
) -> Terms:
    """Return the terms of a region: its part of the wireless budget by vehicles, and an equal part of the wireline."""
    vehicles, headroom = replan["vehicles"], replan["headroom"]
    whole = share_plan_budget(plan, budget_mb, task)
    uploaded = sum(
        entry.bytes for entry in read_entries(work, pretrained) if (entry.link, entry.direction) == ("wireline", "up")
    )
    part = vehicles[region] / sum(vehicles.values())
    wireline = whole.wireline_mb - uploaded / BYTES_PER_MB
    budget = Price(book.budget.wireless_mb, wireline / len(vehicles))
    kept = Price(headroom * whole.wireless_mb * part, headroom * whole.wireline_mb / len(vehicles))
    allowed = Price(budget.wireless_mb - kept.wireless_mb, budget.wireline_mb - kept.wireline_mb)
    return Terms(EDGE, (vehicles[region],), k, allowed, budget)


def _follow(work: Work, plan: Plan, task: str, follows: str, terms: Terms, book: Ledger) -> Course:
    """Return the course that keeps to the plans of another federation, no longer than that went on."""
    other = StageResult.load(work.inputs[follows])
    follower = Follower({made.round: made.plan for made in other.plans or ()}, terms)
    return Course(terms.cut(plan.tasks[task], 0, _sum_sent(book)), follower, book, other.rounds)


def _sum_sent(book: Ledger) -> Price:
    wireless, wireline = (book.used_mb(link) for link in LINKS)
    return Price(wireless, wireline)
