"""Predictions of the weather classifier, their metrics, and the outcomes per image for intervals over scenes.

Metrics are accuracy, recall per class, and the confusion matrix.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from flcav.arrays import Ints, Mask
from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.perception.device import inference
from flcav.perception.images import Picture, read_pictures
from flcav.perception.marks import Bars
from flcav.perception.metrics import interval_words
from flcav.perception.outcomes import Counted, Outcomes, Times, Values, weighted_mean
from flcav.perception.task import Evaluated, Finding, Result
from flcav.perception.weather.model import Classifier, LeNetConfig
from flcav.perception.weather.samples import Sample, label_pictures, reduce_picture, stack_pictures
from flcav.statistics.bootstrap import REDRAWS, bootstrap_over_scenes
from flcav.statistics.estimates import CONFIDENCE
from flcav.statistics.streams import stream
from flcav.storage.records import LEFT_OUT, Class
from flcav.world.weather import find_nearest_class


@dataclass(frozen=True, kw_only=True)
class Classification(Evaluated):
    """Accuracy, recall per class and confusion matrix on some images."""

    accuracy: float
    low: float | None  # bounds of the 95 % bootstrap interval over scenes; None for a single scene
    high: float | None
    confidence: float = CONFIDENCE
    recall: Mapping[str, float | None]  # by class; None for a class without images
    classes: tuple[str, ...]
    confusion: tuple[tuple[int, ...], ...]  # numbers of images: rows are the true class, columns the predicted one
    pictures: int  # number of images
    scenes: int  # number of scenes
    nearest: Annotated["Classification | None", LEFT_OUT] = None  # on all images, see `evaluate_whole_space`

    @property
    def score(self) -> float:
        """Return the accuracy."""
        return self.accuracy

    def numbers(self) -> Mapping[str, float]:
        """Return the accuracy on images within the classes' regions, and on all images if `nearest` is there."""
        nearest = {} if self.nearest is None else {"nearest class": self.nearest.accuracy}
        return {"accuracy": self.accuracy, **nearest}

    def lines(self) -> list[str]:
        """Return a line with the accuracy, then a line per class with its recall and confusions."""
        interval = interval_words(self.low, self.high)
        if self.low is not None:
            interval += f" ({100 * self.confidence:g} %, over scenes)"
        seen = f"{plural(self.pictures, 'picture')} of {plural(self.scenes, 'scene')}"
        lines = [f"{seen}: accuracy {self.accuracy:.3f} {interval}"]
        for name, row in zip(self.classes, self.confusion, strict=True):
            recall = self.recall[name]
            taken = [f"{other} {count}" for other, count in zip(self.classes, row) if count and other != name]
            known = "no pictures" if recall is None else f"recall {recall:.3f} of {sum(row)}"
            lines.append(f"{name:<12}{known}" + (f"; taken for {', '.join(taken)}" if taken else ""))
        return lines


def evaluate_classes(
    truth: Ints, found: Ints, scenes: Sequence[str], classes: Sequence[str], seed: int = 0
) -> Classification:
    """Return accuracy with its 95 % bootstrap interval over scenes, recall per class, and the confusion matrix.

    `truth` and `found` (N,) are the true and the predicted class indices, `scenes` names the scene of each image.
    Whole scenes are redrawn, since the images of a scene are correlated.
    """
    confusion = np.zeros((len(classes), len(classes)), np.int64)
    np.add.at(confusion, (truth, found), 1)
    low, high = _interval(truth == found, scenes, seed)
    recall = {
        name: float(row[i] / row.sum()) if row.sum() else None for i, (name, row) in enumerate(zip(classes, confusion))
    }
    return Classification(
        accuracy=float((truth == found).mean()),
        low=low,
        high=high,
        recall=recall,
        classes=tuple(classes),
        confusion=tuple(map(tuple, confusion.tolist())),
        pictures=len(truth),
        scenes=len(set(scenes)),
    )


def evaluate_samples(
    network: Classifier, samples: Sequence[Sample], progress: Report = ignore_progress
) -> Classification:
    """Return the classification metrics of a network on labelled images, see `evaluate_classes`."""
    found = predict_probabilities(network, [sample.picture for sample in samples], progress).argmax(1)
    truth = np.array([sample.label for sample in samples])
    return evaluate_classes(truth, found, [sample.scene for sample in samples], network.config.classes)


def evaluate_whole_space(network: Classifier, data: Dataset) -> Classification:
    """Return the classification metrics on all images: weathers outside the regions get the nearest class.

    Raises `InputError` as `label_pictures` does.
    """
    samples = label_pictures(data, network.config.classes, named=find_nearest_class)
    return evaluate_samples(network, samples)


