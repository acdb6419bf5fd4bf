"""Names that users give are printed as they are."""

from pathlib import Path

import pytest
import yaml

from flcav.cli.main import run
from flcav.cli.steps import live_steps

NAME = "cars [3D] :car:"
RECIPE = Path(__file__).parents[3] / "recipes" / "allocation" / "objects.yaml"


def test_a_task_s_name_is_no_markup(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("COLUMNS", "160")
    problem = yaml.safe_load(RECIPE.read_text())
    problem["tasks"][0]["name"] = NAME
    (tmp_path / "problem.yaml").write_text(yaml.safe_dump(problem))
    rows = ((100, 0.50), (200, 0.60), (400, 0.68), (800, 0.74))
    table = "".join(f"{NAME},{samples},0,0,{accuracy}\n" for samples, accuracy in rows)
    (tmp_path / "history.csv").write_text(f"task,samples,edge_rounds,cloud_rounds,accuracy\n{table}")
    fit = ("fit", tmp_path / "history.csv", "--at", "1000", "--repeats", "20")
    for command, times in ((("allocate", tmp_path / "problem.yaml"), 1), (fit, 2)):
        with pytest.raises(SystemExit) as ended:
            run([str(word) for word in command])
        told = capsys.readouterr()
        assert not ended.value.code, told.err
        assert told.out.count(NAME) >= times


def test_what_a_round_cost_in_privacy_stays_on_the_terminal(capsys: pytest.CaptureFixture[str]):
    with live_steps("run") as notify:
        notify("grid-edge-fl-weather", 1, 6, "loss 0.512")
        notify("grid-edge-fl-weather", 2, 6, "loss 0.480, epsilon 3.21")
        notify("grid-edge-fl-weather", 1, 1, "done")
    assert capsys.readouterr().err.splitlines() == [
        "run: grid-edge-fl-weather, round 2 of 6: loss 0.480, epsilon 3.21",
        "run: grid-edge-fl-weather done",
    ]
