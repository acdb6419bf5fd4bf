"""Messages outside the rounds: uploads of stage I, networks and shared frames to vehicles, and reported errors."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flcav.config import InputError
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.trainable import Weights
from flcav.network.ledger import Ledger, pack_arrays, send_message, unpack_arrays
from flcav.perception.client import Compresses, SharedSamples, as_shared
from flcav.perception.errors import Registry, pack_errors, unpack_errors
from flcav.perception.task import Task
from flcav.perception.weights import from_arrays, to_arrays
from flcav.runs.engine import Work
from flcav.runs.frames import Frames
from flcav.runs.recipe import EDGE, PRETRAIN
from flcav.runs.results.training import Pretrained
from flcav.runs.training.learning import Learning
from flcav.statistics.streams import stream


def release_network(book: Ledger, task: Task, network: Any, region: str, drive: Frames) -> Any:
    """Send a network to a region's vehicles, and return it as received: by wireline, then by wireless."""
    vehicles = sorted({drive.data.keys[i].agent for i in drive.vehicles})
    clients = [f"{region}/{vehicle}" for vehicle in vehicles]
    from_arrays(network, unpack_arrays(send_to_vehicles(book, pack_arrays(to_arrays(network)), task, region, clients)))
    return network


def send_to_vehicles(book: Ledger, message: bytes, task: Task, region: str, clients: Iterable[str]) -> bytes:
    """Send a message from the cloud to a region's vehicles, and return it as received: by wireline, then wireless."""
    about: Any = {"stage": EDGE, "task": task.name, "direction": "down"}
    received = at_edge = send_message(book, message, **about, link="wireline", client=region)
    for client in clients:
        received = send_message(book, at_edge, **about, link="wireless", client=client)
    return received


def report_errors(book: Ledger, task: Task, found: Registry, region: str, drive: Frames) -> Registry:
    """Return the error registry of the edge server, received in one message per frame with errors.

    Such a message is the vehicle's request to learn. A task whose errors have no frames sends its registry at once.
    """
    about: Any = {"stage": EDGE, "task": task.name, "link": "wireless", "direction": "up"}
    if found.found is None:
        errors = unpack_errors(send_message(book, pack_errors(found.errors), **about, client=region))
        return Registry(errors, found.dropped)
    received = {}
    for frame, errors in found.found.items():
        if errors:
            client = f"{region}/{drive.data.keys[frame].agent}"
            received[frame] = unpack_errors(send_message(book, pack_errors(errors), **about, client=client))
    return Registry.of(received, dropped=found.dropped, standing=found.standing)


@dataclass(frozen=True)
class SharedFrames:
    """Frames shared among vehicles: their messages, and the task's samples of them."""

    messages: tuple[bytes, ...]
    samples: SharedSamples

    def send(self, book: Ledger, network: Any, region: str, clients: Sequence[str]) -> None:
        """Send the frames to a region's vehicles, and the initial network to vehicles that lack it."""
        have = {entry.client for entry in book.entries if (entry.stage, entry.direction) == (EDGE, "down")}
        if lacking := [client for client in clients if client not in have]:
            send_to_vehicles(book, pack_arrays(to_arrays(network)), self.samples.task, region, lacking)
        for message in self.messages:
            send_to_vehicles(book, message, self.samples.task, region, clients)


def send_region_network(book: Ledger, task: Task, weights: Weights, clients: Iterable[str], stage: str) -> None:
    """Send a region's network after stage II to its vehicles, which continue from it in a later `stage`."""
    for client in clients:
        send_message(
            book, pack_arrays(weights), stage=stage, task=task.name, link="wireless", direction="down", client=client
        )


def share_frames(
    work: Work, learning: Learning, config: Any, strategy: FedMD, pools: Mapping[str, str], pretrained: str
) -> SharedFrames:
    """Draw the shared frames of a federation by `strategy` from those uploaded in the step `pretrained`.

    `pools`: the steps that recorded these, by region. Raises `InputError` where the drawn frames have no samples of the
    task.
    """
    every = [
        (region, i) for region, frames in Pretrained.load(work.inputs[pretrained]).uploaded.items() for i in frames
    ]
    drawn = sorted(stream(learning.seed, "shared").permutation(len(every))[: strategy.frames].tolist())
    chosen: dict[str, list[int]] = {}
    for region, frame in (every[number] for number in drawn):
        chosen.setdefault(region, []).append(frame)
    shared = as_shared(learning.task)
    messages = []
    for region, frames in chosen.items():
        messages += shared.pack_samples(Frames.open(work.inputs[pools[region]]).data, config, frames)
    samples = shared.unpack_samples(messages, config)
    if not samples:
        raise InputError(f"strategy fedmd: the {len(messages)} shared frames have no samples of '{learning.task.name}'")
    return SharedFrames(tuple(messages), SharedSamples(learning.task, config, samples, learning.batch))


def choose_uploads(pools: Mapping[str, Sequence[int]], samples: int, seed: int) -> dict[str, tuple[int, ...]]:
    """Draw the frames to upload at random from the union of all regions' pools; return them by region."""
    every = [(region, frame) for region, frames in pools.items() for frame in frames]
    drawn = np.sort(stream(seed, "upload").permutation(len(every))[:samples])
    chosen: dict[str, list[int]] = {region: [] for region in pools}
    for number in drawn:
        region, frame = every[number]
        chosen[region].append(frame)
    return {region: tuple(frames) for region, frames in chosen.items()}


def choose_planned_uploads(
    pools: Mapping[str, Mapping[str, Sequence[int]]], uploads: Mapping[str, int], seed: int
) -> dict[str, tuple[int, ...]]:
    """Draw the frames that vehicles upload, in the numbers of `uploads` by vehicle; return them by region.

    `pools`: frame numbers by region and "region/vehicle".
    """
    chosen: dict[str, tuple[int, ...]] = {}
    for region, vehicles in pools.items():
        drawn = [
            frames[number]
            for name, frames in vehicles.items()
            for number in stream(seed, "upload", name).permutation(len(frames))[: uploads.get(name, 0)]
        ]
        chosen[region] = tuple(sorted(drawn))
    return chosen


def upload_samples(
    book: Ledger,
    task: Task,
    config: Any,
    region: str,
    pool: Frames,
    chosen: Sequence[int],
    stage: str = PRETRAIN,
    compressed: bool = False,
) -> Sequence[Any]:
    """Upload the `chosen` frames from vehicles to the cloud (wireless, then wireline); return the received samples.

    Messages enter `book` under `stage`, compressed if so asked. The samples of a task that does not define messages are
    read from the recording on access.
    """
    shared = as_shared(task)
    received = []
    about: Any = {"stage": stage, "task": task.name, "direction": "up"}
    messages = shared.pack_samples(pool.data, config, chosen)
    if compressed and isinstance(task, Compresses):
        messages = task.compress_samples(messages)
    for frame, message in zip(chosen, messages, strict=True):
        key = pool.data.keys[frame]
        at_edge = send_message(book, message, **about, link="wireless", client=f"{key.scene}/{key.agent}")
        received.append(send_message(book, at_edge, **about, link="wireline", client=region))
    samples = shared.unpack_samples(received, config)
    return task.samples(pool.data, config, chosen) if samples is None else samples
