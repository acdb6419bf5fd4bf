"""Flower's simulation runtime: the clients of a federation train in actors of a Ray cluster.

Flower pickles its client app for every message. The clients are therefore put into Ray's object store once, and the
pickled app only has a reference to them.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache, partial
from queue import SimpleQueue
from typing import Any, Literal

from flwr.app import Context, Message, MessageType, RecordDict
from flwr.clientapp import ClientApp
from flwr.serverapp import Grid, ServerApp
from flwr.simulation import run_simulation

from flcav.federation.client import PARTITION
from flcav.federation.links.in_process import LinkGrid, NamedClients, keep_identity
from flcav.federation.state import ClientStates
from flcav.federation.trainable import Arrays, Trainable
from flcav.federation.wire import METRICS, to_array_record
from flcav.machine.ray_engine import ray_session

STARTING_S = 120.0  # timeout of the nodes' start [s]


class RaySimulation:
    """A runtime of `count` Ray actors with one thread each, in which clients train."""

    deployed: Literal[False] = False

    def __init__(self, count: int) -> None:
        self.count = count

    @contextlib.contextmanager
    def open(
        self,
        clients: Mapping[str, Trainable],
        make_app: Callable[[Mapping[str, Trainable]], ClientApp],
        states: ClientStates,
    ) -> Iterator["SimulatedGrid"]:
        """Yield the grid of a simulation, whose nodes run `make_app` of the clients.

        Flower runs its server app until the context ends. states: client states from earlier rounds. Raises
        `InputError` where Ray is not installed.
        """
        ready, ended = SimpleQueue[SimulatedGrid | BaseException](), threading.Event()
        server = ServerApp()
        names = [*clients]

        @server.main()
        def main(grid: Grid, context: Context) -> None:
            try:
                ready.put(SimulatedGrid(grid, _introduce(grid, names, states)))
            except BaseException as error:
                ready.put(error)
            else:
                ended.wait()

        with ray_session(self.count, "--runtime ray") as ray, keep_identity():
            app = make_app(NamedClients(names, partial(_fetch_client, ray.put({**clients}))))
            resources = {"client_resources": {"num_cpus": 1, "num_gpus": 0.0}}

            def simulate() -> None:
                try:
                    run_simulation(server, app, len(names), backend_config=resources)
                except BaseException as error:
                    ready.put(error)

            simulation = threading.Thread(target=simulate, daemon=True)
            simulation.start()
            try:
                found = ready.get()
                if isinstance(found, BaseException):
                    raise found
                yield found
            finally:
                ended.set()
                simulation.join()


class SimulatedGrid(LinkGrid):
    """The grid of a simulation, with its clients' names by node."""

    def __init__(self, grid: Grid, names: Mapping[int, str]) -> None:
        self._grid, self.names = grid, names

    def send_and_receive(self, messages: Iterable[Message], *, timeout: float | None = None) -> Iterable[Message]:
        """Return the replies of the simulation's nodes, at most those within `timeout` [s]."""
        return self._grid.send_and_receive(messages, timeout=timeout)


@lru_cache(maxsize=1)
def _fetch(stored: Any) -> Mapping[str, Trainable]:
    import ray  # pyright: ignore[reportMissingImports]: an extra

    return ray.get(stored)


def _fetch_client(stored: Any, name: str) -> Trainable:
    return _fetch(stored)[name]


def _introduce(grid: Grid, names: list[str], states: Mapping[str, Mapping[str, Arrays]]) -> dict[int, str]:
    """Return the clients' names by node in the order of `names`, and send the nodes their clients' states."""
    end = time.monotonic() + STARTING_S
    while len(nodes := [*grid.get_node_ids()]) < len(names):
        if time.monotonic() > end:
            raise OSError(f"Flower's simulation: {len(nodes)} of {len(names)} nodes are there after {STARTING_S:.0f} s")
        time.sleep(0.05)
    # Flower assigns partitions to nodes in an order of its choice, so every node is asked for its index
    partition: dict[int, int] = {}
    for reply in grid.send_and_receive(_query(nodes, {})):
        partition[int(reply.content.metric_records[METRICS][PARTITION])] = reply.metadata.src_node_id  # type: ignore[arg-type]
    found = {partition[number]: name for number, name in enumerate(names)}
    kept = {node: states[name] for node, name in found.items() if name in states}
    for reply in grid.send_and_receive(_query(kept, kept)) if kept else ():
        if reply.has_error():
            raise OSError(f"{found[reply.metadata.src_node_id]}: {reply.error.reason}")
    return found


def _query(nodes: Iterable[int], kept: Mapping[int, Mapping[str, Arrays]]) -> list[Message]:
    return [
        Message(
            RecordDict({key: to_array_record(arrays) for key, arrays in kept.get(node, {}).items()}),
            node,
            MessageType.QUERY,
        )
        for node in nodes
    ]
