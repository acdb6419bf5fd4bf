"""Execution of steps by actors of a Ray cluster, on machines without shared storage.

An actor receives the folders of the steps that its step needs, which it keeps for later steps, and the unfinished
folder of the step itself. The step's files are sent back when it is done, and whenever it reports, for at most a
twentieth of its time (`SENDING`). A killed step resumes from the last report whose files came back. Files are sent
unchanged, linked ones too, in pieces of `PIECE_BYTES`, so that no folder is held in memory. A folder is replaced
atomically: it is never seen in part.
"""

import contextlib
import os
import pickle
import shutil
import tempfile
import time
import zipfile
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import Future
from pathlib import Path
from queue import Queue
from typing import IO, Any

from flcav.machine.ray_engine import RayActor, actor_pool
from flcav.machine.threads import use_threads
from flcav.runs.engine.source_hash import package_hash
from flcav.runs.engine.step import Step, StepRecord, digest, read_value, remove, reserve_sibling
from flcav.runs.engine.workers import Workers, perform
from flcav.runs.provenance import provenance
from flcav.storage.files import flush_tree

PIECE_BYTES = 8_000_000
SENDING = 1 / 20  # of a step's time, at most, for sending files back

Stamps = dict[str, tuple[int, int]]  # by file of a folder: time of its last change [ns], size [bytes]


@contextlib.contextmanager
def open_actors(jobs: int) -> Iterator[Workers]:
    """Yield `jobs` actors on the cluster at RAY_ADDRESS, or on as many processors of this machine.

    A step raises `OSError` where its actor was killed, or runs another version of flcav. Raises `InputError` where Ray
    is not installed.
    """
    reports: Queue[Any] = Queue()
    with actor_pool(jobs, _Worker) as pool:

        def submit(folder: Path, step: Step, record: StepRecord) -> Future[Any]:
            return pool.lend(lambda actor: _perform(actor, folder, step, record, reports))

        yield Workers(submit, reports)


def _perform(actor: "RayActor[_Worker]", folder: Path, step: Step, record: StepRecord, reports: Queue[Any]) -> Any:
    """Send an actor the folders that it does not have yet, let it perform a step, and return the step's value."""
    from ray import cloudpickle  # pyright: ignore[reportMissingImports]: an extra

    run = digest(str(folder))  # its steps have a folder of this name there
    there = actor.call(_Worker.holds, package_hash(), run)
    for name in {*step.needs, step.name} - set(there):
        with packed(folder / name, stamps(folder / name)) as pieces:
            for piece in pieces:
                actor.call(_Worker.take, piece)
        actor.call(_Worker.unpack, run, name)
    finish = actor.start(_Worker.perform, run, cloudpickle.dumps((step, record)))
    with tempfile.TemporaryFile() as file:
        while (heard := actor.call(_Worker.hear)) is not None:
            kind, *said = heard
            if kind == "report":
                reports.put((folder, step.name, *said))
            elif kind == "piece":
                file.write(said[0])
            else:
                replace_folder(folder / step.name, said[0], file)
                file.seek(0)
                file.truncate()
    finish()
    return read_value(folder / step.name)


