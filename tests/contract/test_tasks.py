"""Every task satisfies one protocol: trained, resumed, evaluated, saved, used and federated by the same code."""

import inspect
import json
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image
from safetensors import safe_open
from task_drives import Drives

from flcav.cli.main import run
from flcav.config import InputError
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.federation.links.metered import Account
from flcav.federation.loop import Schedule, federate
from flcav.federation.state import FederationState
from flcav.federation.strategies.corrections import Scaffold
from flcav.federation.trainable import Trainable
from flcav.network.ledger import Ledger, LinkMegabytes
from flcav.perception.client import TaskClient, as_shared
from flcav.perception.device import select_device
from flcav.perception.road.task import ROAD
from flcav.perception.signs.task import SIGNS
from flcav.perception.task import Task, build_network, find_configuration
from flcav.perception.tasks import TASKS, task_named
from flcav.perception.training import Checkpointing, Validation, train
from flcav.perception.training.run import TrainingRequest, train_network
from flcav.perception.weather.evaluate import evaluate_whole_space
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import CARD_KEY, load_network, save_network, to_arrays
from flcav.report import style
from flcav.report.pictures.inference import draw
from flcav.reproductions.fig1b.columns import show_layers
from flcav.reproductions.fig1b.run import LAYERS, capture_outputs
from flcav.sensors.frame import Frame
from flcav.world.weather import Weather

each_task = pytest.mark.parametrize("task", [task_named(name) for name in TASKS], ids=TASKS)
CONFIGS = {
    "signs": replace(find_configuration(SIGNS, "n"), window_px=(96, 64)),
    "road": replace(find_configuration(ROAD, "tiny"), window_px=(96, 64)),
}
LACKING = {"objects": ({"lidar": False}, "no LiDAR"), "trajectory": ({"traffic": False}, "no traffic")}
FILES = {"weather": "front/*.webp", "signs": "front/*.webp", "road": "front/*.webp", "objects": "top/*.bin"}


def small(task: Task) -> Any:
    return CONFIGS.get(task.name, find_configuration(task, None))


def shown(data: Dataset) -> list[str]:
    return [data.name(i) for i in range(len(data))]


def folder_of(source: Drives, folder: Path) -> Path:
    record(source, folder)
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Dataset:
    return Dataset.open(folder_of(Drives(spins=2), tmp_path_factory.mktemp("drives") / "data"))


@pytest.fixture(scope="module")
def samples(data) -> dict[str, list[Any]]:
    return {name: list(task_named(name).samples(data, small(task_named(name)))) for name in TASKS}


def same(one, other) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(to_arrays(one).values(), to_arrays(other).values(), strict=True))


