"""Vehicles that announce themselves by radio, as the vehicle of a frame hears them in a simulated town."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from flcav.arrays import Array, Ints, Words
from flcav.config import InputError
from flcav.dataset.ground import DatasetGround
from flcav.dataset.store import Dataset
from flcav.fusion.announced import AROUND_S, Announced, place_senders
from flcav.network.awareness import (
    AwarenessMessages,
    MessageSettings,
    draw_connected,
    find_received,
    send_messages,
)
from flcav.network.radio.links import walls_of
from flcav.perception.objects.model import SecondConfig
from flcav.perception.objects.truth import detection_labels, is_lookalike
from flcav.runs.frames import SLACK_S, Frames
from flcav.world.map.town import Town
from flcav.world.rays.embree import Assembly
from flcav.world.trace import Trace


@dataclass(frozen=True)
class HeardMessages:
    """What a vehicle hears around a frame."""

    announced: Announced  # of the classes of the network; trucks and buses resemble cars
    count: int  # messages
    bytes: int


def hear_messages(split: Frames, i: int, how: MessageSettings, config: SecondConfig) -> HeardMessages:
    """Return the vehicles that announce themselves to the vehicle of frame `i` within `AROUND_S` of it.

    Raises `InputError` for a dataset without its town's traffic, whose vehicles send the messages.
    """
    data, key = split.data, split.data.keys[i]
    town, walls = _town(data, how)
    trace, messages = _sent(data, key.scene, how)
    near = messages[np.abs(messages.time_s - key.time_s) <= max(AROUND_S) + SLACK_S]
    names = (str(data.manifest.recipe.get("seed")), key.scene, str(key.index))
    heard = near[find_received(near, trace, key.agent, walls, how, *names)]
    category = trace.category

    def label(senders: Ints) -> Words:
        classes = detection_labels(category[senders], config.classes)
        return np.where(is_lookalike(category[senders], config.classes), "Car", classes)

    def ground(places: Array) -> Array:
        return town.grounds(*places.T)

    known = heard[label(heard.sender) != ""]
    return HeardMessages(place_senders(known, key.time_s, ground, label), len(heard), int(heard.bytes.sum()))


@lru_cache(maxsize=16)
def _sent(data: Dataset, scene: str, how: MessageSettings) -> tuple[Trace, AwarenessMessages]:
    """Return the traffic of a scene and all messages of its vehicles."""
    trace = data.trace(scene)
    if trace is None:
        raise _lacking(data)
    names = (str(data.manifest.recipe.get("seed")), scene)
    return trace, send_messages(trace, draw_connected(trace, how.share, *names), how, *names)


@lru_cache(maxsize=4)
def _town(data: Dataset, how: MessageSettings) -> tuple[Town, Assembly | None]:
    """Return the town of a dataset, and its buildings; None where it has none, or the radio is a highway's."""
    town = DatasetGround(data).town
    if town is None:
        raise _lacking(data)
    return town, walls_of(town, how.radio) if len(town.buildings) else None


def _lacking(data: Dataset) -> InputError:
    return InputError(
        f"{data.folder}: labels by messages need the traffic of a simulated town, whose vehicles send them, and this "
        "dataset has none; take other labels"
    )