def _interval(right: Mask, scenes: Sequence[str], seed: int) -> tuple[float, float] | tuple[None, None]:
    if len(set(scenes)) < 2:
        return None, None
    return bootstrap_over_scenes(lambda times: times @ right / times.sum(axis=1), scenes, rng=stream(seed, "bootstrap"))


BATCH = 256  # images of a batch of inference


@dataclass(frozen=True)
class Named(Result):
    """Classification of one image: the likeliest class, and the probability of each class."""

    label: Class
    probabilities: Mapping[str, float]  # by class

    def lines(self) -> list[str]:
        """Return one line with the class and its probability."""
        return [f"{self.label} ({self.probabilities[self.label]:.2f})"]


def predict_probabilities(
    network: Classifier, small_pictures: Sequence[Picture], progress: Report = ignore_progress
) -> np.ndarray:
    """Return the class probabilities (N, classes) of images of 32 x 32 pixels.

    The network's training mode is left as it was.
    """
    parts = []
    with inference(network):
        for first in range(0, len(small_pictures), BATCH):
            logits = network(tensor_of(network, list(small_pictures[first : first + BATCH])))
            parts.append(logits.softmax(1).cpu().numpy())
            progress(min(first + BATCH, len(small_pictures)), len(small_pictures), "")
    return np.concatenate(parts)


def tensor_of(network: Classifier, small_pictures: list[Picture]) -> Tensor:
    """Return images as the network's input tensor (N, 3, 32, 32) in [-1, 1], on its device."""
    return torch.from_numpy(stack_pictures(small_pictures)).to(next(network.parameters()).device)


def classify_pictures(network: Classifier, path: Path, frames: Sequence[int] | None = None) -> Iterator[Finding]:
    """Yield the class probabilities and the likeliest class of each image at `path`.

    Raises `InputError` as `flcav.perception.images.read_pictures` does.
    """
    classes = network.config.classes
    for origin, rgb in read_pictures(path, frames):
        shares = predict_probabilities(network, [reduce_picture(rgb)])[0]
        rows = {name: float(share) for name, share in zip(classes, shares, strict=True)}
        yield Finding(origin, rgb, Named(classes[int(shares.argmax())], rows), (Bars(rows),))


class WeatherOutcomes:
    """Measure of the weather task: accuracy, the share of images whose class is predicted correctly."""

    measure_name = "accuracy"
    redraws = REDRAWS

    def describe_targets(self, config: LeNetConfig) -> str:
        """Return the classes of a network in words."""
        return f"pictures of {', '.join(sorted(config.classes))}"

    def share_targets(self, configs: Sequence[LeNetConfig]) -> LeNetConfig:
        """Return the first configuration with the classes that all have; raises `InputError` for none in common."""
        classes = tuple(name for name in configs[0].classes if all(name in config.classes for config in configs))
        if not classes:
            targets = "; ".join(map(self.describe_targets, configs))
            raise InputError(f"the networks look for nothing in common: {targets}")
        return replace(configs[0], classes=classes)

    def outcomes(
        self,
        network: Classifier,
        data: Dataset,
        frames: Sequence[int],
        progress: Report = ignore_progress,
        asked: LeNetConfig | None = None,
    ) -> Outcomes:
        """Return the true class ("truth") and the predicted class ("named") of each image, as indices.

        asked: a configuration with the classes whose images count; None: that of the network. Predictions of other
        classes have the number of these classes as their index.
        """
        classes = (asked or network.config).classes
        samples = label_pictures(data, classes, frames)
        number = np.array([[*classes, name].index(name) for name in network.config.classes])
        named = number[predict_probabilities(network, [sample.picture for sample in samples], progress).argmax(1)]
        truth = np.array([sample.label for sample in samples])
        return Outcomes(np.array([sample.scene for sample in samples]), {"truth": truth, "named": named})

    def measure(self, outcomes: Outcomes, times: Times) -> Values:
        """Return the accuracy of each bootstrap sample."""
        return weighted_mean((outcomes.arrays["truth"] == outcomes.arrays["named"]).astype(np.float64), times)

    def numbers(self, outcomes: Outcomes) -> Mapping[str, float | None]:
        """Return the lowest recall of a class, and the number of images."""
        truth, named = outcomes.arrays["truth"], outcomes.arrays["named"]
        recalls = [float((named[truth == label] == label).mean()) for label in np.unique(truth)]
        return {"least recall": min(recalls), "pictures": float(len(truth))}

    def count(self, outcomes: Outcomes) -> Counted:
        """Return the number of images, and of those whose class is predicted correctly."""
        truth, named = outcomes.arrays["truth"], outcomes.arrays["named"]
        return Counted("pictures", len(truth), int((truth == named).sum()), None)
