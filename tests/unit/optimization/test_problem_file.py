"""Fitted curves put into problem files: the curves get there, and what the user wrote stays."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from flcav.cli.main import run
from flcav.config import InputError, parse_config
from flcav.optimization.allocation.allocate import allocate
from flcav.optimization.allocation.problem_file import (
    FittedFields,
    collect_fitted_fields,
    format_problem,
    insert_curves,
)
from flcav.optimization.curves.bands import bootstrap_bands, fit_lower_curve, fit_upper_curve
from flcav.optimization.curves.curves import Additive, Decay, Effective
from flcav.optimization.curves.fitting import fit, fit_additive
from flcav.optimization.curves.history import parse_histories
from flcav.optimization.graph import load_problem
from flcav.optimization.problem import Problem

RECIPES = Path(__file__).parents[3] / "recipes"
CURVE = Additive(floor=0.01, pretrain=Decay(a=0.7123456789, b=0.25), edge=Decay(a=2e-5, b=0.5, x0=1))
UPPER = CURVE.model_copy(update={"floor": 0.02})
LIMITS = {"samples": [50, 800], "edge_rounds": [0, 8], "cloud_rounds": [0, 0]}
OWN = FittedFields(CURVE, UPPER, LIMITS, {"samples": 800.0, "edge_rounds": 8.0})
EFFECTIVE = Effective(model="effective", a=1.5, b=0.4, alpha=0.1, beta=0.3, group_samples=700)
WRITTEN = {
    "limits": LIMITS,
    "curve": {
        "model": "additive", "floor": 0.01, "pretrain": {"a": 0.712346, "b": 0.25},
        "edge": {"a": 2e-5, "b": 0.5, "x0": 1},
    },
    "measured": {"samples": 800, "edge_rounds": 8},
}  # fmt: skip
WRITTEN["upper"] = WRITTEN["curve"] | {"floor": 0.02}

BLOCK = """\
# mine
budgets_mb: {wireless: 4000, wireline: 2000} # both
tasks:
  - sample_mb: 1.6 # of a sweep
    name: objects
    curve: # an old one
      model: additive
      pretrain:
        a: 0.5
        b: 0.1

    # between
    model_mb: 60
    edge_groups: [4, 3] # vehicles
  # after
  - {name: signs, sample_mb: 0.7, model_mb: 14, edge_groups: [4, 3], }
