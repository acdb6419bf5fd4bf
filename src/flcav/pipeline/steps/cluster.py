"""Steps by actors of a Ray cluster, on any of its machines; they need share no storage.

What a step needs travels to its actor: the folders of the steps that it builds on, which stay there for the next, and
its own unfinished one. Its files travel back when it is done and, where it reports in between, as they are then: at
most a twentieth of its time goes into that. So a killed step goes on from its last report that came back; lost is what
it did since, or all where it reports nothing. Files travel as they are, those behind links too, in pieces, so that
neither side holds a folder in memory. Either side has a folder whole, as it was at one time, or as it was before.
"""

import contextlib
import os
import pickle
import shutil
import tempfile
import time
import zipfile
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from queue import Queue, SimpleQueue
from typing import IO, Any

from flcav.dataset.recording.ray_engine import ray_session
from flcav.pipeline.provenance import provenance
from flcav.pipeline.steps.engines import KILLED, Engine, Hands, perform
from flcav.pipeline.steps.source_hash import package_hash
from flcav.pipeline.steps.step import Record, Step, aside, remove, value_of
from flcav.threads import use_threads

PIECE_BYTES = 8_000_000
SENDING = 1 / 20  # of a step's time
LEAVING_S = 5.0  # that actors have to remove what they wrote

Stamps = dict[str, tuple[int, int]]  # of each file of a folder: when it was changed, bytes


@contextlib.contextmanager
def ray_cluster(jobs: int) -> Iterator[Engine]:
    """Yield the cluster that RAY_ADDRESS names, or one of `jobs` processors on this machine.

    Raises `InputError` where Ray is not installed.
    """
    with ray_session(jobs) as ray:
        yield _Cluster(ray)


class _Cluster:
    """Actors of a cluster, each driven by a thread here."""

    def __init__(self, ray: Any) -> None:
        self._ray = ray
        self._actors: list[Any] = []

    @contextlib.contextmanager
    def hands(self, folder: Path, jobs: int) -> Iterator[Hands]:
        """Yield `jobs` actors; raises `OSError` where one was killed, or runs another flcav than this machine."""
        remote = self._ray.remote(num_cpus=1, max_concurrency=3)(_Worker)  # it works, is heard, and told to leave
        actors = [remote.remote() for _ in range(jobs)]
        self._actors += actors
        reports: Queue[Any] = Queue()
        free: SimpleQueue[Any] = SimpleQueue()
        for actor in actors:
            free.put(actor)

        def submit(step: Step, record: Record) -> Future[Any]:
            return threads.submit(self._perform, free, step, record, folder, reports)

        with ThreadPoolExecutor(jobs) as threads:
            try:
                yield Hands(submit, reports)
            finally:
                self._leave(actors)

    def stop(self) -> None:
        """Stop all actors; what they reported last is here."""
        self._leave(self._actors)

    def _leave(self, actors: Iterable[Any]) -> None:
        if left := [actor.leave.remote() for actor in actors]:
            self._ray.wait(left, num_returns=len(left), timeout=LEAVING_S)
        for actor in actors:
            self._ray.kill(actor)

    def _perform(self, free: SimpleQueue[Any], step: Step, record: Record, folder: Path, reports: Queue[Any]) -> Any:
        from ray.exceptions import RayActorError, RayTaskError  # pyright: ignore[reportMissingImports]

        actor = free.get()
        try:
            self._send(actor, step, folder)
            working = actor.perform.remote(self._ray.cloudpickle.dumps((step, record)))
            self._hear(actor, folder / step.name, lambda *told: reports.put((step.name, *told)))
            self._ray.get(working)
            return value_of(folder / step.name)
        except RayTaskError as error:
            raise error.cause from None
        except RayActorError:
            raise OSError(KILLED) from None
        finally:
            free.put(actor)

    def _send(self, actor: Any, step: Step, folder: Path) -> None:
        """Send what the actor does not have yet."""
        there = self._ray.get(actor.holds.remote(package_hash()))
        for name in {*step.needs, step.name} - set(there):
            with packed(folder / name, stamps(folder / name)) as pieces:
                for piece in pieces:
                    self._ray.get(actor.take.remote(piece))
            self._ray.get(actor.unpack.remote(name))

    def _hear(self, actor: Any, own: Path, report: Any) -> None:
        """Hear a step out: pass on what it reports, and have its folder here as it is there."""
        with tempfile.TemporaryFile() as file:
            while (heard := self._ray.get(actor.hear.remote())) is not None:
                kind, *said = heard
                if kind == "report":
                    report(*said)
                elif kind == "piece":
                    file.write(said[0])
                else:
                    replace_folder(own, said[0], file)
                    file.seek(0)
                    file.truncate()


