"""Names that users give are printed as they are."""

import re
import string
from pathlib import Path

import click
import pytest
import typer
import yaml

from flcav.cli.federate import _describe, _print_rounds
from flcav.cli.main import app, run
from flcav.cli.options import SHOWN, add_next_steps
from flcav.cli.steps import live_steps
from flcav.runs.engine import WHOLE
from flcav.runs.results.training import FederatedRound, StageResult

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


def test_what_a_round_cost_in_privacy_and_who_failed_stays_on_the_terminal(capsys: pytest.CaptureFixture[str]):
    with live_steps("run") as notify:
        notify("grid-edge-fl-weather", 1, 6, "loss 0.512")
        notify("grid-edge-fl-weather", 2, 6, "loss 0.480, epsilon 3.21")
        notify("grid-edge-fl-weather", 3, 6, "loss 0.460, failed or lost: grid/cav1 (no power)")
        notify("grid-edge-fl-weather", 1, 1, "done")
    assert capsys.readouterr().err.splitlines() == [
        "run: grid-edge-fl-weather, round 2 of 6: loss 0.480, epsilon 3.21",
        "run: grid-edge-fl-weather, round 3 of 6: loss 0.460, failed or lost: grid/cav1 (no power)",
        "run: grid-edge-fl-weather done",
    ]


def test_stage_two_alone_tells_a_round_once_with_who_failed(capsys: pytest.CaptureFixture[str]):
    note = "loss 0.460, failed or lost: grid/cav1 (no power)"
    with live_steps("federate") as notify:
        _print_rounds(notify)("grid-federate-weather", 3, 6, note)
        _print_rounds(notify)("pretrain-weather", 1, 1, "done")
    told = capsys.readouterr()
    assert told.out == f"grid-federate-weather, round 3 of 6: {note}\n"
    assert told.err == "federate: pretrain-weather done\n"


@pytest.mark.parametrize("timed", ["", ", 3.0 s on the network"])
def test_a_federation_s_last_line_names_who_failed_or_was_lost(timed: str):
    failed = ({"ring/cav1": "no power"}, {"ring/cav1": "no power", "ring/cav0": "late"}, {})
    for given, words in ((failed, ", failed or lost: ring/cav1 (no power) in 2, ring/cav0 (late) in 1"), (({},), "")):
        seconds = 3.0 / len(given) if timed else None
        rounds = enumerate(given, start=1)
        records = tuple(FederatedRound("ring", i, (), each, 0, 0.0, 0, 0, None, seconds) for i, each in rounds)
        stage = StageResult("edge", "weather", "ring", len(records), 16, 2, (), records=records)
        rounds = f"{len(records)} round{'s' if len(records) > 1 else ''}"
        assert _describe(stage) == f"weather in ring, {rounds}, 2 vehicles, 16 samples{timed}{words}"


def test_all_steps_and_the_time_left_are_one_bar_of_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    for name, value in {"FORCE_COLOR": "1", "COLUMNS": "120", "TERM": "xterm"}.items():
        monkeypatch.setenv(name, value)
    with live_steps("run") as notify:
        notify(WHOLE, 3, 8, "about 2 minutes left")
    assert "3 of 8 steps, about 2 minutes left" in capsys.readouterr().err
    monkeypatch.delenv("FORCE_COLOR")
    with live_steps("run") as notify:
        notify(WHOLE, 3, 8, "about 2 minutes left")
    assert not capsys.readouterr().err


def _find_command(words: list[str]) -> click.Command:
    command = typer.main.get_command(app)
    for word in words:
        command = getattr(command, "commands", {}).get(word, command)
    return command


FOLLOWED = {
    name: example["next"]
    for section in yaml.safe_load(SHOWN.read_text())
    for name, example in section["commands"].items()
    if "next" in example
}


@pytest.mark.parametrize("name", FOLLOWED)
def test_what_follows_a_command_is_a_command_with_parameters_that_there_are(name: str):
    fields = {field for _, field, _, _ in string.Formatter().parse(FOLLOWED[name]) if field}
    assert fields <= {parameter.name for parameter in _find_command(name.split()).params}
    program, *words = FOLLOWED[name].split()
    following = _find_command(words)
    options = {option for parameter in following.params for option in (*parameter.opts, *parameter.secondary_opts)}
    assert program == "flcav"
    assert following.params
    assert {*re.findall(r"--[a-z-]+", FOLLOWED[name])} <= options


def test_a_terminal_tells_what_follows(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    command = typer.main.get_command(app)
    assert isinstance(command, click.Group)
    add_next_steps(command)
    out = tmp_path / "a town.png"
    command(["towns", "show", "suburb", "--out", str(out)], standalone_mode=False)
    assert capsys.readouterr().err == "next: flcav planner suburb\n"
    for quiet in (["towns", "list", "--json"], ["drive", "--list", "--scenario", "suburb-stalled-clear"]):
        command(quiet, standalone_mode=False)
        assert not capsys.readouterr().err
