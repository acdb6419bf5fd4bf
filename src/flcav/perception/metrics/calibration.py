"""Expected calibration error of detection scores, and Platt scaling."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.special import expit, logit

BINS = 10
PULL = 0.01  # weight of the quadratic penalty on the summand and on the logarithm of the factor


def calibration_error(score: ArrayLike, hit: ArrayLike, bins: int = BINS) -> float:
    """Return the expected calibration error (ECE) of D detections, in [0, 1]; NaN without detections.

    score (D,) in [0, 1]; hit (D,) whether the detection is correct. The ECE is the mean over detections of |mean score
    - share of hits| in the detection's bin, `bins` of equal width (Naeini et al., "Obtaining well calibrated
    probabilities using Bayesian binning", AAAI 2015).
    """
    scores, hits = np.asarray(score, dtype=np.float64), np.asarray(hit, dtype=np.float64)
    if not len(scores):
        return float("nan")
    number = np.minimum((scores * bins).astype(np.int64), bins - 1)
    gap = np.bincount(number, scores - hits, bins)
    return float(np.abs(gap).sum() / len(scores))


def fit_logistic(score: ArrayLike, hit: ArrayLike) -> tuple[float, float]:
    """Return factor (positive) and summand of Platt scaling: calibrated logit = factor * logit + summand.

    Fitted by penalised maximum likelihood to scores (D,) in [0, 1] and hits (D,), with the smoothed targets of Platt,
    "Probabilistic outputs for support vector machines", 1999, sec. 2.2. (1, 0), no change, where all or none are hits.
    """
    x = logit(np.clip(np.asarray(score, dtype=np.float64), 1e-7, 1 - 1e-7))
    hits = np.asarray(hit, dtype=bool)
    right, wrong = int(hits.sum()), int((~hits).sum())
    if not right or not wrong:
        return 1.0, 0.0
    wanted = np.where(hits, (right + 1) / (right + 2), 1 / (wrong + 2))

    def loss(parameters: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        factor = np.exp(parameters[0])
        z = factor * x + parameters[1]
        value = np.logaddexp(0, z) - wanted * z
        slope = expit(z) - wanted
        prior = PULL * parameters
        gradient = np.array(((slope * x).sum() * factor, slope.sum())) + 2 * prior
        return float(value.sum() + (prior * parameters).sum()), gradient

    found = minimize(loss, np.zeros(2), jac=True, method="L-BFGS-B", bounds=((-3, 3), (-10, 10)))
    return float(np.exp(found.x[0])), float(found.x[1])
