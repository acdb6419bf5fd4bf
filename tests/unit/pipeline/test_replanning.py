"""Plans made anew after each round: counts by hand, rates, what a kill leaves, who follows whose plan."""

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from line_task import Line, LineTask, Slope
from safetensors.numpy import load_file

from flcav.federation.rules import Rules
from flcav.federation.runtimes.embedded import update_bytes
from flcav.federation.runtimes.metered import Outage
from flcav.federation.stages import Schedule
from flcav.federation.strategies import FEDAVG
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.interface.progress import Report, ignore_progress
from flcav.network.ledger import Budget, Ledger
from flcav.network.plan import Price
from flcav.optimization.problem import Problem
from flcav.optimization.solvers.instance import Infeasible
from flcav.perception.task import Task
from flcav.perception.weights import to_arrays
from flcav.pipeline.federations.network import DrivenRounds
from flcav.pipeline.learning import Learning
from flcav.pipeline.planning.course import Course, Replanning
from flcav.pipeline.planning.rounds import Follower, Planner, restrict_problem
from flcav.pipeline.planning.stages import continue_joins, count_carried_out, remake_plan
from flcav.pipeline.planning.terms import Terms
from flcav.pipeline.planning.updates import follow_plan
from flcav.pipeline.recipe import Federation
from flcav.pipeline.results.plans import Plan, RoundPlan, TaskPlan
from flcav.pipeline.results.saved import WEIGHTS
from flcav.pipeline.results.training import StageResult
from flcav.pipeline.sizes import Training
from flcav.pipeline.stages import edge as stage_two
from flcav.pipeline.stages.edge import EdgeFederation, federate_edge

PREDICTED = {"pretrain": 0.4, "edge": 0.6, "cloud": 0.7}


def plan_of(edge: int, cloud: int, samples: int = 10, model_mb: float = 1.0) -> TaskPlan:
    return TaskPlan(samples, edge, cloud, 0.0, 0.0, 0.5, model_mb, PREDICTED)


def problem(cloud: tuple[int, int] = (1, 1), model_mb: float = 1.0, **changes: Any) -> Problem:
    """Return a problem of two regions with two vehicles and one."""
    curve = {
        "model": "additive",
        "pretrain": {"a": 0.4, "b": 0.5},
        "edge": {"a": 0.4, "x0": 1.0},
        "cloud": {"a": 0.3, "x0": 1.0},
    }
    limits = {"samples": (10, 10), "edge_rounds": (1, 12), "cloud_rounds": cloud}
    task = {"name": "t", "sample_mb": 0.5, "model_mb": model_mb, "edge_groups": (2, 1), "limits": limits}
    return Problem.model_validate(
        {"budgets_mb": {"wireless": 99, "wireline": 99}, "tasks": [{**task, "curve": curve}], **changes}
    )


def planner(asked: Problem, plan: TaskPlan, allowed: Price, budget: Price | None = None) -> Planner:
    terms = Terms("edge", (2,), 1, allowed, budget or allowed)
    return Planner(restrict_problem(asked, {"a": 2, "b": 1}, "a"), Plan("joint", {"t": plan}), "t", terms)


def test_megabytes_that_rounds_did_not_send_are_further_rounds() -> None:
    own = plan_of(9, 1)  # a round of the region costs 2 MB: 9 edge rounds and one cloud round are 20 MB
    plans = planner(problem(), own, Price(20.0, 5.0))
    as_planned = plans.replan(own, 3, 0.5, Price(6.0, 0.0))
    assert (as_planned.edge_rounds, as_planned.cloud_rounds) == (9, 1)
    assert (as_planned.wireless_mb, as_planned.wireline_mb) == (20.0, 1.0)
    more = plans.replan(own, 3, 0.5, Price(2.0, 0.0))  # 18 MB are left: the cloud round, and 8 edge rounds
    assert (more.edge_rounds, more.wireless_mb) == (11, 20.0)
    assert plans.replan(own, 3, 0.5, Price(1.0, 0.0)).edge_rounds == 11  # half a round is none
    assert plans.replan(own, 9, 0.5, Price(9.0, 0.0)).edge_rounds == 12  # and no more than the limits allow
    fewer = plans.replan(own, 3, 0.5, Price(9.5, 0.0))
    assert (fewer.edge_rounds, fewer.wireless_mb) == (7, 19.5)
    assert plans.replan(own, 3, 0.5, Price(25.0, 0.0)).edge_rounds == 3  # nothing is paid any more


