"""Confidence bands of learning curves by the residual bootstrap (Efron and Tibshirani 1993, section 9.3).

Every repeat draws n residuals of the fit with replacement, adds them to the fitted errors, and fits the same form
again. Residuals are scaled by sqrt(n / (n - P)) for n independent points, as P fitted parameters make them smaller than
the measurement errors; the band of a saturated fit, n <= P, is unknown. Residuals are drawn rather than points, because
a draw of five points often has too few different ones for a fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flcav.geometry.arrays import Array
from flcav.optimization.curves.curves import OwnCurve
from flcav.optimization.curves.fitting import CurveFit, refit
from flcav.statistics.streams import stream

METHOD = "residual bootstrap"
BEYOND = (1.0, 2.0, 4.0)  # times the largest measured resources: where the upper curve must not be below the band


@dataclass(frozen=True)
class Bands:
    """A pointwise confidence band, as the curves fitted in the bootstrap's repeats."""

    level: float  # share of the repeats between the lower and the upper band
    seed: int
    curves: tuple[OwnCurve, ...]  # one per repeat
    k: int  # edge rounds per cloud round

    def between(self, resources: Array) -> tuple[Array, Array]:
        """Return the lower and upper band of the error, (n,) each, at `resources` (n, 3); inf where it has no end."""
        errors = np.array([curve.error(*resources.T, k=self.k) for curve in self.curves])
        with np.errstate(invalid="ignore"):  # between infinite errors
            low, high = np.quantile(errors, (0.5 - self.level / 2, 0.5 + self.level / 2), axis=0)
        return np.where(np.isnan(low), np.inf, low), np.where(np.isnan(high), np.inf, high)


def bootstrap_bands(
    fit: CurveFit, *, level: float = 0.9, repeats: int = 200, seed: int = 0, k: int = 1
) -> Bands | None:
    """Return the confidence band of `fit`; None for a saturated fit, whose residuals are no measurement errors."""
    fitted = fit.fitted
    if fitted is None or fitted.spare < 1:
        return None
    predicted, root = fitted.form.predict(fitted.parameters, fitted.resources), np.sqrt(fitted.weight)
    known = root > 0
    residual = ((fitted.error - predicted) * root)[known]
    residual = (residual - residual.mean()) * np.sqrt(fitted.independent / fitted.spare)
    rng = stream(seed, "bands")
    curves = []
    for _ in range(repeats):
        drawn = rng.choice(residual, len(predicted)) / np.where(known, root, 1.0)
        curves.append(fitted.form.curve(refit(fitted, np.maximum(predicted + drawn, 0.0))))
    return Bands(level, seed, tuple(curves), k)


def fit_upper_curve(fit: CurveFit, found: Bands) -> OwnCurve:
    """Return a curve of the fit's form that lies nowhere below the upper band: the worst case of a robust plan.

    It is fitted to the band, then its floor is raised until it is not below the band at the measured resources and at
    1, 2 and 4 times the largest of them all.
    """
    fitted = fit.fitted
    assert fitted is not None
    spent = fitted.resources
    most = spent.max(axis=0)
    checked = np.unique(np.concatenate((spent, *(np.maximum(spent, factor * most) for factor in BEYOND))), axis=0)
    _, high = found.between(spent)
    curve = fitted.form.curve(refit(fitted, high))
    _, band = found.between(checked)
    lift = float(np.max(np.maximum(band - curve.error(*checked.T, k=found.k), 0.0)))
    return curve.model_copy(update={"floor": curve.floor + lift})


def fit_lower_curve(fit: CurveFit, found: Bands) -> OwnCurve:
    """Return a curve of the fit's form that is not above the lower band at the measured resources, unless at floor 0.

    It is fitted to the band, then its floor is lowered, at most to 0.
    """
    fitted = fit.fitted
    assert fitted is not None
    low, _ = found.between(fitted.resources)
    curve = fitted.form.curve(refit(fitted, low))
    drop = float(np.max(np.maximum(curve.error(*fitted.resources.T, k=found.k) - low, 0.0)))
    return curve.model_copy(update={"floor": max(curve.floor - drop, 0.0)})


def tabulate_bands(fit: CurveFit, found: Bands | None, resources: Array, k: int) -> list[dict[str, float | None]]:
    """Return the curve with its bands at every row of `resources` (n, 3), as one dictionary per row.

    Keys: samples, edge_rounds, cloud_rounds, error, low and high; without bands, low and high are None.
    """
    errors = fit.curve.error(*resources.T, k=k)
    edges: Sequence[Sequence[float | None]] = [[None] * len(errors)] * 2
    if found is not None:
        edges = [edge.tolist() for edge in found.between(resources)]
    names = ("samples", "edge_rounds", "cloud_rounds", "error", "low", "high")
    return [
        dict(zip(names, (*row, error, *pair))) for row, error, *pair in zip(resources.tolist(), errors.tolist(), *edges)
    ]
