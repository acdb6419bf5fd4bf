"""One federation client of the detector: its samples, and local steps on weights that come as arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from flcav.config import InputError
from flcav.perception.objects.config import Augmentation, SecondConfig
from flcav.perception.objects.model import second
from flcav.perception.objects.samples import Sample
from flcav.perception.objects.train import GLOBAL, train_steps
from flcav.perception.objects.weights import from_arrays, to_arrays


@dataclass(frozen=True)
class Trained:
    """What local training produced."""

    weights: dict[str, NDArray[Any]]
    samples: int  # distinct samples trained on
    loss: float  # mean over the steps


class ObjectsClient:
    """A vehicle's copy of the detector; shaped as federation's `Trainable`, which this layer does not import."""

    def __init__(
        self,
        config: SecondConfig,
        samples: Sequence[Sample],
        *,
        batch: int = 2,
        augmentation: Augmentation | None = GLOBAL,
    ) -> None:
        if not samples:
            raise InputError("a client with 0 samples cannot train")
        self.config, self.samples = config, samples
        self.batch, self.augmentation = batch, augmentation

    def train(self, weights: Mapping[str, NDArray[Any]], *, steps: int, learning_rate: float, seed: int) -> Trained:
        """Return the weights after `steps` local steps from `weights`; the same arguments give the same result."""
        network = second(self.config)
        from_arrays(network, weights)
        loss = train_steps(
            network,
            self.samples,
            steps=steps,
            batch=self.batch,
            learning_rate=learning_rate,
            seed=seed,
            augmentation=self.augmentation,
        )
        seen = min(len(self.samples), steps * min(self.batch, len(self.samples)))
        return Trained(to_arrays(network), seen, loss)