def test_the_rest_is_the_best_of_what_is_left() -> None:
    own = plan_of(6, 3)
    asked = problem(cloud=(1, 6))
    curve = asked.tasks[0].curve
    for done, sent in ((2, 4.0), (4, 3.0), (5, 10.0)):
        new = planner(asked, own, Price(18.0, 9.0)).replan(own, done, 0.55, Price(sent, 0.0))
        factor = 0.45 / float(curve.error(10, done, 0))
        best = min(
            (factor * float(curve.error(10, edge, cloud)), edge, cloud)
            for edge in range(done, 13)
            for cloud in range(1, 7)
            if sent + 2.0 * (edge - done + cloud) <= 18.0
        )
        assert (new.edge_rounds, new.cloud_rounds) == best[1:]
        assert new.predicted is not None
        assert new.predicted["cloud"] == pytest.approx(1 - best[0])
        assert new.predicted["pretrain"] == PREDICTED["pretrain"]  # what is over


def test_the_headroom_keeps_a_plan_that_its_messages_slightly_exceed() -> None:
    own = plan_of(9, 1)
    kept = planner(problem(), own, Price(20.0, 5.0), Price(20.5, 5.0)).replan(own, 3, 0.5, Price(6.4, 0.0))
    assert kept.edge_rounds == 9
    assert planner(problem(), own, Price(20.0, 5.0)).replan(own, 3, 0.5, Price(6.4, 0.0)).edge_rounds == 8


def test_other_tasks_are_taken_as_planned_and_the_horizon_holds() -> None:
    both = problem()
    tasks = [{**both.tasks[0].model_dump(), "name": name, "train_s": 2.0} for name in ("t", "u")]
    asked = problem(tasks=tasks, horizon_s=30.0)
    plan = Plan("joint", {"t": plan_of(9, 1), "u": plan_of(3, 1)})
    terms = Terms("edge", (2,), 1, Price(99.0, 99.0), Price(99.0, 99.0))
    new = Planner(restrict_problem(asked, {"a": 2, "b": 1}, "a"), plan, "t", terms).replan(
        plan.tasks["t"], 2, 0.5, Price(4.0, 0.0)
    )
    assert new.edge_rounds == 10  # 30 s are 15 rounds, of which 4 are the other task's and one is the cloud round's


def test_one_cloud_plans_for_all_regions_under_both_budgets() -> None:
    own = plan_of(2, 2)
    terms = Terms("cloud", (2, 1), 1, Price(23.0, 14.0), Price(23.0, 14.0))
    plans = Planner(problem(cloud=(1, 6)), Plan("joint", {"t": own}), "t", terms)
    assert terms.price(own, 1) == Price(5.0 + 2 * 3.0 + 3.0, 5.0 + 2.0)
    assert plans.replan(own, 1, 0.6, Price(14.0, 7.0)).cloud_rounds == 4  # 9 MB are three rounds of three vehicles
    assert plans.replan(own, 1, 0.6, Price(11.0, 7.0)).cloud_rounds == 4  # 7 MB of wireline are three of two servers
    assert plans.replan(own, 1, 0.6, Price(11.0, 5.0)).cloud_rounds == 5


