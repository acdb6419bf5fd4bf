"""Fits of learning curves to history: bounded, robust least squares with model selection by AICc.

AICc (Hurvich and Tsai 1989) decides whether the floor and each x0 are fitted; for `Federated` curves the floor, gamma
and drift. For few points none is, and the fit is plain least squares: the article's curve, accuracy = 1 - a x^(-b).
From `ROBUST_FROM` points on, the loss is soft L1, which turns from squares to absolute values at three standard
deviations (estimated by the median absolute residual).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from flcav.config import InputError
from flcav.geometry.arrays import Array
from flcav.optimization.curves.curves import STAGES, Additive, Effective, Federated
from flcav.optimization.curves.forms import (
    FLATTEST,
    STEEPEST,
    CurveT,
    Form,
    additive_forms,
    effective_forms,
    federated_forms,
)
from flcav.optimization.curves.history import History, load_history
from flcav.optimization.curves.levels import level_seeds

ROBUST_FROM = 10  # independent points: the spread of fewer residuals does not show which of them are outliers
SAME_COST = 1e-3  # relative difference of equal costs
EXACT, ROUGH = 1e-14, 1e-6  # tolerances of the solver: for the curve that is returned; for comparisons and repeats
QUANTITIES = ("samples", "edge_rounds", "cloud_rounds")


@dataclass(frozen=True)
class Fit(Generic[CurveT]):
    """A fitted learning curve with its goodness of fit."""

    curve: CurveT
    rmse: float  # of the accuracy
    points: int
    aicc: float  # corrected Akaike information criterion
    fitted: "FitState[CurveT] | None" = None  # data and parameters of the fit; None: not known

    @property
    def r_squared(self) -> float | None:
        """Coefficient of determination R^2 of the accuracy; None where all accuracies are equal or not known."""
        if self.fitted is None or np.ptp(self.fitted.error) == 0:
            return None
        return 1 - self.rmse**2 / float(np.var(self.fitted.error))

    @property
    def measured(self) -> dict[str, float]:
        """The largest measured value of each quantity that varies in the history, by name of `QUANTITIES`."""
        if self.fitted is None:
            return {}
        spent = self.fitted.resources
        return {name: float(column.max()) for name, column in zip(QUANTITIES, spent.T) if len(np.unique(column)) > 1}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to distrust the curve, a sentence each: too few points, a steep exponent, or a low R^2."""
        if self.fitted is None:
            return ()
        reasons = []
        if self.fitted.spare < 1:
            counts = f"{self.fitted.independent} independent points for {len(self.fitted.parameters)} parameters"
            reasons.append(f"{counts}: nothing is left to check them, and the band is not known")
        decays = zip(STAGES, self.curve.decays()) if isinstance(self.curve, Additive) else [("samples", self.curve)]
        reasons += [reason for stage, decay in decays if (reason := explain_exponent(stage, decay.b)) is not None]
        if self.r_squared is None:
            reasons.append("the accuracy is the same at all points: nothing is known of what more would bring")
        elif self.r_squared < 0.5:
            reasons.append(f"the curve explains {max(self.r_squared, 0):.0%} of the variance of the accuracy")
        return tuple(reasons)

    def explain_extrapolation(self, samples: float, edge_rounds: float, cloud_rounds: float) -> str | None:
        """Return a sentence that names the quantities above the largest in the history; None where there are none."""
        if self.fitted is None:
            return None
        over = [
            f"{value:g} {name.replace('_', ' ')} (measured up to {most:g})"
            for name, value, most in zip(
                QUANTITIES, (samples, edge_rounds, cloud_rounds), self.fitted.resources.max(axis=0)
            )
            if value > most
        ]
        return f"extrapolated beyond the history: {', '.join(over)}" if over else None


def explain_exponent(stage: str, b: float) -> str | None:
    """Return a sentence on an exponent at a bound of the search, or too large for a power law; else None."""
    for bound, which in ((FLATTEST, "least"), (STEEPEST, "largest")):
        if np.isclose(b, bound, rtol=1e-3, atol=0):
            return f"{stage}: exponent {b:.3g} is the {which} that is tried: it is not identified by this history"
    if b > 0.5 * STEEPEST:
        return f"{stage}: exponent {b:.3g} is hardly a power law: the history drops at once or varies too little"
    return None


CurveFit = Fit[Additive] | Fit[Effective] | Fit[Federated]


@dataclass(frozen=True)
class FitState(Generic[CurveT]):
    """The parameters, data and loss of a fit: all that is needed to repeat it."""

    form: Form[CurveT]
    parameters: Array  # (P,)
    resources: Array  # (n, 3)
    error: Array  # (n,)
    weight: Array  # (n,)
    scale: float | None  # residual at which the soft L1 loss turns from squares to absolute values; None: squares

    @property
    def independent(self) -> int:
        """Number of different points of a positive weight; a repeated point adds no information."""
        points = np.column_stack((self.resources, self.error))
        return len(np.unique(points[self.weight > 0], axis=0))

    @property
    def spare(self) -> int:
        """Degrees of freedom of the residuals; a fit without any is saturated."""
        return self.independent - len(self.parameters)


