"""Tasks per scenario: more where it is complex, never fewer, and a run recipe that a run takes."""

import json
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.odd.scenario_tasks import ORDER, Complexity, count_tasks, generate_tasks, make_run, saturate, town_of
from flcav.runs.recipe import load_run_recipe

SHARE = st.floats(0, 0.999)


@given(st.lists(SHARE, min_size=4, max_size=4), st.integers(0, 3), SHARE)
def test_the_number_of_tasks_falls_in_no_component(shares: list[float], which: int, more: float):
    raised = [max(value, more) if number == which else value for number, value in enumerate(shares)]
    assert 1 <= count_tasks(Complexity(*shares)) <= count_tasks(Complexity(*raised)) <= len(ORDER)


def test_all_numbers_of_tasks_occur():
    assert [count_tasks(Complexity(*[total] * 4)) for total in (0.0, 0.2, 0.35, 0.5)] == [1, 2, 3, 4]
    assert saturate(0.0, 5.0) == 0.0
    assert saturate(5.0, 5.0) == 0.5


def test_errors_of_a_network_raise_the_complexity_of_where_they_are(drive: Dataset):
    plain = {each.kind: each for each in generate_tasks(drive.folder)}
    scene = drive.keys[0].scene
    x, y = drive.world_from_agent(0)[:2, 3]
    kind = next(name for name in plain if name in _kind_at(drive, 0))
    with_errors = {each.kind: each for each in generate_tasks(drive.folder, [(scene, x, y)] * 9)}
    assert with_errors[kind].complexity.errors > plain[kind].complexity.errors == 0.0
    assert {name: each for name, each in with_errors.items() if name != kind} == {
        name: each for name, each in plain.items() if name != kind
    }
    elsewhere = generate_tasks(drive.folder, [("another-scene", x, y)] * 9)
    assert {each.kind: each for each in elsewhere} == plain


def _kind_at(drive: Dataset, i: int) -> list[str]:
    from flcav.odd.measure import measure_domain

    measured = measure_domain(drive)
    return [str(measured.columns["junction"][measured.frames.index(i)])]


def test_complexity_is_of_the_recording(drive: Dataset):
    found = generate_tasks(drive.folder)
    assert sum(each.frames for each in found) == len(drive)
    for each in found:
        assert each.complexity.conflicts == pytest.approx(
            {"none": 0.0, "t_junction": 9 / 41, "crossroad": 0.5, "roundabout": 0.2}[each.kind]
        )
        assert 0 < each.complexity.occlusion < 1
        assert {task.labels for task in each.tasks} <= {"road", "future", "annotated"}


def test_the_run_recipe_is_one_of_the_pipeline(drive: Dataset, tmp_path: Path):
    with pytest.raises(SystemExit) as ended:
        run(["odd", "tasks", "--data", str(drive.folder), "--out", str(tmp_path / "run.yaml"), "--wireless", "90"])
    assert ended.value.code == 0
    recipe = load_run_recipe(tmp_path / "run.yaml")
    assert recipe.with_role("federate") == ("ring",)
    assert recipe.budgets_mb.wireless == 90
    scenarios = generate_tasks(drive.folder)
    for name, task in recipe.tasks.items():
        share = sum(any(each.task == name for each in one.tasks) for one in scenarios) / len(scenarios)
        assert task.weight == pytest.approx(share, abs=1e-4)
    assert yaml.safe_load((tmp_path / "run.yaml").read_text())["regions"]["suburb"]["role"] == "pretrain"


def test_the_command_counts_the_errors_of_a_table(drive: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    x, y = drive.world_from_agent(0)[:2, 3]
    table = tmp_path / "errors.csv"
    table.write_text(f"x,y,z,scene\n{x},{y},1,{drive.keys[0].scene}\n")
    command = ["odd", "tasks", "--data", str(drive.folder), "--out", str(tmp_path / "run.yaml"), "--json"]
    with pytest.raises(SystemExit) as ended:
        run([*command, "--errors", str(table)])
    assert ended.value.code == 0
    found = json.loads(capsys.readouterr().out)["scenarios"]
    assert [each["complexity"]["errors"] > 0 for each in found].count(True) == 1
    table.write_text(f"x,y\n{x},{y}\n")
    with pytest.raises(SystemExit) as ended:
        run([*command, "--errors", str(table)])
    assert ended.value.code == 2
    assert "column 'scene' is missing" in capsys.readouterr().err


def test_a_run_needs_a_town_that_federates(drive: Dataset):
    with pytest.raises(InputError, match="no other town is recorded"):
        make_run(generate_tasks(drive.folder), {"ring": town_of(drive.folder)}, "ring", 10.0, 10.0)