def test_who_follows_a_plan_keeps_to_what_its_own_ledger_pays() -> None:
    terms = Terms("edge", (2,), 1, Price(20.0, 5.0), Price(20.0, 5.0))
    follower = Follower({3: plan_of(11, 1)}, terms)
    assert follower.replan(plan_of(9, 1), 3, None, Price(2.0, 0.0)).edge_rounds == 11
    assert follower.replan(plan_of(9, 1), 3, None, Price(6.0, 0.0)).edge_rounds == 9  # what comes after is reserved
    assert follower.replan(plan_of(9, 1), 4, None, Price(8.0, 0.0)).edge_rounds == 9


def test_the_rate_is_that_of_the_place_among_the_rounds_of_the_plan_and_never_rises() -> None:
    plain = Schedule(6, 4, 0.16, 0.01, 5)
    longer = Schedule(8, 4, 0.16, 0.01, 5, planned=(5, 5, 9, 9, 5, 6, 8))
    # progress by the plan of then: 0/4, 1/4, 2/8 (= 1/4), 3/8, 4/4, and the end stays the end
    found = [np.log(longer.work(number).learning_rate / 0.16) / np.log(1 / 16) for number in range(1, 9)]
    assert found == pytest.approx([0, 1 / 4, 1 / 4, 3 / 8, 1, 1, 1, 1])
    same = replace(plain, rounds=3, planned=(6, 6, 6))
    assert [same.work(number) for number in (1, 2, 3)] == [plain.work(number) for number in (1, 2, 3)]


class Walk:
    """A client whose weights walk at random: any other round, seed, start or rate ends elsewhere."""

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        moved = np.random.default_rng(seed).normal() * learning_rate * steps
        return LocalUpdate({name: (array + moved).astype(array.dtype) for name, array in weights.items()}, 3, 0.5)


class Killed(BaseException):
    pass


def stage(folder: Path, lost: dict[tuple[int, str], Outage], report: Report = ignore_progress) -> Course:
    """Run a region's stage II, planned for four rounds of two vehicles and a cloud round."""
    learning = Learning(cast(Task, LineTask()), None, Training(local_steps=2), 3)
    torch.manual_seed(0)
    network = Line(Slope())
    model_mb = update_bytes(to_arrays(network)) / 1e6
    book, own = Ledger(Budget(10.5 * model_mb, 0.0)), plan_of(4, 1, model_mb=model_mb)
    allowed = Price(10.1 * model_mb, 1.0)
    asked = restrict_problem(problem(model_mb=model_mb), {"a": 2, "b": 1}, "a")
    course = Course(own, Planner(asked, Plan("joint", {"t": own}), "t", Terms("edge", (2,), 1, allowed, allowed)), book)
    rules = Rules(least_clients=1)
    replanning = Replanning(course, lambda plan, rounds: DrivenRounds(rules, lost, ()), lambda scores: scores["a"])
    clients = {f"a/cav{number}": Walk() for number in range(2)}
    schedule = learning.schedule(4, 2, "edge", "a")
    watched: Any = {"a": cast(Any, Empty())}
    losses = federate_edge(
        EdgeFederation(learning, network, cast(Any, clients), schedule, FEDAVG, 0, book, folder, report, watched),
        rules,
        replanning=replanning,
    )
    assert len(losses) == course.rounds
    assert book.used_mb("wireless") <= 10.1 * model_mb - 2 * model_mb  # the cloud round is still to be paid
    return course


class Empty:
    data, vehicles = None, ()


