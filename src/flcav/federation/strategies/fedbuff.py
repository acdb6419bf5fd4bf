"""FedBuff: buffered asynchronous aggregation (Nguyen et al., AISTATS 2022, algorithm 1, arXiv 2106.06639).

Clients train asynchronously. The server combines updates as soon as a given number has arrived, its buffer, into the
next version of its weights; an update that started from an older version has a lower weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from flcav.config import InputError
from flcav.federation.strategies.fedavg import FedAvg
from flcav.federation.strategies.fedopt import move_mean
from flcav.federation.trainable import LocalUpdate, Update, Weights, learned_names


@dataclass(frozen=True)
class FedBuff:
    """Buffered asynchronous averaging: w <- w + rate sum_i n_i s(t_i) d_i / sum_i n_i, over the updates of a buffer.

    d_i is the change that client i learned, n_i its number of samples, t_i the staleness of its update, the number of
    versions of the weights since the one that it began with, and s(t) = (1 + t)^-exponent.
    """

    buffer: Annotated[int, Field(ge=1, le=10**6)] = 2  # updates in a buffer; no two are of one client
    exponent: Annotated[float, Field(ge=0, le=10)] = 0.5  # of the discount by staleness
    rate: Annotated[float, Field(gt=0, le=1e3)] = 1.0  # of the server

    def check_buffer(self, clients: int) -> None:
        """Raise `InputError` where there are fewer clients than a buffer has updates."""
        if self.buffer > clients:
            raise InputError(f"FedBuff: a buffer of {self.buffer} updates, no two of one client, and {clients} clients")

    def count_rounds(self, rounds: int, clients: int) -> int:
        """Return the number of buffers with as many updates as `rounds` rounds of all clients have, rounded down."""
        return rounds * clients // self.buffer

    def discount(self, staleness: int) -> float:
        """Return the factor s(t) of an update."""
        return float((1 + staleness) ** -self.exponent)

    def rebase(self, start: Weights, begun: Weights, update: LocalUpdate, staleness: int) -> LocalUpdate:
        """Return an update that began with the weights `begun` as one of the server's weights `start`.

        What is learned is start + s(t) (trained - begun). Statistics of batch normalisation are start + s(t)
        (trained - start), so that no variance falls below 0; other arrays are the update's.
        """
        if staleness == 0:
            return update
        factor = self.discount(staleness)
        learned = {*learned_names(start)}
        moved = dict(update.weights)
        for name, array in update.weights.items():
            if np.issubdtype(array.dtype, np.floating):
                # a variance is moved towards the client's, a convex combination that stays positive
                first = begun[name] if name in learned else start[name]
                change = array.astype(np.float64) - first
                moved[name] = (start[name] + factor * change).astype(array.dtype)
        return LocalUpdate(moved, update.samples, update.loss)

    def combine(self, start: Weights, updates: Sequence[Update]) -> Weights:
        """Return the next version of the weights, of updates that were rebased on `start`."""
        if self.rate == 1:
            return FedAvg().combine(start, updates)
        return move_mean(start, updates, lambda _, before, change: before + self.rate * change)

    def weigh(self, update: Update) -> float:
        """Return the update's number of samples."""
        return float(update.samples)
