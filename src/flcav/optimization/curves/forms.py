"""Parametric forms of learning curves for least squares, in a well-conditioned parametrisation.

A decay a (x + x0)^(-b) is fitted as h ((x + x0) / (m + x0))^(-b), where m is the geometric mean of the resources. h is
the error in the middle of the data, of order 1 and almost independent of b, whereas a varies by orders of magnitude
with b. Parameters other than the drift are bounded to be >= 0, so curves without drift or merge fall with every
resource.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Protocol, TypeVar

import numpy as np

from flcav.config import InputError, parse_config
from flcav.geometry.arrays import Array
from flcav.optimization.curves.curves import (
    STAGES,
    Additive,
    CurveConfig,
    Effective,
    Federated,
    drift_part,
    effective_samples,
    split_regions,
)

CurveT = TypeVar("CurveT", Additive, Effective, Federated, covariant=True)
ValueT = TypeVar("ValueT", float, Array)  # of a parameter, or its column of a Jacobian

FLATTEST, STEEPEST = 1e-6, 10.0  # least and largest exponent tried
STARTS = (0.1, 0.5, 1.5)  # exponents at the starts of the search
LARGEST_BETA = 1e3  # relative to alpha
DEFAULT_BETA = 0.5  # of the article
LARGEST_GAMMA = 1e2
START_GAMMA, START_DRIFT = 0.5, 0.02  # starts of the search; of a curve's drift with either sign
FITTED = "the fitted curve"  # origin in error messages


class Form(Protocol[CurveT]):
    """A parametric form of learning curve, with bounded parameters p (P,)."""

    @property
    def simplest(self) -> bool:
        """True for the form of its model with the fewest parameters."""
        ...

    def bounds(self) -> tuple[list[float], list[float]]:
        """Return the least and most of each parameter."""
        ...

    def starts(self, level: float) -> list[list[float]]:
        """Return parameters to start from, for errors around `level`."""
        ...

    def predict(self, p: Array, resources: Array) -> Array:
        """Return the errors (n,) at `resources` (n, 3)."""
        ...

    def derivative(self, p: Array, resources: Array) -> Array:
        """Return the Jacobian (n, P) of the errors at `resources` (n, 3) with respect to the parameters."""
        ...

    def curve(self, p: Array) -> CurveT:
        """Return the curve of parameters p; raises `InputError` for one too large or too small to compute with."""
        ...


@dataclass(frozen=True)
class AdditiveForm:
    """The form of an additive curve: floor + a decay per varying stage + the cost of the first cloud round.

    The parameters p are h per stage, b per stage, the floor if it is fitted, every fitted x0, and the cost if it is
    fitted.
    """

    stages: tuple[int, ...]  # those that vary, as indices into `STAGES`
    floor: bool  # whether the floor is fitted; else it is 0
    shifted: tuple[int, ...]  # stages whose x0 is fitted; else it is 0, or 1 where the stage has a row at 0
    middle: tuple[float, ...]  # per stage that varies: the geometric mean m of the resources
    rest: tuple[float, ...]  # per stage of all three: x0 where it is not fitted
    merge: bool  # whether the cost of the first cloud round is fitted; else it is 0

    @property
    def simplest(self) -> bool:
        """True where neither the floor nor any x0 nor the cost of the first cloud round is fitted."""
        return not (self.floor or self.shifted or self.merge)

    def bounds(self) -> tuple[list[float], list[float]]:
        """Return the least and most of each parameter."""
        n, shifts = len(self.stages), self._middle_shifts()
        least = [1e-9] * n + [FLATTEST] * n + [0.0] * self.floor + [1e-3 * shift for shift in shifts]
        least += [0.0] * self.merge
        most = [np.inf] * n + [STEEPEST] * n + [1.0] * self.floor + [1e3 * shift for shift in shifts]
        return least, most + [1.0] * self.merge

    def starts(self, level: float) -> list[list[float]]:
        """Return one start per exponent of `STARTS`; with a `merge` only that of the middle exponent."""
        n, rest = len(self.stages), self._middle_shifts() + [START_DRIFT] * self.merge
        exponents = STARTS[1:2] if self.merge else STARTS
        return [[level / n] * n + [b] * n + [level / 10] * self.floor + rest for b in exponents]

    def predict(self, p: Array, resources: Array) -> Array:
        """Return the errors (n,) at `resources` (n, 3)."""
        total = np.full(len(resources), p[2 * len(self.stages)] if self.floor else 0.0)
        for i, (stage, m) in enumerate(zip(self.stages, self.middle)):
            h, b, x0 = self._decay(p, i)
            total = total + h * ((resources[:, stage] + x0) / (m + x0)) ** -b
        return total + p[-1] * (resources[:, 2] > 0) if self.merge else total

    def derivative(self, p: Array, resources: Array) -> Array:
        """Return the Jacobian (n, P) of the errors at `resources` (n, 3) with respect to the parameters."""
        n = len(self.stages)
        columns = np.ones((len(p), len(resources)))  # that of the floor is 1
        for i, (stage, m) in enumerate(zip(self.stages, self.middle)):
            h, b, x0 = self._decay(p, i)
            shifted = resources[:, stage] + x0
            columns[i], columns[n + i], slope = _power_derivatives(h, b, shifted, m + x0)
            if stage in self.shifted:  # x0 is in numerator and denominator
                columns[2 * n + self.floor + self.shifted.index(stage)] = slope * (1 - shifted / (m + x0))
        if self.merge:
            columns[-1] = resources[:, 2] > 0
        return columns.T

    def curve(self, p: Array) -> Additive:
        """Return the curve of parameters p."""
        decays = {}
        for i, (stage, m) in enumerate(zip(self.stages, self.middle)):
            h, b, x0 = self._decay(p, i)
            decays[STAGES[stage]] = {"a": float(h * (m + x0) ** b), "b": b, "x0": x0}
        floor = _share(p[2 * len(self.stages)]) if self.floor else 0.0
        merge = _share(p[-1]) if self.merge else 0.0
        return parse_config(Additive, {"floor": floor, "merge": merge, **decays}, FITTED)

    def _decay(self, p: Array, i: int) -> tuple[float, float, float]:
        stage = self.stages[i]
        n = len(self.stages)
        x0 = p[2 * n + self.floor + self.shifted.index(stage)] if stage in self.shifted else self.rest[stage]
        return float(p[i]), float(p[n + i]), float(x0)

    def _middle_shifts(self) -> list[float]:
        return [self.middle[self.stages.index(stage)] for stage in self.shifted]


def additive_forms(resources: Array) -> list[AdditiveForm]:
    """Return the candidate forms for `resources` (n, 3): with and without a fitted floor, each fitted x0 and a `merge`.

    A stage that never varies is left out; so is the cost of the first cloud round unless the history has two different
    positive numbers of cloud rounds and 0: it could not be distinguished from the decay. Raises `InputError` where
    there are too few points.
    """
    stages = tuple(stage for stage in range(3) if len(np.unique(resources[:, stage])) > 1)
    if not stages or len(resources) < 2 * len(stages):
        raise InputError(
            f"history of {len(resources)} points: a curve needs at least 2 different points for each stage that it "
            "covers"
        )
    middle = tuple(float(np.exp(np.log(np.maximum(resources[:, stage], 1)).mean())) for stage in stages)
    rest = tuple(np.where(resources.min(axis=0) == 0, 1.0, 0.0).tolist())
    merges = (False, True) if rest[2] and len(np.unique(resources[:, 2])) > 2 else (False,)
    return [
        AdditiveForm(stages, floor, tuple(s for s, fitted in zip(stages, shifts) if fitted), middle, rest, merge)
        for merge in merges
        for floor, *shifts in product((False, True), repeat=1 + len(stages))
    ]


@dataclass(frozen=True)
class EffectiveForm:
    """The form of an effective-samples curve: floor + a n^(-b) for n effective samples.

    The parameters p are h, b, the floor if it is fitted, and beta if it is fitted. Scaling alpha and beta together is
    equivalent to scaling a, so that alpha is given; beta is fitted where the rounds vary.
    """

    floor: bool  # whether the floor is fitted; else it is 0
    alpha: float
    beta: float | None  # None: fitted
    group_samples: float
    k: int  # edge rounds per cloud round
    middle: float  # geometric mean of the effective samples

    @property
    def simplest(self) -> bool:
        """True where the floor is not fitted."""
        return not self.floor

    def bounds(self) -> tuple[list[float], list[float]]:
        """Return the least and most of each parameter."""
        beta = [LARGEST_BETA * self.alpha] * (self.beta is None)
        return [1e-9, FLATTEST, *[0.0] * self.floor, *[0.0] * len(beta)], [np.inf, STEEPEST, *[1.0] * self.floor, *beta]

    def starts(self, level: float) -> list[list[float]]:
        """Return one start per exponent of `STARTS`."""
        beta = [DEFAULT_BETA] * (self.beta is None)
        return [[level, b, *[level / 10] * self.floor, *beta] for b in STARTS]

    def predict(self, p: Array, resources: Array) -> Array:
        """Return the errors (n,) at `resources` (n, 3)."""
        t = resources[:, 1] + self.k * resources[:, 2]
        effective = effective_samples(resources[:, 0], t, self.alpha, self._beta(p) * self.group_samples)
        return p[0] * (effective / self.middle) ** -p[1] + (p[2] if self.floor else 0.0)

    def derivative(self, p: Array, resources: Array) -> Array:
        """Return the Jacobian (n, P) of the errors at `resources` (n, 3) with respect to the parameters."""
        t = resources[:, 1] + self.k * resources[:, 2]
        held = effective_samples(0.0, t, 0.0, self.group_samples)
        by_h, by_b, slope = _power_derivatives(
            p[0], p[1], self.alpha * resources[:, 0] + self._beta(p) * held, self.middle
        )
        floor = [np.ones(len(t))] * self.floor
        beta = [slope * held] * (self.beta is None)
        return np.stack([by_h, by_b, *floor, *beta], axis=1)

    def curve(self, p: Array) -> Effective:
        """Return the curve of parameters p."""
        values = {
            "model": "effective",
            "floor": _share(p[2]) if self.floor else 0.0,
            "a": float(p[0] * self.middle ** p[1]),
            "b": float(p[1]),
            "alpha": self.alpha,
            "beta": self._beta(p),
            "group_samples": self.group_samples,
        }
        return parse_config(Effective, values, FITTED)

    def _beta(self, p: Array) -> float:
        return _share(p[-1]) if self.beta is None else self.beta


def _power_derivatives(h: float, b: float, x: Array, middle: float) -> tuple[Array, Array, Array]:
    """Return the derivatives (n,) of h (x / middle)^(-b) at x (n,) with respect to h, b and x."""
    power = (x / middle) ** -b
    return power, -h * power * np.log(x / middle), -b * h * power / x


def _share(fitted: float) -> float:
    """Return a fitted floor or beta; 0 for one below the smallest number that a curve may hold."""
    return float(fitted) if fitted >= CurveConfig.magnitudes[0] else 0.0


def effective_forms(
    resources: Array, alpha: float, beta: float | None, group_samples: float, k: int
) -> list[EffectiveForm]:
    """Return the candidate forms for `resources` (n, 3): with and without a fitted floor.

    Raises `InputError` where a point has no samples, all points have the same effective samples, or there are fewer
    points than parameters.
    """
    t = resources[:, 1] + k * resources[:, 2]
    if beta is None and (group_samples == 0 or len(np.unique(t)) < 2):
        beta = DEFAULT_BETA
    group = (DEFAULT_BETA if beta is None else beta) * group_samples
    effective = effective_samples(resources[:, 0], t, alpha, group)
    if np.any(alpha * resources[:, 0] <= 0):
        raise InputError("history has a point without samples: its effective samples would be none, its error infinite")
    parameters = 2 + (beta is None)
    if len(np.unique(np.round(effective, 9))) < 2 or len(resources) < parameters:
        raise InputError(f"history of {len(resources)} points: {parameters} parameters need that many different points")
    middle = float(np.exp(np.log(effective).mean()))
    return [EffectiveForm(floor, alpha, beta, group_samples, k, middle) for floor in (False, True)]


@dataclass(frozen=True)
class FederatedForm:
    """The form of a `Federated` curve: floor + a n^(-b) of n effective samples, and the drift part of the cloud rounds.

    The parameters p are h, b, and those of floor, gamma, drift and beta that are fitted; the first three are 0 where
    they are not.
    """

    floor: bool  # whether the floor is fitted
    gamma: bool  # whether the worth of other regions' samples is fitted
    drift: bool  # whether the drift is fitted
    alpha: float
    beta: float | None  # None: fitted
    group_samples: tuple[float, ...]  # held in each region
    k: int  # edge rounds per cloud round
    middle: float  # geometric mean of the effective samples, without those of other regions

    @property
    def simplest(self) -> bool:
        """True where neither floor nor gamma nor drift is fitted."""
        return not (self.floor or self.gamma or self.drift)

    def bounds(self) -> tuple[list[float], list[float]]:
        """Return the least and most of each parameter."""
        most = self._fitted(1.0, LARGEST_GAMMA, 1.0, LARGEST_BETA * self.alpha)
        return [1e-9, FLATTEST, *self._fitted(0.0, 0.0, -1.0, 0.0)], [np.inf, STEEPEST, *most]

    def starts(self, level: float) -> list[list[float]]:
        """Return one start per exponent of `STARTS`; where the drift is fitted, of the middle one with either sign."""
        exponents, drifts = (STARTS[1:2], (START_DRIFT, -START_DRIFT)) if self.drift else (STARTS, (0.0,))
        return [
            [level, b, *self._fitted(level / 10, START_GAMMA, drift, DEFAULT_BETA)]
            for b, drift in product(exponents, drifts)
        ]

    def predict(self, p: Array, resources: Array) -> Array:
        """Return the errors (n,) at `resources` (n, 3)."""
        floor, gamma, drift, beta = self._named(p)
        samples, edge_rounds, cloud_rounds = resources.T
        region, others = split_regions(self.group_samples)
        effective = effective_samples(samples, edge_rounds + self.k * cloud_rounds, self.alpha, beta * region)
        effective = effective_samples(effective, cloud_rounds, 1.0, beta * gamma * others)
        return p[0] * (effective / self.middle) ** -p[1] + floor + drift_part(cloud_rounds, drift)

    def derivative(self, p: Array, resources: Array) -> Array:
        """Return the Jacobian (n, P) of the errors at `resources` (n, 3) with respect to the parameters."""
        _, gamma, drift, beta = self._named(p)
        samples, edge_rounds, cloud_rounds = resources.T
        region, others = split_regions(self.group_samples)
        others_held = effective_samples(0.0, cloud_rounds, 0.0, others)
        held = effective_samples(0.0, edge_rounds + self.k * cloud_rounds, 0.0, region) + gamma * others_held
        by_h, by_b, slope = _power_derivatives(p[0], p[1], self.alpha * samples + beta * held, self.middle)
        by_floor, by_drift = np.ones(len(samples)), float(drift > 0) - 1 / (cloud_rounds + 1)
        fitted = self._fitted(by_floor, slope * beta * others_held, by_drift, slope * held)
        return np.stack([by_h, by_b, *fitted], axis=1)

    def curve(self, p: Array) -> Federated:
        """Return the curve of parameters p."""
        floor, gamma, drift, beta = map(float, self._named(p))
        values = {
            **{"model": "federated", "floor": _share(floor), "a": float(p[0] * self.middle ** p[1]), "b": float(p[1])},
            **{"alpha": self.alpha, "beta": _share(beta), "gamma": _share(gamma)},
            **{"group_samples": self.group_samples, "drift": float(np.copysign(_share(abs(drift)), drift))},
        }
        return parse_config(Federated, values, FITTED)

    def _fitted(self, floor: ValueT, gamma: ValueT, drift: ValueT, beta: ValueT) -> list[ValueT]:
        """Return the values whose parameters are fitted."""
        fitted = (self.floor, self.gamma, self.drift, self.beta is None)
        return [value for value, wanted in zip((floor, gamma, drift, beta), fitted) if wanted]

    def _named(self, p: Array) -> tuple[float, float, float, float]:
        """Return floor, gamma, drift and beta, whether fitted or given."""
        left = iter(p[2:])
        floor, gamma, drift = (next(left) if fitted else 0.0 for fitted in (self.floor, self.gamma, self.drift))
        return floor, gamma, drift, next(left) if self.beta is None else self.beta


def federated_forms(
    resources: Array, alpha: float, beta: float | None, group_samples: Sequence[float], k: int
) -> list[FederatedForm]:
    """Return the candidate forms for `resources` (n, 3): with and without a fitted floor, gamma and drift.

    Raises `InputError` as `effective_forms` does, and for fewer than two regions, regions without samples, and a
    history in which the cloud rounds never vary.
    """
    if len(group_samples) < 2 or sum(group_samples) == 0:
        raise InputError(
            "--model federated needs --group-samples of each region: once for each of two or more, and not all 0"
        )
    if len(np.unique(resources[:, 2])) < 2:
        raise InputError(
            "the cloud rounds of the history never vary, so nothing is known of what the samples of other regions bring"
        )
    per_region, _ = split_regions(group_samples)
    plain = effective_forms(resources, alpha, beta, per_region, k)[0]
    middle = plain.middle
    given = plain.beta
    return [
        FederatedForm(floor, gamma, drift, alpha, given, tuple(group_samples), k, middle)
        for floor, gamma, drift in product((False, True), repeat=3)
    ]
