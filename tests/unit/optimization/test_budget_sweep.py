"""What more budget saves, against exhaustive search that shares no code with it."""

import itertools
from pathlib import Path
from typing import Any

import pytest
import yaml
from made_problems import SMALL, parsed, searched, written
from test_fleet import best_carried, fleet, problem

from flcav.cli.main import run
from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.allocation.budget_sweep import compute_savings, sweep_budgets
from flcav.optimization.allocation.fleet import allocate_fleet


def with_more(values: dict[str, Any], link: str, added: float) -> dict[str, Any]:
    budgets = values["budgets_mb"]
    return values | {"budgets_mb": budgets | {link: (1 + added) * budgets[link]}}


@pytest.mark.parametrize(
    ("model", "seed", "objective"), [*itertools.product(("additive", "effective"), range(3), ("weighted", "max-min"))]
)
def test_what_more_of_a_budget_saves_is_what_trying_every_plan_finds(model: str, seed: int, objective: str) -> None:
    values: dict[str, Any] = written(seed, 2, model, SMALL, budget=150.0) | {"objective": objective}
    now = searched(values)
    found = compute_savings(parsed(values), allocate(parsed(values)))
    assert [(each.link, each.added) for each in found] == [
        *(("wireless", added) for added in (0.1, 0.5)),
        *(("wireline", added) for added in (0.1, 0.5)),
    ]
    for each in found:
        best = searched(with_more(values, each.link, each.added))
        assert each.added_mb == pytest.approx(each.added * values["budgets_mb"][each.link])
        assert each.saved == pytest.approx(now - best, abs=1e-9)
        assert each.gap == pytest.approx(0, abs=2e-9)
    assert any(each.saved > 0 for each in found)


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["weighted", "max-min"])
def test_what_more_megabytes_save_is_printed_as_trying_every_plan_finds_it(
    objective: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    values: dict[str, Any] = written(4, 2, "additive", SMALL, budget=150.0) | {"objective": objective}
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(values))
    with pytest.raises(SystemExit) as stopped:
        run(["allocate", str(tmp_path / "problem.yaml"), "--out", str(tmp_path / "plan.html")])
    assert stopped.value.code == 0
    told = capsys.readouterr().out
    page = (tmp_path / "plan.html").read_text()
    now = searched(values)
    for link, added in itertools.product(("wireless", "wireline"), (0.1, 0.5)):
        best = searched(with_more(values, link, added))
        saved = f"saves {now - best:#.2g}" if now - best > 1e-12 else "saves nothing"
        own = told.split(f"\n{link}: ")[1]
        budget = f"{added:.0%} more ({added * values['budgets_mb'][link]:.6g} MB)"
        assert f"  {budget}, solved anew: {saved} (proven within 0.00%)" in own.splitlines()[1:3]
        row = page.split(f"<td>{link}: {added:.0%} more, ")[1].split("</tr>")[0]
        assert f"<td>{best:.4f}</td>" in row
        assert f"<td>{max(now - best, 0):.3g}</td>" in row


def test_links_that_limit_plans_limit_what_more_budget_saves() -> None:
    limits = {"samples": [1, 4], "edge_rounds": [0, 2], "cloud_rounds": [0, 1]}
    asked = problem([{"uplink_mbps": fleet(3, 3, 3), "limits": limits}], horizon_s=12)
    plan, _ = allocate_fleet(asked)
    assert "own links" in (plan.note or "")
    found = [each for each in compute_savings(asked, plan) if each.added == 0.5]
    for each, budgets in zip(found, ({"wireless": 135.0}, {"wireline": 90.0}), strict=True):
        more = asked.model_copy(update={"budgets_mb": asked.budgets_mb.model_copy(update=budgets)})
        assert each.objective == pytest.approx(plan.objective - each.saved)
        assert each.lower_bound is not None
        assert each.lower_bound <= best_carried(more) * (1 + 1e-9) <= each.objective * (1 + 2e-9)
        assert each.objective > allocate(more).objective  # which asks of the links what they do not carry


def test_a_larger_budget_errs_no_more_and_its_own_budget_is_the_plan() -> None:
    asked = parsed(written(1, 1, "additive"))
    plan = allocate(asked)
    sweep = sweep_budgets(asked, plan, factors=(0.5, 1.0, 2.0))
    errors = [point.objective for point in sweep]
    assert errors == sorted(errors, reverse=True)
    assert sweep[1].objective == plan.objective
    assert sweep[2].budgets_mb.wireless_mb == 2 * asked.budgets_mb.wireless
    (alone,) = sweep_budgets(asked, plan, ("wireline",), factors=(2.0,))
    assert alone.budgets_mb.wireless_mb == asked.budgets_mb.wireless
    assert alone.budgets_mb.wireline_mb == 2 * asked.budgets_mb.wireline


def test_budgets_that_allow_no_plan_are_left_out() -> None:
    asked = parsed(written(1, 1, "additive"))
    assert [point.factor for point in sweep_budgets(asked, allocate(asked), factors=(0.01, 1.0))] == [1.0]
