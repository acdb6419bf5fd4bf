"""The plan of a run: both budgets, all tasks."""

import json
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Literal, get_args

import networkx as nx
import numpy as np
import pytest
from flwr.app import Array, ArrayRecord, MetricRecord, RecordDict
from flwr.common.serde import recorddict_to_proto

from flcav.config import InputError
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.trainable import LocalUpdate
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.network.plan import MessageSizes, price
from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.curves.curves import Additive, Federated
from flcav.optimization.curves.fitting import CurveFit, fit
from flcav.optimization.curves.held_out import hold_out_runs
from flcav.optimization.curves.history import History
from flcav.optimization.graph import load_graph, load_problem
from flcav.optimization.solvers.instance import Infeasible
from flcav.perception.objects.model import second_tiny
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import to_arrays
from flcav.reproductions.fig6a_allocation.run import BUDGETS
from flcav.runs import allocation
from flcav.runs.allocation import PlanRequest, PlanSettings, make_plan, remake_plan
from flcav.runs.arms import PlanRule
from flcav.runs.recipe import FixedPlan, PlanLimits, load_run_recipe
from flcav.runs.results.plans import TaskPlan
from flcav.runs.spread import read_spreads
from flcav.runs.tables import HistoryPoint, append_records, load_known_history, parse_history
from flcav.runs.training.updates import model_mb

RECIPES = Path(__file__).parents[3] / "recipes/runs"
FITTED: dict[tuple[bytes, ...], CurveFit] = {}


