"""Actors on the machines of a Ray cluster: a session, and a pool of them."""

import contextlib
import logging
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from queue import SimpleQueue
from types import ModuleType
from typing import Any

from flcav.config import InputError
from flcav.interface.extras import format_install_command
from flcav.machine.processes import KILLED
from flcav.machine.threads import VARIABLES

STORE_BYTES = 128_000_000  # object store of a Ray started here: only jobs and pieces of files pass through it
CALLS = 3  # that an actor answers at the same time: it works, tells how far it is, and leaves
LEAVING_S = 5.0  # for actors to leave before they are killed


@dataclass(frozen=True)
class ActorPool:
    """A pool of Ray actors, each driven by a thread of this process."""

    ray: ModuleType
    lend: Callable[[Callable[[Any], Any]], Future[Any]]  # calls a function with an actor that is idle then


@contextlib.contextmanager
def actor_pool(jobs: int, kind: type, *arguments: Any) -> Iterator[ActorPool]:
    """Yield a pool of `jobs` actors, `kind(*arguments)`, on the cluster of `ray_session`.

    What is lent an actor raises what the actor's methods raise, and `OSError` where it was killed. In the end its
    method `leave`, if it has one, is called, and the actors are killed.
    """
    with ray_session(jobs) as ray, ThreadPoolExecutor(jobs) as threads:
        from ray.exceptions import RayActorError, RayTaskError  # pyright: ignore[reportMissingImports]

        remote = ray.remote(num_cpus=1, max_concurrency=CALLS)(kind)
        given = [ray.put(each) for each in arguments]
        actors = [remote.remote(*given) for _ in range(jobs)]
        idle: SimpleQueue[Any] = SimpleQueue()
        for actor in actors:
            idle.put(actor)

        def lend(use: Callable[[Any], Any]) -> Any:
            actor = idle.get()
            try:
                return use(actor)
            except RayTaskError as error:
                raise error.cause from None
            except RayActorError:
                raise OSError(KILLED) from None
            finally:
                idle.put(actor)

        try:
            yield ActorPool(ray, lambda use: threads.submit(lend, use))
        finally:
            threads.shutdown(wait=False, cancel_futures=True)
            if leaving := [actor.leave.remote() for actor in actors if hasattr(kind, "leave")]:
                ray.wait(leaving, num_returns=len(leaving), timeout=LEAVING_S)
            for actor in actors:
                ray.kill(actor)


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
    ray.init(
        **local,
        runtime_env={"env_vars": variables},
        log_to_driver=False,
        logging_level=logging.ERROR,
    )
    try:
        yield ray
    finally:
        ray.shutdown()