horizon_s: 900
"""


def test_what_the_user_wrote_stays_and_the_curves_get_there() -> None:
    text = insert_curves(BLOCK, {"objects": OWN, "signs": OWN}, 1, "p.yaml")
    for comment in ("# mine", "# both", "# of a sweep", "# between", "# vehicles", "# after"):
        assert comment in text
    before, after = yaml.safe_load(BLOCK), yaml.safe_load(text)
    assert after == before | {"tasks": [task | WRITTEN for task in before["tasks"]]}
    assert insert_curves(text, {"objects": OWN, "signs": OWN}, 1, "p.yaml") == text


def test_limits_stand_and_a_band_of_older_points_does_not() -> None:
    given = (
        "budgets_mb: {wireless: 1, wireline: 1}\ntasks:\n- name: a\n  limits: {samples: [1, 2]}\n  upper: {floor: 1}"
    )
    text = insert_curves(given, {"a": FittedFields(CURVE, None, LIMITS, {})}, 1, "p.yaml")
    (task,) = yaml.safe_load(text)["tasks"]
    assert task["limits"] == {"samples": [1, 2]}
    assert task["upper"] is None
    assert task["curve"] == WRITTEN["curve"]


@pytest.mark.parametrize(
    "recipe", sorted(set(RECIPES.glob("*/*.yaml")) - set(RECIPES.glob("runs/*"))), ids=lambda path: path.stem
)
def test_every_problem_of_the_recipes_takes_curves(recipe: Path, tmp_path: Path) -> None:
    tasks = yaml.safe_load(recipe.read_text()).get("tasks")
    if tasks is None:
        pytest.skip("no allocation problem")
    if isinstance(tasks, dict) and isinstance(tasks["objects"].get("network"), list):
        with pytest.raises(InputError, match=r"p\.yaml: task 'objects' has 3 networks, and a curve is of one of them"):
            insert_curves(recipe.read_text(), {"objects": OWN}, 1, "p.yaml")
        return
    text = insert_curves(recipe.read_text(), {"objects": OWN}, 1, "p.yaml")
    (tmp_path / "problem.yaml").write_text(text)
    found = {task.name: task.curve for task in load_problem(tmp_path / "problem.yaml").tasks}["objects"]
    assert isinstance(found, Additive)
    assert found.pretrain.a == pytest.approx(CURVE.pretrain.a, rel=1e-5)
    kept = [line for line in recipe.read_text().splitlines() if "objects" not in line and "curve" not in line]
    gone = ("model: additive", "floor: 0.05", "pretrain:", "edge: {", "cloud: {")
    assert all(line in text.splitlines() for line in kept if not line.strip().startswith(gone))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("budgets_mb: {wireless: 1, wireline: 1}\n", "has no tasks"),
        ("tasks: 3\n", "has no tasks"),
        ("- 1\n", "has no tasks"),
        ("", "has no tasks"),
        ("tasks: {1: {curve: 2}}\n", "task 'objects', which is none of"),
        ("tasks: [{name: cars}, {name: signs}]\n", "task 'objects', which is none of cars, signs"),
        ("tasks:\n- &t {name: cars}\n- *t\n", "aliases"),
        ("tasks:\n- name: objects\n  ? curve\n  : 1\n", "laid out"),
    ],
)
def test_what_cannot_take_curves_is_refused_in_a_sentence(text: str, named: str) -> None:
    with pytest.raises(InputError, match=named):
        insert_curves(text, {"objects": OWN}, 1, "p.yaml")


def test_effective_samples_are_of_one_number_of_edge_rounds_per_cloud_round() -> None:
    own = FittedFields(EFFECTIVE, None, LIMITS, {})
    text = "edge_rounds_per_cloud_round: 2\ntasks: [{name: a}]\n"
    assert yaml.safe_load(insert_curves(text, {"a": own}, 2, "p.yaml"))["tasks"][0]["curve"]["beta"] == 0.3
    with pytest.raises(InputError, match="edge_rounds_per_cloud_round = 2, and the curves are fitted with 1"):
        insert_curves(text, {"a": own}, 1, "p.yaml")


def test_a_new_problem_says_what_is_missing_and_is_one_once_it_is_there(tmp_path: Path) -> None:
    path = tmp_path / "problem.yaml"
    path.write_text(format_problem({"a: #1": OWN, "b": OWN}, 1, "history.csv"))
    with pytest.raises(InputError, match=r"'budgets_mb.wireless' is empty \(and 7 more\)"):
        load_problem(path)
    filled = path.read_text().replace("wireless: , wireline: ", "wireless: 4000, wireline: 4000")
    for field, value in (("sample_mb", "1.6"), ("model_mb", "60"), ("edge_groups", "[4, 3]")):
        filled = filled.replace(f"{field}:", f"{field}: {value}")
    path.write_text(filled)
    found = load_problem(path)
    assert [task.name for task in found.tasks] == ["a: #1", "b"]
    assert found.tasks[0].limits.samples == (50, 800)
    assert allocate(found).warnings == ()


def test_limits_are_what_the_history_covers() -> None:
    x = np.array([20.0, 100, 500, 500.5, 2000.9])
    zero = np.zeros_like(x)
    fit = fit_additive(x, zero + 3, zero, 1 - 0.9 * x**-0.3)
    found = collect_fitted_fields(fit, np.column_stack((x, zero + 3, zero)), None)
    assert found.limits == {"samples": [20, 2000], "edge_rounds": [3, 3], "cloud_rounds": [0, 0]}
    assert found.measured == {"samples": 2000.9}


def test_a_plan_from_the_file_is_that_of_the_curves_that_fit_prints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    rows = [f"{x},{y},0,{0.9 * x**-0.3 + 0.2 * (y + 1) ** -0.5 + rng.normal(0, 0.002):.4f}" for x, y in
            ((50, 0), (200, 0), (1000, 0), (1000, 1), (1000, 2), (1000, 4), (1000, 8))]  # fmt: skip
    (tmp_path / "runs.csv").write_text("samples,edge_rounds,cloud_rounds,error\n" + "\n".join(rows))
    path = tmp_path / "problem.yaml"
    path.write_text((RECIPES / "allocation" / "objects.yaml").read_text())
    asked = ["fit", str(tmp_path / "runs.csv"), "--problem", str(path), "--repeats", "20", "--json"]
    with pytest.raises(SystemExit) as stopped:
        run(asked)
    assert stopped.value.code == 0
    (curve,) = json.loads(capsys.readouterr().out)["curves"]
    problem = load_problem(path)
    own = Additive.model_validate({name: curve[name] for name in ("model", "floor", "pretrain", "edge", "cloud")})
    task = problem.tasks[0].model_copy(update={"curve": own})
    (planned,), (expected,) = allocate(problem).tasks, allocate(problem.model_copy(update={"tasks": (task,)})).tasks
    assert planned.predicted_error == pytest.approx(expected.predicted_error, rel=1e-5)
    assert planned.samples == pytest.approx(expected.samples, rel=0.01)
    assert problem.tasks[0].upper is not None


def test_a_problem_that_cannot_take_the_curves_stays_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "runs.csv").write_text("task,samples,edge_rounds,cloud_rounds,error\na,1,0,0,.5\na,9,0,0,.4\n")
    for name, text in (("p.yaml", BLOCK), ("p.json", "{}"), ("q.yaml", "{")):
        (tmp_path / name).write_text(text)
        with pytest.raises(SystemExit) as stopped:
            run(["fit", str(tmp_path / "runs.csv"), "--problem", str(tmp_path / name)])
        out, err = capsys.readouterr()
        assert (stopped.value.code, out, err.count("\n")) == (2, "", 1)
        assert (tmp_path / name).read_text() == text


def test_a_plan_has_the_band_of_its_accuracy_and_says_what_its_history_lacks() -> None:
    samples = np.array([10.0, 20, 40, 80, 160, 320])
    columns = {"samples": samples.tolist(), "accuracy": [0.42, 0.55, 0.63, 0.70, 0.74, 0.78]}
    history = parse_histories(columns, "curve.csv", "curve")["curve"]
    found = fit(history)
    band = bootstrap_bands(found)
    assert band is not None
    own = collect_fitted_fields(found, history.resources, fit_upper_curve(found, band), fit_lower_curve(found, band))
    text = format_problem({"curve": own}, 1, "curve.csv").replace(
        "wireless: , wireline: ", "wireless: 300, wireline: 90"
    )
    for field, value in (("sample_mb", "1.2"), ("model_mb", "3"), ("edge_groups", "[3, 3]")):
        text = text.replace(f"{field}:", f"{field}: {value}")
    problem = parse_config(Problem, yaml.safe_load(text), "problem")
    plan = allocate(problem)
    (task,) = plan.tasks
    assert task.samples == 75
    low, high = (float(edge[0]) for edge in band.between(np.array([[75.0, 0, 0]])))
    assert task.accuracy_low is not None
    assert task.accuracy_high is not None
    assert task.accuracy_low == pytest.approx(1 - high, abs=0.01)
    assert task.accuracy_high == pytest.approx(1 - low, abs=0.01)
    assert task.accuracy_low < 1 - task.predicted_error < task.accuracy_high
    assert task.describe_accuracy() == f"{1 - task.predicted_error:.2f} ({1 - high:.2f} to {1 - low:.2f})"
    assert plan.warnings == (
        "task 'curve': 0 edge rounds, as the history of its curve has none: what they bring is not known",
    )
