"""How good a vehicle's data are where they are not IID; where they are, every quality is equal and throughput decides.

Three measures from the literature, each over a fleet of V vehicles, and one number made of them.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

LEAST = 0.01  # of a share: the poorest data are still worth something


def label_distribution_distance(counts: ArrayLike, reference: ArrayLike | None = None) -> Array:
    """Return each vehicle's total variation distance (V,) in [0, 1] of its labels (V, C) to a reference (C,).

    Half the L1 distance that Zhao et al. (2018, "Federated learning with non-IID data") relate the loss of accuracy to.
    The reference defaults to the fleet's labels together. A vehicle without labels is at distance 1.
    """
    numbers = np.asarray(counts, dtype=np.float64)
    whole = numbers.sum(axis=0) if reference is None else np.asarray(reference, dtype=np.float64)
    if not (np.all(numbers >= 0) and np.all(whole >= 0) and whole.sum() > 0):
        raise ValueError("label counts must be at least 0, and those of the reference not all 0")
    totals = numbers.sum(axis=1, keepdims=True)
    own = np.divide(numbers, totals, out=np.zeros_like(numbers), where=totals > 0)
    return np.where(totals[:, 0] > 0, 0.5 * np.abs(own - whole / whole.sum()).sum(axis=1), 1.0)


def visible_objects(objects: ArrayLike, samples: ArrayLike) -> Array:
    """Return each vehicle's mean number of visible objects per sample (V,); 0 for one without samples."""
    seen, held = np.asarray(objects, dtype=np.float64), np.asarray(samples, dtype=np.float64)
    return np.divide(seen, held, out=np.zeros_like(seen), where=held > 0)


def gradient_diversity(gradients: ArrayLike) -> float:
    """Return the sum of the squared norms of gradients (V, P) over the squared norm of their sum.

    Yin et al. (2018, "Gradient diversity"): 1/V where all are equal, 1 where they are orthogonal, infinite where they
    cancel.
    """
    rows = np.asarray(gradients, dtype=np.float64)
    together = float((rows.sum(axis=0) ** 2).sum())
    apart = float((rows**2).sum())
    return apart / together if together > 0 else float("inf") if apart > 0 else 1 / len(rows)


def gradient_novelty(gradients: ArrayLike) -> Array:
    """Return how far each vehicle's gradient (V, P) points from the others' mean: (1 - cosine) / 2 (V,) in [0, 1].

    0: it says what the others say; 1/2: what none of them says. 0 for a gradient of 0 and for a single vehicle.
    """
    rows = np.asarray(gradients, dtype=np.float64)
    others = rows.sum(axis=0) - rows
    norms = np.linalg.norm(rows, axis=1) * np.linalg.norm(others, axis=1)
    cosine = np.divide((rows * others).sum(axis=1), norms, out=np.ones(len(rows)), where=norms > 0)
    return (1 - np.clip(cosine, -1, 1)) / 2


def data_quality(
    label_distance: ArrayLike, objects_per_sample: ArrayLike | None = None, novelty: ArrayLike | None = None
) -> Array:
    """Return each vehicle's quality (V,) in (0, 1], the fleet's best 1: what one of its samples is worth.

    The product of its label overlap with the reference (1 - distance), its visible objects and (1 + novelty), each
    relative to the fleet's best. Equal vehicles are all worth 1.
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
