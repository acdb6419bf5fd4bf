"""Parametric forms of learning curves for least squares, in a well-conditioned parametrisation.

A decay a (x + x0)^(-b) is fitted as h ((x + x0) / (m + x0))^(-b), where m is the geometric mean of the resources. h is
the error in the middle of the data, of order 1 and almost independent of b, whereas a varies by orders of magnitude
with b. Parameters are bounded to be >= 0, so every curve falls with every resource.
"""

from dataclasses import dataclass
from itertools import product
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError, parse_config
from flcav.optimization.curves.curves import STAGES, Additive, CurveConfig, Effective, effective_samples

Array = NDArray[np.float64]
CurveT = TypeVar("CurveT", Additive, Effective, covariant=True)

STEEPEST = 10.0  # largest exponent tried
STARTS = (0.1, 0.5, 1.5)  # exponents at the starts of the search
LARGEST_BETA = 1e3  # relative to alpha
DEFAULT_BETA = 0.5  # of the article
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

    def curve(self, p: Array) -> CurveT:
        """Return the curve of parameters p; raises `InputError` for one too large or too small to compute with."""
        ...


@dataclass(frozen=True)
class AdditiveForm:
    """Form of an additive curve: floor + a decay per stage that varies.

    The parameters p are h of each stage, b of each stage, the floor if it is fitted, and the fitted x0.
    """

    stages: tuple[int, ...]  # those that vary, as indices into `STAGES`
    floor: bool  # whether the floor is fitted; else it is 0
    shifted: tuple[int, ...]  # stages whose x0 is fitted; else it is 0, or 1 where the stage has a row at 0
    middle: tuple[float, ...]  # per stage that varies: the geometric mean m of the resources
    rest: tuple[float, ...]  # per stage of all three: x0 where it is not fitted

    @property
    def simplest(self) -> bool:
        """True where neither the floor nor any x0 is fitted."""
        return not self.floor and not self.shifted

    def bounds(self) -> tuple[list[float], list[float]]:
        """Return the least and most of each parameter."""
        n, shifts = len(self.stages), self._middle_shifts()
        least = [1e-9] * n + [1e-6] * n + [0.0] * self.floor + [1e-3 * shift for shift in shifts]
        most = [np.inf] * n + [STEEPEST] * n + [1.0] * self.floor + [1e3 * shift for shift in shifts]
        return least, most

    def starts(self, level: float) -> list[list[float]]:
        """Return one start per exponent of `STARTS`."""
        n, shifts = len(self.stages), self._middle_shifts()
        return [[level / n] * n + [b] * n + [level / 10] * self.floor + shifts for b in STARTS]

    def predict(self, p: Array, resources: Array) -> Array:
        """Return the errors (n,) at `resources` (n, 3)."""
        total = np.full(len(resources), p[2 * len(self.stages)] if self.floor else 0.0)
        for i, (stage, m) in enumerate(zip(self.stages, self.middle)):
            h, b, x0 = self._decay(p, i)
            total = total + h * ((resources[:, stage] + x0) / (m + x0)) ** -b
        return total

    def curve(self, p: Array) -> Additive:
        """Return the curve of parameters p."""
        decays = {}
        for i, (stage, m) in enumerate(zip(self.stages, self.middle)):
            h, b, x0 = self._decay(p, i)
            decays[STAGES[stage]] = {"a": float(h * (m + x0) ** b), "b": b, "x0": x0}
        floor = _share(p[2 * len(self.stages)]) if self.floor else 0.0
        return parse_config(Additive, {"floor": floor, **decays}, FITTED)

    def _decay(self, p: Array, i: int) -> tuple[float, float, float]:
        stage = self.stages[i]
        n = len(self.stages)
        x0 = p[2 * n + self.floor + self.shifted.index(stage)] if stage in self.shifted else self.rest[stage]
        return float(p[i]), float(p[n + i]), float(x0)

    def _middle_shifts(self) -> list[float]:
        return [self.middle[self.stages.index(stage)] for stage in self.shifted]


def additive_forms(resources: Array) -> list[AdditiveForm]:
    """Return the candidate forms for `resources` (n, 3): with and without a fitted floor and each fitted x0.

    A stage that never varies is left out. Raises `InputError` where there are too few points.
    """
    stages = tuple(stage for stage in range(3) if len(np.unique(resources[:, stage])) > 1)
    if not stages or len(resources) < 2 * len(stages):
        raise InputError(
            f"history of {len(resources)} points: a curve needs at least 2 different points for each stage that it "
            "covers"
        )
    middle = tuple(float(np.exp(np.log(np.maximum(resources[:, stage], 1)).mean())) for stage in stages)
    rest = tuple(np.where(resources.min(axis=0) == 0, 1.0, 0.0).tolist())
    return [
        AdditiveForm(stages, floor, tuple(s for s, fitted in zip(stages, shifts) if fitted), middle, rest)
        for floor, *shifts in product((False, True), repeat=1 + len(stages))
    ]


@dataclass(frozen=True)
class EffectiveForm:
    """Form of an effective-samples curve: floor + a n^(-b) of n effective samples.

    The parameters p are h, b, the floor if it is fitted, and beta if it is fitted. Scaling alpha and beta together is
    the same as scaling a, so alpha is given; beta is fitted where the rounds vary.
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
        return [1e-9, 1e-6, *[0.0] * self.floor, *[0.0] * len(beta)], [np.inf, STEEPEST, *[1.0] * self.floor, *beta]

    def starts(self, level: float) -> list[list[float]]:
        """Return one start per exponent of `STARTS`."""
        beta = [DEFAULT_BETA] * (self.beta is None)
        return [[level, b, *[level / 10] * self.floor, *beta] for b in STARTS]

    def predict(self, p: Array, resources: Array) -> Array:
        """Return the errors (n,) at `resources` (n, 3)."""
        t = resources[:, 1] + self.k * resources[:, 2]
        effective = effective_samples(resources[:, 0], t, self.alpha, self._beta(p) * self.group_samples)
        return p[0] * (effective / self.middle) ** -p[1] + (p[2] if self.floor else 0.0)

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
