"""The trajectory task: trajectory prediction of vehicles as a `Task`."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from flcav.config import Json
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.errors import Registry
from flcav.perception.study import StudyRecipe
from flcav.perception.task import Finding, Practice
from flcav.perception.trajectory.config import CONFIGURATIONS, TrajectoryConfig
from flcav.perception.trajectory.errors import register_errors
from flcav.perception.trajectory.evaluate import TrajectoryEvaluation, evaluate_paths
from flcav.perception.trajectory.infer import forecast_frames
from flcav.perception.trajectory.loss import batch_loss
from flcav.perception.trajectory.messages import pack_frames, unpack_frames
from flcav.perception.trajectory.model import TrajectoryNetwork
from flcav.perception.trajectory.outcomes import TrajectoryOutcomes
from flcav.perception.trajectory.predict import predict
from flcav.perception.trajectory.samples import Sample, samples_of, select_fitting_frames


class TrajectoryTask(TrajectoryOutcomes):
    """Trajectory prediction: K paths of a vehicle over the next three seconds."""

    name = "trajectory"
    family = "trajectory-lstm"
    configurations = CONFIGURATIONS
    practice = Practice(batch=64, learning_rate=2e-3)
    recording: Mapping[str, Json] = {
        "vehicle_rig": {"lidars": {"lidar": {"mount": {"z": 1.85}, "settings": {"channels": 4, "azimuth_steps": 90}}}},
        "every_s": 0.5,
    }
    labels = ("future",)

    def study(self) -> StudyRecipe:
        """Return the study recipe, see `flcav.perception.trajectory.study`."""
        from flcav.perception.trajectory.study import STUDY

        return STUDY

    def build(self, config: TrajectoryConfig) -> TrajectoryNetwork:
        """Return a network with random initial weights."""
        return TrajectoryNetwork(config)

    def samples(self, data: Dataset, config: TrajectoryConfig, frames: Sequence[int] | None = None) -> Sequence[Sample]:
        """Return the vehicles of the frames with a complete past and future, see `samples_of`."""
        return samples_of(data, config, frames)

    def fitting(self, data: Dataset, config: TrajectoryConfig) -> Sequence[int]:
        """Return the numbers of the frames that can have samples, see `select_fitting_frames`."""
        return select_fitting_frames(data, config.cameras is not None)

    def draw(self, samples: Sequence[Sample], index: int, config: TrajectoryConfig, rng: np.random.Generator) -> Sample:
        """Return the sample without augmentation: its frame already removes rotation and translation."""
        return samples[index]

    def loss(self, network: TrajectoryNetwork, samples: Sequence[Sample]) -> Tensor:
        """Return the loss of the forecast, with cameras plus the weighted loss of the map's segmentation."""
        return batch_loss(network, samples)

    def evaluate(
        self,
        network: TrajectoryNetwork,
        data: Dataset,
        frames: Sequence[int] | None = None,
        *,
        progress: Report = ignore_progress,
    ) -> TrajectoryEvaluation:
        """Return displacement errors of single path, K modes and constant velocity by slice, see `evaluate_paths`."""
        samples = samples_of(data, network.config, frames)
        paths, probabilities = predict(network, samples, progress)
        seen = samples.columns
        return evaluate_paths(paths, probabilities, seen.past, seen.future, seen.at_junction, seen.scene)

    def pack_samples(self, data: Dataset, config: TrajectoryConfig, frames: Sequence[int]) -> Iterator[bytes]:
        """Yield the message of each frame: its samples, see `flcav.perception.trajectory.messages`."""
        return pack_frames(data, config, frames)

    def unpack_samples(self, messages: Sequence[bytes], config: TrajectoryConfig) -> list[Sample]:
        """Return the samples in messages of `pack_samples`, each once."""
        return unpack_frames(messages)

    def infer(
        self, network: TrajectoryNetwork, path: Path, threshold: float = 0.0, frames: Sequence[int] | None = None
    ) -> Iterator[Finding]:
        """Yield the forecasts of each frame of a dataset, see `forecast_frames`; all modes, whatever the threshold."""
        yield from forecast_frames(network, path, frames)

    def register_errors(
        self,
        network: TrajectoryNetwork,
        data: Dataset,
        frames: Sequence[int] | None = None,
        threshold: float = 0.0,
        progress: Report = ignore_progress,
    ) -> Registry:
        """Return the misses, see `flcav.perception.trajectory.errors.register_errors`; `threshold` has no effect."""
        return register_errors(network, data, samples_of(data, network.config, frames), progress)


TRAJECTORY = TrajectoryTask()
