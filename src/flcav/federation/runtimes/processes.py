"""Client processes: several clients train at the same time, each in a process of one thread.

A process trains one client after another and has all of them, so that a client goes to whichever process is free. What
a client returns does not depend on the process, nor on how many there are.
"""

import pickle
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from queue import SimpleQueue
from typing import Any

from flcav.config import InputError
from flcav.federation.trainable import Trainable, Update, Weights
from flcav.processes import exit_with_parent, start_server
from flcav.threads import use_threads

_clients: Mapping[str, Trainable] = {}  # in a client process


class ClientKilled(RuntimeError):
    """A client's process ended while it trained."""


class ClientProcesses:
    """`count` processes in which `clients` train; a context manager, whose end is theirs.

    They start when they are first needed. One that is killed loses the client that it was training, and is replaced.
    """

    def __init__(self, clients: Mapping[str, Trainable], count: int) -> None:
        """Hand `clients` to each process, by pickling; raises `InputError` where they cannot be."""
        try:
            self._pickled = pickle.dumps(clients)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise InputError(f"clients cannot be sent to processes ({error}); train them in one process") from None
        self.count = count
        self._free: SimpleQueue[ProcessPoolExecutor] = SimpleQueue()
        self._all: list[ProcessPoolExecutor] = []

    def __enter__(self) -> "ClientProcesses":
        self._all = [self._make() for _ in range(self.count)]
        for each in self._all:
            self._free.put(each)
        return self

    def __exit__(self, *exception: object) -> None:
        for each in self._all:
            for process in list((each._processes or {}).values()):
                process.terminate()  # between trainings, or after an error
            each.shutdown(cancel_futures=True)

    def _make(self) -> ProcessPoolExecutor:
        """Return a pool of one process: where it breaks, it is known whose training broke it."""
        return ProcessPoolExecutor(1, mp_context=start_server(), initializer=_start, initargs=(self._pickled,))

    def _train(self, name: str, weights: Weights, how: Mapping[str, Any]) -> Update:
        """Return what the client's `train` does in the first free process; raises what it raises.

        May be called from several threads. Raises `ClientKilled` where the process ends before.
        """
        process = self._free.get()
        try:
            return process.submit(_train_here, name, weights, how).result()
        except BrokenProcessPool:
            process.shutdown(wait=False)
            self._all.remove(process)
            process = self._make()
            self._all.append(process)
            raise ClientKilled("its process was killed while it trained") from None
        finally:
            self._free.put(process)


class RemoteClients(Mapping[str, Trainable]):
    """Clients as they are reached from this process: they train in `processes`."""

    def __init__(self, clients: Mapping[str, Trainable], processes: ClientProcesses) -> None:
        """Stand for `clients`, which `processes` have, too."""
        self._names, self._processes = clients, processes

    def __getitem__(self, name: str) -> Trainable:
        if name not in self._names:
            raise KeyError(name)
        return _Remote(name, self._processes)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


class _Remote:
    def __init__(self, name: str, processes: ClientProcesses) -> None:
        self._name, self._processes = name, processes

    def train(self, weights: Weights, **how: Any) -> Update:
        return self._processes._train(self._name, weights, how)


def _start(pickled: bytes) -> None:
    global _clients
    exit_with_parent()
    use_threads(1)
    _clients = pickle.loads(pickled)


def _train_here(name: str, weights: Weights, how: Mapping[str, Any]) -> Update:
    return _clients[name].train(weights, **how)
