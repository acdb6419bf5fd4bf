"""Memory shared by two processes, through which arrays pass: a pipe would copy them six times, in pieces."""

import mmap
import os
import pickle
from dataclasses import dataclass
from multiprocessing.reduction import DupFd
from typing import Any


@dataclass(frozen=True)
class Parcel:
    """A pickled value whose arrays are in a block, if they are not in the pickle."""

    pickled: bytes
    sizes: tuple[int, ...] = ()  # of the arrays, one after another from the beginning of the block [bytes]


class SharedBlock:
    """A block of memory for one value at a time, written by one of two processes and read by the other.

    It has a name in no folder, so that none is left behind by processes that are killed. It reaches the other process
    as an argument of its start. Values that it has no room for are pickled whole; where the system has no such memory,
    all are.
    """

    def __init__(self, size: int) -> None:
        """Reserve `size` bytes; memory is taken when it is first written to."""
        self._file: int | None = None
        self._memory: mmap.mmap | bytearray = bytearray()
        if size and hasattr(os, "memfd_create"):  # Linux
            self._file = os.memfd_create("flcav")
            os.truncate(self._file, size)
            self._memory = mmap.mmap(self._file, size)

    def __reduce__(self) -> tuple[Any, ...]:
        return _attach, (None if self._file is None else DupFd(self._file), len(self._memory))

    def close(self) -> None:
        """Give the memory back, once the other process has ended, too."""
        if self._file is not None:
            os.close(self._file)
            self._file, self._memory = None, bytearray()

    def write(self, value: object) -> Parcel:
        """Write a value, over the one before; return what else the reader needs."""
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
        arrays, start = [], 0
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
