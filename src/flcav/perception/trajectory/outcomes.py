"""Outcomes of the trajectory task: displacement errors of each road user, and the score of bootstrap samples."""

from collections.abc import Mapping, Sequence

import numpy as np

from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.outcomes import Outcomes, Times, Values, weighted_mean
from flcav.perception.trajectory.evaluate import MISS_M, compute_errors
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.predict import predict
from flcav.perception.trajectory.samples import samples_of
from flcav.perception.trajectory.tracks import constant_velocity
from flcav.statistics.bootstrap import REDRAWS

NUMBERS = {
    "single path FDE m": "single_FDE",
    "best mode FDE m": "minFDE_K",
    "constant velocity FDE m": "constant_velocity_FDE",
}


class TrajectoryOutcomes:
    """Measure of the trajectory task: 1 / (1 + (minFDE_1 + minFDE_K) / 2), errors in metres."""

    measure_name = "1 / (1 + FDE in m)"
    redraws = REDRAWS

    def outcomes(
        self, network: TrajectoryNetwork, data: Dataset, frames: Sequence[int], progress: Report = ignore_progress
    ) -> Outcomes:
        """Return the displacement errors of each sample [m], see `compute_errors`."""
        samples = samples_of(data, network.config, frames)
        paths, probabilities = predict(network, samples, progress)
        columns = samples.columns
        future = columns.future.astype(np.float64)
        errors = compute_errors(paths, probabilities, future, constant_velocity(columns.past))
        return Outcomes(np.asarray(columns.scene, dtype=np.str_), errors)

    def measure(self, outcomes: Outcomes, times: Times) -> Values:
        """Return the score of each bootstrap sample."""
        likeliest, best = (weighted_mean(outcomes.arrays[name], times) for name in ("minFDE_1", "minFDE_K"))
        return 1 / (1 + (likeliest + best) / 2)

    def numbers(self, outcomes: Outcomes) -> Mapping[str, float | None]:
        """Return mean final errors [m], the miss rate of the single path, and the number of samples."""
        errors = outcomes.arrays
        means = {name: float(errors[column].mean()) for name, column in NUMBERS.items()}
        return {
            **means,
            "missed": float((errors["single_FDE"] > MISS_M).mean()),
            "road users": float(len(outcomes.scene)),
        }
