"""Learning curves: the error that is left after so many samples, edge rounds and cloud rounds."""

from typing import Annotated, ClassVar, Literal, Self, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from flcav.config import Config

STAGES = ("pretrain", "edge", "cloud")  # measured in samples, edge rounds, cloud rounds

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Sizeable = Annotated[float, Field(ge=1e-9)]  # small enough for every curve, and large enough to divide by


Array = NDArray[np.float64]


@overload
def effective_samples(samples: float, t: float, alpha: float, group: float) -> float: ...
@overload
def effective_samples(samples: float | Array, t: Array, alpha: float | Array, group: float | Array) -> Array: ...
def effective_samples(
    samples: float | Array, t: float | Array, alpha: float | Array, group: float | Array
) -> float | Array:
    """Return n = alpha * samples + group * (1 - 1 / (t + 1)) effective samples, elementwise, after `t` rounds.

    Rounds bring the vehicles' own `group` samples in, ever more slowly; `alpha` is what an uploaded one is worth.
    """
    return alpha * samples + group * (1 - 1 / (t + 1))


class Fitted(Config):
    """Base of curves: their parameters are fitted, and of steep ones any size."""

    magnitudes: ClassVar[tuple[float, float]] = (1e-100, 1e100)


class Decay(Fitted):
    """The error a * (x + x0)^(-b) that is left after x samples or rounds. The default is none at all."""

    a: NonNegative = 0.0
    b: Sizeable = 1.0
    x0: NonNegative = 0.0

    def __str__(self) -> str:
        """Return the formula."""
        return f"{self.a:.4g} {f'(x + {self.x0:.4g})' if self.x0 else 'x'}^-{self.b:.4g}"

    @property
    def infinite_at_0(self) -> bool:
        """Return whether the error is infinite before the first sample or round."""
        return self.a > 0 and self.x0 == 0

    def at(self, resource: ArrayLike) -> Array:
        """Return the error left after `resource` samples or rounds."""
        shifted = np.asarray(resource, dtype=np.float64) + self.x0
        with np.errstate(divide="ignore"):
            return self.a * shifted**-self.b if self.a > 0 else np.zeros_like(shifted)


class Additive(Fitted):
    """error = floor + the decay of each stage."""

    model: Literal["additive"] = "additive"
    floor: NonNegative = 0.0
    pretrain: Decay = Decay()
    edge: Decay = Decay()
    cloud: Decay = Decay()

    def __str__(self) -> str:
        """Return the formula: x samples, y edge rounds, z cloud rounds."""
        parts = [str(decay).replace("x", name) for name, decay in zip("xyz", self.decays()) if decay.a > 0]
        return " + ".join([f"{self.floor:.4g}"] * (self.floor > 0) + parts) or "0"

    def decays(self) -> tuple[Decay, Decay, Decay]:
        """Return the decays in the order of `STAGES`."""
        return self.pretrain, self.edge, self.cloud

    def error(self, samples: ArrayLike, edge_rounds: ArrayLike, cloud_rounds: ArrayLike, k: int = 1) -> Array:
        """Return the error after so much of each stage, elementwise; `k` plays no part in this model."""
        return self.floor + self.pretrain.at(samples) + self.edge.at(edge_rounds) + self.cloud.at(cloud_rounds)


class Effective(Fitted):
    """error = floor + a * n^(-b) at n `effective_samples` of group = beta * group_samples.

    t = edge_rounds + k * cloud_rounds; group_samples are those that the vehicles of all groups hold.
    """

    model: Literal["effective"]
    floor: NonNegative = 0.0
    a: Sizeable
    b: Sizeable
    alpha: Sizeable
    beta: NonNegative
    group_samples: NonNegative

    def __str__(self) -> str:
        """Return the formula: x samples, t rounds."""
        floor = f"{self.floor:.4g} + " if self.floor else ""
        held = f"{self.beta * self.group_samples:.4g} (1 - 1/(t + 1))"
        return f"{floor}{self.a:.4g} ({self.alpha:.4g} x + {held})^-{self.b:.4g}"

    def error(self, samples: ArrayLike, edge_rounds: ArrayLike, cloud_rounds: ArrayLike, k: int = 1) -> Array:
        """Return the error after so much of each stage, elementwise, at `k` edge rounds per cloud round."""
        return self.floor + self.a * self.effective_samples(samples, edge_rounds, cloud_rounds, k) ** -self.b

    def effective_samples(self, samples: ArrayLike, edge_rounds: ArrayLike, cloud_rounds: ArrayLike, k: int) -> Array:
        """Return n, elementwise."""
        t = np.asarray(edge_rounds, np.float64) + k * np.asarray(cloud_rounds)
        return effective_samples(np.asarray(samples, np.float64), t, self.alpha, self.beta * self.group_samples)


class Member(Config):
    """One of the tasks that share a network and its data."""

    name: Annotated[str, Field(min_length=1)]
    weight: Positive = 1.0
    curve: Annotated[Additive | Effective, Field(discriminator="model")]


class Shared(Config):
    """The weighted mean error of a cluster: one sample or round serves every member."""

    model: Literal["shared"]
    members: Annotated[tuple[Member, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _additive(self) -> Self:
        for member in self.members:
            if len(self.members) > 1 and isinstance(member.curve, Effective):
                raise ValueError(f"members: {member.name!r} shares its network, so its curve must be additive")
        return self

    def error(self, samples: ArrayLike, edge_rounds: ArrayLike, cloud_rounds: ArrayLike, k: int = 1) -> Array:
        """Return the weighted mean error after so much of each stage, elementwise."""
        weights = [member.weight for member in self.members]
        errors = [member.curve.error(samples, edge_rounds, cloud_rounds, k) for member in self.members]
        return np.asarray(np.average(errors, axis=0, weights=weights), dtype=np.float64)


Curve = Annotated[Additive | Effective | Shared, Field(discriminator="model")]