def test_a_lost_vehicle_s_megabytes_are_a_further_round_and_a_kill_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stage_two, "score_network", lambda task, network, *frames: float(network.bias.detach()) % 1)
    (tmp_path / "plain").mkdir()
    assert [made.plan.edge_rounds for made in stage(tmp_path / "plain", {}).made] == [4] * 4
    lost = {(number, "a/cav1"): Outage("away") for number in (1, 3)}  # half of a round's megabytes each
    (tmp_path / "whole").mkdir()
    whole = stage(tmp_path / "whole", lost)
    assert [made.plan.edge_rounds for made in whole.made] == [4, 4, 5, 5, 5]
    assert [made.round for made in whole.made] == [1, 2, 3, 4, 5]
    first = whole.made[0]
    assert first.planned_mb.wireless_mb == pytest.approx(2 * first.sent_mb.wireless_mb, rel=1e-2)
    weights = load_file(tmp_path / "whole" / WEIGHTS)

    for last in range(1, 6):
        (folder := tmp_path / str(last)).mkdir()

        def killed(done: int, total: int, note: str = "", last: int = last) -> None:
            if done == last:
                raise Killed

        with pytest.raises(Killed):
            stage(folder, lost, killed)
        assert stage(folder, lost).made == whole.made
        found = load_file(folder / WEIGHTS)
        assert all(np.array_equal(found[name], weights[name]) for name in weights)


def test_regions_of_different_rounds_count_by_their_vehicles() -> None:
    def result(region: str, rounds: int, clients: int, joins: dict[str, tuple[int, ...]]) -> StageResult:
        made = RoundPlan(rounds, 0.5, Price(0, 0), Price(0, 0), replace(plan_of(rounds, 1), joins=joins))
        return StageResult("edge", "t", region, rounds, 9, clients, (), plans=(made,))

    both = (result("a", 7, 3, {"a/cav0": (1, 7)}), result("b", 3, 1, {"b/cav0": (2, 3)}))
    joins: dict[str, tuple[int, ...]] = {"a/cav0": (1, 2), "b/cav0": (1, 2)}
    found = count_carried_out(replace(plan_of(4, 1), joins=joins), both, 1)
    assert found.edge_rounds == 6  # (3 x 7 + 1 x 3) / 4
    assert found.joins == {"a/cav0": (1, 7), "b/cav0": (2, 3)}  # a region's rounds are counted from its first
    assert found.ran == {"a": 7, "b": 3}
    same = count_carried_out(replace(plan_of(4, 1), joins=joins), (both[0], replace(both[1], rounds=7)), 1)
    assert (same.edge_rounds, same.ran) == (7, None)


def test_a_plan_that_is_not_made_anew_has_the_cloud_rounds_that_all_regions_have_vehicles_for() -> None:
    first = replace(plan_of(4, 3), joins=dict.fromkeys(VEHICLES, tuple(range(1, 11))))
    both = [ran_stage(region, rounds, replace(first, cloud_rounds=cloud), 2) for region, rounds, cloud in CARRIED]
    ended = replace(both[0], rounds=4)  # a privacy budget ended the stage before its plan
    for stages, many in ((both, 5), ([ended, both[1]], 4)):
        ran = count_carried_out(first, stages, 2)
        assert (ran.edge_rounds, ran.cloud_rounds) == (many, 2)
        assert ran.joins is not None
        for name, joined in ran.joins.items():
            assert joined == tuple(range(1, 1 + next(own.rounds for own in stages if own.region == name[0]) + 2 * 2))
    short = {**problem().model_dump(), "budgets_mb": {"wireless": 10.0, "wireline": 99.0}}
    none = remake_plan(
        Plan("joint", {"t": first}), Problem.model_validate(short), "edge", {"t": 0.6}, Price(9.9, 0.0), {"t": ran}
    )
    assert none.tasks == {"t": ran}  # nothing is left for a cloud round


CARRIED = (("a", 5, 2), ("b", 4, 3))  # region, its edge rounds, cloud rounds by its last plan


