"""A user's own experiment, a folder anywhere, is repeated and tabulated as those that come with flcav are."""

import json
import sys
from pathlib import Path

import pytest
from reproduction_pages import main as fill_pages

from flcav.cli.main import run
from flcav.config import InputError
from flcav.experiments import list_experiments
from flcav.experiments.experiment import load_experiment

SCRIPT = """
from dataclasses import dataclass
from pathlib import Path

from flcav.experiments.experiment import Experiment, Options, Outcome
from flcav.runs.engine import Step, Work, run_steps
from flcav.storage.markdown import format_table


@dataclass(frozen=True)
class Squares:
    squares: tuple[int, ...]


def square(work: Work, *, seed: int) -> int:
    return seed * seed


def _run(out: Path, options: Options) -> Outcome[Squares]:
    steps = [Step(f"seed{seed}", square, {"seed": seed}) for seed in range(1, options.seeds + 1)]
    with options.show_steps(options.title) as notify:
        values = run_steps(steps, out, **options.how(notify))
    return Outcome(Squares(tuple(values[step.name] for step in steps)), {"dot.png": b"PNG"}, ["squared"])


def tables(results: Squares) -> dict[str, str]:
    return {"squares": format_table(("n",), [[each] for each in results.squares])}


EXPERIMENT = Experiment(Squares, _run, tables)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(sys, "path", [*sys.path])
    own = tmp_path / "squares_of_seeds"
    own.mkdir()
    (own / "run.py").write_text(SCRIPT)
    (own / "README.md").write_text("<!-- squares -->\n<!-- end -->\n")
    return own


@pytest.mark.slow
def test_a_folder_of_ones_own_is_run_in_processes_and_fills_its_page(folder: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as ended:
        run(["reproduce", str(folder), "--seeds", "3", "--jobs", "2", "--out", str(folder / "out")])
    assert not ended.value.code
    assert "squared" in capsys.readouterr().out
    assert json.loads((folder / "out/result.json").read_text()) == {"squares": [1, 4, 9]}
    assert (folder / "out/dot.png").read_bytes() == b"PNG"
    (folder / "out/result.json").rename(folder / "result.json")
    fill_pages([str(folder)])
    assert (folder / "README.md").read_text() == "<!-- squares -->\n| n |\n|---|\n| 1 |\n| 4 |\n| 9 |\n<!-- end -->\n"


def test_what_is_no_experiment_is_refused_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    for name, script, said in (
        ("own_bare", "", "has no EXPERIMENT"),
        ("own_broken", "import nothing_there", "cannot be imported .ModuleNotFoundError"),
        ("json", "", "cannot be imported|is installed"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.py").write_text(script)
        with pytest.raises(InputError, match=said):
            load_experiment(str(tmp_path / name))
    with pytest.raises(InputError, match=r"nor one of .*fig3a"):
        load_experiment("fig3")


def test_each_experiment_of_the_checkout_is_found_by_its_folder_and_by_its_name():
    root = Path(__file__).parents[3] / "reproductions"
    folders = [path.parent for path in root.rglob("run.py")]
    assert len(folders) == len(list_experiments()) > 30
    found = load_experiment(str(root / "federation" / "groups"))
    assert found is load_experiment("federation-groups")


def test_results_of_another_recipe_are_refused_by_its_name() -> None:
    experiment = load_experiment("gap")
    path = list_experiments()["gap"] / "result.json"
    held = json.loads(path.read_text())
    assert "differences" in experiment.tabulate(held, "result.json")
    steps = held["recipe"]["training"]["steps"]
    held["recipe"]["training"]["steps"] = 7
    with pytest.raises(
        InputError, match=rf"result\.json: of another recipe than recipes/runs/gap\.yaml, .*{steps}, and not 7"
    ):
        experiment.tabulate(held, "result.json")
    del held["recipe"]
    with pytest.raises(InputError, match="of another recipe than recipes/runs/gap"):
        experiment.tabulate(held, "result.json")
