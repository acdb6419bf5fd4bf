"""Time limit of a client's training in this process, where it cannot be interrupted: it is left behind."""

import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from typing import Any, TypeVar

from flcav.federation.trainable import Trainable, Update, Weights, answer_question, count_samples

ResultT = TypeVar("ResultT")

_busy: dict[int, threading.Thread] = {}  # by identity of a client, which its thread holds: what was left behind


class ClientLate(OSError):
    """A client did not end its training within its time."""

    def __init__(self, limit_s: float | None) -> None:
        super().__init__(f"it had not trained after {limit_s:g} s")


class TimedClients(Mapping[str, Trainable]):
    """Clients that train in a thread each, and raise `ClientLate` after `limit_s` of wall time.

    A training that is left behind goes on until it ends, or the program does; until then its client refuses another
    one, so that no client trains twice at a time. What it returns is lost.
    """

    def __init__(self, clients: Mapping[str, Trainable], limit_s: float) -> None:
        self._clients, self._limit_s = clients, limit_s

    def __getitem__(self, name: str) -> Trainable:
        return _Timed(self._clients[name], self._limit_s)

    def __iter__(self) -> Iterator[str]:
        return iter(self._clients)

    def __len__(self) -> int:
        return len(self._clients)


class _Timed:
    def __init__(self, client: Trainable, limit_s: float) -> None:
        self._client, self._limit_s = client, limit_s

    def train(self, weights: Weights, **how: Any) -> Update:
        return self._within(lambda: self._client.train(weights, **how))

    def count_samples(self, steps: int) -> int:
        return self._within(lambda: count_samples(self._client, steps))

    def answer(self, question: str, arrays: Weights) -> Weights:
        return self._within(lambda: answer_question(self._client, question, arrays))

    def _within(self, do: Callable[[], ResultT]) -> ResultT:
        if (earlier := _busy.get(id(self._client))) is not None and earlier.is_alive():
            raise ClientLate(self._limit_s)
        done: Future[ResultT] = Future()

        def work() -> None:
            try:
                done.set_result(do())
            except BaseException as error:
                done.set_exception(error)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        thread.join(self._limit_s)
        if not thread.is_alive():
            return done.result()
        _busy[id(self._client)] = thread
        raise ClientLate(self._limit_s)
