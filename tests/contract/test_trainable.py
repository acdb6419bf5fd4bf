"""Every task's client is what a federation asks for."""

import inspect

import numpy as np
import pytest

from flcav.federation.trainable import Trainable
from flcav.geometry import Boxes
from flcav.perception.objects import Sample, second_tiny
from flcav.perception.objects.client import ObjectsClient
from flcav.perception.objects.weights import to_arrays


def objects() -> tuple[Trainable, dict[str, np.ndarray]]:
    network = second_tiny()
    points = np.random.default_rng(0).uniform((5, -9, -2, 0), (40, 9, 0, 1), (500, 4)).astype(np.float32)
    sample = Sample(points, Boxes.from_array([[20, 0, -1, 4.4, 1.8, 1.6, 0]], "Car"))
    return ObjectsClient(network.config, [sample, sample]), to_arrays(network)


CLIENTS = {"objects": objects}


@pytest.mark.parametrize("name", CLIENTS)
def test_a_client_is_trainable(name):
    client, weights = CLIENTS[name]()
    assert inspect.signature(client.train).parameters.keys() == {"weights", "steps", "learning_rate", "seed"}
    before = {key: array.copy() for key, array in weights.items()}
    one = client.train(weights, steps=1, learning_rate=1e-3, seed=3)
    other = client.train(weights, steps=1, learning_rate=1e-3, seed=3)
    assert list(one.weights) == list(weights)
    assert all(array.dtype == weights[key].dtype for key, array in one.weights.items())
    assert all(np.array_equal(array, weights[key]) for key, array in before.items())  # its input is left alone
    assert all(np.array_equal(array, other.weights[key]) for key, array in one.weights.items())
    assert one.samples > 0
    assert np.isfinite(one.loss)
    still = client.train(weights, steps=0, learning_rate=1e-3, seed=3)
    assert all(np.array_equal(array, weights[key]) for key, array in still.weights.items())
