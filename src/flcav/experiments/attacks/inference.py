"""What a server can tell from weights: gradient inversion of an update, and membership inference on the final weights.

Inversion: the gradient of a dense layer with bias is at_hidden x^T and at_hidden, of one picture with the layer's
input x; so the quotient of both is x (Geiping et al., "Inverting Gradients", NeurIPS 2020, proposition 3.1), and their
least-squares quotient over the rows is x under noise. Of several pictures it is a mixture. Zhu et al. ("Deep Leakage
from Gradients", NeurIPS 2019) search for the same input by descent.

Membership: who was trained on has a lower loss (Yeom et al., "Privacy Risk in Machine Learning", CSF 2018).
"""

from collections.abc import Iterable, Mapping

import numpy as np
from flwr.app import Message
from flwr.serverapp import Grid
from numpy.typing import NDArray

from flcav.experiments.attacks.drives import HIDDEN, Vector
from flcav.federation.client import client_app
from flcav.federation.encoding import decode, unflatten
from flcav.federation.records import VECTOR, to_arrays, to_update, to_weights
from flcav.federation.rounds import Rounds
from flcav.federation.rules import Rules
from flcav.federation.runtimes.embedded import EmbeddedGrid
from flcav.federation.runtimes.wrapped import WrappedGrid
from flcav.federation.secure.masks import to_values
from flcav.federation.stages import Schedule
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG
from flcav.federation.trainable import LocalUpdate, Trainable, Weights


class ReadGrid(WrappedGrid):
    """A grid whose server keeps the last update of each client as it was sent."""

    def __init__(self, grid: Grid, names: Mapping[int, str]) -> None:
        self._grid, self._names = grid, names
        self.updates: dict[str, LocalUpdate] = {}

    def push_messages(self, messages: Iterable[Message]) -> Iterable[str]:
        """Pass messages on."""
        return self._grid.push_messages(messages)

    def pull_messages(self, message_ids: Iterable[str]) -> Iterable[Message]:
        """Pass replies on."""
        return self._grid.pull_messages(message_ids)

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterable[Message]:
        """Yield the replies, and keep those that are updates."""
        for reply in self._grid.send_and_receive(messages, timeout=timeout):
            if reply.has_content() and "arrays" in reply.content:
                self.updates[self._names[reply.metadata.src_node_id]] = to_update(reply)
            yield reply


def read_round(
    clients: Mapping[str, Trainable], start: Weights, schedule: Schedule, rules: Rules
) -> tuple[dict[str, Weights], Weights]:
    """Return what the server makes of each client's update in the first round, and the weights after it.

    Of a masked update it takes the integers for a change of the weights.
    """
    with EmbeddedGrid(client_app(clients, FEDAVG, rules), [*clients]) as grid:
        reading = ReadGrid(grid, grid.names)
        app = Rounds(FEDAVG, rules, schedule.work, grid.names, FederationState(), 0, 0, lambda *_: None)
        after = to_weights(app.start(reading, to_arrays(start), 1).arrays)
    seen: dict[str, Weights] = {}
    for name, update in reading.updates.items():
        if rules.secure is None:
            seen[name] = decode(update.weights, start, rules)
        else:
            vector = np.asarray(update.weights[VECTOR], np.uint32)
            seen[name] = unflatten(to_values(vector, rules.secure.largest, len(clients)), start, rules)
    return seen, after


def invert(start: Weights, sent: Weights) -> Vector:
    """Return the input of layer F6 (120,) that explains the change of its weights and biases best.

    x = sum_i b_i W_i / sum_i b_i^2 over rows W_i and biases b_i of the change; zeros where no bias changed.
    """
    rows = np.asarray(sent[f"{HIDDEN}.weight"], np.float64) - start[f"{HIDDEN}.weight"]
    biases = np.asarray(sent[f"{HIDDEN}.bias"], np.float64) - start[f"{HIDDEN}.bias"]
    return (biases @ rows / max(float(biases @ biases), 1e-30)).astype(np.float32)


def name_nearest(found: Vector, known: Vector) -> int:
    """Return which of the known inputs (N, 120) has the largest cosine similarity with the one that was found."""
    return int(np.argmax(known @ found / np.maximum(np.linalg.norm(known, axis=1), 1e-12)))


def membership_auc(members: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return the chance that a member has a lower loss than another picture, ties counted half."""
    less = members[:, None] < others[None]
    same = members[:, None] == others[None]
    return float(less.mean() + same.mean() / 2)


def membership_advantage(members: NDArray[np.float64], others: NDArray[np.float64]) -> float:
    """Return the shares of members and of others with a loss up to the members' mean, one less the other."""
    limit = members.mean()
    return float((members <= limit).mean() - (others <= limit).mean())
