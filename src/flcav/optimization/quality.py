"""Data quality of vehicles under non-IID data: label distribution distance, visible objects, gradient novelty.

Each measure is over a fleet of V vehicles; `data_quality` combines them into one weight per vehicle. For IID data all
weights are equal.
"""

import numpy as np
from numpy.typing import ArrayLike

from flcav.geometry.arrays import Array

LEAST = 0.01  # least factor of a quality, relative to the fleet's best: no data are worth nothing


def label_distribution_distance(counts: ArrayLike, reference: ArrayLike | None = None) -> Array:
    """Return the total variation distance (V,) in [0, 1] of each vehicle's label distribution to the reference's.

    `counts` (V, C) are the vehicles' labels by class, `reference` (C,) those of the reference: by default the whole
    fleet's. The distance is half the L1 distance to which Zhao et al. (2018, "Federated learning with non-IID data")
    relate the loss of accuracy. A vehicle without labels has distance 1. Raises ValueError for negative counts and for
    a reference without labels.
    """
    numbers = np.asarray(counts, dtype=np.float64)
    whole = numbers.sum(axis=0) if reference is None else np.asarray(reference, dtype=np.float64)
    if not (np.all(numbers >= 0) and np.all(whole >= 0) and whole.sum() > 0):
        raise ValueError("label counts must be at least 0, and those of the reference not all 0")
    totals = numbers.sum(axis=1, keepdims=True)
    shares = np.divide(numbers, totals, out=np.zeros_like(numbers), where=totals > 0)
    return np.where(totals[:, 0] > 0, 0.5 * np.abs(shares - whole / whole.sum()).sum(axis=1), 1.0)


def visible_objects(objects: ArrayLike, samples: ArrayLike) -> Array:
    """Return each vehicle's mean number of visible objects per sample (V,): `objects` (V,) over `samples` (V,).

    It is 0 for a vehicle without samples.
    """
    seen, held = np.asarray(objects, dtype=np.float64), np.asarray(samples, dtype=np.float64)
    return np.divide(seen, held, out=np.zeros_like(seen), where=held > 0)


def gradient_novelty(gradients: ArrayLike) -> Array:
    """Return the cosine distance (V,) in [0, 1] of each vehicle's gradient (V, P) to the mean of the others'.

    The distance is (1 - cosine) / 2: 0 for parallel, 1/2 for orthogonal, 1 for opposite gradients. It is 0 for a
    gradient of 0 and for a single vehicle.
    """
    rows = np.asarray(gradients, dtype=np.float64)
    others = rows.sum(axis=0) - rows
    norms = np.linalg.norm(rows, axis=1) * np.linalg.norm(others, axis=1)
    cosine = np.divide((rows * others).sum(axis=1), norms, out=np.ones(len(rows)), where=norms > 0)
    return (1 - np.clip(cosine, -1, 1)) / 2


def data_quality(
    label_distance: ArrayLike, objects_per_sample: ArrayLike | None = None, novelty: ArrayLike | None = None
) -> Array:
    """Return the quality (V,) in (0, 1] of each vehicle's data, the worth of one sample relative to the fleet's best.

    It is the product of (1 - label distance), visible objects per sample and (1 + gradient novelty), each (V,) relative
    to the fleet's best and at least `LEAST`; a measure that is None is left out. Equal vehicles all have quality 1.
    """
    parts = [1 - np.asarray(label_distance, dtype=np.float64)]
    if objects_per_sample is not None:
        parts.append(np.asarray(objects_per_sample, dtype=np.float64))
    if novelty is not None:
        parts.append(1 + np.asarray(novelty, dtype=np.float64))
    worth = np.prod([_relative(part) for part in parts], axis=0)
    return worth / worth.max()


def _relative(part: Array) -> Array:
    best = part.max()
    return np.maximum(part / best, LEAST) if best > 0 else np.ones_like(part)
