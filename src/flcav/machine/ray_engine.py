"""Actors on the machines of a Ray cluster: a session, and a pool of them."""

import contextlib
import logging
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from queue import SimpleQueue
from types import ModuleType
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, TypeVarTuple

from flcav.config import InputError
from flcav.interface.wording import format_install_command
from flcav.machine.processes import KILLED
from flcav.machine.threads import VARIABLES

Kind = TypeVar("Kind")
Result = TypeVar("Result")
Given = ParamSpec("Given")
Arguments = TypeVarTuple("Arguments")

STORE_BYTES = 128_000_000  # object store of a Ray started here: only jobs and pieces of files pass through it
CALLS = 3  # concurrent calls of an actor: its work, its progress, and its end
LEAVING_S = 5.0  # for actors to leave before they are killed


@dataclass(frozen=True)
class RayActor(Generic[Kind]):
    """A handle to an actor: an object of the class `Kind` in a process of its own, on some machine."""

    _ray: ModuleType
    _handle: Any  # Ray's

    def start(
        self, method: Callable[Concatenate[Kind, Given], Result], *given: Given.args, **named: Given.kwargs
    ) -> Callable[[], Result]:
        """Call a method of the class on the actor; return what waits for its result."""
        reference = getattr(self._handle, method.__name__).remote(*given, **named)
        return lambda: self._ray.get(reference)

    def call(
        self, method: Callable[Concatenate[Kind, Given], Result], *given: Given.args, **named: Given.kwargs
    ) -> Result:
        """Return the result of a method of the class, called on the actor."""
        return self.start(method, *given, **named)()


class ActorPool(Generic[Kind]):
    """A pool of actors, each driven by a thread of this process."""

    def __init__(self, actors: Iterable[RayActor[Kind]], threads: ThreadPoolExecutor) -> None:
        self._threads = threads
        self._idle: SimpleQueue[RayActor[Kind]] = SimpleQueue()
        for actor in actors:
            self._idle.put(actor)

    def lend(self, use: Callable[[RayActor[Kind]], Result]) -> Future[Result]:
        """Call `use` in a thread, with an actor that is idle then.

        The future raises what the actor's methods raise, and `OSError` where the actor was killed.
        """
        return self._threads.submit(self._lend, use)

    def _lend(self, use: Callable[[RayActor[Kind]], Result]) -> Result:
        from ray.exceptions import RayActorError, RayTaskError  # pyright: ignore[reportMissingImports]

        actor = self._idle.get()
        try:
            return use(actor)
        except RayTaskError as error:
            raise error.cause from None
        except RayActorError:
            raise OSError(KILLED) from None
        finally:
            self._idle.put(actor)


@contextlib.contextmanager
def actor_pool(jobs: int, kind: Callable[[*Arguments], Kind], *arguments: *Arguments) -> Iterator[ActorPool[Kind]]:
    """Yield a pool of `jobs` actors, `kind(*arguments)` for a class `kind`, on the cluster of `ray_session`.

    In the end their method `leave`, if there is one, is called, and they are killed.
    """
    with ray_session(jobs) as ray, ThreadPoolExecutor(jobs) as threads:
        remote = ray.remote(num_cpus=1, max_concurrency=CALLS)(kind)
        shared = [ray.put(each) for each in arguments]
        handles = [remote.remote(*shared) for _ in range(jobs)]
        try:
            yield ActorPool([RayActor(ray, handle) for handle in handles], threads)
        finally:
            threads.shutdown(wait=False, cancel_futures=True)
            if leaving := [handle.leave.remote() for handle in handles if hasattr(kind, "leave")]:
                ray.wait(leaving, num_returns=len(leaving), timeout=LEAVING_S)
            for handle in handles:
                ray.kill(handle)


@contextlib.contextmanager
def ray_session(jobs: int, asked: str = "--engine ray") -> Iterator[ModuleType]:
    """Yield the module `ray`, connected to the cluster of RAY_ADDRESS or, without it, to a local one of `jobs` CPUs.

    Its workers compute on one thread each. Raises `InputError` where Ray is not installed; `asked` is what needs it.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # without it, Ray prints a warning
    try:
        import ray  # pyright: ignore[reportMissingImports]: an extra
    except ImportError:
        raise InputError(f"{asked} needs Ray, which is not installed: {format_install_command('ray')}") from None
    variables: dict[str, str] = dict.fromkeys(VARIABLES, "1")
    local: dict[str, Any] = {}
    if "RAY_ADDRESS" not in os.environ:
        local = {"num_cpus": jobs, "object_store_memory": STORE_BYTES, "include_dashboard": False}
        variables["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))  # workers find modules as this process does
    ray.init(**local, runtime_env={"env_vars": variables}, log_to_driver=False, logging_level=logging.ERROR)
    try:
        yield ray
    finally:
        ray.shutdown()
