"""Learning curves fitted to history by bounded robust least squares, with bands.

Which of the floor and the x0 are fitted is chosen by AICc (Hurvich and Tsai 1989); for few points it is neither, and
the fit is plain least squares: then it is the article's curve, accuracy = 1 - a x^(-b). From `ROBUST_FROM` points on,
the loss is soft L1 around three standard deviations. `bands` says how far curves of repeated histories would scatter.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from flcav.config import InputError
from flcav.optimization.curves.curves import STAGES, Additive, Decay, Effective
from flcav.optimization.curves.forms import STEEPEST, AdditiveForm, CurveT, Form, additive_forms, effective_forms
from flcav.optimization.curves.history import History

Array = NDArray[np.float64]

ROBUST_FROM = 10  # points: the spread of fewer residuals does not say which of them is an outlier
EXACT, ROUGH = 1e-14, 1e-6  # tolerances: of the curve that is returned; of those that are only compared
QUANTITIES = ("samples", "edge_rounds", "cloud_rounds")


@dataclass(frozen=True)
class Fit(Generic[CurveT]):
    """A curve and how well it describes the points."""

    curve: CurveT
    rmse: float  # of the accuracy
    points: int
    aicc: float
    fitted: "Fitted[CurveT] | None" = None

    @property
    def r_squared(self) -> float | None:
        """Return the share of the variance of the accuracy that the curve explains; None where none is known to be."""
        if self.fitted is None or np.ptp(self.fitted.error) == 0:
            return None
        return 1 - self.rmse**2 / float(np.var(self.fitted.error))

    @property
    def measured(self) -> dict[str, float]:
        """Return the largest of each quantity that varies in the history."""
        if self.fitted is None:
            return {}
        spent = self.fitted.resources
        return {name: float(column.max()) for name, column in zip(QUANTITIES, spent.T) if len(np.unique(column)) > 1}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return what should keep one from trusting the curve, a sentence each."""
        if self.fitted is None:
            return ()
        said = []
        spare = self.points - len(self.fitted.parameters)
        if spare < 1:
            said.append(
                f"{self.points} points for {len(self.fitted.parameters)} parameters: nothing is left to check them"
            )
        decays = zip(STAGES, self.curve.decays()) if isinstance(self.curve, Additive) else [("samples", self.curve)]
        said += [
            f"{stage}: exponent {decay.b:.3g} is hardly a power law: the history drops at once or varies too little"
            for stage, decay in decays
            if decay.b > 0.5 * STEEPEST
        ]
        if self.r_squared is None:
            said.append("the accuracy is the same at all points: nothing is known of what more would bring")
        elif self.r_squared < 0.5:
            said.append(f"the curve explains {max(self.r_squared, 0):.0%} of the variance of the accuracy")
        return tuple(said)

    def beyond(self, samples: float, edge_rounds: float, cloud_rounds: float) -> str | None:
        """Return a sentence if that is more than the history covers of any quantity, else None."""
        if self.fitted is None:
            return None
        over = [
            f"{asked:g} {name.replace('_', ' ')} (measured up to {most:g})"
            for name, asked, most in zip(
                QUANTITIES, (samples, edge_rounds, cloud_rounds), self.fitted.resources.max(axis=0)
            )
            if asked > most
        ]
        return f"extrapolated beyond the history: {', '.join(over)}" if over else None


CurveFit = Fit[Additive] | Fit[Effective]


@dataclass(frozen=True)
class Fitted(Generic[CurveT]):
    """What a fit was made from: all that repeating it needs."""

    form: Form[CurveT]
    parameters: Array  # (P,)
    resources: Array  # (n, 3)
    error: Array  # (n,)
    weight: Array  # (n,)
    scale: float | None  # of the residuals where the loss turns from squares to absolute values; None: squares


def fit_power(resource: ArrayLike, accuracy: ArrayLike) -> Decay:
    """Return the article's curve accuracy = 1 - a x^(-b) by plain least squares on the accuracies (n,)."""
    amounts = np.asarray(resource, dtype=np.float64)
    spent = np.stack((amounts, np.zeros_like(amounts), np.zeros_like(amounts)), axis=1)
    middle = float(np.exp(np.log(amounts).mean()))
    form = AdditiveForm((0,), False, (), (middle,), (0.0, 0.0, 0.0))
    error = 1 - np.asarray(accuracy, dtype=np.float64)
    return form.curve(_solved(form, spent, error, np.ones(len(error)), False).parameters).pretrain


