"""Every plan and placement that these tests make is verified, with no code of the solvers."""

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from functools import wraps
from typing import Any

import numpy as np
import pytest

from flcav.optimization.allocation import allocate as allocation
from flcav.optimization.allocation import fleet
from flcav.optimization.allocation.allocate import Allocation
from flcav.optimization.placement import cheapest, solve
from flcav.optimization.placement.instance import UNIT
from flcav.optimization.placement.solve import Candidates
from flcav.optimization.problem import Problem
from flcav.optimization.verification.allocation import verify_allocation
from flcav.optimization.verification.placement import PlacementProblem, verify_placement


def check_plan(problem: Problem, plan: Allocation, optimal: float) -> None:
    found = verify_allocation(problem.model_dump_json(), json.dumps(asdict(plan)), optimal)
    assert not found.faults, (found, plan)


def _verified_plan(solve: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(solve)
    def solve_and_verify(problem: Problem, *, gap: float = 1e-4, clocks: Any = ()) -> Allocation:
        plan = solve(problem, gap=gap, clocks=clocks)
        if not clocks:  # of vehicles with names, which the problem does not tell
            held = {"samples_held": {}}  # not limits of this function
            tasks = tuple(task.model_copy(update=held) for task in problem.tasks)
            check_plan(problem.model_copy(update={"tasks": tasks}), plan, gap)
        return plan

    return solve_and_verify


def _verified_fleet(solve: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(solve)
    def solve_and_verify(problem: Problem) -> Any:
        plan, shares = solve(problem)
        check_plan(problem, plan, 1e-4)
        return plan, shares

    return solve_and_verify


ASKED: dict[int, PlacementProblem] = {}  # by the candidates' coverage
KEPT: list[Any] = []  # which are not collected, so that no other has the same id


def _remembered(find: Callable[..., Candidates]) -> Callable[..., Candidates]:
    @wraps(find)
    def find_and_remember(errors: Any, poles: Any, ranges_m: Any, **given: Any) -> Candidates:
        found = find(errors, poles, ranges_m, **given)
        arrays = (np.asarray(each, np.float64) for each in (errors, poles, ranges_m))
        places, sites, ranges = arrays
        visible = None if given.get("visible") is None else given["visible"].toarray() > 0
        ASKED[id(found.covers)] = PlacementProblem(places, found.weight, sites, ranges, np.zeros(0), visible=visible)
        KEPT.append(found.covers)
        return found

    return find_and_remember


def _verified_placement(name: str, place: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(place)
    def place_and_verify(candidates: Candidates, limit: Any, **how: Any) -> Any:
        found = place(candidates, limit, **how)
        placed, least = found if name == "cover" else (found, None)
        by_range = np.array([each * UNIT for each in candidates.price]).reshape(candidates.poles, candidates.sensors)
        asked = replace(ASKED[id(candidates.covers)], cost=by_range[:, np.argsort(candidates.order)], **{name: limit})
        checked = verify_placement(asked, json.dumps(asdict(placed)), least)
        assert not checked.faults, (checked, placed)
        return found

    return place_and_verify


WRAPPED = (
    (solve.find_candidates, _remembered(solve.find_candidates)),
    (solve.place_count, _verified_placement("count", solve.place_count)),
    (solve.place_budget, _verified_placement("budget", solve.place_budget)),
    (cheapest.cover_share, _verified_placement("cover", cheapest.cover_share)),
    (allocation.allocate, _verified_plan(allocation.allocate)),
    (fleet.allocate_fleet, _verified_fleet(fleet.allocate_fleet)),
)


@pytest.fixture(scope="module", autouse=True)
def _verify_all() -> Iterator[None]:
    """Put functions that also verify in the place of the solvers, wherever these tests and the package know them."""
    modules = [sys.modules[name] for name in sys.modules if name.startswith(("flcav.optimization", "test_"))]
    with pytest.MonkeyPatch.context() as patch:
        for module in modules:
            for name, value in list(vars(module).items()):
                for solver, verified in WRAPPED:
                    if value is solver:
                        patch.setattr(module, name, verified)
        yield
