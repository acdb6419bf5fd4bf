"""Outcomes of the weather task: true and predicted class of each image, and the accuracy of bootstrap samples."""

from collections.abc import Mapping, Sequence

import numpy as np

from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.outcomes import Outcomes, Times, Values, weighted_mean
from flcav.perception.weather.model import Classifier
from flcav.perception.weather.predict import predict_probabilities
from flcav.perception.weather.samples import label_pictures
from flcav.statistics.bootstrap import REDRAWS


class WeatherOutcomes:
    """Measure of the weather task: accuracy, the share of images whose class is predicted correctly."""

    measure_name = "accuracy"
    redraws = REDRAWS

    def outcomes(
        self, network: Classifier, data: Dataset, frames: Sequence[int], progress: Report = ignore_progress
    ) -> Outcomes:
        """Return the true class ("truth") and the predicted class ("named") of each image, as indices."""
        samples = label_pictures(data, network.config.classes, frames)
        named = predict_probabilities(network, [sample.picture for sample in samples], progress).argmax(1)
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