class _Worker:
    """On one of the machines: performs one step after another in a folder of its own."""

    def __init__(self) -> None:
        use_threads(1)
        self._folder = Path(tempfile.mkdtemp(prefix="flcav-steps-"))
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - as long as this lives
        self._told: Queue[Any] = Queue(maxsize=2)  # what is not heard yet waits, and the step with it

    def holds(self, package: str) -> list[str]:
        """Return the steps whose folders are here; raises `OSError` where this is not the flcav that is asked for."""
        if package != package_hash():
            raise OSError(f"{os.uname().nodename} runs another flcav: install the same on all machines of the cluster")
        return [path.name for path in self._folder.iterdir()]

    def take(self, piece: bytes) -> None:
        """Take a piece of a folder."""
        self._file.write(piece)

    def unpack(self, name: str) -> None:
        """Unpack what was taken as the folder of the step `name`."""
        replace_folder(self._folder / name, None, self._file)
        self._file.seek(0)
        self._file.truncate()

    def perform(self, pickled: bytes) -> None:
        """Perform a step, by a record; what it reports, and its files, are told to whoever hears."""
        try:
            step, record = pickle.loads(pickled)  # here, so that the end is told where its function is not to be had
            sender = _Sender(self._folder / step.name, self._told)
            perform(step, self._folder, record, provenance(), sender.report)
            sender.send()
        finally:
            self._told.put(None)

    def hear(self) -> Any:
        """Return what is told next: a report, a piece of changed files, the names of all; None at the end."""
        return self._told.get()

    def leave(self) -> None:
        """Remove what is here."""
        shutil.rmtree(self._folder, ignore_errors=True)


class _Sender:
    """Tells what a step reports, and its files as they are then."""

    def __init__(self, folder: Path, told: Queue[Any]) -> None:
        self._folder, self._told = folder, told
        self._sent = stamps(folder)
        self._next_s = 0.0

    def report(self, done: int, total: int, note: str = "") -> None:
        """Tell a report, after the files where it is time."""
        if (start := time.monotonic()) >= self._next_s:
            self.send()
            end = time.monotonic()
            self._next_s = end + (end - start) / SENDING
        self._told.put(("report", done, total, note))

    def send(self) -> None:
        """Tell the pieces of what has changed since the last time, and the names of all files."""
        now = stamps(self._folder)
        with packed(self._folder, [name for name in now if self._sent.get(name) != now[name]]) as pieces:
            for piece in pieces:
                self._told.put(("piece", piece))
        self._told.put(("files", list(now)))
        self._sent = now


def stamps(folder: Path) -> Stamps:
    """Return the stamp of each file below `folder`, links followed, and of each empty folder, which ends in a slash."""
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
    """Yield the pieces of an archive of the files `names` of a folder."""
    with tempfile.TemporaryFile() as file:
        with zipfile.ZipFile(file, "w", strict_timestamps=False) as archive:
            for name in names:
                archive.write(folder / name, name)
        file.seek(0)
        yield iter(lambda: file.read(PIECE_BYTES), b"")


def replace_folder(folder: Path, names: Collection[str] | None, archive: IO[bytes]) -> None:
    """Make `folder` hold the files of an archive and, of those that it held, those in `names`; None for nothing else.

    It is replaced as a whole: an interruption leaves it as it was, or not there.
    """
    new = aside(folder, "new")
    new.mkdir(parents=True)
    with zipfile.ZipFile(archive) as files:
        files.extractall(new)
        here = set(files.namelist())
    for name in set(names or ()) - here:
        (new / name).parent.mkdir(parents=True, exist_ok=True)
        if name.endswith("/"):
            (new / name).mkdir(exist_ok=True)
        else:
            os.link(folder / name, new / name)
    remove(folder)
    new.rename(folder)