def fit(
    history: History,
    *,
    model: Literal["additive", "effective"] = "additive",
    group_samples: float = 0.0,
    k: int = 1,
    alpha: float = 0.1,
    beta: float | None = None,
) -> CurveFit:
    """Return how the error falls with samples and rounds: the learning curve fitted to the history of one task.

    For the other settings, of the effective model, see `fit_effective`. Raises `InputError` where there are too few
    points, and where the effective model is told nothing of the samples that the rounds are about.

    >>> from flcav import fit
    >>> from flcav.optimization import article_histories  # the points of Wang et al., Fig. 3a
    >>> found = fit(article_histories()["objects"])
    >>> found.points, float(found.curve.error(2500, 0, 0)) < float(found.curve.error(50, 0, 0))
    (5, True)
    """
    samples, edge_rounds, cloud_rounds = history.resources.T
    columns = (samples, edge_rounds, cloud_rounds, history.accuracy, history.weight)
    if model == "additive":
        return fit_additive(*columns)
    if group_samples == 0 and history.resources[:, 1:].any():
        raise InputError("--model effective needs --group-samples, as the history has rounds")
    return fit_effective(*columns, group_samples=group_samples, k=k, alpha=alpha, beta=beta)


def fit_additive(
    samples: ArrayLike,
    edge_rounds: ArrayLike,
    cloud_rounds: ArrayLike,
    accuracy: ArrayLike,
    weight: ArrayLike | None = None,
) -> Fit[Additive]:
    """Return the additive curve fitted jointly to accuracies (n,) after so much of each stage (n,).

    A stage that never varies is left out. Raises `InputError` where there are too few points.
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
    """Return the effective-samples curve fitted to accuracies (n,) after so much of each stage (n,).

    `group_samples` are those that the vehicles of all groups hold. Only beta / alpha can be told from the data: alpha
    is given, and beta is fitted unless given too, or unless the rounds never vary (then it is the article's 0.5).
    """
    spent = _columns(samples, edge_rounds, cloud_rounds)
    return _chosen(effective_forms(spent, alpha, beta, group_samples, k), spent, accuracy, weight)


def refitted(fitted: Fitted[Any], error: Array) -> Array:
    """Return the parameters fitted to other errors (n,) at the same resources, from the old ones on."""
    start, scale = fitted.parameters, fitted.scale
    return _least(fitted.form, fitted.resources, error, fitted.weight, [start], scale, ROUGH)[1]


def _columns(*columns: ArrayLike) -> Array:
    return np.stack([np.asarray(each, dtype=np.float64) for each in columns], axis=1)


def _chosen(forms: Sequence[Form[CurveT]], spent: Array, accuracy: ArrayLike, weight: ArrayLike | None) -> Fit[CurveT]:
    """Return the fit of least AICc: roughly of all forms, then exactly of the best."""
    error = 1 - np.asarray(accuracy, dtype=np.float64)
    weights = np.ones(len(error)) if weight is None else np.asarray(weight, dtype=np.float64)
    if not weights.sum() > 0:
        raise InputError("the weights of the history are all 0")
    robust = len(error) >= ROBUST_FROM
    rough = [_measured(_solved(form, spent, error, weights, robust, ROUGH)).aicc for form in forms]
    return _measured(_solved(forms[int(np.argmin(rough))], spent, error, weights, robust))


def _solved(
    form: Form[CurveT], spent: Array, error: Array, weight: Array, robust: bool, tolerance: float = EXACT
) -> Fitted[CurveT]:
    """Return the curve of least squares from several starts; then, if `robust`, of least soft L1 loss."""
    starts = form.starts(max(float(np.median(error)), 1e-3))
    _, p = _least(form, spent, error, weight, starts, None, tolerance)
    scale = None
    if robust:
        residuals = (form.predict(p, spent) - error) * np.sqrt(weight)
        scale = max(3 * 1.4826 * float(np.median(np.abs(residuals))), 1e-6)
        _, p = _least(form, spent, error, weight, [p], scale, tolerance)
    return Fitted(form, p, spent, error, weight, scale)


def _least(
    form: Form[Any],
    spent: Array,
    error: Array,
    weight: Array,
    starts: Sequence[ArrayLike],
    scale: float | None,
    tolerance: float,
) -> tuple[float, Array]:
    """Return the least cost from any of `starts`, and its parameters."""
    root = np.sqrt(weight)
    results = [
        least_squares(
            lambda p: (form.predict(p, spent) - error) * root,
            start,
            bounds=form.bounds(),
            xtol=tolerance,
            ftol=tolerance,
            gtol=tolerance,
            loss="linear" if scale is None else "soft_l1",
            f_scale=1.0 if scale is None else scale,
        )
        for start in starts
    ]
    best = min(results, key=lambda result: result.cost)
    return float(best.cost), best.x


def _measured(fitted: Fitted[CurveT]) -> Fit[CurveT]:
    form, weight = fitted.form, fitted.weight
    residual = form.predict(fitted.parameters, fitted.resources) - fitted.error
    mean_square = float((weight * residual**2).sum() / weight.sum())
    n, parameters = len(residual), len(fitted.parameters) + 1  # and the variance
    spare = n - parameters - 1
    correction = 2 * parameters * (parameters + 1) / spare if spare > 0 else (1e9 if form.simplest else np.inf)
    aicc = n * np.log(max(mean_square, 1e-18)) + 2 * parameters + correction
    rmse = float(np.sqrt((residual**2).mean()))
    return Fit(form.curve(fitted.parameters), rmse, n, float(aicc), fitted)
