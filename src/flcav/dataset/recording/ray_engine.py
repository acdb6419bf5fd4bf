"""Recording engine on a Ray cluster: actors on any of its machines perform the jobs.

The dataset's folder must be on storage shared by all machines, and flcav installed on each. RAY_ADDRESS names the
cluster; without it, Ray is started on this machine.
"""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from flcav.dataset.recording.jobs import Engine, Job, Part, perform
from flcav.machine.processes import ray_session
from flcav.sources.source import Source


@contextlib.contextmanager
def start_ray_engine(source: Source, work: Path, jobs: int, wrote: Callable[[int], None]) -> Iterator[Engine]:
    """Yield an engine of `jobs` Ray actors that perform jobs of `source` below the folder `work`.

    It calls `wrote` with the number of frames written so far, as parts are completed. Raises `InputError` where Ray is
    not installed.
    """
    with ray_session(jobs) as ray:
        shared = ray.put(source)
        actors = [ray.remote(num_cpus=1)(_Worker).remote(shared, work.absolute()) for _ in range(jobs)]
        yield _RayEngine(actors, wrote)


class _Worker:
    """A Ray actor that performs jobs in sequence; its source keeps the scene that it built last."""

    def __init__(self, source: Source, work: Path) -> None:
        self._source, self._work = source, work

    def perform(self, task: Job) -> None:
        if not self._work.is_dir():
            raise OSError(
                f"{self._work}: not seen from {os.uname().nodename}; record into storage that all nodes share"
            )
        perform(self._source, task, self._work, lambda: None)


class _RayEngine:
    """An engine that hands each queued job to an idle Ray actor."""

    def __init__(self, actors: list[Any], wrote: Callable[[int], None]) -> None:
        self.slots = len(actors)
        self._idle, self._wrote = actors, wrote
        self._waiting: list[Job] = []
        self._busy: dict[Any, tuple[Any, Job]] = {}  # reference -> actor, task
        self._count = 0

    def submit(self, task: Job) -> None:
        self._waiting.append(task)
        self._hand_out()

    def wait(self) -> list[Job]:
        import ray  # pyright: ignore[reportMissingImports]: an extra
        from ray.exceptions import RayActorError, RayTaskError  # pyright: ignore[reportMissingImports]

        (done,), _ = ray.wait(list(self._busy), num_returns=1)
        actor, task = self._busy.pop(done)
        try:
            ray.get(done)
        except RayTaskError as error:
            raise error.cause from None
        except RayActorError:
            raise OSError("a worker was killed from outside, most often for want of memory: try fewer jobs") from None
        self._idle.append(actor)
        self._hand_out()
        self._count += task.frames if isinstance(task, Part) else 0
        self._wrote(self._count)
        return [task]

    def _hand_out(self) -> None:
        while self._idle and self._waiting:
            actor, task = self._idle.pop(), self._waiting.pop(0)
            self._busy[actor.perform.remote(task)] = actor, task
