"""Metrics of detection: matching, average precision, orientation similarity, calibration error; and of tracking."""

from flcav.perception.metrics.detection import (
    Matches,
    average_precision,
    bootstrap_interval,
    calibration_error,
    fit_logistic,
    interval_words,
    match,
    match_at_each,
    orientation_similarity,
    right_headings,
    round_or_none,
    weighted_precision,
)
from flcav.perception.metrics.operating_point import FoundCars, count_found_cars

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
    "match_at_each",
    "orientation_similarity",
    "right_headings",
    "round_or_none",
    "weighted_precision",
]
