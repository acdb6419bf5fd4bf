"""Sizes of class probabilities that vehicles send in rounds, by dry runs, and the drives that others are measured in.

Shared frames are drawn from all candidates for upload.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flcav.federation.runtimes.embedded import update_bytes
from flcav.network.ledger import BYTES_PER_MB
from flcav.perception.client import as_shared
from flcav.perception.distillation import SharedSamples
from flcav.perception.task import Task, build_network
from flcav.perception.weights import to_arrays
from flcav.runs.frames import Frames
from flcav.runs.plan.updates import UpdateForm
from flcav.statistics.streams import stream


def measure_exchange(
    task: Task, config: Any, pools: Sequence[Frames], forms: Sequence[UpdateForm], most: int, seed: int
) -> float | None:
    """Return what a vehicle sends in a round to be combined [MB], the largest of the `forms`.

    None where all of them are updates of weights. `most` frames are uploaded, of which those that are shared are drawn.
    """
    if not any(form.frames for form in forms):
        return None
    weights, sizes = to_arrays(build_network(task, config, 0)), []
    every = [(pool, i) for pool in pools for i in pool.vehicles]
    drawn = [every[number] for number in stream(seed, "shared").permutation(len(every)).tolist()]
    for form in forms:
        sent: Mapping[str, Any] = weights
        if form.frames:
            shown = drawn[: min(form.frames, most)]
            messages = [one for pool, i in shown for one in as_shared(task).pack_samples(pool.data, config, [i])]
            samples = as_shared(task).unpack_samples(messages, config) or ()
            sent = SharedSamples(task, config, samples, 1).outputs(weights) if samples else {}
        sizes.append(update_bytes(sent, form.upload, exchanging=form.exchanging))
    return max(sizes) / BYTES_PER_MB


@dataclass(frozen=True)
class RegionDrive:
    """A drive of a region before its training, and how many training frames its vehicles will hold."""

    drive: Frames
    recorded: bool  # whether the region is a recorded dataset, whose poles are those that it was recorded from
    training_frames: int  # of all its vehicles together
    vehicles: int


@dataclass(frozen=True)
class Sensors:
    """The roadside sensors near which vehicles label their frames, as far as they are known before they are placed."""

    poles: tuple[int, ...]  # numbers of those that are named
    count: int  # of others, in each region
    traffic_m: float  # radius of the traffic around a pole [m]
    near_m: float  # vehicles label frames recorded within this distance of a sensor [m]
