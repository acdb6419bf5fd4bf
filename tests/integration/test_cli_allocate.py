"""`flcav allocate` and `flcav fit` from files to JSON."""

import itertools
import json
import re
from pathlib import Path

import pytest
import yaml

from flcav.cli.main import run
from flcav.optimization.allocation import allocate as allocation
from flcav.optimization.allocation import budget_sweep, fleet
from flcav.optimization.allocation.problem_file import TERMS
from flcav.optimization.curves.history import ARTICLE

RECIPES = sorted((Path(__file__).parents[2] / "recipes" / "allocation").glob("*.yaml"))
TASK_KEYS = {"name", "samples", "edge_rounds", "cloud_rounds", "predicted_error", "wireless_mb", "wireline_mb"}


SOLVED: dict[str, fleet.Carried] = {}


@pytest.fixture
def solved_once(monkeypatch):
    """Solve each problem once: the JSON and the text of a command, and its baselines, are of one plan."""
    solve = fleet.allocate_fleet

    def recall(problem):
        asked = problem.model_dump_json()
        if asked not in SOLVED:
            SOLVED[asked] = solve(problem)
        return SOLVED[asked]

    for module in (fleet, budget_sweep):
        monkeypatch.setattr(module, "allocate_fleet", recall)


def called(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stopped:
        run([str(argument) for argument in arguments])
    return int(stopped.value.code or 0)


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda path: path.stem)
def test_every_recipe_gives_a_plan_within_its_budgets(recipe, capsys, solved_once):
    assert called("allocate", recipe, "--json") == 0
    plan, asked = json.loads(capsys.readouterr().out), yaml.safe_load(recipe.read_text())
    assert set(plan) - {"busy_s"} == {
        "status", "objective", "lower_bound", "gap", "tasks", "used_mb", "marginal_error_per_gb", "certificate",
        "savings",
    }  # fmt: skip
    assert ("busy_s" in plan) == ("horizon_s" in asked)
    for task, given in zip(plan["tasks"], asked["tasks"], strict=True):
        assert set(task) == TASK_KEYS | ({"local_steps", "form"} if "forms" in given else set())
    budgets = asked["budgets_mb"]
    for link in ("wireless", "wireline"):
        assert plan["used_mb"][link] <= budgets[link] + 1e-6
        assert plan["used_mb"][link] == pytest.approx(sum(task[f"{link}_mb"] for task in plan["tasks"]))
        assert plan["marginal_error_per_gb"][link] >= 0
    assert called("allocate", recipe) == 0
    assert plan["tasks"][0]["name"] in capsys.readouterr().out


@pytest.mark.slow
def test_a_weighted_error_is_told_with_its_mean(tmp_path, capsys, solved_once):
    values = yaml.safe_load(RECIPES[-1].read_text())
    for task in values["tasks"]:
        task["weight"] = 1
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(values))
    assert called("allocate", tmp_path / "problem.yaml") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert re.search(r"weighted error 0\.\d\d, optimal for the fitted curves \(proven within", told)
    assert called("allocate", tmp_path / "problem.yaml", "--json") == 0
    total = json.loads(capsys.readouterr().out)["objective"]
    assert f"Weighted error: {TERMS['weighted error']} Here they sum to 3, and the mean is {total / 3:#.2g}." in told


@pytest.mark.parametrize("by", [1.0, 1.02])
def test_a_certificate_is_verified_and_one_that_does_not_hold_is_exit_1(by, capsys, monkeypatch):
    prove = allocation._dual
    monkeypatch.setattr(allocation, "_dual", lambda multipliers, bound: prove(multipliers, by * bound))
    assert called("allocate", RECIPES[0], "--verify") == (by > 1)
    told = " ".join(capsys.readouterr().out.split())
    assert ("does not hold: the duals" in told) == (by > 1), told
    assert "trusted: the learning curves" in told
    assert called("allocate", RECIPES[0], "--verify", "--json") == (by > 1)
    assert bool(json.loads(capsys.readouterr().out)["verification"]["faults"]) == (by > 1)