class _Worker:
    """The actor on a machine: performs one step after another in a temporary folder."""

    def __init__(self) -> None:
        use_threads(1)
        self._folder = Path(tempfile.mkdtemp(prefix="flcav-steps-"))
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the actor lives
        self._messages: Queue[Any] = Queue(maxsize=2)  # bounded: a step waits until it is heard

    def holds(self, package: str, run: str) -> list[str]:
        """Return the steps of a run whose folders are here; raises `OSError` where flcav's hash is not `package`."""
        if package != package_hash():
            raise OSError(f"{os.uname().nodename} runs another flcav: install the same on all machines of the cluster")
        return [path.name for path in (self._folder / run).glob("*")]

    def take(self, piece: bytes) -> None:
        """Append a piece to the archive that is being received."""
        self._file.write(piece)

    def unpack(self, run: str, name: str) -> None:
        """Unpack the received archive as the folder of the step `name` of a run."""
        replace_folder(self._folder / run / name, None, self._file)
        self._file.seek(0)
        self._file.truncate()

    def perform(self, run: str, pickled: bytes) -> None:
        """Perform a pickled (step, record) of a run; reports and files are queued for `hear`."""
        try:
            step, record = pickle.loads(pickled)  # within try: the end is reported even if this fails
            folder = self._folder / run
            sender = _Sender(folder / step.name, self._messages)
            try:
                perform(step, folder, record, provenance(), sender.report)
            finally:
                sender.send()  # of a refused federation, too, that it has removed its secrets
        finally:
            self._messages.put(None)

    def hear(self) -> Any:
        """Return the next message: a report, a piece of changed files, or the names of all files; None at the end."""
        return self._messages.get()

    def leave(self) -> None:
        """Remove the temporary folder."""
        shutil.rmtree(self._folder, ignore_errors=True)


class _Sender:
    """Queues a step's reports and its changed files."""

    def __init__(self, folder: Path, messages: Queue[Any]) -> None:
        self._folder = folder
        self._messages = messages
        self._sent = stamps(folder)
        self._next_s = 0.0

    def report(self, done: int, total: int, note: str = "") -> None:
        """Queue a report, preceded by the changed files where `SENDING` allows."""
        if (start := time.monotonic()) >= self._next_s:
            self.send()
            end = time.monotonic()
            self._next_s = end + (end - start) / SENDING
        self._messages.put(("report", done, total, note))

    def send(self) -> None:
        """Queue the files that have changed since the last call, in pieces, then the names of all files."""
        now = stamps(self._folder)
        with packed(self._folder, [name for name in now if self._sent.get(name) != now[name]]) as pieces:
            for piece in pieces:
                self._messages.put(("piece", piece))
        self._messages.put(("files", list(now)))
        self._sent = now


def stamps(folder: Path) -> Stamps:
    """Return the stamps of the files below `folder`, by relative path; links are followed, empty folders end in "/"."""
    found: Stamps = {}
    for place, folders, files in os.walk(folder, followlinks=True):
        below = Path(place)
        if not folders and not files and below != folder:
            found[f"{below.relative_to(folder).as_posix()}/"] = (0, 0)
        for name in files:
            state = (below / name).stat()
            found[(below / name).relative_to(folder).as_posix()] = state.st_mtime_ns, state.st_size
    return found


@contextlib.contextmanager
def packed(folder: Path, names: Iterable[str]) -> Iterator[Iterator[bytes]]:
    """Yield a ZIP archive of the files `names` of a folder, in pieces of `PIECE_BYTES`."""
    with tempfile.TemporaryFile() as file:
        with zipfile.ZipFile(file, "w", strict_timestamps=False) as archive:
            for name in names:
                archive.write(folder / name, name)
        file.seek(0)
        yield iter(lambda: file.read(PIECE_BYTES), b"")


def replace_folder(folder: Path, names: Collection[str] | None, archive: IO[bytes]) -> None:
    """Replace `folder` by the files of a ZIP archive, keeping those of its files that are in `names` (None: none).

    Files keep the permissions that they were packed with. The folder is replaced atomically: an interruption leaves
    the old folder, or none.
    """
    new = reserve_sibling(folder, "new")
    new.mkdir(parents=True)
    with zipfile.ZipFile(archive) as files:
        for member in files.infolist():
            if member.is_dir():
                files.extract(member, new)
                continue
            place = new / member.filename
            place.parent.mkdir(parents=True, exist_ok=True)
            place.touch(mode=0o600)  # key files must not be readable by others while they are being written
            files.extract(member, new)
            place.chmod(member.external_attr >> 16 & 0o777)
        here = set(files.namelist())
    for name in set(names or ()) - here:
        (new / name).parent.mkdir(parents=True, exist_ok=True)
        if name.endswith("/"):
            (new / name).mkdir(exist_ok=True)
        else:
            os.link(folder / name, new / name)
    flush_tree(new)
    remove(folder)
    new.rename(folder)
