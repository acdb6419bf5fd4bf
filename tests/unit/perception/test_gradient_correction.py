"""A client that corrects its gradients descends a loss with the correction's potential in it."""

from typing import Any, cast

import numpy as np
import pytest
import torch
from line_task import Line, LineTask, Slope

from flcav.config import InputError
from flcav.federation.loop import Schedule, federate
from flcav.federation.state import FederationState
from flcav.federation.strategies.corrections import Scaffold
from flcav.perception.client import TaskClient
from flcav.perception.weights import to_arrays

MU, STEPS = 0.7, 6
SHIFT = {"weight": np.array([[0.3]], np.float32), "bias": np.array([-0.2], np.float32)}


class PenalisedTask(LineTask):
    """Fits y = 2 x, with a proximal term and a linear one in the loss where they are given."""

    def __init__(self, start: Any = None, mu: float = 0.0, shift: Any = None) -> None:
        self.start, self.mu, self.shift = start, mu, shift

    def loss(self, network: Any, samples: Any) -> Any:
        total = super().loss(network, samples)
        for name, parameter in network.named_parameters():
            if self.mu:
                total = total + self.mu / 2 * ((parameter - torch.tensor(self.start[name])) ** 2).sum()
            if self.shift:
                total = total + (torch.tensor(self.shift[name]) * parameter).sum()
        return total


SAMPLES = [np.float32(number) for number in range(5)]


def train(task: LineTask, start: Any, **correction: Any) -> Any:
    client = TaskClient(cast(Any, task), Slope(), SAMPLES)
    return client.train(start, steps=STEPS, learning_rate=0.1, seed=4, **correction)


@pytest.fixture
def start() -> Any:
    torch.manual_seed(1)
    return to_arrays(Line(Slope()))


@pytest.mark.parametrize(("mu", "shift"), [(MU, None), (0.0, SHIFT), (MU, SHIFT)])
def test_the_correction_is_the_gradient_of_terms_in_the_loss(start, mu, shift):
    found = train(LineTask(), start, proximal=mu, shift=shift)
    expected = train(PenalisedTask(start, mu, shift), start)
    plain = train(LineTask(), start)
    for name in start:
        np.testing.assert_allclose(found.weights[name], expected.weights[name], rtol=1e-4)
        assert not np.allclose(found.weights[name], plain.weights[name], rtol=1e-3)
    assert set(found.gradient) == (set(start) if shift else set())


def test_the_gradient_is_the_mean_of_those_before_the_correction(start):
    seen = []

    class Watched(LineTask):
        def loss(self, network, samples):
            total = super().loss(network, samples)
            seen.append(torch.autograd.grad(total, list(network.parameters()), retain_graph=True))
            return total

    found = train(Watched(), start, proximal=MU, shift=SHIFT)
    for name, each in zip(("weight", "bias"), zip(*seen, strict=True), strict=True):
        np.testing.assert_allclose(found.gradient[name], torch.stack(each).mean(0).numpy(), rtol=1e-5)


def test_named_layers_alone_are_trained(start):
    found = train(LineTask(), start, layers=("b*",))
    assert np.array_equal(found.weights["weight"], start["weight"])
    assert not np.array_equal(found.weights["bias"], start["bias"])
    with pytest.raises(InputError, match="layers head: match no parameter"):
        train(LineTask(), start, layers=("head",))


def test_tasks_of_the_package_can_be_corrected(start):
    clients = {f"cav{i}": TaskClient(cast(Any, LineTask()), Slope(), SAMPLES[i:]) for i in range(2)}
    schedule, state = Schedule(1, STEPS, learning_rate=0.1, final_learning_rate=0.1, seed=0), FederationState()
    federate(clients, start, schedule, strategy=Scaffold(), state=state)
    for name in start:
        variates = [arrays[name] for kinds in state.clients.values() for arrays in kinds.values()]
        assert len(variates) == len(clients)
        assert not np.allclose(variates, 0)
        np.testing.assert_allclose(state.server[name], np.mean(variates, axis=0), rtol=1e-6)
