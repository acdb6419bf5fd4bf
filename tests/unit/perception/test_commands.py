"""flcav train, evaluate and infer from files to exit codes."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import flcav
from flcav.cli.main import run
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.perception.client import TaskClient
from flcav.perception.objects import predict
from flcav.perception.objects.model import second_tiny
from flcav.perception.objects.task import OBJECTS
from flcav.perception.weights import load_network, read_card, save_network, to_arrays

from .frames import cloud_in, detections, frame


@dataclass(frozen=True)
class Drives:
    """A source of two scenes with three cars each."""

    spins: int = 4

    def describe(self) -> dict[str, Any]:
        return {"town": "none", "split": "train", "seed": 0, "spins": self.spins}

    def scenes(self) -> list[str]:
        return ["a", "b"]

    def frame_count(self, scene: str) -> int:
        return self.spins

    def frames(self, scene: str):
        for index in range(self.spins):
            places = [(10.0 + index, 3.0), (22.0, -4.0 - index), (35.0, 8.0)]
            cars = detections(*((x, y, 1.0) for x, y in places))
            objects = [(f"veh{i}", "car", x, y, 40) for i, (x, y) in enumerate(places)]
            yield frame(objects, points=cloud_in(cars, each=40), scene=scene, index=index)

    def trace(self, scene: str) -> None:
        return None


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("data") / "drives"
    record(Drives(), out)
    return out


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "weights.safetensors"
    save_network(OBJECTS, second_tiny(), path)
    return path


def called(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stopped:
        run([str(argument) for argument in arguments])
    return int(stopped.value.code or 0)


def test_train_writes_weights_that_evaluate_and_infer_take(data, tmp_path, capsys):
    out = tmp_path / "run"
    assert called("train", "objects", "--data", data, "--data", data, "--out", out, "--epochs", 1) == 0
    assert "- samples: 16" in (out / "card.md").read_text()
    weights = out / "weights.safetensors"
    capsys.readouterr()
    assert called("evaluate", "objects", "--data", data, "--weights", weights, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["frames"] == 8
    assert result["scenes"] == 2
    assert {(row["kind"], row["iou"]) for row in result["scores"]} == {
        (k, i) for k in ("3d", "bev") for i in (0.5, 0.7)
    }
    assert result["scores"][0]["targets"] == 24
    assert called("evaluate", "objects", "--data", data, "--weights", weights) == 0
    assert "8 frames of 2 scenes" in capsys.readouterr().out


def test_scores_are_calibrated_on_the_validation_data(data, tmp_path, monkeypatch):
    monkeypatch.setattr(predict, "fit_logistic", lambda scores, hits: (2.0, -0.25))
    options = ("train", "objects", "--data", data, "--epochs", 1, "--seed", 3)
    assert called(*options, "--out", tmp_path / "without") == 0
    assert called(*options, "--out", tmp_path / "with", "--validation", data) == 0
    without, held = (load_network(OBJECTS, tmp_path / name / "weights.safetensors") for name in ("without", "with"))
    assert (without.config.calibration, held.config.calibration) == (None, ((2.0, -0.25),))
    assert all(np.array_equal(to_arrays(held)[name], array) for name, array in to_arrays(without).items())
    card = read_card(tmp_path / "with" / "weights.safetensors")
    assert card.metrics == OBJECTS.evaluate(held, Dataset.open(data)).as_json()  # of the calibrated scores


def test_infer_takes_files_folders_and_datasets(data, weights, tmp_path, capsys):
    cloud = cloud_in(detections((10, 0, 1), (20, 5, 1)), each=50)
    for name in ("one.bin", "two.bin"):
        cloud.tofile(tmp_path / name)
    inputs = (tmp_path / "one.bin", tmp_path, data)
    assert called("infer", "objects", "--weights", weights, *inputs, "--threshold", 0, "--json") == 0
    results = json.loads(capsys.readouterr().out)["inputs"]
    assert len(results) == 1 + 2 + 8
    assert results[0]["path"] == str(tmp_path / "one.bin")
    assert results[0]["boxes"] == results[1]["boxes"]
    fields = {"class", "score", "x", "y", "z", "length", "width", "height", "yaw"}
    assert results[0]["boxes"]
    assert all(set(box) == fields for box in results[0]["boxes"])


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "empty"),
        (b"\x00\x00\x80\x3f56789", "truncated"),
        (b"123456789", "a text file"),
        (np.full((3, 4), np.nan, np.float32).tobytes(), "not finite"),
        (None, "no such file"),
    ],
)
def test_bad_clouds_are_one_sentence(content, sentence, weights, tmp_path, capsys):
    path = tmp_path / "cloud.bin"
    if content is not None:
        path.write_bytes(content)
    assert called("infer", "objects", "--weights", weights, path, "--json") == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert sentence in shown.err
    assert str(path) in shown.err
    assert shown.err.count("\n") == 1


def test_other_bad_input_is_one_sentence(data, weights, tmp_path, capsys):
    (tmp_path / "broken").write_bytes(b"no weights")
    (tmp_path / "empty").mkdir()
    cases = {
        "task 'poetry': choose one of weather, signs": ("train", "poetry", "--data", data, "--out", tmp_path / "o"),
        "choose one of pillars, tiny, small, road, paper": (
            *("train", "objects", "--data", data, "--out", tmp_path / "o", "--network", "huge"),
        ),
        "manifest": ("train", "objects", "--data", tmp_path / "empty", "--out", tmp_path / "o"),
        "damaged": ("evaluate", "objects", "--data", data, "--weights", tmp_path / "broken"),
        "neither a dataset": ("infer", "objects", "--weights", weights, tmp_path / "empty"),
        "2.0 is not in the range": ("infer", "objects", "--weights", weights, data, "--threshold", 2),
        "a finite number is wanted": ("infer", "objects", "--weights", weights, data, "--threshold", "nan"),
        "-3 is not in the range": ("train", "objects", "--data", data, "--out", tmp_path / "o", "--seed", -3),
    }
    for sentence, arguments in cases.items():
        assert called(*arguments) == 2, sentence
        shown = capsys.readouterr().err
        assert sentence in shown
        assert shown.count("\n") == 1
    assert not (tmp_path / "o").exists()


@pytest.mark.slow
def test_a_killed_training_ends_where_an_uninterrupted_one_does(data, tmp_path):
    def command(out: Path) -> list[str]:
        options = ["--data", str(data), "--out", str(out), "--epochs", "18", "--seed", "4"]  # 72 steps
        return ["train", "objects", *options]

    def trained(out: Path) -> None:
        with pytest.raises(SystemExit) as ended:
            run(command(out))
        assert not ended.value.code

    trained(tmp_path / "whole")
    code = [sys.executable, "-c", "from flcav.cli.main import run; run()"]
    process = subprocess.Popen([*code, *command(tmp_path / "cut")], stderr=subprocess.DEVNULL)
    while process.poll() is None and not (tmp_path / "cut" / "checkpoint.pt").exists():
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "cut" / "weights.safetensors").exists()
    trained(tmp_path / "cut")
    whole, cut = (
        to_arrays(load_network(OBJECTS, tmp_path / name / "weights.safetensors")) for name in ("whole", "cut")
    )
    assert all(np.array_equal(whole[name], cut[name]) for name in whole)


@pytest.mark.slow
def test_python_trains_the_same_weights_as_the_shell(data: Path, tmp_path: Path):
    """One thread by default, in both: threads decide the order of sums, and so the last bits."""
    torch.set_num_threads(2)
    trained = flcav.train("objects", data, out=tmp_path / "python", network="tiny", epochs=1, seed=1)
    assert torch.get_num_threads() == 1
    how = ("--data", data, "--network", "tiny", "--epochs", 1, "--seed", 1)
    assert called("train", "objects", *how, "--out", tmp_path / "shell") == 0
    assert trained.weights.read_bytes() == (tmp_path / "shell" / "weights.safetensors").read_bytes()
    torch.set_num_threads(2)
    config = second_tiny().config
    client = TaskClient(OBJECTS, config, OBJECTS.samples(Dataset.open(data), config, [0]))
    client.train(to_arrays(trained.network), steps=1, learning_rate=1e-3, seed=1)
    assert torch.get_num_threads() == 1
