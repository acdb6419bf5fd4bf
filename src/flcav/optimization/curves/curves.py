"""Learning curves: models of the error as a function of samples, edge rounds and cloud rounds.

`Additive` sums an inverse power law per stage, and the cost of the first cloud round; `Effective` is one inverse power
law of effective samples; `Federated` is such a law, too, in which cloud rounds bring the samples of the other regions
and may cost accuracy; `SharedCurve` is the weighted mean of the curves of tasks with the same network.
"""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal, Self, overload

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from flcav.config import Config
from flcav.geometry.arrays import Array

STAGES = ("pretrain", "edge", "cloud")  # their resources are samples, edge rounds, cloud rounds

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Sizeable = Annotated[float, Field(ge=1e-9)]  # large enough to divide by
Change = Annotated[float, Field(ge=-1, le=1)]  # of an error
Pace = Annotated[
    float, Field(ge=1e-9, exclude_if=lambda value: value == 1)
]  # rounds of the history that one is worth; left out of the JSON where it is 1


@overload
def effective_samples(samples: float, t: float, alpha: float, group: float) -> float: ...
@overload
def effective_samples(samples: float | Array, t: Array, alpha: float | Array, group: float | Array) -> Array: ...
def effective_samples(
    samples: float | Array, t: float | Array, alpha: float | Array, group: float | Array
) -> float | Array:
    """Return the effective samples n = alpha * samples + group * (1 - 1 / (t + 1)) after `t` rounds, elementwise.

    `alpha` is the worth of an uploaded sample; `group` is the number of samples that stay on the vehicles times their
    worth, of which the share 1 - 1 / (t + 1) is learned in t rounds.
    """
    return alpha * samples + group * (1 - 1 / (t + 1))


class CurveConfig(Config):
    """Base of learning curves: parameters come from fits, and those of steep curves may be very large or small."""

    magnitudes: ClassVar[tuple[float, float]] = (1e-100, 1e100)


class Decay(CurveConfig):
    """Inverse power law a * (x + x0)^(-b): a stage's error after x samples or rounds. By default it is 0."""

    a: NonNegative = 0.0
    b: Sizeable = 1.0
    x0: NonNegative = 0.0

    def __str__(self) -> str:
        """Return the formula."""
        return f"{self.a:.4g} {f'(x + {self.x0:.4g})' if self.x0 else 'x'}^-{self.b:.4g}"

    @property
    def infinite_at_0(self) -> bool:
        """True where the error is infinite before the first sample or round."""
        return self.a > 0 and self.x0 == 0

    def at(self, resource: ArrayLike) -> Array:
        """Return the error after `resource` samples or rounds, elementwise."""
        shifted = np.asarray(resource, dtype=np.float64) + self.x0
        with np.errstate(divide="ignore"):
            return self.a * shifted**-self.b if self.a > 0 else np.zeros_like(shifted)


class Additive(CurveConfig):
    """Additive learning curve: error = floor + the sum of an inverse power law per stage + merge from z = 1 on.

    `merge` is the cost of the first cloud round, in addition to what cloud rounds bring: it averages networks that
    drifted apart in different regions (client drift; Karimireddy et al., 2020, "SCAFFOLD", ICML); later ones start from
    the mean.
    """

    model: Literal["additive"] = "additive"
    floor: NonNegative = 0.0
    merge: NonNegative = 0.0  # added to the error after one cloud round or more
    pretrain: Decay = Decay()
    edge: Decay = Decay()
    cloud: Decay = Decay()

    def __str__(self) -> str:
        """Return the formula in x samples, y edge rounds and z cloud rounds."""
        parts = [str(decay).replace("x", name) for name, decay in zip("xyz", self.decays()) if decay.a > 0]
        merge = [f"{self.merge:.4g} [z > 0]"] * (self.merge > 0)
        return " + ".join([f"{self.floor:.4g}"] * (self.floor > 0) + parts + merge) or "0"

    def decays(self) -> tuple[Decay, Decay, Decay]:
        """Return the decays in the order of `STAGES`."""
        return self.pretrain, self.edge, self.cloud

    def error(self, samples: ArrayLike, edge_rounds: ArrayLike, cloud_rounds: ArrayLike, k: int = 1) -> Array:
        """Return the error after the samples and rounds given, elementwise; this model does not depend on `k`."""
        decays = self.pretrain.at(samples) + self.edge.at(edge_rounds) + self.cloud.at(cloud_rounds)
        return self.floor + decays + self.merge * (np.asarray(cloud_rounds) > 0)