@pytest.fixture(autouse=True)
def _equal_histories_are_fitted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the curve of a history from `FITTED` where it was fitted before: most tests here plan by the same one."""

    def fit_once(history: History, *, model: Literal["best"], group_samples: tuple[int, ...], k: int) -> CurveFit:
        arrays = (history.resources, history.accuracy, history.weight, np.array([*group_samples, k]))
        key = tuple(array.tobytes() for array in arrays)
        if key not in FITTED:
            FITTED[key] = fit(history, model=model, group_samples=group_samples, k=k)
        return FITTED[key]

    monkeypatch.setattr(allocation, "fit", fit_once)


SIZES = MessageSizes(sample_mb=0.4, model_mb=1.4)
LIMITS = PlanLimits(edge_rounds=(1, 12), cloud_rounds=(1, 6))


def frame(wireless: float = 90.0, wireline: float = 60.0) -> PlanSettings:
    return PlanSettings(LinkMegabytes(wireless, wireline), 0.02, LIMITS, (4, 3), 1)


def history() -> History:
    counts = np.array([(s, e, c) for s in (80, 160, 320) for e in (0, 2, 6) for c in (0, 1, 3)], dtype=float)
    samples, edge, cloud = counts.T
    error = 2.0 * samples**-0.3 * 0.8 + 0.2 * (edge + 1) ** -0.7 + 0.1 * (cloud + 1) ** -0.7 - 0.1
    return History(counts, 1 - error.clip(0.01, 0.99), np.ones(len(counts)))


def asked(name: str = "objects", pool: int = 400, weight: float = 1.0, fixed: FixedPlan | None = None) -> PlanRequest:
    return PlanRequest(name, weight, SIZES, pool, None if fixed else history(), fixed)


def test_the_plans_price_leaves_the_headroom() -> None:
    plan = make_plan((asked(),), frame(), "joint")[0].tasks["objects"]
    cost = price(frame().stage_plan(plan.samples, plan.edge_rounds, plan.cloud_rounds), SIZES)
    assert (plan.wireless_mb, plan.wireline_mb) == pytest.approx((cost.wireless_mb, cost.wireline_mb))
    assert cost.wireless_mb <= 0.98 * 90
    assert cost.wireline_mb <= 0.98 * 60


def test_both_budgets_bind() -> None:
    def counts(*budgets: float) -> list[int]:
        plan = make_plan((asked(),), frame(*budgets), "joint")[0].tasks["objects"]
        return [plan.samples, plan.edge_rounds, plan.cloud_rounds]

    once, twice = counts(90, 60), counts(180, 120)
    assert all(more >= less for more, less in zip(twice, once, strict=True))
    assert twice != once


def test_tasks_share_both_budgets_and_fixed_plans_are_paid_first() -> None:
    fixed = FixedPlan(samples=50, edge_rounds=2, cloud_rounds=1)
    both = make_plan((asked(), asked("signs", fixed=fixed)), frame(), "joint")[0]
    alone = make_plan((asked(),), frame(), "joint")[0]
    assert (both.tasks["signs"].samples, both.tasks["signs"].edge_rounds) == (50, 2)
    assert both.tasks["signs"].predicted is None
    assert sum(task.wireless_mb for task in both.tasks.values()) <= 0.98 * 90
    assert both.tasks["objects"].wireless_mb < alone.tasks["objects"].wireless_mb
    two = make_plan((asked(weight=3.0), asked("weather")), frame(180, 120), "joint")[0]
    assert two.tasks["objects"].wireless_mb > two.tasks["weather"].wireless_mb
    with pytest.raises(InputError, match="fixed plans take"):
        make_plan((asked("signs", fixed=FixedPlan(samples=300, edge_rounds=2, cloud_rounds=1)),), frame(), "joint")
    with pytest.raises(InputError, match="the pools hold 20"):
        make_plan((asked("signs", pool=20, fixed=fixed),), frame(), "joint")


def test_a_graph_prices_exchanges_and_labels_as_a_run_does(tmp_path: Path) -> None:
    sizes = MessageSizes(sample_mb=0.4, model_mb=1.4, exchange_mb=0.2, labels_mb=0.3)
    plan, problem = make_plan((replace(asked(), sizes=sizes),), frame(), "joint")
    assert problem is not None
    (task,), own = problem.tasks, plan.tasks["objects"]
    values = {
        "budgets_mb": problem.budgets_mb.model_dump(),
        "tasks": {"objects": {"network": "detector"}},
        "networks": {
            "detector": {
                **{"model_mb": 1.4, "exchange_mb": 0.2, "labels_mb": 0.3, "modalities": ["lidar"]},
                "limits": task.limits.model_dump(mode="json"),
                "curve": task.curve.model_dump(mode="json"),
            }
        },
        "modalities": {"lidar": {"sample_mb": 0.4}},
        "vehicles": {f"car {i}": {"edge": "grid" if i < 4 else "ring", "holds": {"lidar": {}}} for i in range(7)},
    }
    (tmp_path / "layers.yaml").write_text(json.dumps(values))
    joined = json.dumps(nx.node_link_data(load_graph(tmp_path / "layers.yaml"), edges="links"))
    (tmp_path / "graph.json").write_text(joined)
    vehicles, edge_rounds, cloud_rounds = 4 + 3, own.edge_rounds, own.cloud_rounds
    wireless = own.samples * 0.4 + vehicles * ((edge_rounds + cloud_rounds) * 0.2 + (edge_rounds + 1) * 0.3)
    wireline = own.samples * 0.4 + 2 * cloud_rounds * 1.4
    for name in ("layers.yaml", "graph.json"):
        (same,) = allocate(load_problem(tmp_path / name)).tasks
        assert (same.samples, same.edge_rounds, same.cloud_rounds) == (own.samples, edge_rounds, cloud_rounds)
        assert (same.wireless_mb, same.wireline_mb) == (own.wireless_mb, own.wireline_mb)
        assert (same.wireless_mb, same.wireline_mb) == pytest.approx((wireless, wireline))


def test_the_curve_predicts_every_stage() -> None:
    predicted = make_plan((asked(),), frame(), "joint")[0].tasks["objects"].predicted
    assert predicted is not None
    assert predicted["pretrain"] < predicted["edge"] < predicted["cloud"]
    equal = make_plan((asked(),), frame(), "equal-stages")[0].tasks["objects"].predicted
    assert equal is not None
    assert equal["cloud"] <= predicted["cloud"] + 1e-9


def test_a_plan_made_anew_is_the_best_of_what_is_left() -> None:
    first, problem = make_plan((asked(),), frame(120, 60), "joint")
    assert problem is not None
    own = first.tasks["objects"]
    cases: tuple[tuple[Literal["pretrain", "edge"], float, float], ...] = (
        ("pretrain", 0.2, 0.0),
        ("pretrain", 0.7, 9.0),
        ("edge", 0.6, 0.0),
        ("edge", 0.3, 4.0),
    )
    for stage, reached, saved_mb in cases:
        rounds = own.edge_rounds if stage == "edge" else 0
        sent = price(frame().stage_plan(own.samples, rounds, 0), SIZES)
        used = LinkMegabytes(sent.wireless_mb - saved_mb, sent.wireline_mb)
        plan = remake_plan(first, problem, stage, {"objects": reached}, used)
        new = plan.tasks["objects"]
        factor = (1 - reached) / float(problem.tasks[0].curve.error(own.samples, rounds, 0))
        best = min(
            (factor * float(problem.tasks[0].curve.error(own.samples, edge, cloud)), edge, cloud)
            for edge in (range(1, 13) if stage == "pretrain" else (rounds,))
            for cloud in range(1, 7)
            for cost in (price(frame().stage_plan(own.samples, edge, cloud), SIZES),)
            if cost.wireless_mb - saved_mb <= 0.98 * 120 + 1e-9 and cost.wireline_mb <= 0.98 * 60 + 1e-9
        )
        assert (new.samples, new.edge_rounds, new.cloud_rounds) == (own.samples, *best[1:])
        assert new.predicted is not None
        assert own.predicted is not None
        assert new.predicted["cloud"] == pytest.approx(1 - best[0], abs=1e-6)
        assert new.predicted["pretrain"] == own.predicted["pretrain"]
        assert (plan.after, plan.reached) == (stage, {"objects": reached})
    more = remake_plan(first, problem, "pretrain", {"objects": 0.5}, LinkMegabytes(0.0, 0.0)).tasks["objects"]
    assert more.wireless_mb > own.wireless_mb  # what stage I did not send is free


def test_no_other_plan_fits_what_is_left() -> None:
    first, problem = make_plan((asked(),), frame(), "joint")
    assert problem is not None
    counts = first.tasks["objects"]
    sent = price(frame().stage_plan(counts.samples, 0, 0), SIZES)
    plan = remake_plan(
        first, problem, "pretrain", {"objects": 0.5}, LinkMegabytes(sent.wireless_mb + 60.0, sent.wireline_mb)
    )
    assert plan.tasks == first.tasks


@pytest.mark.slow
def test_the_curve_of_least_aicc_is_planned_by() -> None:
    counts = history().resources
    samples, edge, cloud = counts.T
    curve = Federated(
        model="federated", a=1.6, b=0.4, alpha=0.1, beta=0.3, gamma=0.8, group_samples=(40, 30), drift=0.0
    )
    error = curve.error(samples, edge, cloud, k=1)
    regional = fit(History(counts, 1 - error, np.ones(len(counts))), model="best", group_samples=(40, 30))
    assert isinstance(regional.curve, Federated)
    assert float(regional.curve.error(160, 2, 1)) == pytest.approx(float(curve.error(160, 2, 1)), abs=2e-3)
    assert isinstance(fit(history(), model="best", group_samples=(40, 30)).curve, Additive)
    assert isinstance(
        fit(history(), model="best", group_samples=40).curve, Additive
    )  # one region has nobody to learn from


def test_rounds_without_limits_are_those_that_were_measured_and_there_is_time_for() -> None:
    open_ended = replace(frame(9000.0, 9000.0), limits=PlanLimits())
    free = make_plan((asked(),), open_ended, "joint")[0].tasks["objects"]
    assert (free.edge_rounds, free.cloud_rounds) == (6, 3)
    timed = make_plan((replace(asked(), train_s=4.0),), replace(open_ended, horizon_s=25.0), "joint")[0].tasks[
        "objects"
    ]
    assert 4.0 * (timed.edge_rounds + timed.cloud_rounds) <= 25.0
    assert 4.0 * (timed.edge_rounds + timed.cloud_rounds) > 21.0


def test_slow_vehicles_are_planned_into_the_rounds_that_they_have_time_for() -> None:
    speeds = {f"a/cav{number}": 1.0 for number in range(4)} | {f"b/cav{number}": 0.5 for number in range(3)}
    settings = replace(frame(9000.0, 9000.0), limits=PlanLimits(), horizon_s=12.0, speeds=speeds)
    first, problem = make_plan((replace(asked(), train_s=2.0),), settings, "joint")
    own = first.tasks["objects"]
    assert problem is not None
    assert own.joins is not None
    assert all(len(own.joins[name]) * 2.0 / speed <= 12.0 for name, speed in speeds.items())
    for group in (range(4), range(3)):
        names = [f"{'a' if len(group) == 4 else 'b'}/cav{number}" for number in group]
        assert {each for name in names for each in own.joins[name]} == set(
            range(1, 1 + own.edge_rounds + own.cloud_rounds)
        )
    sent_mb = own.samples * SIZES.sample_mb + sum(map(len, own.joins.values())) * SIZES.model_mb
    all_join = price(settings.stage_plan(own.samples, own.edge_rounds, own.cloud_rounds), SIZES)
    assert sent_mb < own.wireless_mb == pytest.approx(all_join.wireless_mb)  # priced as if all joined every round
    on_air, slower = make_plan((replace(asked(), train_s=2.0, air_s={"b": 1.0}),), settings, "joint")
    assert slower is not None
    for name, speed in speeds.items():
        assert slower.tasks[0].vehicle_train_s[name] == 2.0 / speed + (1.0 if name.startswith("b/") else 0.0)
    air_joins = on_air.tasks["objects"].joins
    assert air_joins is not None
    assert all(len(air_joins[name]) * slower.tasks[0].vehicle_train_s[name] <= 12.0 for name in speeds)
    later = remake_plan(
        first, problem, "edge", {"objects": 0.4}, LinkMegabytes(own.wireless_mb / 2, own.wireline_mb / 2)
    )
    joins = later.tasks["objects"].joins
    assert joins is not None
    for name, joined in own.joins.items():  # what is over stays
        assert [each for each in joins[name] if each <= own.edge_rounds] == [e for e in joined if e <= own.edge_rounds]
    after = later.tasks["objects"].joins_after_edge()
    assert {each for joined in after.values() for each in joined} == set(
        range(1, 1 + later.tasks["objects"].cloud_rounds)
    )


def plan_recipe(name: str, wireless: float = 1, wireline: float = 1, rule: PlanRule = "joint") -> TaskPlan:
    """Return the plan of objects in a recipe of the package, with so many times its budgets."""
    recipe = load_run_recipe(RECIPES / f"{name}.yaml")
    pool, edge, own = recipe.sized_splits.pool, recipe.sized_splits.edge, recipe.tasks["objects"]
    groups = tuple(recipe.vehicles(region) for region in recipe.with_role("federate"))
    sizes = MessageSizes(sample_mb=0.448, model_mb=model_mb(OBJECTS, own.network))  # a sweep: as in docs/runs.md
    candidates = pool.scenes * pool.spins * pool.cavs
    request = PlanRequest("objects", own.weight, sizes, candidates, load_known_history("objects"), None, own.train_s)
    settings = PlanSettings(
        budgets_mb=LinkMegabytes(wireless * recipe.budgets_mb.wireless, wireline * recipe.budgets_mb.wireline),
        headroom=recipe.headroom,
        limits=recipe.limits,
        edge_groups=groups,
        edge_rounds_per_cloud_round=recipe.federation.edge_rounds_per_cloud_round,
        group_samples=tuple(vehicles * edge.scenes * edge.spins for vehicles in groups),
        horizon_s=recipe.horizon_s,
    )
    return make_plan((request,), settings, rule)[0].tasks["objects"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["demo_road", "arms"])
def test_doubling_up_to_a_recipe_s_budget_is_worth_more_than_trainings_differ_and_beyond_it_less(name: str) -> None:
    spreads = read_spreads("demo", Path())
    differ = max(spreads["objects", town, "main", "cloud", "", ""].sd for town in ("grid", "ring"))
    half, own, twice, more = ((plan_recipe(name, factor).predicted or {})["cloud"] for factor in (0.5, 1, 2, 4))
    assert own - half > differ
    assert 0 < twice - own < differ  # docs/runs.md: where more megabytes cease to help
    assert more - twice < 0.001
    assert plan_recipe(name, 1, 2).predicted == plan_recipe(name).predicted  # of wireline there is enough
    with pytest.raises(Infeasible, match=r"the least that the limits allow costs 20\.6\d+ MB of wireline"):
        plan_recipe(name, 1, 0.5)


def test_plans_of_the_comparison_of_plans_stay_within_what_the_history_covers() -> None:
    limits, covered = (
        load_run_recipe(RECIPES / "allocation.yaml").limits,
        load_known_history("objects").resources.max(axis=0),
    )
    assert (limits.edge_rounds[1], limits.cloud_rounds[1]) == (None, None)  # rounds: the history's
    assert limits.samples[1] == covered[0]
    for factor, rule in product(BUDGETS, get_args(PlanRule)):
        plan = plan_recipe("allocation", factor, factor, rule)
        counts = (plan.samples, plan.edge_rounds, plan.cloud_rounds)
        assert (np.array(counts) <= covered).all()


@pytest.mark.slow  # a curve for each run and each seed
@pytest.mark.parametrize(  # docs/runs.md, "Histories of the package"
    ("task", "runs", "points", "agreement", "noise", "attainable", "before", "pretrained"),
    [
        ("objects", 10, 190, (0.0199, 0.856), (0.0099, 0.0199), (0.0202, 0.905), (0.1089, -0.661), (0.0507, 0.294)),
        ("weather", 15, 285, (0.0321, 0.939), (0.0203, 0.0248), (0.0289, 0.952), (0.0521, 0.836), (0.0519, 0.934)),
        ("signs", 10, 190, (0.0140, 0.911), (0.0068, 0.0134), (0.0134, 0.937), (0.0207, 0.819), (0.0232, 0.878)),
    ],
)
def test_runs_of_the_package_s_histories_are_predicted_from_the_others(
    task: str,
    runs: int,
    points: int,
    agreement: tuple[float, float],
    noise: tuple[float, float],
    attainable: tuple[float, float],
    before: tuple[float, float],
    pretrained: tuple[float, float],
) -> None:
    found = hold_out_runs(load_known_history(task), partial(fit, model="best", group_samples=(4, 3)))
    assert (found.runs, found.points) == (runs, points)
    assert (found.mean_error, found.rank_correlation) == pytest.approx(agreement, abs=5e-4)
    assert (found.between_runs, found.within_runs) == pytest.approx(noise, abs=5e-5)
    assert (found.attainable_error, found.attainable) == pytest.approx(attainable, abs=5e-4)
    new = found.new_seeds
    assert new is not None
    assert (new.mean_error, new.rank_correlation) == pytest.approx(before, abs=5e-4)
    reached = (new.mean_error_pretrained, new.rank_correlation_pretrained)
    assert reached == pytest.approx(pretrained, abs=5e-4)


def test_a_small_pool_limits_the_samples() -> None:
    assert make_plan((asked(pool=24),), frame(), "joint")[0].tasks["objects"].samples == 24


def test_budgets_below_the_least_plan_are_refused() -> None:
    with pytest.raises(Infeasible, match="wireless"):
        make_plan((asked(),), frame(10.0), "joint")


def test_a_models_size_is_what_flower_sends() -> None:
    weights = to_arrays(second_tiny())
    record = ArrayRecord({name: Array(np.ascontiguousarray(value)) for name, value in weights.items()})
    content = RecordDict({"arrays": record, "metrics": MetricRecord({"num-examples": 12, "loss": 0.345})})
    sent = len(recorddict_to_proto(content).SerializeToString())
    assert model_mb(OBJECTS, "tiny") == pytest.approx(sent / 1e6, rel=1e-4)

    class Echo:
        def train(self, weights, *, steps, learning_rate, seed):
            return LocalUpdate(weights, 12, 0.345)

    book = Ledger(LinkMegabytes(10, 0))
    federate({"v": Echo()}, weights, Schedule(1, 1, 1e-3, 1e-3, 0), Account(book, "edge", "t", "wireless"))
    assert book.used_mb("wireless") == pytest.approx(sent / 1e6, rel=1e-4)


@pytest.mark.parametrize("name", ["objects", "signs", "weather"])
def test_a_history_of_the_package_falls_with_every_resource(name: str) -> None:
    known = load_known_history(name)
    assert len(known.accuracy) >= 6
    problem = make_plan((PlanRequest(name, 1.0, SIZES, 400, known, None),), frame(), "joint")[1]
    assert problem is not None
    curve = problem.tasks[0].curve
    here = float(curve.error(200, 2, 1, 1))
    assert 0 < here < 1
    for more in ((400, 2, 1), (200, 4, 1), (200, 2, 3)):
        assert curve.error(*more, 1) <= here


@pytest.mark.parametrize(("name", "costs"), [("objects", False), ("signs", True), ("weather", False)])
def test_curves_say_what_the_first_cloud_round_did_in_the_histories(name: str, costs: bool) -> None:
    """The mean over runs of what the first cloud round changed, and what all six did, against the curve's."""
    known = load_known_history(name)
    runs, (_, edge, cloud) = np.array(known.runs), known.resources.T

    def change(cloud_rounds: int) -> float:
        changes = []
        for run in np.unique(runs):
            last = (runs == run) & (edge == 12)
            changes.append(known.accuracy[last & (cloud == 0)][0] - known.accuracy[last & (cloud == cloud_rounds)][0])
        return float(np.mean(changes))

    curve = fit(known, model="best", group_samples=(4, 3)).curve
    for rounds in (1, 6):
        foreseen = np.mean(
            [curve.error(x, 12, rounds) - curve.error(x, 12, 0) for x in np.unique(known.resources[:, 0])]
        )
        assert foreseen == pytest.approx(change(rounds), abs=0.02)
    assert (change(1) > 0.02) == costs
    assert (curve.error(80, 12, 1) > curve.error(80, 12, 0)) == costs


def test_points_are_added_once_and_read_again(tmp_path) -> None:
    point = HistoryPoint("t", samples=8, edge_rounds=1, cloud_rounds=0, accuracy=0.5, weight=9, run="a", seed=1)
    for _ in range(2):
        append_records(tmp_path / "history.csv", [point, replace(point, edge_rounds=2, accuracy=0.6)])
    found = parse_history("t", (tmp_path / "history.csv").read_text(), "history.csv")
    assert found.resources.tolist() == [[8, 1, 0], [8, 2, 0]]
    assert json.dumps(found.accuracy.tolist()) == "[0.5, 0.6]"
    assert (found.runs, found.seeds) == (("a", "a"), ("1", "1"))
