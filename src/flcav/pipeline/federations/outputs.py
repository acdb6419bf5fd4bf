"""Shared samples of federated distillation: frames that were uploaded in stage I, sent to a region's vehicles."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flcav.config import InputError
from flcav.federation.strategies.fedmd import FedMD
from flcav.federation.trainable import Weights
from flcav.network.ledger import Ledger
from flcav.network.messages import pack, send
from flcav.perception.client import as_shared
from flcav.perception.distillation import SharedSamples
from flcav.perception.task import Task
from flcav.perception.weights import to_arrays
from flcav.pipeline.engine import Work
from flcav.pipeline.federations.messages import send_to_vehicles
from flcav.pipeline.frames import Frames
from flcav.pipeline.learning import Learning
from flcav.pipeline.recipe import EDGE
from flcav.pipeline.results.training import Pretrained
from flcav.statistics.streams import stream


@dataclass(frozen=True)
class SharedFrames:
    """Frames as the messages that carry them, and what a task makes of them."""

    messages: tuple[bytes, ...]
    samples: SharedSamples

    def send(self, book: Ledger, network: Any, region: str, clients: Sequence[str]) -> None:
        """Send the frames to a region's vehicles, and the network that they begin with to those who lack it."""
        have = {entry.client for entry in book.entries if (entry.stage, entry.direction) == (EDGE, "down")}
        if lacking := [client for client in clients if client not in have]:
            send_to_vehicles(book, pack(to_arrays(network)), self.samples.task, region, lacking)
        for message in self.messages:
            send_to_vehicles(book, message, self.samples.task, region, clients)


def send_region_network(book: Ledger, task: Task, weights: Weights, clients: Iterable[str], stage: str) -> None:
    """Send a region's network after stage II to its vehicles, who go on from it in a later `stage`."""
    for client in clients:
        send(book, pack(weights), stage=stage, task=task.name, link="wireless", direction="down", client=client)


def share_frames(
    work: Work, learning: Learning, config: Any, strategy: FedMD, pools: Mapping[str, str], pretrained: str
) -> SharedFrames:
    """Return the frames of a federation by `strategy`: drawn from those that the step `pretrained` uploaded.

    `pools` are the steps that recorded them, by region. Raises `InputError` where they have no samples of the task.
    """
    every = [
        (region, i) for region, frames in Pretrained.load(work.inputs[pretrained]).uploaded.items() for i in frames
    ]
    drawn = sorted(stream(learning.seed, "shared").permutation(len(every))[: strategy.frames].tolist())
    chosen: dict[str, list[int]] = {}
    for region, frame in (every[number] for number in drawn):
        chosen.setdefault(region, []).append(frame)
    shared, messages = as_shared(learning.task), []
    for region, frames in chosen.items():
        messages += shared.pack_samples(Frames.open(work.inputs[pools[region]]).data, config, frames)
    samples = shared.unpack_samples(messages, config)
    if not samples:
        raise InputError(f"strategy fedmd: the {len(messages)} shared frames have no samples of '{learning.task.name}'")
    return SharedFrames(tuple(messages), SharedSamples(learning.task, config, samples, learning.batch))
