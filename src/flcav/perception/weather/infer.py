"""Inference on images of files, folders and datasets: findings with the probability of each class of weather."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from flcav.perception.images import read_pictures
from flcav.perception.marks import Bars
from flcav.perception.task import Finding
from flcav.perception.weather.model import Classifier
from flcav.perception.weather.predict import Named, predict_probabilities
from flcav.perception.weather.samples import reduce_picture


def classify_pictures(network: Classifier, path: Path, frames: Sequence[int] | None = None) -> Iterator[Finding]:
    """Yield the class probabilities and the likeliest class of each image at `path`.

    Raises `InputError` as `flcav.perception.images.read_pictures` does.
    """
    classes = network.config.classes
    for origin, rgb in read_pictures(path, frames):
        shares = predict_probabilities(network, [reduce_picture(rgb)])[0]
        rows = {name: float(share) for name, share in zip(classes, shares, strict=True)}
        yield Finding(origin, rgb, Named(classes[int(shares.argmax())], rows), (Bars(rows),))
