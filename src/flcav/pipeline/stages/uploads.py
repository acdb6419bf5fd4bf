"""Uploads of stage I: which frames are sent, and the samples as they reach the cloud."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flcav.network.ledger import Ledger
from flcav.network.messages import send
from flcav.perception.client import as_shared
from flcav.perception.task import Task
from flcav.pipeline.frames import Frames
from flcav.pipeline.recipe import PRETRAIN
from flcav.statistics.streams import stream


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
    """Draw the frames that each vehicle uploads from its own, as many as `uploads` says; return them by region.

    pools: by region the frames of each vehicle, "region/vehicle".
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
    book: Ledger, task: Task, config: Any, region: str, pool: Frames, chosen: Sequence[int]
) -> Sequence[Any]:
    """Return the samples of frames as they reach the cloud: from vehicle to edge server (wireless), then by wireline.

    Samples of a task without messages of its own are read from the recording, each on access.
    """
    shared, received = as_shared(task), []
    about: Any = {"stage": PRETRAIN, "task": task.name, "direction": "up"}
    for frame, message in zip(chosen, shared.pack_samples(pool.data, config, chosen), strict=True):
        key = pool.data.keys[frame]
        at_edge = send(book, message, **about, link="wireless", client=f"{key.scene}/{key.agent}")
        received.append(send(book, at_edge, **about, link="wireline", client=region))
    samples = shared.unpack_samples(received, config)
    return task.samples(pool.data, config, chosen) if samples is None else samples