def called(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stopped:
        run([str(argument) for argument in arguments])
    return int(stopped.value.code or 0)


@each_task
def test_samples_are_those_of_the_frames_asked_for(task, data, samples):
    assert len(samples[task.name]) == len(data) == 6
    assert len(task.samples(data, small(task), data.select(scenes=["fog"]))) == 2


def alike(one: Any, other: Any) -> bool:
    """Return whether two samples are of one type, and all their fields are the same."""
    if is_dataclass(one) or isinstance(one, tuple):
        parts = [list(each if isinstance(each, tuple) else vars(each).values()) for each in (one, other)]
        return type(one) is type(other) and all(map(alike, *parts))
    kinds = [np.asarray(each).dtype.kind for each in (one, other)]
    return kinds[0] == kinds[1] and np.array_equal(one, other)


@each_task
def test_samples_are_the_same_on_the_other_side_of_a_link(task, data):
    config = small(task)
    frames = range(1, len(data))
    messages = list(as_shared(task).pack_samples(data, config, frames))
    assert all(type(message) is bytes for message in messages)
    assert len(messages) == len(frames)
    received = as_shared(task).unpack_samples([bytes(bytearray(message)) for message in messages], config)
    sent = task.samples(data, config, frames)
    assert received is not None
    assert len(received) == len(sent) > 0
    assert all(alike(received[i], sent[i]) for i in range(len(sent)))


@each_task
def test_a_seed_names_a_training(task, samples):
    networks = [build_network(task, small(task), 1) for _ in range(3)]
    for network, seed in zip(networks, (3, 3, 4), strict=True):
        history = train(task, network, samples[task.name], steps=2, batch=2, seed=seed)
        assert np.isfinite(history.losses).all()
    assert same(networks[0], networks[1])
    assert not same(networks[0], networks[2])
    assert not same(networks[0], build_network(task, small(task), 1))


@each_task
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_a_gpu_trains_evaluates_and_goes_on_to_the_same_weights(task, data, samples, tmp_path):
    network, again = (build_network(task, small(task), 1).to(select_device("cuda")) for _ in range(2))
    checkpointing = Checkpointing(tmp_path / "checkpoint.pt", every=2)
    history = train(task, network, samples[task.name], steps=2, batch=2, seed=3, checkpointing=checkpointing)
    train(task, again, samples[task.name], steps=2, batch=2, seed=3, checkpointing=checkpointing)
    assert np.isfinite(history.losses).all()
    assert same(network, again)
    assert np.isfinite(task.evaluate(network, data).score)


class Killed(Exception):
    """Stands for SIGKILL: nothing is caught, nothing is written after it."""


@each_task
@pytest.mark.parametrize("validated", [False, True])
def test_a_killed_training_goes_on_to_the_same_weights(task, validated, samples, tmp_path):
    def score(network) -> float:
        return -float(sum(np.abs(array).sum() for array in to_arrays(network).values()))

    validation = Validation(score, every=2, patience=9) if validated else None
    settings = {"steps": 5, "batch": 2, "seed": 3, "validation": validation}
    learned = samples[task.name]
    whole, cut, resumed = (build_network(task, small(task), 1) for _ in range(3))
    losses = train(task, whole, learned, **settings)
    checkpointing = Checkpointing(tmp_path / "checkpoint.pt", every=3)

    def kill(done, total, note):
        if done == 4:
            raise Killed

    with pytest.raises(Killed):
        train(task, cut, learned, checkpointing=checkpointing, progress=kill, **settings)
    again = train(task, resumed, learned, checkpointing=checkpointing, **settings)
    assert np.array_equal(losses.losses, again.losses)
    assert np.array_equal(losses.scores, again.scores)
    assert len(again.scores) == (2 if validated else 0)
    assert same(whole, resumed)


@each_task
def test_weights_come_back_and_those_of_another_task_are_refused(task, tmp_path):
    network, path = build_network(task, small(task), 1), tmp_path / "weights.safetensors"
    save_network(task, network, path)
    loaded = load_network(task, path)
    assert same(network, loaded)
    assert loaded.config == small(task)
    assert not loaded.training
    for other in (other for other in map(task_named, TASKS) if other is not task):
        with pytest.raises(InputError, match=f"'{task.family}'.*'{other.name}' takes those of '{other.family}'"):
            load_network(other, path)


@each_task
def test_a_client_is_trainable(task, samples):
    client: Trainable = TaskClient(task, small(task), samples[task.name], batch=2)
    asked = inspect.signature(client.train).parameters
    assert {name for name, each in asked.items() if each.default is each.empty} == {
        "weights",
        "steps",
        "learning_rate",
        "seed",
    }
    assert set(asked) - {"weights", "steps", "learning_rate", "seed"} == {
        "proximal",
        "centre",
        "shift",
        "layers",
        "optimiser",
    }  # of the strategies and rules that ask for them
    weights = to_arrays(build_network(task, small(task), 1))
    before = {key: array.copy() for key, array in weights.items()}
    one, other = (client.train(weights, steps=1, learning_rate=1e-3, seed=3) for _ in range(2))
    assert list(one.weights) == list(weights)
    assert all(array.dtype == weights[key].dtype for key, array in one.weights.items())
    assert all(np.array_equal(array, weights[key]) for key, array in before.items())  # its input is left alone
    assert all(np.array_equal(array, other.weights[key]) for key, array in one.weights.items())
    assert one.samples == 2
    assert np.isfinite(one.loss)
    still = client.train(weights, steps=0, learning_rate=1e-3, seed=3)
    assert all(np.array_equal(array, weights[key]) for key, array in still.weights.items())


@each_task
def test_two_clients_federate(task, samples):
    learned = samples[task.name]
    clients = {f"cav{i}": TaskClient(task, small(task), learned[i::2], batch=2) for i in range(2)}
    weights = to_arrays(build_network(task, small(task), 1))
    ledger = Ledger(LinkMegabytes(wireless_mb=100.0, wireline_mb=0.0))
    schedule = Schedule(rounds=1, steps=1, learning_rate=1e-3, final_learning_rate=1e-3, seed=1)
    result = federate(clients, weights, schedule, Account(ledger, "edge", task.name, "wireless"))
    assert list(result.weights) == list(weights)
    assert any(not np.array_equal(result.weights[name], weights[name]) for name in weights)
    assert ledger.used_mb("wireless") > 0
    assert np.isfinite(result.loss)
    state, account = FederationState(), Account(ledger, "edge", task.name, "wireless")
    federate(clients, weights, schedule, account, strategy=Scaffold(), state=state)
    assert not state.records[0].failed  # a gradient of each array that is learned


def assert_comes_back(result):
    values = result.as_json()
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert type(result).from_json(values, "test") == result


@each_task
def test_evaluations_and_findings_are_json_and_words_and_pictures(task, data):
    network = build_network(task, small(task), 1)
    result = task.evaluate(network, data, [0, 3])
    assert_comes_back(result)
    assert 0 <= result.score <= 1
    assert all(isinstance(line, str) for line in result.lines())
    finding = next(iter(task.infer(network, data.folder, 0.0)))
    assert_comes_back(finding.result)
    assert finding.result.lines()
    assert finding.marks
    picture = style.png(draw(finding), dpi=40)
    assert picture.startswith(b"\x89PNG")
    assert picture != style.png(draw(replace(finding, marks=())), dpi=40)


@pytest.mark.parametrize("task", [task_named(name) for name in LAYERS], ids=LAYERS)
def test_the_layers_that_fig1b_shows_are_all_seen(task, data):
    network = build_network(task, small(task), 1).eval()
    layers = LAYERS[task.name](network)
    with capture_outputs(layers) as seen:
        list(task.infer(network, data.folder, 0.9))
    assert set(seen) == set(layers)
    assert all(layer.values.ndim in (1, 3) and np.isfinite(layer.values).all() for layer in seen.values())
    assert not any(module._forward_hooks for module in layers.values())
    figure = Figure()
    show_layers(figure.add_subplot(), list(seen.values()))
    assert style.png(figure, dpi=40).startswith(b"\x89PNG")


@each_task
def test_a_whole_training_leaves_weights_with_their_card_and_curves(task, data, tmp_path, monkeypatch):
    monkeypatch.setattr(type(task), "configurations", {"small": small(task)})
    card = train_network(task, TrainingRequest([data, data], data, epochs=1, seed=2), tmp_path)
    assert (card.task, card.network, card.seed, card.samples) == (task.name, "small", 2, 12)
    assert card.metrics == task.evaluate(load_network(task, tmp_path / "weights.safetensors"), data).as_json()
    with safe_open(tmp_path / "weights.safetensors", framework="pt") as file:
        assert json.loads(file.metadata()[CARD_KEY]) == json.loads(card.model_dump_json())
    assert (tmp_path / "card.md").read_text() == card.markdown()
    again = tmp_path / "again.safetensors"
    save_network(task, load_network(task, tmp_path / "weights.safetensors"), again, card)
    assert again.read_bytes() == (tmp_path / "weights.safetensors").read_bytes()
    assert len(list((tmp_path / "events").glob("events.out.tfevents.*"))) == 1


@each_task
def test_a_dataset_without_its_sensor_is_one_sentence(task, tmp_path, capsys):
    lacking, said = LACKING.get(task.name, ({"camera": False}, "no camera pictures"))
    blind = Drives(spins=1, **lacking)
    folder, weights = folder_of(blind, tmp_path / "data"), tmp_path / "weights.safetensors"
    save_network(task, build_network(task, small(task), 1), weights)
    for command in (
        ("train", task.name, "--data", folder, "--out", tmp_path / "out"),
        ("evaluate", task.name, "--data", folder, "--weights", weights),
        ("infer", task.name, folder, "--weights", weights),
    ):
        assert called(*command) == 2, command
        told = capsys.readouterr()
        assert told.out == ""
        assert told.err.count("\n") == 1
        assert said in told.err
    assert not (tmp_path / "out").exists()


@each_task
def test_validation_data_without_its_sensor_are_refused_before_training(task, data, tmp_path, capsys, monkeypatch):
    lacking, said = LACKING.get(task.name, ({"camera": False}, "no camera pictures"))
    blind = folder_of(Drives(spins=1, **lacking), tmp_path / "data")
    monkeypatch.setattr(type(task), "draw", None)  # not even called
    out = tmp_path / "out"
    assert called("train", task.name, "--data", data.folder, "--validation", blind, "--out", out) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert f"{blind}: {said}" in told
    assert not out.exists()


@each_task
def test_weights_that_are_no_numbers_are_refused(task, tmp_path):
    network = build_network(task, small(task), 1)
    name, first = next(iter(network.named_parameters()))
    first.data[(0,) * first.dim()] = float("nan")
    save_network(task, network, tmp_path / "weights.safetensors")
    with pytest.raises(InputError, match=rf"weights that are not finite numbers, in '{name}'"):
        load_network(task, tmp_path / "weights.safetensors")


@each_task
def test_where_no_picture_can_be_drawn_nothing_is_inferred(task, data, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(type(task), "infer", None)  # not even called
    weights, taken = tmp_path / "weights.safetensors", tmp_path / "file"
    save_network(task, build_network(task, small(task), 1), weights)
    taken.touch()
    assert called("infer", task.name, data.folder, "--weights", weights, "--pictures", taken) == 2
    assert capsys.readouterr() == ("", f"flcav: {taken}: Not a directory\n")


@each_task
def test_where_nothing_can_be_written_no_training_starts(task, data, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(type(task), "samples", None)  # not even called
    (tmp_path / "file").touch()
    for out in (tmp_path / "file" / "out", tmp_path / "file"):
        assert called("train", task.name, "--data", data.folder, "--out", out) == 2
        told = capsys.readouterr()
        assert told.err == f"flcav: {out}: Not a directory\n"


@pytest.mark.parametrize("task", [WEATHER, SIGNS, ROAD], ids=lambda task: task.name)
def test_a_bad_picture_is_one_sentence(task, tmp_path, capsys):
    weights = tmp_path / "weights.safetensors"
    save_network(task, build_network(task, small(task), 1), weights)
    bad = {
        "a picture of 1 channels (L); 3 are wanted": np.zeros((40, 60), np.uint8),
        "a picture of 1 channels (I;16); 3 are wanted": np.zeros((40, 60), np.uint16),
        "a picture of 4 channels (RGBA); 3 are wanted": np.zeros((40, 60, 4), np.uint8),
        "a picture of 60 x 20 pixels": np.zeros((20, 60, 3), np.uint8),
        "a picture of 1 x 1 pixels": np.zeros((1, 1, 3), np.uint8),
        "not a picture, or a damaged one": np.zeros((40, 60, 3), np.uint8),
    }
    for number, (said, pixels) in enumerate(bad.items()):
        path = tmp_path / f"{number}.png"
        Image.fromarray(pixels).save(path)
        if "damaged" in said:
            path.write_bytes(path.read_bytes()[:60])
        assert called("infer", task.name, path, "--weights", weights, "--json") == 2
        told = capsys.readouterr()
        assert told.out == ""
        assert told.err.count("\n") == 1
        assert f"{path}: {said}" in told.err


@each_task
def test_infer_writes_a_picture_of_each_input(task, data, tmp_path, capsys):
    weights, out = tmp_path / "weights.safetensors", tmp_path / "pictures"
    save_network(task, build_network(task, small(task), 1), weights)
    source = next(iter(sorted(data.folder.glob(FILES.get(task.name, "none")))), data.folder)
    assert called("infer", task.name, source, "--weights", weights, "--pictures", out) == 0
    assert capsys.readouterr().out.startswith(str(source))
    names = [path.stem for path in sorted(out.iterdir())]
    assert names == [f"{i:05d}_{name}" for i, name in enumerate([source.stem] if source.is_file() else shown(data))]


def test_a_picture_of_the_whole_space_counts_as_of_the_nearest_class(tmp_path):
    class Between(Drives):
        def frame(self, scene: str, index: int) -> Frame:
            return replace(super().frame(scene, index), weather=Weather(cloud_cover=0.31))  # nearest: cloudy

    record(Between(spins=2), tmp_path)
    data, network = Dataset.open(tmp_path), build_network(WEATHER, small(WEATHER), 1)
    with pytest.raises(InputError, match="no picture in any of the weathers clear"):
        WEATHER.evaluate(network, data)
    nearest = evaluate_whole_space(network, data)
    assert nearest.pictures == sum(nearest.confusion[1]) == 6