def test_a_graph_is_planned_down_to_its_vehicles(capsys, solved_once):
    graph = RECIPES[0].parents[1] / "graphs" / "three_layers.yaml"
    assert called("allocate", graph, "--json") == 0
    plan = json.loads(capsys.readouterr().out)
    for task in plan["tasks"]:
        assert set(task) == TASK_KEYS | {"vehicles"}
        assert all(set(each) == {"vehicle", "samples", "rounds", "wireless_mb", "busy_s"} for each in task["vehicles"])
        assert sum(each["samples"] for each in task["vehicles"]) == task["samples"]
        assert sum(each["wireless_mb"] for each in task["vehicles"]) <= task["wireless_mb"] + 1e-6
    assert called("allocate", graph) == 0
    assert "car 4" in capsys.readouterr().out


def test_out_is_a_page_that_tells_the_plan(tmp_path, capsys, solved_once):
    assert called("allocate", RECIPES[0], "--json", "--out", tmp_path / "plan.html") == 0
    plan = json.loads(capsys.readouterr().out)
    page = (tmp_path / "plan.html").read_text()
    assert f"{plan['objective']:.4f}" in page
    assert f"<td>{plan['tasks'][0]['samples']:,}</td>" in page


@pytest.mark.slow
def test_links_too_slow_limit_the_plan_until_nothing_can_be_carried(tmp_path, capsys):
    values = yaml.safe_load((RECIPES[0].parents[1] / "graphs" / "three_layers.yaml").read_text())
    errors = []
    for horizon_s in (600, 60):
        (tmp_path / "graph.yaml").write_text(yaml.safe_dump(values | {"horizon_s": horizon_s}))
        assert called("allocate", tmp_path / "graph.yaml", "--json") == 0
        errors.append(json.loads(capsys.readouterr().out)["objective"])
    assert errors[0] < errors[1]
    (tmp_path / "graph.yaml").write_text(yaml.safe_dump(values | {"horizon_s": 20}))
    assert called("allocate", tmp_path / "graph.yaml", "--json") == 2
    answer = json.loads(capsys.readouterr().out)
    assert answer["status"] == "infeasible"
    assert "more than horizon_s = 20" in answer["message"]


def test_infeasible_is_exit_2_a_sentence_and_json(tmp_path, capsys):
    values = yaml.safe_load(RECIPES[0].read_text())
    values["budgets_mb"]["wireless"] = 100
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(values))
    assert called("allocate", tmp_path / "problem.yaml", "--json") == 2
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert answer["status"] == "infeasible"
    assert "60 MB more than budgets_mb.wireless = 100" in answer["message"]
    assert answer["message"] in err


def test_fit_reads_a_history_and_writes_what_allocate_takes(tmp_path, capsys):
    points = {50: 0.659, 200: 0.710, 500: 0.716, 1000: 0.721, 2500: 0.793}
    rows = "".join(f"objects,pretrain,{x},{accuracy}\n" for x, accuracy in points.items())
    (tmp_path / "history.csv").write_text("task,stage,resource,accuracy\n" + rows)
    assert called("fit", tmp_path / "history.csv", "--json") == 0
    (curve,) = json.loads(capsys.readouterr().out)["curves"]
    assert (curve["task"], curve["model"], curve["floor"], curve["points"]) == ("objects", "additive", 0, 5)
    assert curve["pretrain"]["a"] == pytest.approx(0.51, rel=0.03)
    values = yaml.safe_load(RECIPES[0].read_text())
    values["tasks"][0]["curve"] = {key: curve[key] for key in ("model", "floor", "pretrain", "edge", "cloud")}
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(values))
    assert called("allocate", tmp_path / "problem.yaml") == 0


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("task,stage,resource\na,edge,1\n", "accuracy"),
        ("task,stage,resource,accuracy\na,dream,1,0.5\n", "dream"),
        ("task,stage,resource,accuracy\na,edge,1,1.5\n", "accuracy = 1.5"),
        ("task,stage,resource,accuracy\na,edge,nan,0.5\n", "resource"),
        ("task,stage,resource,accuracy\na,edge,1,0.5\n", "at least 2"),
        ("task,stage,resource,accuracy\n", "no rows"),
        ("", "history.csv"),
    ],
)
def test_bad_history_is_one_sentence(text, named, tmp_path, capsys):
    (tmp_path / "history.csv").write_text(text)
    assert called("fit", tmp_path / "history.csv") == 2
    err = capsys.readouterr().err
    assert named in err
    assert err.count("\n") == 1


