"""Every task satisfies one protocol: trained, resumed, saved and federated by the same code."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from flcav.config import InputError
from flcav.federation.runtimes.metered import Account
from flcav.federation.stages import Schedule, federate
from flcav.federation.trainable import Trainable
from flcav.geometry import Boxes
from flcav.network.ledger import Budget, Ledger
from flcav.perception.client import TaskClient
from flcav.perception.objects import Sample
from flcav.perception.objects.task import OBJECTS
from flcav.perception.task import Task, configuration, fresh
from flcav.perception.training import Checkpointing, Validation, train
from flcav.perception.weather import samples as weather_samples
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import load_network, save_network, to_arrays


def sweeps() -> list[Sample]:
    random = np.random.default_rng(0)
    clouds = [random.uniform((5, -9, -2, 0), (40, 9, 0, 1), (500, 4)).astype(np.float32) for _ in range(4)]
    return [Sample(cloud, Boxes.from_array([[20, 0, -1, 4.4, 1.8, 1.6, 0]], "Car")) for cloud in clouds]


def skies() -> list[weather_samples.Sample]:
    random = np.random.default_rng(0)
    return [
        weather_samples.Sample(random.integers(0, 256, (32, 32, 3), dtype=np.uint8), label % 8) for label in range(12)
    ]


@dataclass(frozen=True)
class Case:
    task: Task[Any, Any, Any]
    make: Callable[[], list[Any]]

    @property
    def config(self) -> Any:
        return configuration(self.task, None)

    @property
    def samples(self) -> list[Any]:
        return self.make()


CASES = [Case(WEATHER, skies), Case(OBJECTS, sweeps)]
TASKS = pytest.mark.parametrize("case", CASES, ids=[case.task.name for case in CASES])


def same(one, other) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(to_arrays(one).values(), to_arrays(other).values(), strict=True))


@TASKS
def test_a_seed_names_a_training(case):
    networks = [fresh(case.task, case.config, 1) for _ in range(3)]
    for network, seed in zip(networks, (3, 3, 4), strict=True):
        history = train(case.task, network, case.samples, steps=2, seed=seed)
        assert np.isfinite(history.losses).all()
    assert same(networks[0], networks[1])
    assert not same(networks[0], networks[2])
    assert not same(networks[0], fresh(case.task, case.config, 1))


class Killed(Exception):
    """Stands for SIGKILL: nothing is caught, nothing is written after it."""


@TASKS
@pytest.mark.parametrize("validated", [False, True])
def test_a_killed_training_goes_on_to_the_same_weights(case, validated, tmp_path):
    def score(network) -> float:
        return -float(sum(np.abs(array).sum() for array in to_arrays(network).values()))

    validation = Validation(score, every=2, patience=9) if validated else None
    settings = {"steps": 6, "seed": 3, "validation": validation}
    whole, cut, resumed = (fresh(case.task, case.config, 1) for _ in range(3))
    losses = train(case.task, whole, case.samples, **settings)
    checkpointing = Checkpointing(tmp_path / "checkpoint.pt", every=3)

    def kill(done, total, note):
        if done == 4:
            raise Killed

    with pytest.raises(Killed):
        train(case.task, cut, case.samples, checkpointing=checkpointing, progress=kill, **settings)
    again = train(case.task, resumed, case.samples, checkpointing=checkpointing, **settings)
    assert np.array_equal(losses.losses, again.losses)
    assert np.array_equal(losses.scores, again.scores)
    assert len(again.scores) == (3 if validated else 0)
    assert same(whole, resumed)


@TASKS
def test_weights_come_back_and_those_of_another_task_are_refused(case, tmp_path):
    network = fresh(case.task, case.config, 1)
    save_network(case.task, network, tmp_path / "weights.safetensors")
    loaded = load_network(case.task, tmp_path / "weights.safetensors")
    assert same(network, loaded)
    assert loaded.config == case.config
    assert not loaded.training
    for other in (other.task for other in CASES if other is not case):
        with pytest.raises(InputError, match=f"'{case.task.family}'.*'{other.name}' takes those of '{other.family}'"):
            load_network(other, tmp_path / "weights.safetensors")


@TASKS
def test_a_client_is_trainable(case):
    client: Trainable = TaskClient(case.task, case.config, case.samples)
    assert inspect.signature(client.train).parameters.keys() == {"weights", "steps", "learning_rate", "seed"}
    weights = to_arrays(fresh(case.task, case.config, 1))
    before = {key: array.copy() for key, array in weights.items()}
    one, other = (client.train(weights, steps=1, learning_rate=1e-3, seed=3) for _ in range(2))
    assert list(one.weights) == list(weights)
    assert all(array.dtype == weights[key].dtype for key, array in one.weights.items())
    assert all(np.array_equal(array, weights[key]) for key, array in before.items())  # its input is left alone
    assert all(np.array_equal(array, other.weights[key]) for key, array in one.weights.items())
    assert one.samples > 0
    assert np.isfinite(one.loss)
    still = client.train(weights, steps=0, learning_rate=1e-3, seed=3)
    assert all(np.array_equal(array, weights[key]) for key, array in still.weights.items())


@TASKS
def test_two_clients_federate(case):
    half = len(case.samples) // 2
    clients = {
        "cav0": TaskClient(case.task, case.config, case.samples[:half]),
        "cav1": TaskClient(case.task, case.config, case.samples[half:]),
    }
    weights = to_arrays(fresh(case.task, case.config, 1))
    ledger = Ledger(Budget(wireless_mb=100.0, wireline_mb=0.0))
    schedule = Schedule(rounds=1, steps=1, learning_rate=1e-3, final_learning_rate=1e-3, seed=1)
    result = federate(clients, weights, schedule, Account(ledger, "edge", case.task.name, "wireless"))
    assert list(result.weights) == list(weights)
    assert any(not np.array_equal(result.weights[name], weights[name]) for name in weights)
    assert ledger.used_mb("wireless") > 0
    assert np.isfinite(result.loss)
