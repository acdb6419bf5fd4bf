"""Metrics of detection: matching, average precision, orientation similarity, calibration error; and of tracking."""

from flcav.perception.metrics.average_precision import (
    average_precision,
    bootstrap_interval,
    interval_words,
    orientation_similarity,
    right_headings,
    round_or_none,
    weighted_precision,
)
from flcav.perception.metrics.calibration import calibration_error, fit_logistic
from flcav.perception.metrics.found_cars import FoundCars, count_found_cars
from flcav.perception.metrics.matching import Matches, match

__all__ = [
    "FoundCars",
    "Matches",
    "average_precision",
    "bootstrap_interval",
    "calibration_error",
    "count_found_cars",
    "fit_logistic",
    "interval_words",
    "match",
    "orientation_similarity",
    "right_headings",
    "round_or_none",
    "weighted_precision",
]