def test_fit_on_the_articles_points_prints_its_curves_bands_and_warnings(capsys):
    assert called("fit", ARTICLE, "--json", "--at", "9000", "--repeats", "40") == 0
    curves = {curve["task"]: curve for curve in json.loads(capsys.readouterr().out)["curves"]}
    for task, (a, b) in {"weather": (11.84, 1.23), "signs": (8.15, 0.62), "objects": (0.51, 0.10)}.items():
        curve = curves[task]
        assert (curve["pretrain"]["a"], curve["pretrain"]["b"]) == pytest.approx((a, b), rel=0.03)
        assert curve["band"]["method"] == "residual bootstrap"
        assert all(row["low"] <= row["error"] <= row["high"] for row in curve["band"]["at"])
        assert "9000 samples (measured up to 2500)" in curve["asked"][0]["warning"]
    assert called("fit", ARTICLE, "--model", "effective", "--repeats", "20") == 0
    assert "signs" in capsys.readouterr().out


def federated_history() -> str:
    """Return a history in which cloud rounds bring the other of two regions' samples and cost accuracy, k = 2."""
    rows = ["samples,edge_rounds,cloud_rounds,error"]
    for x, y, z in itertools.product((80, 320, 1280), (0, 1, 2, 4, 8), (0, 1, 2, 4)):
        t = y + 2 * z
        n = 0.1 * x + 0.3 * (500 * t / (t + 1) + 0.6 * 500 * z / (z + 1))
        rows.append(f"{x},{y},{z},{1.2 * n**-0.4 + 0.03 * z / (z + 1):.8f}")
    return "\n".join(rows) + "\n"


def test_a_federated_curve_goes_from_a_history_through_the_problem_file_to_a_plan(tmp_path, capsys):
    (tmp_path / "objects.csv").write_text(federated_history())
    asked = ("fit", tmp_path / "objects.csv", "--model", "federated", "-k", "2", "--repeats", "20")
    groups = ("--group-samples", "400", "--group-samples", "600")
    assert called(*asked, *groups, "--json", "--problem", tmp_path / "problem.yaml") == 0
    (curve,) = json.loads(capsys.readouterr().out)["curves"]
    assert curve["group_samples"] == [400, 600]
    assert [curve[name] for name in ("b", "beta", "gamma", "drift")] == pytest.approx([0.4, 0.3, 0.6, 0.03], rel=0.01)
    text = (tmp_path / "problem.yaml").read_text()
    filled = {"{wireless: , wireline: }": "{wireless: 4000, wireline: 4000}", "sample_mb:": "sample_mb: 1"}
    for old, new in (filled | {"model_mb:": "model_mb: 10", "edge_groups:": "edge_groups: [4, 3]"}).items():
        text = text.replace(old, new)
    (tmp_path / "problem.yaml").write_text(text)
    assert called("allocate", tmp_path / "problem.yaml", "--json") == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["status"] == "optimal"
    assert plan["gap"] < 1e-8
    assert called(*asked, *groups) == 0
    assert "t rounds, z cloud" in capsys.readouterr().out
    assert called(*asked) == 2
    assert "--group-samples of each region" in capsys.readouterr().err


