"""Client processes: several clients train at the same time, in processes of one thread.

A process trains one client after another and holds all of them, so that a client can use any free process. Its update
does not depend on the process, nor on their number. Arrays pass through memory shared by two processes: a pipe would
copy them six times, in pieces.
"""

import contextlib
import mmap
import os
import pickle
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.reduction import DupFd
from queue import SimpleQueue
from typing import Any

from flcav.config import InputError
from flcav.federation.links.in_process import ClientLate, NamedClients
from flcav.federation.trainable import Trainable, Update, Weights, count_samples
from flcav.machine.processes import exit_with_parent, start_server
from flcav.machine.threads import keep_freed_memory, use_threads


@dataclass(frozen=True)
class Parcel:
    """A pickled value whose arrays are in a shared block, if they are not in the pickle."""

    pickled: bytes
    sizes: tuple[int, ...] = ()  # of the arrays, stored consecutively from the start of the block [bytes]


class SharedBlock:
    """A block of shared memory for one value at a time, written by one of two processes and read by the other.

    It is anonymous, so that killed processes leave nothing behind, and is passed to the other process as an argument of
    its start. Values that do not fit are pickled whole, as are all where the system has no such memory.
    """

    def __init__(self, size: int) -> None:
        """Reserve `size` bytes; the system allocates them when they are first written."""
        self._file: int | None = None
        self._memory: mmap.mmap | bytearray = bytearray()
        if size and hasattr(os, "memfd_create"):  # Linux
            self._file = os.memfd_create("flcav")
            os.truncate(self._file, size)
            self._memory = mmap.mmap(self._file, size)

    def __reduce__(self) -> tuple[Any, ...]:
        return _attach, (None if self._file is None else DupFd(self._file), len(self._memory))

    def close(self) -> None:
        """Release the memory, once the other process has ended, too."""
        if self._file is not None:
            os.close(self._file)
            self._file, self._memory = None, bytearray()

    def write(self, value: object) -> Parcel:
        """Write a value over the previous one; return what the reader needs besides."""
        # protocol 5 keeps arrays out of the pickle, so that they are copied once, into shared memory
        buffers: list[pickle.PickleBuffer] = []
        pickled = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        arrays = [buffer.raw() for buffer in buffers]
        sizes = tuple(array.nbytes for array in arrays)
        if sum(sizes) > len(self._memory):
            return Parcel(pickle.dumps(value))
        start = 0
        for array, size in zip(arrays, sizes, strict=True):
            self._memory[start : start + size] = array  # type: ignore[assignment]: any buffer
            start += size
        return Parcel(pickled, sizes)

    def read(self, parcel: Parcel) -> Any:
        """Return the value, with copies of its arrays."""
        arrays = []
        start = 0
        with memoryview(self._memory) as memory:
            for size in parcel.sizes:
                arrays.append(bytearray(memory[start : start + size]))
                start += size
        return pickle.loads(parcel.pickled, buffers=arrays)


def _attach(file: Any, size: int) -> SharedBlock:
    """Return the block of the process that started this one."""
    block = SharedBlock(0)
    if file is not None:
        descriptor = file.detach()
        block._memory = mmap.mmap(descriptor, size)
        os.close(descriptor)
    return block


_clients: Mapping[str, Trainable] = {}  # in a client process
_block = SharedBlock(0)  # in a client process: shared with its parent


class ClientKilled(RuntimeError):
    """A client's process ended while it trained."""