def fit(
    history: History | Path | str,
    *,
    model: Literal["additive", "effective", "federated", "best"] = "additive",
    group_samples: float | Sequence[float] = 0.0,
    k: int = 1,
    alpha: float = 0.1,
    beta: float | None = None,
) -> CurveFit:
    """Return the learning curve fitted to the history of a task, or to that in a CSV file.

    It is the error as a function of samples, edge rounds and cloud rounds.

    The best model is the additive or, where there are several regions and cloud rounds vary, the federated one,
    whichever has the smaller AICc; runs are planned by it. Where a history has runs of several seeds, the curve is that
    of a mean seed (`level_seeds`). The data determine only beta / alpha. Raises `InputError` where there are too few
    points, where the effective model lacks `group_samples` for a history with rounds, and as `fit_federated` does.

    Args:
        history: accuracies at samples, edge rounds and cloud rounds, or the CSV file that holds them.
        model: `Additive`, `Effective`, `Federated`, or the best one; the arguments below apply to the latter ones.
        group_samples: number of samples that the vehicles hold, of all regions, or of each.
        k: number of edge rounds per cloud round.
        alpha: worth of an uploaded sample.
        beta: worth of a sample that vehicles hold; None: fitted, or 0.5 where the rounds never vary.

    >>> from flcav import fit
    >>> from flcav.optimization import article_histories  # the points of Wang et al., Fig. 3a
    >>> found = fit(article_histories()["objects"])
    >>> found.points, float(found.curve.error(2500, 0, 0)) < float(found.curve.error(50, 0, 0))
    (5, True)
    """
    history = level_seeds(history if isinstance(history, History) else load_history(history)).history
    samples, edge_rounds, cloud_rounds = history.resources.T
    columns = (samples, edge_rounds, cloud_rounds, history.accuracy, history.weight)
    if model == "additive":
        return fit_additive(*columns)
    held = (group_samples,) if isinstance(group_samples, int | float) else tuple(group_samples)
    if model == "best":
        fits: list[CurveFit] = [fit_additive(*columns)]
        if len(held) > 1 and np.ptp(cloud_rounds) > 0:
            fits.append(fit_federated(*columns, group_samples=held, k=k, alpha=alpha, beta=beta))
        return min(fits, key=lambda found: found.aicc)
    if model == "federated":
        return fit_federated(*columns, group_samples=held, k=k, alpha=alpha, beta=beta)
    if sum(held) == 0 and history.resources[:, 1:].any():
        raise InputError("--model effective needs --group-samples, as the history has rounds")
    return fit_effective(*columns, group_samples=sum(held), k=k, alpha=alpha, beta=beta)


def fit_additive(
    samples: ArrayLike,
    edge_rounds: ArrayLike,
    cloud_rounds: ArrayLike,
    accuracy: ArrayLike,
    weight: ArrayLike | None = None,
) -> Fit[Additive]:
    """Return the additive curve fitted jointly over all stages to accuracies (n,) at samples and rounds, (n,) each.

    `weight` (n,) multiplies the squared residuals; by default it is 1. A stage that never varies is left out. Raises
    `InputError` where there are too few points or all weights are 0.
    """
    spent = _columns(samples, edge_rounds, cloud_rounds)
    return _chosen(additive_forms(spent), spent, accuracy, weight)


def fit_effective(
    samples: ArrayLike,
    edge_rounds: ArrayLike,
    cloud_rounds: ArrayLike,
    accuracy: ArrayLike,
    weight: ArrayLike | None = None,
    *,
    group_samples: float,
    k: int = 1,
    alpha: float = 0.1,
    beta: float | None = None,
) -> Fit[Effective]:
    """Return the effective-samples curve fitted to accuracies (n,) at samples and rounds, (n,) each.

    `group_samples` is the number of samples that the vehicles of all groups hold, `k` the number of edge rounds per
    cloud round, `weight` (n,) as in `fit_additive`. The data determine only beta / alpha: alpha is given, and beta is
    fitted unless it is given, too, or the rounds never vary (then it is the article's 0.5). Raises `InputError` where
    there are too few different points, a point has no samples, or all weights are 0.
    """
    spent = _columns(samples, edge_rounds, cloud_rounds)
    return _chosen(effective_forms(spent, alpha, beta, group_samples, k), spent, accuracy, weight)


def fit_federated(
    samples: ArrayLike,
    edge_rounds: ArrayLike,
    cloud_rounds: ArrayLike,
    accuracy: ArrayLike,
    weight: ArrayLike | None = None,
    *,
    group_samples: Sequence[float],
    k: int = 1,
    alpha: float = 0.1,
    beta: float | None = None,
) -> Fit[Federated]:
    """Return the `Federated` curve fitted to accuracies (n,) at samples and rounds, (n,) each.

    `group_samples` are the samples that the vehicles of each region hold, the rest is as in `fit_effective`. AICc
    decides whether other regions' samples are worth something, and whether the curve has a drift. Raises `InputError`
    as `fit_effective` does, for fewer than two regions, and where the cloud rounds never vary.
    """
    spent = _columns(samples, edge_rounds, cloud_rounds)
    return _chosen(federated_forms(spent, alpha, beta, group_samples, k), spent, accuracy, weight)


