"""Learning curves fitted to history: error = floor + sum over stages of a (x + x0)^(-b), all of them >= 0.

Each decay is fitted as h ((x + x0) / (m + x0))^(-b), where m is the geometric mean of the resources: h is the error in
the middle of the data, of order 1 and almost independent of b, where a spans decades with b. Which of floor and x0 are
fitted is chosen by AICc (Hurvich and Tsai 1989); for few points it is neither, and the fit is plain least squares.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from flcav.config import InputError
from flcav.optimization.curves import STAGES, Additive, Decay

Array = NDArray[np.float64]

ROBUST_FROM = 10  # points: the spread of fewer residuals does not say which of them is an outlier
STEEPEST = 10.0  # largest exponent tried
STARTS = (0.1, 0.5, 1.5)  # exponents to start from


@dataclass(frozen=True)
class Fit:
    """A curve and how well it describes the points."""

    curve: Additive
    rmse: float  # of the accuracy
    points: int
    aicc: float


def fit_power(resource: ArrayLike, accuracy: ArrayLike) -> Decay:
    """Return the article's curve accuracy = 1 - a x^(-b) by plain least squares on the accuracies (n,)."""
    resources = np.asarray(resource, dtype=np.float64)
    rows = np.stack((resources, np.zeros_like(resources), np.zeros_like(resources)), axis=1)
    return _best(
        rows, 1 - np.asarray(accuracy, dtype=np.float64), np.ones(len(rows)), _Shape((0,), False, ()), robust=False
    ).pretrain


def fit_additive(
    samples: ArrayLike,
    edge_rounds: ArrayLike,
    cloud_rounds: ArrayLike,
    accuracy: ArrayLike,
    weight: ArrayLike | None = None,
) -> Fit:
    """Return the additive curve fitted jointly to accuracies (n,) after so much of each stage (n,).

    A stage that never varies is left out. Raises `InputError` where there are too few points.
    """
    resources = np.stack([np.asarray(each, dtype=np.float64) for each in (samples, edge_rounds, cloud_rounds)], axis=1)
    error = 1 - np.asarray(accuracy, dtype=np.float64)
    weights = np.ones(len(error)) if weight is None else np.asarray(weight, dtype=np.float64)
    stages = tuple(stage for stage in range(3) if len(np.unique(resources[:, stage])) > 1)
    if not stages or len(error) < 2 * len(stages):
        raise InputError(
            f"history of {len(error)} points: a curve needs at least 2 different points for each stage that it covers"
        )
    shapes = [
        _Shape(stages, floor, tuple(stage for stage, shifted in zip(stages, shifts) if shifted))
        for floor, *shifts in product((False, True), repeat=1 + len(stages))
    ]
    fits = [
        _measured(
            _best(resources, error, weights, shape, robust=len(error) >= ROBUST_FROM), resources, error, weights, shape
        )
        for shape in shapes
    ]
    return min(fits, key=lambda fit: fit.aicc)


@dataclass(frozen=True)
class _Shape:
    """Which parameters are fitted."""

    stages: tuple[int, ...]
    floor: bool
    shifted: tuple[int, ...]  # stages whose x0 is fitted; else it is 0, or 1 where the stage has a row at 0

    def parameters(self) -> int:
        return 2 * len(self.stages) + self.floor + len(self.shifted)


def _best(resources: Array, error: Array, weight: Array, shape: _Shape, *, robust: bool) -> Additive:
    """Return the curve of least squares from several starts; then, if `robust`, of least soft L1 loss."""
    middle = np.exp([np.log(np.maximum(resources[:, s], 1)).mean() for s in shape.stages])
    rest = np.where(resources.min(axis=0) == 0, 1.0, 0.0)
    n = len(shape.stages)
    shifts = [middle[shape.stages.index(stage)] for stage in shape.shifted]

    def decays(p: Array) -> list[tuple[float, float, float]]:
        shift = dict(zip(shape.shifted, p[2 * n + shape.floor :]))
        return [(p[i], p[n + i], float(shift.get(stage, rest[stage]))) for i, stage in enumerate(shape.stages)]

    def residual(p: Array) -> Array:
        total = np.full(len(error), p[2 * n] if shape.floor else 0.0)
        for stage, m, (h, b, x0) in zip(shape.stages, middle, decays(p)):
            total = total + h * ((resources[:, stage] + x0) / (m + x0)) ** -b
        return (total - error) * np.sqrt(weight)

    least = [1e-9] * n + [1e-6] * n + [0.0] * shape.floor + [1e-3 * shift for shift in shifts]
    most = [np.inf] * n + [STEEPEST] * n + [1.0] * shape.floor + [1e3 * shift for shift in shifts]
    level = max(float(np.median(error)), 1e-3)

    def solved(start: ArrayLike, loss: str = "linear", f_scale: float = 1.0) -> tuple[float, Array]:
        result = least_squares(
            residual, start, bounds=(least, most), xtol=1e-14, ftol=1e-14, gtol=1e-14, loss=loss, f_scale=f_scale
        )
        return float(result.cost), result.x

    starts = [[level / n] * n + [b] * n + [level / 10] * shape.floor + list(shifts) for b in STARTS]
    _, p = min((solved(start) for start in starts), key=lambda found: found[0])
    if robust:
        spread = 1.4826 * float(np.median(np.abs(residual(p))))
        _, p = solved(p, loss="soft_l1", f_scale=max(3 * spread, 1e-6))
    fitted = [Decay(a=float(h * (m + x0) ** b), b=float(b), x0=x0) for m, (h, b, x0) in zip(middle, decays(p))]
    named = {STAGES[stage]: decay for stage, decay in zip(shape.stages, fitted)}
    return Additive.model_validate({"floor": float(p[2 * n]) if shape.floor else 0.0, **named})


def _measured(curve: Additive, resources: Array, error: Array, weight: Array, shape: _Shape) -> Fit:
    residual = curve.error(resources[:, 0], resources[:, 1], resources[:, 2]) - error
    mean_square = float((weight * residual**2).sum() / weight.sum())
    n, parameters = len(error), shape.parameters() + 1  # and the variance
    spare = n - parameters - 1
    simplest = not shape.floor and not shape.shifted
    correction = 2 * parameters * (parameters + 1) / spare if spare > 0 else (1e9 if simplest else np.inf)
    aicc = n * np.log(max(mean_square, 1e-18)) + 2 * parameters + correction
    return Fit(curve, float(np.sqrt((residual**2).mean())), n, float(aicc))


def resources_in_order(stage: Sequence[str], resource: ArrayLike) -> Array:
    """Return (n, 3) samples, edge rounds and cloud rounds of rows that give only their own stage's resource (n,).

    Stages follow each other: a row stands at the largest resource of the earlier stages, and at 0 of the later ones.
    """
    amounts, number = np.asarray(resource, dtype=np.float64), np.array([STAGES.index(name) for name in stage])
    largest = [amounts[number == s].max(initial=0.0) for s in range(3)]
    own = np.where(number[:, None] == np.arange(3), amounts[:, None], 0.0)
    return np.where(np.arange(3) < number[:, None], largest, own)
