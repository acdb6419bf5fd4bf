"""A curious server: it reads the updates of a round as they arrive, for experiments on leakage."""

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from flwr.app import Message
from flwr.serverapp import Grid

from flcav.federation.client import client_app
from flcav.federation.links.in_process import EmbeddedGrid, LinkGrid
from flcav.federation.loop import FederationServer
from flcav.federation.privacy import draw_secret
from flcav.federation.rules import Rules
from flcav.federation.secure.primitives import to_values
from flcav.federation.state import FederationState
from flcav.federation.strategies import FEDAVG
from flcav.federation.trainable import Trainable, Weights
from flcav.federation.wire import ARRAYS, VECTOR, LocalWork, decode_update, read_arrays, unflatten


class ReadGrid(LinkGrid):
    """A grid whose server keeps the arrays of each client's last update as they were sent."""

    def __init__(self, grid: Grid, names: Mapping[int, str]) -> None:
        self._grid, self.names = grid, names
        self.updates: dict[str, Weights] = {}

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterable[Message]:
        """Yield the replies, and keep those that are updates."""
        for reply in self._grid.send_and_receive(messages, timeout=timeout):
            if reply.has_content() and ARRAYS in reply.content:
                self.updates[self.names[reply.metadata.src_node_id]] = read_arrays(reply.content, ARRAYS)
            yield reply


def read_round(
    clients: Mapping[str, Trainable], start: Weights, work: Callable[[int], LocalWork], rules: Rules
) -> tuple[dict[str, Weights], Weights]:
    """Return what the server makes of each client's update in the first round, and the weights after it.

    work: of a round, counted from 1 (`Schedule.work`).
    Of a masked update it takes the integers for a change of the weights.
    """
    secrets = {party: draw_secret() for party in rules.secret_parties([*clients]) if party in clients}
    with EmbeddedGrid(client_app(clients, FEDAVG, rules, secrets), [*clients]) as grid:
        reading = ReadGrid(grid, grid.names)
        after = dict(FederationServer(reading, grid.names, FEDAVG, rules, work, FederationState()).run_round(1, start))
    seen: dict[str, Weights] = {}
    for name, update in reading.updates.items():
        if rules.secure is None:
            seen[name] = decode_update(update, start, rules)
        else:
            vector = np.asarray(update[VECTOR], np.uint32)
            seen[name] = unflatten(to_values(vector, rules.secure.largest, len(clients)), start, rules)
    return seen, after
