"""Tasks and strategies of a user's own, named as module:NAME."""

import dataclasses
import sys
from pathlib import Path

import pytest

from flcav.cli.main import run
from flcav.config import InputError
from flcav.federation.strategies import STRATEGIES, FedAvg, strategy_named
from flcav.perception.tasks import TASKS, task_named

WEATHER = "from flcav.perception.weather.task import WeatherTask\n"
TASK = f'{WEATHER}class Sky(WeatherTask):\n    name = "sky"\nSKY = Sky()\n'
STRATEGY = """
from dataclasses import dataclass
@dataclass(frozen=True)
class First:
    place: int = 0
    def combine(self, start, updates):
        return updates[self.place].weights
SECOND = First(1)
class Plain:
    def combine(self, start, updates):
        return start
class Needy:
    def __init__(self, what):
        pass
"""


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [path for path in sys.path if path])


def write(name: str, body: str) -> None:
    Path(name).parent.mkdir(exist_ok=True)
    Path(name).write_text(body, encoding="utf-8")


@pytest.mark.parametrize("name", TASKS)
def test_each_name_is_its_task(name: str):
    assert task_named(name).name == name


def test_own_tasks_and_strategies_are_found_in_the_working_directory():
    write("own_sky.py", TASK)
    write("own_parts/sky.py", TASK)
    write("own_first.py", STRATEGY)
    assert task_named("own_sky:SKY").name == "sky"
    assert task_named("own_sky:Sky").name == "sky"  # what the class makes
    assert task_named("own_parts.sky:SKY").name == "sky"
    assert dataclasses.asdict(strategy_named("own_first:SECOND")) == {"place": 1}  # type: ignore[call-overload]
    assert dataclasses.asdict(strategy_named("own_first:First")) == {"place": 0}  # type: ignore[call-overload]
    assert strategy_named("fedavg") == FedAvg()
    assert [type(strategy_named(name)) for name in STRATEGIES] == [*STRATEGIES.values()]


@pytest.mark.parametrize(
    ("name", "body", "said"),
    [
        ("poetry", "", r"task 'poetry': choose one of weather, signs, objects, trajectory, road, or name your own"),
        ("no_such_sky:SKY", "", r"no module 'no_such_sky' in .* or among what is installed"),
        ("no_such.sky:SKY", "", r"no module 'no_such' in"),
        ("sky_1:", TASK, r"a module, a colon and a name in it are wanted"),
        (":SKY", TASK, r"a module, a colon and a name in it are wanted"),
        ("../sky_2:SKY", TASK, r"a module, a colon and a name in it are wanted"),
        ("sky_3:RAIN", TASK, r"sky_3\.py has no 'RAIN'"),
        ("sky_4:SKY", "SKY = 3", r"is no task, it has no name, family, configurations, .*infer"),
        (
            "sky_5:SKY",
            "import no_such_sky",
            r"\(ModuleNotFoundError: .*'no_such_sky', sky_5.py line 1",
        ),
        ("sky_6:SKY", "SKY = (", r"cannot be imported \(SyntaxError"),
        ("sky_7:SKY", "\n\nSKY = 1 / 0", r"cannot be imported \(ZeroDivisionError: .*, sky_7.py line 3\)"),
        ("sky_8:SKY", "import sys\nsys.exit(3)", r"cannot be imported \(SystemExit: 3"),
        ("sky_9:Needy", STRATEGY, r"makes nothing without arguments \(TypeError"),
    ],
)
def test_what_is_no_task_is_one_sentence(name: str, body: str, said: str, capsys: pytest.CaptureFixture[str]):
    if ":" in name and not name.startswith((":", "no_such", "..")):
        write(f"{name.partition(':')[0]}.py", body)
    with pytest.raises(InputError, match=said):
        task_named(name)
    for command in (("train", name, "--data", "none", "--out", "out"), ("infer", name, "none")):
        with pytest.raises(SystemExit) as stopped:
            run(list(command))
        assert stopped.value.code == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
    assert not Path("out").exists()


def test_what_is_no_strategy_is_one_sentence():
    write("own_plain.py", STRATEGY + "SKY = 3\n")
    for name, said in {
        "fedprose": "strategy 'fedprose': choose one of fedavg, fedprox, .*krum, or name your own",
        "own_plain:SKY": "is no strategy, it has no combine",
        "own_plain:Plain": "is no dataclass, so that its settings are not known",
    }.items():
        with pytest.raises(InputError, match=said):
            strategy_named(name)


def test_names_of_the_package_leave_the_path_alone(tmp_path: Path):
    task_named("weather")
    assert str(tmp_path) not in sys.path
