"""Choice of the runtime that clients train in, by its name."""

import contextlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from flcav.config import InputError
from flcav.federation.runtimes.processes import ClientProcesses
from flcav.federation.trainable import Trainable
from flcav.interface.wording import suggest

if TYPE_CHECKING:
    from flcav.federation.runtimes.simulation import RaySimulation

RUNTIMES = "embedded", "ray"


@contextlib.contextmanager
def open_processes(clients: Mapping[str, Trainable], count: int) -> Iterator[ClientProcesses | None]:
    """Yield `count` processes for `clients`; None, for this one, where one is enough or they cannot be pickled."""
    try:
        own = ClientProcesses(clients, count) if count > 1 else None
    except InputError:
        own = None
    with own or contextlib.nullcontext() as processes:
        yield processes


@contextlib.contextmanager
def open_runtime(
    name: str, clients: Mapping[str, Trainable], count: int
) -> Iterator["ClientProcesses | RaySimulation | None"]:
    """Yield what `federate` takes as its `runtime`.

    embedded: messages within this process, and clients in `count` processes where these are several. ray: Flower's
    simulation with `count` actors. Raises `InputError` for another name.
    """
    match name:
        case "embedded":
            with open_processes(clients, count) as processes:
                yield processes
        case "ray":
            from flcav.federation.runtimes.simulation import RaySimulation

            yield RaySimulation(count)
        case _:
            raise InputError(f"runtime '{name}': choose one of {', '.join(RUNTIMES)}{suggest(name, RUNTIMES)}")