class Effective(CurveConfig):
    """Learning curve over effective samples: error = floor + a * n^(-b).

    n is `effective_samples` with group = beta * group_samples and t = pace * (edge_rounds + k * cloud_rounds).
    """

    model: Literal["effective"]
    floor: NonNegative = 0.0
    a: Sizeable
    b: Sizeable
    alpha: Sizeable  # worth of an uploaded sample
    beta: NonNegative  # worth of a sample that stays on its vehicle
    group_samples: NonNegative  # held by the vehicles of all edge groups
    pace: Pace = 1.0

    def __str__(self) -> str:
        """Return the formula in x samples and t rounds."""
        floor = f"{self.floor:.4g} + " if self.floor else ""
        held = f"{self.beta * self.group_samples:.4g} (1 - 1/(t + 1))"
        return f"{floor}{self.a:.4g} ({self.alpha:.4g} x + {held})^-{self.b:.4g}"

    def error(self, samples: ArrayLike, edge_rounds: ArrayLike, cloud_rounds: ArrayLike, k: int = 1) -> Array:
        """Return the error after the samples and rounds given, elementwise, at `k` edge rounds per cloud round."""
        return self.floor + self.a * self.effective_samples(samples, edge_rounds, cloud_rounds, k) ** -self.b

    def effective_samples(self, samples: ArrayLike, edge_rounds: ArrayLike, cloud_rounds: ArrayLike, k: int) -> Array:
        """Return the number of effective samples n, elementwise, at `k` edge rounds per cloud round."""
        t = self.pace * (np.asarray(edge_rounds, np.float64) + k * np.asarray(cloud_rounds))
        return effective_samples(np.asarray(samples, np.float64), t, self.alpha, self.beta * self.group_samples)


