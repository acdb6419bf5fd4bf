"""Messages before the rounds of a region: the pretrained network to its vehicles, and the mistakes that they report."""

from collections.abc import Iterable
from typing import Any

from flcav.network.ledger import Ledger
from flcav.network.messages import pack, send, unpack
from flcav.perception.errors import Registry, pack_errors, unpack_errors
from flcav.perception.task import Task
from flcav.perception.weights import from_arrays, to_arrays
from flcav.pipeline.frames import Frames
from flcav.pipeline.recipe import EDGE


def release_network(book: Ledger, task: Task, network: Any, region: str, drive: Frames) -> Any:
    """Return a network as the vehicles receive it: from the cloud to the edge server by wireline, then by wireless."""
    vehicles = sorted({drive.data.keys[i].agent for i in drive.vehicles})
    clients = [f"{region}/{vehicle}" for vehicle in vehicles]
    from_arrays(network, unpack(send_to_vehicles(book, pack(to_arrays(network)), task, region, clients)))
    return network


def send_to_vehicles(book: Ledger, message: bytes, task: Task, region: str, clients: Iterable[str]) -> bytes:
    """Return a message as a region's vehicles receive it: from the cloud by wireline, then to each by wireless."""
    about: Any = {"stage": EDGE, "task": task.name, "direction": "down"}
    received = at_edge = send(book, message, **about, link="wireline", client=region)
    for client in clients:
        received = send(book, at_edge, **about, link="wireless", client=client)
    return received


def report_errors(book: Ledger, task: Task, found: Registry, region: str, drive: Frames) -> Registry:
    """Return the registry as the edge server has it, of what each vehicle reports: a message for each of its frames.

    Such a message is the vehicle's request to learn. A task that does not tell frames apart sends its registry at once.
    """
    about: Any = {"stage": EDGE, "task": task.name, "link": "wireless", "direction": "up"}
    if found.found is None:
        errors = unpack_errors(send(book, pack_errors(found.errors), **about, client=region))
        return Registry(errors, found.dropped)
    received = {}
    for frame, errors in found.found.items():
        if errors:
            client = f"{region}/{drive.data.keys[frame].agent}"
            received[frame] = unpack_errors(send(book, pack_errors(errors), **about, client=client))
    return Registry.of(received, dropped=found.dropped, standing=found.standing)