def test_no_vehicle_joins_more_rounds_than_it_has_time_for_after_a_plan_is_made_anew() -> None:
    rng = np.random.default_rng(3)
    refused = 0
    for _ in range(200):
        most = {f"{region}/cav{number}": int(rng.integers(1, 7)) for region in "ab" for number in range(3)}
        plans = [replace(plan_of(rounds, 0), joins=joins_of(most, rounds)) for rounds in (4, 4 + int(rng.integers(4)))]
        before, new = plans
        over = int(rng.integers(5))
        ran = {region: over + int(rng.integers(-1, 2)) for region in "ab"}  # of the mean `over`
        assert before.joins is not None
        assert new.joins is not None
        before = replace(before, edge_rounds=over, ran=ran)
        past = {
            name: [each for each in joined if each <= ran[name[0]]] for name, joined in (before.joins or {}).items()
        }
        time = {name: max(most[name], len(joined)) for name, joined in new.joins.items()}  # of so many rounds of 2 s
        spare_s = {name: 2.0 * (time[name] - len(joined)) for name, joined in new.joins.items()}
        task = problem(tasks=[{**problem().tasks[0].model_dump(), "train_s": 2.0}]).tasks[0]
        try:
            joins = continue_joins(before, new, over, task, spare_s)
        except Infeasible:
            left = {name: max(time[name] - len(past[name]), 0) for name in past}
            fewest = min(sum(many for name, many in left.items() if name[0] == region) for region in "ab")
            assert fewest < new.edge_rounds - over
            refused += 1
            continue
        assert joins is not None
        for name, joined in joins.items():
            assert [each for each in joined if each <= ran[name[0]]] == past[name]
            assert len({*joined}) == len(joined) <= max(time[name], len(past[name]))
        for region in "ab":
            own = [each for name, joined in joins.items() if name[0] == region for each in joined]
            later = {each - ran[region] for each in own if each > ran[region]}
            assert later == {*range(1, new.edge_rounds - over + 1)}
    assert 0 < refused < 100


@pytest.mark.parametrize("cloud_rounds", [1, 2])
@pytest.mark.parametrize("horizon_s", [None, 40.0, 17.0])
def test_a_region_that_ran_more_rounds_than_the_mean_joins_the_cloud_rounds(
    cloud_rounds: int, horizon_s: float | None
) -> None:
    asked = timed(problem(cloud=(cloud_rounds, cloud_rounds)), horizon_s, "t")
    first = replace(plan_of(6, cloud_rounds), joins=dict.fromkeys(VEHICLES, tuple(range(1, 7 + cloud_rounds))))
    ran = count_carried_out(first, [ran_stage(region, rounds, first) for region, rounds in (("a", 7), ("b", 5))], 1)
    assert (ran.edge_rounds, (ran.joins or {})["a/cav0"][:7]) == (6, (1, 2, 3, 4, 5, 6, 7))
    made = remake_plan(Plan("joint", {"t": first}), asked, "edge", {"t": 0.6}, Price(0.0, 0.0), {"t": ran})
    own = made.tasks["t"]
    after = own.joins_after_edge()
    assert (own.cloud_rounds, own.predicted == ran.predicted) == (cloud_rounds, False)  # not the plan of before
    if horizon_s != 17.0:
        assert after == dict.fromkeys(VEHICLES, tuple(range(1, 1 + cloud_rounds)))
    else:  # 8 rounds of 2 s, of which those of the region that ran more have one left each
        assert {name: len(rounds) for name, rounds in after.items()} == {
            "a/cav0": 1,
            "a/cav1": 1,
            "b/cav0": cloud_rounds,
        }
        assert {*after["a/cav0"], *after["a/cav1"]} == {*range(1, 1 + cloud_rounds)}


def test_the_cloud_s_plans_go_on_from_the_last_edge_round_of_each_region() -> None:
    asked = timed(problem(cloud=(2, 2)), 99.0, "t")
    first = replace(plan_of(6, 2), joins=dict.fromkeys(VEHICLES, tuple(range(1, 9))))
    ran = count_carried_out(first, [ran_stage(region, rounds, first) for region, rounds in (("a", 7), ("b", 5))], 1)
    begun = remake_plan(Plan("joint", {"t": first}), asked, "edge", {"t": 0.6}, Price(0.0, 0.0), {"t": ran})
    terms = Terms("cloud", (2, 1), 1, Price(99.0, 99.0), Price(99.0, 99.0))
    own = Planner(asked, begun, "t", terms).replan(begun.tasks["t"], 1, 0.6, Price(30.0, 9.0))
    for plan in (begun.tasks["t"], own):
        assert plan.ran == {"a": 7, "b": 5}
        assert plan.joins == {name: tuple(range(1, {"a": 10, "b": 8}[name[0]])) for name in VEHICLES}
        rules = [follow_plan(Federation(), plan, after_edge=after).selection.joins for after in (False, True)]
        assert rules == [plan.joins, dict.fromkeys(VEHICLES, (1, 2))]