def test_numbers_too_different_for_the_solver_are_refused_in_a_sentence(tmp_path, capsys):
    limits = {name: [0, 9] for name in ("edge_rounds", "cloud_rounds")} | {"samples": [40, 400]}
    shared = {"model_mb": 5.0, "limits": limits, "edge_groups": [3]}
    slow = {"model": "additive", "floor": 0.02, "pretrain": {"a": 2.0, "b": 0.4}}
    fast = {"model": "effective", "floor": 0.0, "a": 8.0, "b": 0.6, "alpha": 0.1, "beta": 2**64, "group_samples": 700}
    tasks = [{"name": "slow", "weight": 0.6, "sample_mb": 1.0, "curve": slow} | shared]
    tasks += [{"name": "fast", "weight": 0.4, "sample_mb": 0.5, "curve": fast} | shared]
    problem = {"budgets_mb": {"wireless": 900.0, "wireline": 900.0}, "tasks": tasks}
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(problem))
    assert called("allocate", tmp_path / "problem.yaml", "--baseline", "article") == 2
    said = capsys.readouterr().err
    assert said.startswith("flcav: the solver fails on numbers of such different sizes")
    assert said.count("\n") == 1


@pytest.mark.parametrize("name", ["equal-stages", "equal-tasks", "max-throughput", "article"])
def test_a_baseline_stands_beside_the_optimum(name, capsys, solved_once):
    assert called("allocate", RECIPES[0], "--baseline", name, "--json") == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["baseline"]["name"] == name
    assert plan["baseline"]["objective"] >= plan["lower_bound"]
    assert set(plan["baseline"]["tasks"][0]) == TASK_KEYS


def test_a_plan_goes_on_from_progress(tmp_path, capsys):
    progress = {"tasks": {"objects": {"samples": 700, "edge_rounds": 1, "accuracy": 0.5}}}
    (tmp_path / "progress.yaml").write_text(yaml.safe_dump(progress))
    assert called("allocate", RECIPES[0], "--progress", tmp_path / "progress.yaml", "--json") == 0
    plan = json.loads(capsys.readouterr().out)
    (task,) = plan["tasks"]
    assert task["samples"] == 700
    assert task["edge_rounds"] >= 1
    assert called("replan", RECIPES[0], tmp_path / "progress.yaml", "--json") == 0
    assert json.loads(capsys.readouterr().out) == plan


@pytest.mark.slow
def test_time_to_train_is_kept_and_said(tmp_path, capsys):
    values = yaml.safe_load(RECIPES[0].read_text()) | {"horizon_s": 100}
    limits = {"samples": [100, 400], "edge_rounds": [0, 6], "cloud_rounds": [0, 2]}
    values["tasks"][0] |= {"train_s": 30, "limits": limits}
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(values))
    assert called("allocate", tmp_path / "problem.yaml", "--json", "--out", tmp_path / "plan.html") == 0
    plan = json.loads(capsys.readouterr().out)
    (task,) = plan["tasks"]
    assert plan["busy_s"] == 30 * (task["edge_rounds"] + task["cloud_rounds"]) == 90
    assert called("allocate", tmp_path / "problem.yaml") == 0
    assert "time: 90.0 of 100 s on the busiest vehicle" in capsys.readouterr().out
    values["tasks"][0]["vehicle_train_s"] = {f"car {i}": 20 + 5 * i for i in range(7)}
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(values))
    assert called("allocate", tmp_path / "problem.yaml", "--json", "--out", tmp_path / "named.html") == 0
    named = json.loads(capsys.readouterr().out)
    assert all(each["busy_s"] <= 100 for each in named["tasks"][0]["vehicles"])
    assert "within the 100 s that vehicles may be busy" in (tmp_path / "named.html").read_text()


@pytest.mark.slow
def test_the_area_says_that_it_has_no_certificate(tmp_path, capsys):
    values = yaml.safe_load(RECIPES[-1].read_text()) | {"objective": "area"}
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(values))
    assert called("allocate", tmp_path / "problem.yaml", "--json") == 0
    plan = json.loads(capsys.readouterr().out)
    assert (plan["lower_bound"], plan["gap"]) == (None, None)
    assert "no certificate" in plan["note"]
