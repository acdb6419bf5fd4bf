"""Nearest-neighbour mixing before a robust rule (Allouah et al., "Fixing by Mixing", AISTATS 2023, algorithm 2).

Where clients have unlike data, honest updates lie far apart, and a rule that keeps few of them is easily led. Mixing
first draws each towards those near it: y_i is the mean of the n - f updates nearest to x_i, itself among them, of n of
which f are Byzantine. Distances are of what is learned, and this alone is mixed.
"""

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flcav.config import InputError
from flcav.federation.trainable import LocalUpdate, Update, Weights, learned_names

Mixing = Annotated[int, Field(ge=0, le=10**6)]  # Byzantine clients that mixing is to withstand; 0: nothing is mixed


def mix_neighbours(updates: Sequence[Update], mixing: Mixing) -> Sequence[Update]:
    """Return each update with the mean of its n - `mixing` nearest for what it learned; the same ones for 0.

    Of equally near updates the first count. Samples do not.
    """
    if not mixing:
        return updates
    names = learned_names(updates[0].weights)
    flat = flatten_updates(updates, names)
    mixed = []
    for own, update in zip(flat, updates, strict=True):
        near = np.argsort(((flat - own) ** 2).sum(axis=1), kind="stable")[: len(updates) - mixing]
        mean, start, weights = flat[np.sort(near)].mean(axis=0), 0, dict(update.weights)
        for name in names:
            array = update.weights[name]
            weights[name] = mean[start : start + array.size].reshape(array.shape).astype(array.dtype)
            start += array.size
        mixed.append(LocalUpdate(weights, update.samples, update.loss))
    return mixed


def check_mixing(mixing: Mixing, clients: int) -> None:
    """Raise `InputError` unless fewer than half of the clients are to be withstood."""
    if mixing and clients <= 2 * mixing:
        raise InputError(f"mixing: {2 * mixing + 1} clients or more are wanted for {mixing}, and there are {clients}")


def flatten_updates(updates: Sequence[Update], names: Sequence[str]) -> NDArray[np.float64]:
    """Return the arrays `names` of each update, one after another (updates, coordinates)."""
    return np.stack([_flatten(update.weights, names) for update in updates])


def _flatten(weights: Weights, names: Sequence[str]) -> NDArray[np.float64]:
    return np.concatenate([weights[name].astype(np.float64).ravel() for name in names])
