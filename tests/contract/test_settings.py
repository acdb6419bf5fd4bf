"""What names a training: settings, agents and threads. Weights and checkpoints of others are left alone; Ctrl-C."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from task_drives import Drives

from flcav.cli.main import run
from flcav.dataset.recording.recorder import record
from flcav.machine.threads import use_threads
from flcav.perception.device import CPU, processor_of
from flcav.perception.weather.task import WeatherTask
from flcav.perception.weights import read_card
from flcav.storage.files import sha256

STEPS = 60  # one an epoch; a checkpoint is written after 50


class Called(NamedTuple):
    code: int
    out: str
    err: str


Call = Callable[..., Called]


@dataclass(frozen=True)
class OtherDrives(Drives):
    """As many frames of the same scenes, recorded with another seed."""

    def describe(self) -> dict[str, Any]:
        return {**super().describe(), "seed": 1}


@pytest.fixture(scope="module")
def drives(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("drives") / "data"
    record(Drives(spins=2), out)
    return out


@pytest.fixture(scope="module")
def others(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("others") / "data"
    record(OtherDrives(spins=2), out)
    return out


@pytest.fixture
def call(capsys) -> Call:
    """Run a command; return its exit code and what it says."""

    def called(*arguments: object) -> Called:
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            run([str(argument) for argument in arguments])
        return Called(int(stopped.value.code or 0), *capsys.readouterr())

    return called


@pytest.fixture
def one_thread() -> Iterator[None]:
    yield
    use_threads(1)


@pytest.fixture
def interrupted_at(monkeypatch) -> Callable[[int], None]:
    """Have Ctrl-C come when the sample of this number is drawn, counted from now."""
    draw = WeatherTask.draw

    def at(number: int) -> None:
        drawn = 0

        def counted(*arguments: Any) -> Any:
            nonlocal drawn
            drawn += 1
            if drawn == number:
                raise KeyboardInterrupt
            return draw(*arguments)

        monkeypatch.setattr(WeatherTask, "draw", counted)

    return at


def weather(data: Path, out: Path, *options: object) -> tuple[object, ...]:
    return ("train", "weather", "--data", data, "--out", out, *options)


def bytes_in(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): sha256(path) for path in folder.rglob("*") if path.is_file()}


def test_a_finished_training_is_not_done_again(drives, tmp_path, call):
    assert call(*weather(drives, tmp_path, "--epochs", 2)).code == 0
    before = bytes_in(tmp_path)
    for same in ((), ("--seed", 0, "--network", "tiny"), ("--agents", "cav0"), ("--agents", "all")):
        code, out, err = call(*weather(drives, tmp_path, "--epochs", 2, *same))
        assert (code, err) == (0, "")
        assert out == f"{tmp_path / 'weights.safetensors'}: trained with these settings before, nothing to do\n"
    assert bytes_in(tmp_path) == before


@pytest.fixture(scope="module")
def finished(drives, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("finished")
    with pytest.raises(SystemExit):
        run([str(each) for each in weather(drives, out, "--validation", drives, "--epochs", 2)])
    return out


@pytest.mark.parametrize(
    ("said", "change"),
    [
        ("epochs 2 instead of 3", {"--epochs": 3}),
        ("seed 0 instead of 4", {"--seed": 4}),
        ("network tiny instead of paper", {"--network": "paper"}),
        ("patience 5 instead of 9", {"--patience": 9}),
        ("threads 1 instead of 2", {"--threads": 2}),
        ("other data or agents", {"--data": "others"}),
        ("other validation data or agents", {"--validation": "others"}),
    ],
)
@pytest.mark.usefixtures("one_thread")
def test_finished_weights_of_other_settings_are_left_alone(said, change, drives, others, finished, call):
    options = {"--data": drives, "--validation": drives, "--epochs": 2} | change
    words = [others if word == "others" else word for pair in options.items() for word in pair]
    before = bytes_in(finished)
    code, out, err = call("train", "weather", "--out", finished, *words)
    assert (code, out) == (2, "")
    path = finished / "weights.safetensors"
    anew = ", where it begins anew: the learning rate's schedule spans all epochs" * ("epochs" in said)
    assert err == f"flcav: {path}: weights of a training with other settings ({said}); choose another folder{anew}\n"
    assert bytes_in(finished) == before


def test_weights_of_another_task_or_without_a_card_are_left_alone(drives, finished, tmp_path, call):
    assert "task weather instead of signs" in call("train", "signs", "--data", drives, "--out", finished).err
    (tmp_path / "weights.safetensors").write_bytes(b"mine")
    code, _, err = call(*weather(drives, tmp_path))
    assert (code, err.count("\n")) == (2, 1)
    assert (tmp_path / "weights.safetensors").read_bytes() == b"mine"


def test_damaged_weights_of_a_training_are_told_and_made_anew(drives, tmp_path, call):
    assert call(*weather(drives, tmp_path, "--epochs", 2)).code == 0
    before, path = bytes_in(tmp_path), tmp_path / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:-9])
    (tmp_path / "checkpoint.pt").write_bytes(b"")
    code, _, err = call(*weather(drives, tmp_path, "--epochs", 2))
    assert (code, [line.partition(": ")[2] for line in err.splitlines()]) == (
        0,
        [f"{path} is damaged, made anew", f"{tmp_path / 'checkpoint.pt'} is damaged, training begins anew"],
    )
    after = bytes_in(tmp_path)
    assert all(after[name] == before[name] for name in ("weights.safetensors", "card.md"))
    (tmp_path / "card.md").unlink()
    assert call(*weather(drives, tmp_path, "--epochs", 2)).out.endswith("nothing to do\n")
    assert bytes_in(tmp_path)["card.md"] == before["card.md"]


def test_ctrl_c_says_what_is_kept_and_the_same_command_goes_on(drives, tmp_path, call, interrupted_at):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert call(*weather(drives, whole, "--epochs", STEPS)).code == 0
    command = weather(drives, cut, "--epochs", STEPS)
    interrupted_at(6 * 10)
    code, _, err = call(*command)
    assert (code, err) == (130, "flcav: interrupted; nothing saved yet\n")
    interrupted_at(6 * 55)
    code, _, err = call(*command)
    assert (code, err) == (130, f"flcav: interrupted; the same command goes on from {cut / 'checkpoint.pt'}\n")
    assert not (cut / "weights.safetensors").exists()
    interrupted_at(6 * 11)  # ten steps are left
    assert call(*command).code == 0
    assert (cut / "weights.safetensors").read_bytes() == (whole / "weights.safetensors").read_bytes()


@pytest.mark.usefixtures("one_thread")
def test_a_checkpoint_of_other_data_or_threads_is_left_alone(drives, others, tmp_path, call, interrupted_at):
    options = ("--epochs", STEPS)
    interrupted_at(6 * 55)
    assert call(*weather(drives, tmp_path, *options)).code == 130
    before = sha256(tmp_path / "checkpoint.pt")
    for command in (weather(others, tmp_path, *options), weather(drives, tmp_path, *options, "--threads", 2)):
        code, _, err = call(*command)
        assert code == 2
        assert "the checkpoint of a run with other settings or data" in err
    assert sha256(tmp_path / "checkpoint.pt") == before


@pytest.mark.parametrize(("command", "method"), [("evaluate", "samples"), ("infer", "infer")])
def test_what_keeps_nothing_does_not_say_it_goes_on(command, method, drives, call, monkeypatch):
    def stopped(*_: Any, **__: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(WeatherTask, method, stopped)
    arguments = ("--data", drives) if command == "evaluate" else (drives,)
    assert call(command, "weather", *arguments) == (130, "", "flcav: interrupted\n")


def test_the_help_names_the_exit_codes(call):
    said = " ".join(call("--help").out.split())
    assert "0 done, 2 bad input (one sentence on stderr), 130 interrupted (Ctrl-C), 1 anything else" in said


@pytest.mark.parametrize(
    "command",
    [
        ("train", "weather", "--data", "none", "--out", "none"),
        ("evaluate", "weather", "--data", "none"),
        ("infer", "weather", "none"),
        ("reproduce", "sim-to-real", "--out", "none"),
    ],
    ids=lambda command: command[0],
)
@pytest.mark.usefixtures("one_thread")
def test_a_command_computes_on_one_thread(command, call):
    torch.set_num_threads(2)
    assert call(*command).code == 2
    assert torch.get_num_threads() == 1


@pytest.mark.slow
def test_threads_are_those_asked_for_whatever_the_environment_and_are_in_the_card(drives, tmp_path):
    code = (
        "import json, sys\nfrom flcav.cli.main import run\n"
        "for words in json.loads(sys.argv[1]):\n"
        "    try:\n        run(words)\n    except SystemExit as stopped:\n        assert not stopped.code\n"
    )
    commands = [
        [str(word) for word in weather(drives, tmp_path / str(number), "--epochs", 1, *threads)]
        for number, threads in ((1, ()), (2, ("--threads", 2)))
    ]
    environment = os.environ | {"OMP_NUM_THREADS": "2", "MKL_NUM_THREADS": "2"}
    subprocess.run([sys.executable, "-c", code, json.dumps(commands)], check=True, env=environment, capture_output=True)
    for number in (1, 2):
        card = read_card(tmp_path / str(number) / "weights.safetensors")
        assert (card.threads, card.processor, card.torch) == (number, processor_of(CPU), str(torch.__version__))
        assert f"- threads: {number}\n" in card.markdown()
