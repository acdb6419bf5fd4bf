"""Drives of ten vehicles through all weathers, which train and exchange the last two layers of LeNet.

The convolutions are those of the package's network and are frozen. A picture is represented by its 120 features (layer
C5), and a local step is a few matrix products.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.federation.trainable import LocalUpdate, Weights
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.client import camera_ahead
from flcav.perception.networks import resolve_network
from flcav.perception.task import build_network
from flcav.perception.training import batches
from flcav.perception.weather.evaluate import tensor_of
from flcav.perception.weather.model import Classifier, LeNet
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import to_arrays
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.statistics.bootstrap import share_scenes
from flcav.statistics.seeds import OWN_SCENES, MeanOverSeeds, SharedScenes, mean_over_seeds
from flcav.statistics.streams import derive_seed, stream
from flcav.world.weather import WEATHER_CLASSES

RECIPE: Mapping[str, Any] = {
    "town": "ring",
    "seed": 9101,
    "split": "train",
    "scenes": 12,
    "warmup_s": 30.0,
    "spins_per_scene": 8,
    "every_s": 4.0,  # a spin in each weather
    "cavs": 10,
    "vehicle_rig": camera_ahead(96, 64, 90.0),
    "weather": {"classes": list(WEATHER_CLASSES), "turn_s": 4.0},
}
TEST: Mapping[str, Any] = {**RECIPE, "seed": 9102, "split": "test", "scenes": 10, "cavs": 4}
CLASSES, BATCH = len(WEATHER_CLASSES), 16
HIDDEN, OUT = "layers.9", "layers.11"  # F6 and the output layer of `LeNet.layers`
F6 = 9  # index of F6 in `LeNet.layers`

Vector = NDArray[np.float32]
Labels = NDArray[np.int64]


@dataclass(frozen=True)
class Pictures:
    """N labelled pictures, represented by the features of the convolutions."""

    features: Vector  # (N, 120)
    labels: Labels  # (N,)
    scenes: tuple[str, ...]


@dataclass(frozen=True)
class Drives:
    """Pictures of a federation's vehicles and of its test."""

    vehicles: Mapping[str, Pictures]  # by name
    test: Pictures  # of other drives in the same town


def record_drives(out: Path, progress: Report = ignore_progress) -> Drives:
    """Record the drives to `out`, or resume an interrupted recording, and return their pictures."""
    for name, recipe in (("train", RECIPE), ("test", TEST)):
        record(EmbeddedSource(parse_config(Recipe, dict(recipe), name)), out / name, progress=progress)
    data = Dataset.open(out / "train")
    network = resolve_network(WEATHER, None)
    frames: dict[str, list[int]] = {}
    for number, key in enumerate(data.keys):
        frames.setdefault(key.agent, []).append(number)
    vehicles = {name: see_pictures(network, data, frames[name]) for name in sorted(frames)}
    return Drives(vehicles, see_pictures(network, Dataset.open(out / "test"), None))


def see_pictures(network: Classifier, data: Dataset, frames: Sequence[int] | None) -> Pictures:
    """Return the features of the labelled pictures in frames of a dataset (None: all)."""
    assert isinstance(network, LeNet)
    samples = WEATHER.samples(data, network.config, frames)
    with torch.inference_mode():
        features = network.layers[:F6](tensor_of(network, [sample.picture for sample in samples])).numpy()
    labels = np.array([sample.label for sample in samples])
    return Pictures(features, labels, tuple(sample.scene for sample in samples))


def draw_head(seed: int) -> Weights:
    """Return initial weights of the two layers: those of a new LeNet, unlike the frozen convolutions."""
    arrays = to_arrays(build_network(WEATHER, WEATHER.configurations["tiny"], derive_seed(seed, "head")))
    return {name: array for name, array in arrays.items() if name.startswith((f"{HIDDEN}.", f"{OUT}."))}


def predict(weights: Weights, features: Vector) -> tuple[Vector, Vector]:
    """Return the activations of F6 (N, 84) and the class probabilities (N, 8) for features (N, 120)."""
    with np.errstate(all="ignore"):  # weights may overflow after an attack
        hidden = np.maximum(features @ weights[f"{HIDDEN}.weight"].T + weights[f"{HIDDEN}.bias"], 0)
        logits = hidden @ weights[f"{OUT}.weight"].T + weights[f"{OUT}.bias"]
        powers = np.exp(logits - logits.max(axis=1, keepdims=True))
        return hidden, powers / powers.sum(axis=1, keepdims=True)


def find_right(weights: Weights, pictures: Pictures) -> NDArray[np.bool_]:
    """Return a mask (N,) of the correctly classified pictures."""
    return predict(weights, pictures.features)[1].argmax(axis=1) == pictures.labels


def spread_over_scenes(pictures: Pictures, values: Sequence[NDArray[np.float64]]) -> SharedScenes:
    """Return the spread of a mean over pictures and seeds under resampling of the test scenes, which seeds share.

    `values` are numbers (N,) of the pictures by seed. For a single seed it is `OWN_SCENES`.
    """
    if len(values) == 1:
        return OWN_SCENES
    measures = [lambda times, each=each: times @ each / np.maximum(times.sum(axis=1), 1) for each in values]
    return share_scenes(measures, [pictures.scenes] * len(values), rng=stream(0, "scenes"))


def average_pictures(pictures: Pictures, values: Sequence[NDArray[np.float64]], *, share: bool) -> MeanOverSeeds:
    """Return the mean over seeds and pictures; `values` are numbers (N,) of the pictures by seed."""
    means = [float(of_seed.mean()) for of_seed in values]
    return mean_over_seeds(means, share=share, shared=spread_over_scenes(pictures, values))


def measure_losses(weights: Weights, pictures: Pictures) -> NDArray[np.float64]:
    """Return the cross entropies (N,) of the pictures."""
    probabilities = predict(weights, pictures.features)[1]
    return -np.log(np.maximum(probabilities[np.arange(len(pictures.labels)), pictures.labels], 1e-30))


def differentiate(weights: Weights, features: Vector, labels: Labels) -> dict[str, Vector]:
    """Return the gradient of the mean cross entropy of a batch, by name of array."""
    hidden, probabilities = predict(weights, features)
    at_output = (probabilities - np.eye(CLASSES, dtype=np.float32)[labels]) / len(labels)
    at_hidden = (at_output @ weights[f"{OUT}.weight"]) * (hidden > 0)
    slopes = {
        f"{HIDDEN}.weight": at_hidden.T @ features,
        f"{HIDDEN}.bias": at_hidden.sum(axis=0),
        f"{OUT}.weight": at_output.T @ hidden,
        f"{OUT}.bias": at_output.sum(axis=0),
    }
    return {name: np.asarray(slope, np.float32) for name, slope in slopes.items()}


@dataclass(frozen=True)
class Vehicle:
    """A client that takes plain gradient steps on its pictures."""

    pictures: Pictures
    batch: int = BATCH

    def train(self, weights: Weights, *, steps: int, learning_rate: float, seed: int) -> LocalUpdate:
        """Return the weights after `steps` steps of gradient descent."""
        seen, reached, losses = self.pictures, dict(weights), []
        for places in batches(len(seen.labels), self.batch, steps, seed):
            features, labels = seen.features[places], seen.labels[places]
            losses.append(float(measure_losses(reached, Pictures(features, labels, ())).mean()))
            for name, slope in differentiate(reached, features, labels).items():
                reached[name] = reached[name] - np.float32(learning_rate) * slope
        return LocalUpdate(reached, len(seen.labels), float(np.mean(losses)))