class ClientProcesses:
    """A pool of `count` processes in which `clients` train; a context manager, whose exit ends them.

    A process starts when it is first needed. If one is killed, the client that it trained fails, and it is replaced.
    """

    def __init__(self, clients: Mapping[str, Trainable], count: int) -> None:
        """Pickle `clients` for the processes; raises `InputError` where that is impossible."""
        try:
            self._pickled = pickle.dumps(clients)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise InputError(f"clients cannot be sent to processes ({error}); train them in one process") from None
        self.count = count
        self._free: SimpleQueue[_Process] = SimpleQueue()
        self._all: list[_Process] = []

    def renew(self, clients: Mapping[str, Trainable]) -> None:
        """Send the processes the clients in their present state; no client may be training."""
        self._pickled = pickle.dumps(clients)
        for each in self._all:
            with contextlib.suppress(BrokenProcessPool):  # its next training raises the error
                each.renew(self._pickled)

    def __enter__(self) -> "ClientProcesses":
        self._all = [_Process(self._pickled) for _ in range(self.count)]
        for each in self._all:
            self._free.put(each)
        return self

    def __exit__(self, *exception: object) -> None:
        for each in self._all:
            each.end()

    @property
    def pids(self) -> list[int]:
        """Return the ids of the processes that have started."""
        return [pid for each in self._all for pid in each.pids]

    def _train(self, name: str, weights: Weights, how: Mapping[str, Any], limit_s: float | None) -> Update:
        """Return the update of a client's `train` in the first free process; raises what `train` raises.

        May be called from several threads. Raises `ClientKilled` where the process died, `ClientLate` where it was
        ended after `limit_s` [s].
        """
        process = self._free.get()
        try:
            return process.train(name, weights, how, limit_s)
        except (BrokenProcessPool, ClientLate) as error:
            process.end()
            self._all.remove(process)
            process = _Process(self._pickled)
            self._all.append(process)
            if isinstance(error, ClientLate):
                raise
            raise ClientKilled("its process was killed while it trained") from None
        finally:
            self._free.put(process)


class _Process:
    """A client process, which starts with its first training, and the memory it shares with this one."""

    def __init__(self, clients: bytes) -> None:
        self._clients = clients
        self._pool: ProcessPoolExecutor | None = None  # of one process, so that it is known which client broke it
        self._block = SharedBlock(0)

    @property
    def pids(self) -> list[int]:
        return [] if self._pool is None else [*(self._pool._processes or {})]

    def train(self, name: str, weights: Weights, how: Mapping[str, Any], limit_s: float | None) -> Update:
        if self._pool is None:
            self._block = SharedBlock(
                2 * sum(array.nbytes for array in weights.values())
            )  # room for the further arrays of a strategy
            given = self._clients, self._block
            self._pool = ProcessPoolExecutor(1, mp_context=start_server(), initializer=_start, initargs=given)
            self._pool.submit(os.getpid).result()  # its start does not count as training
        trained = self._pool.submit(_train_here, self._block.write((name, weights, how)))
        if not wait([trained], limit_s).done:
            raise ClientLate(limit_s)
        return self._block.read(trained.result())

    def renew(self, clients: bytes) -> None:
        self._clients = clients
        if self._pool is not None:
            self._pool.submit(_take, clients).result()

    def end(self) -> None:
        if self._pool is not None:
            for process in list((self._pool._processes or {}).values()):
                process.terminate()  # between trainings, or after an error
            self._pool.shutdown(cancel_futures=True)
        self._block.close()


def train_remotely(
    clients: Mapping[str, Trainable], processes: ClientProcesses, limit_s: float | None = None
) -> Mapping[str, Trainable]:
    """Return proxies of `clients` that train in `processes`, which hold the same clients.

    limit_s: time limit of a training [s]; None: none.
    """
    return NamedClients(clients, lambda name: _Remote(name, processes, clients, limit_s))


class _Remote:
    def __init__(
        self, name: str, processes: ClientProcesses, clients: Mapping[str, Trainable], limit_s: float | None
    ) -> None:
        self._name, self._processes, self._clients, self._limit_s = name, processes, clients, limit_s

    def train(self, weights: Weights, **how: Any) -> Update:
        return self._processes._train(self._name, weights, how, self._limit_s)

    def count_samples(self, steps: int) -> int:
        return count_samples(self._clients[self._name], steps)


def _start(pickled: bytes, block: SharedBlock) -> None:
    global _block
    exit_with_parent()
    use_threads(1)
    keep_freed_memory()  # gradients of megabytes come and go in every step
    _block = block
    _take(pickled)


def _take(pickled: bytes) -> None:
    global _clients
    _clients = pickle.loads(pickled)


def _train_here(asked: Parcel) -> Parcel:
    name, weights, how = _block.read(asked)
    return _block.write(_clients[name].train(weights, **how))