class Federated(CurveConfig):
    """Learning curve of regions that learn from each other in cloud rounds: error = floor + a * n^(-b) + drift part.

    With t = edge_rounds + k * cloud_rounds, z cloud rounds, R regions and G samples held in all of them, for a pace of
    1 (another one multiplies t and z in n),

        n = alpha * samples + beta * (G / R * (1 - 1 / (t + 1)) + gamma * (G - G / R) * (1 - 1 / (z + 1))):

    rounds bring the samples of the region's vehicles, cloud rounds also those of the other regions. The drift part
    max(drift, 0) - drift / (z + 1) changes the error by `drift` from no cloud round to infinitely many. Where it is
    positive, cloud rounds cost accuracy: they average networks that drifted apart in different regions, the client
    drift of Karimireddy et al. (2020, "SCAFFOLD", ICML).
    """

    model: Literal["federated"]
    floor: NonNegative = 0.0
    a: Sizeable
    b: Sizeable
    alpha: Sizeable  # worth of an uploaded sample
    beta: NonNegative  # worth of a sample that a vehicle of the same region holds
    gamma: NonNegative = 0.0  # worth of a sample of another region, relative to beta
    group_samples: Annotated[tuple[NonNegative, ...], Field(min_length=2)]  # held by the vehicles of each region
    drift: Change = 0.0  # change of the error by infinitely many cloud rounds, in addition to what they bring
    pace: Pace = 1.0

    def __str__(self) -> str:
        """Return the formula in x samples, t rounds and z cloud rounds."""
        floor = f"{self.floor:.4g} + " if self.floor else ""
        held = f" + {self.others:.4g} (1 - 1/(z + 1))" if self.others else ""
        effective = f"{self.alpha:.4g} x + {self.own:.4g} (1 - 1/(t + 1)){held}"
        drift = f" + {self.drift:.4g} (1 - 1/(z + 1))" if self.drift > 0 else f" + {-self.drift:.4g}/(z + 1)"
        return f"{floor}{self.a:.4g} ({effective})^-{self.b:.4g}{drift if self.drift else ''}"

    @property
    def own(self) -> float:
        """Worth of the samples held in a region: beta * G / R."""
        return self.beta * split_regions(self.group_samples)[0]

    @property
    def others(self) -> float:
        """Worth of the samples held in the other regions: beta * gamma * (G - G / R)."""
        return self.beta * self.gamma * split_regions(self.group_samples)[1]

    def error(self, samples: ArrayLike, edge_rounds: ArrayLike, cloud_rounds: ArrayLike, k: int = 1) -> Array:
        """Return the error after the samples and rounds given, elementwise, at `k` edge rounds per cloud round."""
        power = self.a * self.effective_samples(samples, edge_rounds, cloud_rounds, k) ** -self.b
        return self.floor + power + drift_part(cloud_rounds, self.drift)

    def effective_samples(self, samples: ArrayLike, edge_rounds: ArrayLike, cloud_rounds: ArrayLike, k: int) -> Array:
        """Return the number of effective samples n, elementwise, at `k` edge rounds per cloud round."""
        z = np.asarray(cloud_rounds, np.float64)
        t = self.pace * (np.asarray(edge_rounds, np.float64) + k * z)
        effective = effective_samples(np.asarray(samples, np.float64), t, self.alpha, self.own)
        return np.asarray(effective_samples(effective, self.pace * z, 1.0, self.others), dtype=np.float64)


def split_regions(group_samples: Sequence[float]) -> tuple[float, float]:
    """Return the samples held in a region, and in all others, as means over the regions that hold `group_samples`."""
    total = sum(group_samples)
    return total / len(group_samples), total - total / len(group_samples)


def drift_part(cloud_rounds: ArrayLike, drift: float | Array) -> Array:
    """Return max(drift, 0) - drift / (z + 1) after z = `cloud_rounds`, elementwise: the drift part of a `Federated`."""
    return np.maximum(drift, 0.0) - drift / (np.asarray(cloud_rounds, np.float64) + 1)


OwnCurve = Annotated[Additive | Effective | Federated, Field(discriminator="model")]  # of one task


class Member(Config):
    """A member of a cluster: one of the tasks that share a network and its data."""

    name: Annotated[str, Field(min_length=1)]  # name of the task
    weight: Positive = 1.0  # weight of the task's error in the cluster's mean
    curve: OwnCurve  # the task's learning curve


class SharedCurve(Config):
    """Learning curve of a cluster: the weighted mean error of its members, which all learn from each sample and round.

    Construction raises pydantic's ValidationError where one of several members has a curve that is not `Additive`.
    """

    model: Literal["shared"]  # discriminator
    members: Annotated[tuple[Member, ...], Field(min_length=1)]  # tasks of the cluster

    @model_validator(mode="after")
    def _additive(self) -> Self:
        for member in self.members:
            if len(self.members) > 1 and not isinstance(member.curve, Additive):
                raise ValueError(f"members: {member.name!r} shares its network, so its curve must be additive")
        return self

    def error(self, samples: ArrayLike, edge_rounds: ArrayLike, cloud_rounds: ArrayLike, k: int = 1) -> Array:
        """Return the weighted mean error after the samples and rounds given, elementwise."""
        weights = [member.weight for member in self.members]
        errors = [member.curve.error(samples, edge_rounds, cloud_rounds, k) for member in self.members]
        return np.asarray(np.average(errors, axis=0, weights=weights), dtype=np.float64)


Curve = Annotated[Additive | Effective | Federated | SharedCurve, Field(discriminator="model")]
