"""No option is passed over in silence: each is used, or refused in a sentence where it would have no effect."""

import ast
import functools
import inspect
import textwrap
from collections.abc import Callable, Iterator

import click
import pytest
import typer

from flcav.cli.main import app, run
from flcav.config import InputError
from flcav.dataset.formats.formats import EXPORTS, IMPORTS
from flcav.experiments import list_experiments
from flcav.experiments.experiment import OPTIONS, load_experiment
from flcav.perception.errors import RegistersErrors
from flcav.perception.task import Scores
from flcav.perception.tasks import TASKS, task_named

ALWAYS = "always"
SCORED = tuple(name for name in TASKS if isinstance(task_named(name), Scores))
EXPERIMENTS = {name: load_experiment(name) for name in list_experiments()}
# command -> what it can be asked for -> the arguments that ask for it, of inputs that are not there
CHOICES: dict[str, dict[str, str]] = {
    "export": {name: f"{name} none --out out" for name in EXPORTS},
    "import": {name: f"{name} none --out out" for name in IMPORTS},
    "train": {
        **{task: f"{task} --data none --validation none --out out" for task in TASKS},
        "unvalidated": "weather --data none --out out",
    },
    "evaluate": {task: f"{task} --data none" for task in TASKS},
    "infer": {task: f"{task} none" for task in TASKS},
    "errors": {
        task: f"{task} --data none --out errors.csv" for task in TASKS if isinstance(task_named(task), RegistersErrors)
    },
    "fit": {model: f"none --model {model}" for model in ("additive", "effective", "federated")},
    "federate": {name: f"none --out out --runtime {name}" for name in ("embedded", "ray", "flower")},
    "run": {name: f"none --out out --runtime {name}" for name in ("embedded", "ray", "flower")},
    "reproduce": {target: f"{target} --out out" for target in EXPERIMENTS},
}
RUNS: dict[str, str | tuple[str, ...]] = dict.fromkeys(("--agents", "--threads", "--device"), ALWAYS)
# command -> option -> what of CHOICES takes it; `--out` and `--json` are always taken
TAKEN: dict[str, dict[str, str | tuple[str, ...]]] = {
    "run": {
        **dict.fromkeys(("--dry", "--jobs", "--seeds", "--engine", "--runtime", "--stale"), ALWAYS),
        "--fleet": ("flower",),
    },
    "demo": dict.fromkeys(("--seed", "--recipe", "--seeds", "--retrainings", "--jobs", "--engine", "--stale"), ALWAYS),
    "compare": dict.fromkeys(("--data", "--task", "--agents"), ALWAYS),
    "federate": {**dict.fromkeys(("--arm", "--jobs", "--runtime", "--stale"), ALWAYS), "--fleet": ("flower",)},
    "fleet init": {"--host": ALWAYS},
    "fleet key": {"--vehicle": ALWAYS},
    "fleet register": {"--days": ALWAYS},
    "fleet rotate": {"--days": ALWAYS},
    "fleet install": dict.fromkeys(("--authority", "--trusted", "--server", "--client"), ALWAYS),
    "fleet revoke": {"--reason": ALWAYS},
    "fleet list": {"--audit": ALWAYS},
    "fleet status": {"--page": ALWAYS},
    "fleet up": dict.fromkeys(("--vehicles", "--host", "--port"), ALWAYS),
    "fleet vehicle": {},
    "fleet request": dict.fromkeys(("--task", "--loss", "--frames", "--at"), ALWAYS),
    "towns list": {},
    "towns show": {"--poles": ALWAYS},
    "towns import": {},
    "odd check": dict.fromkeys(("--town", "--data"), ALWAYS),
    "odd of": {},
    "odd inside": dict.fromkeys(("--perceived", "--weather", "--objects", "--device", "--frames"), ALWAYS),
    "odd cover": dict.fromkeys(("--data", "--by", "--detect", "--weights", "--range", "--device"), ALWAYS),
    "odd sample": dict.fromkeys(
        ("--count", "--town", "--method", "--covered", "--weights", "--seed", "--openscenario"), ALWAYS
    ),
    "odd tasks": dict.fromkeys(("--data", "--errors", "--pretrain", "--wireless", "--wireline"), ALWAYS),
    "carla serve": dict.fromkeys(("--port", "--seed", "--traffic", "--maps", "--quality", "--host"), ALWAYS),
    "release init": {"--keys": ALWAYS, "--threshold": ALWAYS},
    "release propose": dict.fromkeys(
        ("--driving", "--release", "--changes", "--for", "--data", "--recipe", "--ledger", "--task"), ALWAYS
    ),
    "release verify": dict.fromkeys(("--driving", "--data", "--margin", "--frames", "--odd", "--by", "--jobs"), ALWAYS),
    "release sign": dict.fromkeys(("--repository", "--key", "--share", "--vehicle", "--revoke"), ALWAYS),
    "release publish": {},
    "release install": dict.fromkeys(
        ("--name", "--image", "--director", "--image-root", "--director-root", "--task"), ALWAYS
    ),
    "release shadow": dict.fromkeys(("--driving", "--data"), ALWAYS),
    "release equip": dict.fromkeys(("--image-root", "--director-root", "--data", "--drive"), ALWAYS),
    "release rollout": dict.fromkeys(
        ("--key", "--shadows", "--share", "--revoke", "--task", "--fleet", "--provider", "--data", "--wait"), ALWAYS
    ),
    "release deliver": dict.fromkeys(("--data", "--pole", "--scene", "--network", "--seed"), ALWAYS),
    "release rehearse": dict.fromkeys(("--earlier", "--data", "--vehicles", "--pole", "--network", "--seed"), ALWAYS),
    "release rollback": dict.fromkeys(("--driving", "--release", "--reason"), ALWAYS),
    "release status": dict.fromkeys(("--candidate", "--task"), ALWAYS),
    "record": {"--frames": ALWAYS, "--seed": ALWAYS, "--jobs": ALWAYS, "--engine": ALWAYS},
    "validate": {},
    "birdseye": {"--frame": ALWAYS, "--range": ALWAYS, "--tracks": ALWAYS},
    "camera": {"--frame": ALWAYS, "--camera": ALWAYS, "--boxes": ALWAYS},
    "view": {"--scene": ALWAYS, "--save": ALWAYS, "--animate": ALWAYS},
    "export": {  # which format takes which is said beside the formats
        "--labels": ALWAYS,
        "--validation": ALWAYS,
        "--min-pixels": ALWAYS,
        "--min-points": ALWAYS,
        "--calibration": ALWAYS,
    },
    "import": dict.fromkeys(("--split", "--estimate-poses", "--lidar-height", "--beams"), ALWAYS),
    "train": {
        "--data": ALWAYS,
        "--validation": ALWAYS,
        "--network": ALWAYS,
        "--epochs": ALWAYS,
        "--patience": tuple(TASKS),
        "--seed": ALWAYS,
        **RUNS,
    },
    "evaluate": {
        "--data": ALWAYS,
        "--weights": ALWAYS,
        "--tracks": ("objects",),
        "--range": ("objects",),
        "--around": ("objects",),
        "--lidar-height": (),
        "--beams": (),
        **RUNS,
    },
    "infer": {
        "--weights": ALWAYS,
        "--threshold": SCORED,
        "--around": ("objects",),
        "--lidar-height": ("objects",),
        "--beams": ("objects",),
        "--pictures": ALWAYS,
        **RUNS,
    },
    "errors": {
        "--data": ALWAYS,
        "--weights": ALWAYS,
        "--threshold": SCORED,
        "--around": ("objects",),
        "--map": ALWAYS,
        **RUNS,
    },
    "allocate": dict.fromkeys(("--baseline", "--progress", "--throughput", "--verify"), ALWAYS),
    "replan": dict.fromkeys(("--baseline", "--throughput", "--verify"), ALWAYS),
    "place": {
        "--errors": ALWAYS,
        "--poles": ALWAYS,
        "--range": ALWAYS,
        "--count": ALWAYS,
        **dict.fromkeys(
            ("--every", "--sensors", "--curve", "--budget", "--cover", "--data", "--line-of-sight"), ALWAYS
        ),
        **dict.fromkeys(("--class-weight", "--driving", "--method", "--town", "--map", "--verify"), ALWAYS),
    },
    "planner": dict.fromkeys(
        ("--errors", "--poles", "--every", "--sensors", "--range", "--data", "--port", "--html"), ALWAYS
    ),
    "fit": {
        **dict.fromkeys(("--model", "--at", "--problem", "--level", "--repeats", "--seed", "--held-out"), ALWAYS),
        **dict.fromkeys(
            ("--group-samples", "--alpha", "--beta", "--edge-rounds-per-cloud-round"), ("effective", "federated")
        ),
    },
    "history": dict.fromkeys(
        (
            *("--task", "--samples", "--edge-rounds", "--cloud-rounds", "--seeds", "--first-seed"),
            *("--jobs", "--engine", "--stale"),
        ),
        ALWAYS,
    ),
    "radio": dict.fromkeys(("--pole", "--scene", "--network", "--seed", "--map"), ALWAYS),
    "rounds": dict.fromkeys(
        (
            *("--model-mb", "--update-mb", "--steps", "--step-s", "--rounds", "--edge-rounds-per-cloud-round"),
            *("--pole", "--scene", "--network", "--seed", "--timeline"),
        ),
        ALWAYS,
    ),
    "drive": dict.fromkeys(
        (
            *("--scenario", "--seeds", "--first-seed", "--perception", "--errors", "--lasts", "--margin", "--sigmas"),
            *("--pole", "--lanes", "--measure", "--jobs", "--list", "--night"),
        ),
        ALWAYS,
    ),
    "odd importance": dict.fromkeys(
        (
            *("--scenarios", "--seeds", "--first-seed", "--perception", "--errors", "--lasts", "--coupling", "--weigh"),
            *("--keep", "--jobs"),
        ),
        ALWAYS,
    ),
    "reproduce": {
        f"--{option}": tuple(name for name, own in EXPERIMENTS.items() if option in own.takes) for option in OPTIONS
    },
}
LATER = {("place", "range_m"), ("export", "validation")}  # are refused by what takes them
VALUES = {
    "--engine": "ray",
    "--stale": "keep",
    "--labels": "actors",
    "--calibration": "assumed",
    "--scale": "quick",
    "--tracks": None,
    "--around": None,
    "--estimate-poses": None,
}  # else 0.5 or 1