def test_time_that_one_task_takes_beyond_its_plan_is_gone_for_the_others() -> None:
    first = replace(plan_of(6, 1), joins=dict.fromkeys(VEHICLES, tuple(range(1, 8))))
    ran = count_carried_out(first, [ran_stage(region, rounds, first) for region, rounds in (("a", 7), ("b", 5))], 1)
    ran = replace(ran, joins={**(ran.joins or {}), "a/cav1": (1, 2, 3, 8)})
    plan, asked = Plan("joint", {"t": first, "u": first}), timed(problem(), 30.0, "t", "u")
    made = remake_plan(plan, asked, "edge", dict.fromkeys("tu", 0.6), Price(0.0, 0.0), dict.fromkeys("tu", ran))
    joined = [own.joins_after_edge() for own in made.tasks.values()]
    assert [{name for name, own in each.items() if own} for each in joined] == [{*VEHICLES}, {"a/cav1", "b/cav0"}]


def test_all_tasks_go_on_as_planned_where_one_of_them_has_too_little_time_left() -> None:
    first = replace(plan_of(6, 1), joins=dict.fromkeys(VEHICLES, tuple(range(1, 8))))
    ran = count_carried_out(first, [ran_stage(region, rounds, first) for region, rounds in (("a", 5), ("b", 7))], 1)
    plan, sent = Plan("joint", {"t": first, "u": first}), Price(0.0, 0.0)
    for horizon_s, anew in ((28.0, False), (30.0, True)):  # 14 rounds of 2 s, 13 of which b/cav0 has joined; 15
        made = remake_plan(
            plan, timed(problem(), horizon_s, "t", "u"), "edge", dict.fromkeys("tu", 0.6), sent, {"u": ran}
        )
        assert (made.tasks != {"t": first, "u": ran}) == anew


VEHICLES = ("a/cav0", "a/cav1", "b/cav0")


def timed(asked: Problem, horizon_s: float | None, *names: str) -> Problem:
    """Return the problem of tasks with these names, whose vehicles train for 2 s in a round, within a horizon [s]."""
    own = asked.tasks[0].model_dump() | {"vehicle_train_s": dict.fromkeys(VEHICLES, 2.0)}
    tasks = [own | {"name": name} for name in names]
    return Problem.model_validate(asked.model_dump() | {"horizon_s": horizon_s, "tasks": tasks})


def ran_stage(region: str, rounds: int, plan: TaskPlan, k: int = 1) -> StageResult:
    """Return a region's stage II whose last plan gave all its vehicles all its rounds, `rounds` of the edge."""
    number = rounds + k * plan.cloud_rounds
    own = {name: tuple(range(1, number + 1)) for name in VEHICLES if name.startswith(region)}
    last = replace(plan, edge_rounds=rounds, joins=own)
    made = RoundPlan(rounds, 0.5, Price(0, 0), Price(0, 0), last)
    return StageResult("edge", "t", region, rounds, 9, len(own), (), plans=(made,))


def joins_of(most: dict[str, int], rounds: int) -> dict[str, tuple[int, ...]]:
    """Return the rounds of vehicles, each of so many at most, one vehicle after another."""
    joins = {}
    for region in "ab":
        start = 0
        for name in (each for each in most if each[0] == region):
            count = min(max(most[name], -(-rounds // 3)), rounds)
            joins[name] = tuple(sorted((start + number) % rounds + 1 for number in range(count)))
            start += count
    return joins
