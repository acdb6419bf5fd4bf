"""Drives of ten vehicles through all weathers: the pictures of each, held-out ones, and a pretrained network."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flcav.config import parse_config
from flcav.dataset.recording.recorder import record
from flcav.dataset.store import Dataset
from flcav.perception.client import camera_ahead
from flcav.perception.task import build_network
from flcav.perception.training import train
from flcav.perception.weather.config import LeNetConfig
from flcav.perception.weather.model import Classifier
from flcav.perception.weather.predict import predict_probabilities
from flcav.perception.weather.samples import Sample
from flcav.perception.weather.task import WEATHER
from flcav.perception.weights import from_arrays, to_arrays
from flcav.progress import Report, ignore_progress
from flcav.sources.embedded import EmbeddedSource
from flcav.sources.recipe import Recipe
from flcav.world.weather import WEATHER_CLASSES

CONFIG = LeNetConfig()
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
PRETRAINING_SCENES = 3  # the first ones: their pictures are the cloud's, and no vehicle's
PRETRAINING_STEPS, BATCH, LEARNING_RATE = 100, 16, 2e-3

Weights = Mapping[str, NDArray[np.number]]


@dataclass(frozen=True)
class Drives:
    """Labelled pictures of a federation."""

    pretraining: Sequence[Sample]  # of the cloud
    vehicles: Mapping[str, Sequence[Sample]]  # by name
    test: Sequence[Sample]  # of other drives in the same town


def record_drives(out: Path, progress: Report = ignore_progress) -> Drives:
    """Record the drives into `out`, or go on with what is there; return their pictures."""
    for name, recipe in (("train", RECIPE), ("test", TEST)):
        record(EmbeddedSource(parse_config(Recipe, dict(recipe), name)), out / name, progress=progress)
    return read_drives(Dataset.open(out / "train"), Dataset.open(out / "test"))


def read_drives(data: Dataset, test: Dataset) -> Drives:
    """Return the pictures of recorded drives: those of the first scenes are the cloud's."""
    pretraining_scenes = sorted({key.scene for key in data.keys})[:PRETRAINING_SCENES]
    frames: dict[str, list[int]] = {}
    for number, key in enumerate(data.keys):
        owner = "cloud" if key.scene in pretraining_scenes else key.agent
        frames.setdefault(owner, []).append(number)
    samples = {owner: WEATHER.samples(data, CONFIG, numbers) for owner, numbers in sorted(frames.items())}
    return Drives(samples.pop("cloud"), samples, WEATHER.samples(test, CONFIG))


def pretrain(drives: Drives, seed: int) -> Weights:
    """Return the weights that the cloud hands to the vehicles: a short training on its own pictures."""
    network = build_network(WEATHER, CONFIG, seed)
    train(
        WEATHER,
        network,
        drives.pretraining,
        steps=PRETRAINING_STEPS,
        batch=BATCH,
        learning_rate=LEARNING_RATE,
        seed=seed,
    )
    return to_arrays(network)


def load(weights: Weights) -> Classifier:
    """Return a network with these weights."""
    network = build_network(WEATHER, CONFIG, 0)
    from_arrays(network, weights)
    return network


def find_right(weights: Weights, samples: Sequence[Sample]) -> NDArray[np.bool_]:
    """Return whether the network names the class of each picture (N,)."""
    with np.errstate(all="ignore"):  # of weights that an attack made useless
        found = predict_probabilities(load(weights), [each.picture for each in samples]).argmax(1)
    return found == np.array([each.label for each in samples])