def refit(fitted: FitState[Any], error: Array) -> Array:
    """Return the parameters (P,) of the same form fitted to other errors (n,) at the same resources.

    The search starts from the parameters of `fitted`.
    """
    start = fitted.parameters
    scale = fitted.scale
    return _least(fitted.form, fitted.resources, error, fitted.weight, [start], scale, ROUGH)[1]


def _columns(*columns: ArrayLike) -> Array:
    return np.stack([np.asarray(each, dtype=np.float64) for each in columns], axis=1)


def _chosen(forms: Sequence[Form[CurveT]], spent: Array, accuracy: ArrayLike, weight: ArrayLike | None) -> Fit[CurveT]:
    """Return the fit of least AICc: forms are fitted roughly, then the best one exactly, from where that ended.

    The rough least-squares fit of a form has no larger AICc than its refined fit. Forms are therefore refined in the
    order of their rough AICc, until that of the next one is no less than the best refined one.
    """
    error = 1 - np.asarray(accuracy, dtype=np.float64)
    weights = np.ones(len(error)) if weight is None else np.asarray(weight, dtype=np.float64)
    if not weights.sum() > 0:
        raise InputError("the weights of the history are all 0")
    level = max(float(np.median(error)), 1e-3)
    squares = [_fit_squares(form, spent, error, weights, form.starts(level), ROUGH) for form in forms]
    refined_fits: list[tuple[float, FitState[CurveT]]] = []
    for aicc, rough in sorted(((_measured(each).aicc, each) for each in squares), key=lambda pair: pair[0]):
        if refined_fits and aicc >= min(refined_fits, key=lambda pair: pair[0])[0]:
            break
        refined = _refine(rough, ROUGH)
        refined_fits.append((_measured(refined).aicc, refined))
    best = min(refined_fits, key=lambda pair: pair[0])[1]
    return _measured(_refine(_fit_squares(best.form, spent, error, weights, [best.parameters], EXACT), EXACT))


def _fit_squares(
    form: Form[CurveT], spent: Array, error: Array, weight: Array, starts: Sequence[ArrayLike], tolerance: float
) -> FitState[CurveT]:
    """Return the least-squares fit from `starts`."""
    return FitState(form, _least(form, spent, error, weight, starts, None, tolerance)[1], spent, error, weight, None)


def _refine(fitted: FitState[CurveT], tolerance: float) -> FitState[CurveT]:
    """Return a least-squares fit refined under soft L1 where there are many points; else the fit itself."""
    if fitted.independent < ROBUST_FROM:
        return fitted
    form, weight, p = fitted.form, fitted.weight, fitted.parameters
    residuals = (form.predict(p, fitted.resources) - fitted.error) * np.sqrt(weight)
    scale = max(3 * 1.4826 * float(np.median(np.abs(residuals))), 1e-6)
    _, p = _least(form, fitted.resources, fitted.error, weight, [p], scale, tolerance)
    return replace(fitted, parameters=p, scale=scale)


def _least(
    form: Form[Any],
    spent: Array,
    error: Array,
    weight: Array,
    starts: Sequence[ArrayLike],
    scale: float | None,
    tolerance: float,
) -> tuple[float, Array]:
    """Return the least cost over the local optima from `starts`, and its parameters (P,).

    Starts are left out once two of them have reached the same cost.
    """
    root = np.sqrt(weight)

    def jacobian(p: Array) -> Array:
        return form.derivative(p, spent) * root[:, None]

    results: list[tuple[float, Array]] = []
    for start in starts:
        found = least_squares(
            lambda p: (form.predict(p, spent) - error) * root,
            start,
            jacobian,  # pyright: ignore[reportArgumentType]  # its stub has the names of methods alone
            bounds=form.bounds(),
            xtol=tolerance,
            ftol=tolerance,
            gtol=tolerance,
            loss="linear" if scale is None else "soft_l1",
            f_scale=1.0 if scale is None else scale,
        )
        results.append((float(found.cost), found.x))
        costs = sorted(cost for cost, _ in results)
        if len(costs) > 1 and costs[1] <= costs[0] * (1 + SAME_COST):
            break
    return min(results, key=lambda result: result[0])


def _measured(fitted: FitState[CurveT]) -> Fit[CurveT]:
    form, weight = fitted.form, fitted.weight
    residual = form.predict(fitted.parameters, fitted.resources) - fitted.error
    mean_square = float((weight * residual**2).sum() / weight.sum())
    n = fitted.independent
    parameters = len(fitted.parameters) + 1
    spare = n - parameters - 1
    correction = 2 * parameters * (parameters + 1) / spare if spare > 0 else (1e9 if form.simplest else np.inf)
    aicc = n * np.log(max(mean_square, 1e-18)) + 2 * parameters + correction
    rmse = float(np.sqrt((residual**2).mean()))
    return Fit(form.curve(fitted.parameters), rmse, len(residual), float(aicc), fitted)
