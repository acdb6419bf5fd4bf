"""Plans of runs with groups on request: the number of vehicles is the plan's, of its own arms alone, and is kept."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flcav.config import parse_config
from flcav.network.ledger import LinkMegabytes
from flcav.network.plan import MessageSizes, StagePlan, price
from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.curves.history import History
from flcav.optimization.problem import Problem
from flcav.optimization.verification.allocation import verify_allocation
from flcav.runs.allocation import PlanRequest, PlanSettings, make_plan, remake_plan
from flcav.runs.arms import Names, resolve_settings
from flcav.runs.extras.groups.choosing import choose_members
from flcav.runs.extras.groups.settings import Requests
from flcav.runs.recipe import PlanLimits, RunRecipe
from flcav.runs.tables import parse_history, read_history

SIZES = MessageSizes(sample_mb=0.4, model_mb=1.4)
LIMITS = PlanLimits(edge_rounds=(1, 12), cloud_rounds=(0, 6))
FRAME = PlanSettings(LinkMegabytes(90.0, 60.0), 0.02, LIMITS, (8, 6), 1, (320, 240), called=(1, 8), overlap=0.5)


def history() -> History:
    counts = np.array([(s, e, c) for s in (80, 160, 320) for e in (0, 2, 6) for c in (0, 1, 3)], dtype=float)
    samples, edge, cloud = counts.T
    known = 0.1 * samples + 0.5 * (280 * (1 - 1 / (edge + cloud + 1)) + 0.5 * 280 * (1 - 1 / (cloud + 1)))
    return History(counts, 1 - 2.0 * known**-0.4, np.ones(len(counts)))


REQUEST = PlanRequest("objects", 1.0, SIZES, 400, history(), None)


def test_a_run_s_plan_decides_how_many_vehicles_are_called_and_pays_for_them() -> None:
    plan, problem = make_plan((REQUEST,), FRAME, "joint")
    own = plan.tasks["objects"]
    assert problem is not None
    assert own.called is not None
    assert 1 <= own.called < 8
    counts = (own.samples, own.edge_rounds, own.cloud_rounds)
    paid = price(StagePlan(*counts, (8, 6), called=own.called), SIZES)
    assert (own.wireless_mb, own.wireline_mb) == pytest.approx((paid.wireless_mb, paid.wireline_mb))
    assert own.wireless_mb <= 0.98 * 90
    all_of_them, _ = make_plan((REQUEST,), replace(FRAME, called=(8, 8)), "joint")
    assert own.predicted is not None
    assert all_of_them.tasks["objects"].predicted is not None
    assert own.predicted["cloud"] > all_of_them.tasks["objects"].predicted["cloud"]
    assert parse_config(Problem, json.loads(problem.model_dump_json()), "problem.json") == problem
    told = json.loads(json.dumps(allocate(problem), default=vars))
    told = {**told, **{each: {k.removesuffix("_mb"): v for k, v in told[each].items()} for each in ("used_mb",)}}
    assert not verify_allocation(problem.model_dump_json(), json.dumps(told)).faults


def test_a_fixed_roster_has_all_vehicles() -> None:
    plan, _ = make_plan((REQUEST,), replace(FRAME, called=None), "joint")
    assert plan.tasks["objects"].called is None
    assert '"called"' not in json.dumps(plan.as_json())


def test_unspent_bytes_of_a_group_that_dissolved_buy_cloud_rounds() -> None:
    frame = replace(FRAME, limits=PlanLimits(edge_rounds=(4, 12), cloud_rounds=(0, 20)), called=(4, 4))
    plan, problem = make_plan((REQUEST,), frame, "joint")
    assert problem is not None
    own = plan.tasks["objects"]
    samples, group = own.samples * 0.4, sum(min(own.called or 8, size) for size in (8, 6))
    reached = {"objects": 0.8}

    def rest(rounds: int) -> int:
        sent = LinkMegabytes(samples + rounds * group * 1.4, samples)
        after = remake_plan(plan, problem, "edge", reached, sent).tasks["objects"]
        assert (after.called, after.edge_rounds) == (own.called, own.edge_rounds)
        return after.cloud_rounds

    dissolved, whole = rest(2), rest(own.edge_rounds)
    saved = (own.edge_rounds - 2) * group * 1.4
    assert dissolved - whole == pytest.approx(saved / (14 * 1.4), abs=1)
    assert dissolved > whole


def test_an_arm_with_groups_has_a_plan_of_its_own_and_a_group_no_more_members() -> None:
    recipe = RunRecipe.model_validate(
        {
            "tasks": {"objects": {"history": "objects"}},
            "regions": {"suburb": {"role": "pretrain"}, "grid": {"role": "federate", "vehicles": 4}},
            "budgets_mb": {"wireless": 100, "wireline": 80},
            "arms": {
                "group": {"federation": {"requests": {"most": 3}}},
                "equal": {"federation": {"requests": {}}, "plan": "equal-stages"},
            },
        }
    )
    settings = resolve_settings(recipe)
    assert [settings[name].calls for name in ("main", "group", "equal")] == [None, (1, 3, 0.0), None]
    assert [settings[name].replanned for name in ("main", "group")] == [True, False]
    names = Names(settings)
    assert (names.plan("main"), names.plan("group"), names.plan("equal")) == ("plan", "plan-group", "plan-equal")
    quality = {"a": 0.4, "b": 0.9, "c": 1.0}
    assert choose_members(Requests(), ["a"], quality, {}, 2).members == ("a", "c")
    assert choose_members(Requests(most=3), ["a"], quality, {}, 1).members == ("a",)


@pytest.mark.parametrize(("overlap", "called"), [(0.0, 3), (0.3, 2), (0.6, 1)])
def test_by_the_package_s_history_fewer_are_called_the_more_their_data_overlap(overlap: float, called: int) -> None:
    """As docs/groups.md has it."""
    tracks = parse_history("objects", read_history("objects", "tracks", Path()), "objects")
    about = (LinkMegabytes(40, 40), 0.02, PlanLimits(), (4, 3), 1, (320, 240))
    frame = PlanSettings(*about, called=(1, 4), overlap=overlap)
    asked = PlanRequest("objects", 1.0, MessageSizes(0.52, 0.83), 320, tracks, None)
    assert make_plan((asked,), frame, "joint")[0].tasks["objects"].called == called
