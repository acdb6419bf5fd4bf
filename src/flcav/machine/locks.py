"""Locks of folders: one writer at a time.

A lock is flock(2) of a file beside the folder, `.NAME.lock`, which says who holds it and is removed at the end; where
the folder above cannot be written, it is `.lock` in the folder. The system releases it when the process ends, however
that ends; forks of the process do not hold it. On NFS, Linux has the server lock the file, so that it holds between
machines, unless the share is mounted with `nolock` or `local_lock`; of a machine that is lost, the server drops the
locks. On file systems without locks, where no file can be made, and on Windows, nobody is held off.
"""

import contextlib
import os
import platform
import shlex
import sys
import tempfile
import time
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from flcav.config import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK = ".lock"
ATTEMPTS = 100  # to lock a file that its holder does not remove meanwhile
COMMAND = 200  # longest command in a message, in characters

_mine: ContextVar[frozenset[Path]] = ContextVar("_mine", default=frozenset())  # locks that this thread holds
_files: set[int] = set()  # open files of the locks that this process holds


@contextlib.contextmanager
def only_writer(path: Path) -> Iterator[None]:
    """Lock the folder, or file, at `path` within the context; the thread that holds it may enter it again.

    Raises `InputError` that says who holds it, if another process or thread does.
    """
    lock = _lock_path(path)
    if lock in _mine.get():
        yield
        return
    new = [parent for parent in lock.parents if not os.path.exists(parent)]  # noqa: PTH110 - False for any path
    file = _acquire(lock, path)
    before = _mine.set(_mine.get() | {lock})
    try:
        yield
    finally:
        _mine.reset(before)
        if file in _files:
            _files.discard(file)
            with contextlib.suppress(OSError):
                lock.unlink()  # before it is released: whoever has opened it meanwhile finds it removed
            os.close(file)
        for parent in new:
            with contextlib.suppress(OSError):  # something was written there
                parent.rmdir()


@contextlib.contextmanager
def wait_for_turn(what: str) -> Iterator[None]:
    """Hold the machine-wide lock named `what` (letters, digits, dashes) within the context; other processes wait."""
    with (Path(tempfile.gettempdir()) / f"flcav-{what}{LOCK}").open("a") as file:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _lock_path(path: Path) -> Path:
    path = Path(os.path.realpath(path))
    beside = os.access(next(each for each in path.parents if os.path.exists(each)), os.W_OK)  # noqa: PTH110
    return path.with_name(f".{path.name}{LOCK}") if beside else path / LOCK


def _acquire(lock: Path, path: Path) -> int | None:
    """Return the open file of the lock; None where there cannot be one."""
    with contextlib.suppress(OSError):
        for _ in range(ATTEMPTS if fcntl else 0):
            with contextlib.suppress(FileNotFoundError):
                return _open_locked(lock, path)
    return None


def _open_locked(lock: Path, path: Path) -> int:
    """Return the file of the lock, open and locked; raises `FileNotFoundError` where it was removed meanwhile."""
    lock.parent.mkdir(parents=True, exist_ok=True)
    file = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        _lock(file, path)
        if not os.path.samestat(os.fstat(file), lock.stat()):
            raise FileNotFoundError(lock)
        with contextlib.suppress(OSError):  # the writer itself reports a full disk
            os.ftruncate(file, 0)
            os.write(file, _describe_process().encode())
    except BaseException:
        os.close(file)
        raise
    _files.add(file)
    return file


def _lock(file: int, path: Path) -> None:
    assert fcntl is not None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.read(file, 4096).decode(errors="replace") or "another process writes there"
        raise InputError(f"{path}: {holder}; wait for its end, or choose another folder") from None
    except OSError:
        pass  # the file system has no locks


def _describe_process() -> str:
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])[:COMMAND]
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    return f"process {os.getpid()} on {platform.node()} writes there since {since} ({command})"


def _drop_in_fork() -> None:
    while _files:
        os.close(_files.pop())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_drop_in_fork)