def commands(group: click.Group, before: str = "") -> Iterator[tuple[str, click.Command]]:
    """Yield every command of the app by what one types."""
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from commands(command, f"{name} ")
        else:
            yield before + name, command


@functools.cache
def app_commands() -> dict[str, click.Command]:
    group = typer.main.get_command(app)
    assert isinstance(group, click.Group)
    return dict(commands(group))


def options(command: click.Command) -> set[str]:
    found = {parameter.opts[0] for parameter in command.params if isinstance(parameter, click.Option)}
    return found - {"--out", "--json", "--help"}


def test_every_option_of_every_command_has_its_row() -> None:
    assert {name: options(command) for name, command in app_commands().items()} == {
        name: set(row) for name, row in TAKEN.items()
    }


@pytest.mark.parametrize("name", app_commands())
def test_every_parameter_is_read(name: str) -> None:
    command = app_commands()[name].callback
    assert command is not None
    function: Callable[..., object] = inspect.unwrap(command)
    body = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    read = {node.id for node in ast.walk(body) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    assert not set(inspect.signature(function).parameters) - read


@pytest.mark.parametrize("name", app_commands())
def test_no_number_that_is_none_passes(name: str) -> None:
    command = app_commands()[name]
    for option in command.params:
        if isinstance(option.type, click.types.FloatParamType | click.FloatRange) and (name, option.name) not in LATER:
            value = ["nan"] if isinstance(option, click.Option) and option.multiple else "nan"
            with pytest.raises(InputError, match=f"{option.opts[0]} nan: a finite number"):
                option.process_value(click.Context(command), value)


def said(capsys: pytest.CaptureFixture[str], command: str, choice: str, option: str) -> str:
    """Return what a command answers that is asked for `choice` with the option, and for what is not there."""
    found = next(each for each in app_commands()[command].params if option in each.opts)
    value = "1" if isinstance(found.type, click.IntRange | click.types.IntParamType) else "0.5"
    given = [option] if VALUES.get(option, "") is None else [option, VALUES.get(option) or value]
    with pytest.raises(SystemExit) as ended:
        run([*command.split(), *CHOICES[command][choice].split(), *given])
    told = capsys.readouterr()
    assert (ended.value.code, told.out, told.err.count("\n")) == (2, "", 1)
    return told.err


CASES = [
    (command, choice, option, choice in taken)
    for command, row in TAKEN.items()
    for option, taken in row.items()
    if taken != ALWAYS
    for choice in CHOICES[command]
]


@pytest.mark.parametrize(("command", "choice", "option"), [case[:3] for case in CASES if not case[3]])
def test_an_option_without_effect_is_refused(
    command: str, choice: str, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert option in said(capsys, command, choice, option)


@pytest.mark.parametrize(
    ("command", "choice", "option"), [case[:3] for case in CASES if case[3] and case[0] != "reproduce"]
)
def test_an_option_with_an_effect_is_taken(
    command: str, choice: str, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert option not in said(capsys, command, choice, option)
