import pytest
from flcav.experiments.planning import fixed_plan, history_fit, problem_for, update_mb
from flcav.experiments.protocol import Protocol

from flcav.config import parse_config
from flcav.federation.runtimes.metered import Account
from flcav.federation.stages import Schedule, federate
from flcav.federation.trainable import LocalUpdate
from flcav.network.ledger import Budget, Ledger
from flcav.network.plan import MessageSizes, StagePlan, price
from flcav.optimization.allocation import Infeasible, TaskPlan, allocate
from flcav.optimization.curves import Additive, Decay
from flcav.optimization.learning_curve import Fit
from flcav.optimization.problem import Problem
from flcav.perception.objects.model import second_tiny
from flcav.perception.weights import to_arrays

CURVE = Additive(pretrain=Decay(a=2.0, b=0.3), edge=Decay(a=0.2, b=0.7, x0=1), cloud=Decay(a=0.1, b=0.7, x0=1))
FIT = Fit(CURVE, 0.0, 20, 0.0)
SIZES = MessageSizes(sample_mb=0.4, model_mb=1.4)
SETTING = Protocol(wireless_mb=90, wireline_mb=60, max_rounds=(12, 6))


def planned(setting: Protocol, samples: int = 400) -> TaskPlan:
    problem = problem_for(setting, SIZES.sample_mb, SIZES.model_mb, samples, FIT)
    return allocate(parse_config(Problem, problem, "test")).tasks[0]


def test_the_plans_price_leaves_the_headroom():
    plan, vehicles = planned(SETTING), tuple(SETTING.vehicles.values())
    cost = price(StagePlan(plan.samples, plan.edge_rounds, plan.cloud_rounds, vehicles), SIZES)
    assert (plan.wireless_mb, plan.wireline_mb) == pytest.approx((cost.wireless_mb, cost.wireline_mb))
    assert cost.wireless_mb <= 0.98 * SETTING.wireless_mb
    assert cost.wireline_mb <= 0.98 * SETTING.wireline_mb


@pytest.mark.parametrize("seed", [1, 2])
def test_both_budgets_bind(seed: int):
    setting = SETTING.model_copy(update={"seed": seed})
    plan = planned(setting)
    for link in ("wireless_mb", "wireline_mb"):
        doubled = planned(setting.model_copy(update={link: 2 * getattr(setting, link)}))
        assert doubled.predicted_error <= plan.predicted_error
    doubled = planned(setting.model_copy(update={"wireless_mb": 180.0, "wireline_mb": 120.0}))
    counts = ("samples", "edge_rounds", "cloud_rounds")
    assert all(getattr(doubled, name) >= getattr(plan, name) for name in counts)
    assert any(getattr(doubled, name) > getattr(plan, name) for name in counts)


def test_a_small_pool_limits_the_samples():
    assert planned(SETTING, samples=24).samples == 24


def test_budgets_below_the_least_plan_are_refused():
    with pytest.raises(Infeasible, match="wireless"):
        planned(SETTING.model_copy(update={"wireless_mb": 10.0}))


def test_the_dry_run_weighs_what_a_vehicle_sends():
    class Echo:
        def train(self, weights, *, steps, learning_rate, seed):
            return LocalUpdate(weights, 12, 0.345)

    book = Ledger(Budget(10, 0))
    federate(
        {"v": Echo()}, to_arrays(second_tiny()), Schedule(1, 1, 1e-3, 1e-3, 0), Account(book, "edge", "t", "wireless")
    )
    assert book.used_mb("wireless") == pytest.approx(update_mb(), rel=1e-4)


def test_the_committed_history_is_fitted_and_falls_with_every_resource():
    fit = history_fit()
    assert fit.points >= 6
    here = fit.curve.error(200, 2, 1)
    assert 0 < float(here) < 1
    for more in ((400, 2, 1), (200, 4, 1), (200, 2, 3)):
        assert fit.curve.error(*more) <= here


def test_a_plan_by_hand_has_the_form_of_a_plan(tmp_path):
    assert fixed_plan(None, 80, 2, 1)["tasks"][0] == {"samples": 80, "edge_rounds": 2, "cloud_rounds": 1}  # type: ignore[arg-type]
