"""Vehicles that announce themselves by radio, and what they perceive, as another vehicle hears it in a simulated town.

Awareness messages are of the traffic of a recording, with errors: of vehicles, and of pedestrians and cyclists with a
phone. Perception messages are of the vehicles that record, by the network that also labels: no annotation has a part
in either.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from flcav.arrays import Array, Ints, Words
from flcav.config import InputError
from flcav.dataset.ground import DatasetGround
from flcav.dataset.store import Dataset
from flcav.fusion.announced import HEARD_S, Announced, place_senders
from flcav.fusion.average import BoxReport, Sighting, report_boxes, state_accuracy
from flcav.fusion.tracks import LEAST_SCORE
from flcav.geometry import Boxes, pose
from flcav.network.awareness import (
    PEOPLE_S,
    WHITE,
    AwarenessMessages,
    MessageSettings,
    draw_bias,
    draw_connected,
    find_received,
    is_person,
    perception_bytes,
    send_messages,
    state_deviation,
)
from flcav.network.radio.links import raise_walls
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in
from flcav.perception.objects.truth import choose_lidar, detection_labels, is_lookalike
from flcav.runs.frames import SLACK_S, Frames
from flcav.statistics.streams import stream
from flcav.world.map.town import Town
from flcav.world.rays.embree import Assembly
from flcav.world.trace import Trace

BESIDE_M = 10.0  # as far beyond the network's range are vehicles of which something is in it
ITSELF_M = 2.0  # a vehicle that is perceived as near as this, and twice the deviation, is the one that hears of it


@dataclass(frozen=True)
class HeardMessages:
    """Messages that a vehicle receives around a frame, and the objects that they announce."""

    announced: Announced  # of the classes of the network; trucks and buses resemble cars
    count: int  # messages, of awareness and of perception
    bytes: int


def hear_messages(split: Frames, i: int, how: MessageSettings, network: Second) -> HeardMessages:
    """Return the vehicles that announce themselves to the vehicle of frame `i` within `HEARD_S` of it.

    Those that record at the same spin also send what `network` detects in their sweeps, if they are asked to. Raises
    `InputError` for a dataset without its town's traffic, whose vehicles send the messages.
    """
    data, key, classes = split.data, split.data.keys[i], network.config.classes
    town, walls = _raise_town(data, how.radio.environment)
    trace, messages = _send(data, key.scene, how.model_dump_json())
    if key.agent not in trace.actor:
        raise _lacking(data)
    drive = (str(data.manifest.recipe.get("seed")), key.scene)
    lasts_s = np.where(is_person(trace.category[messages.sender]), PEOPLE_S, HEARD_S)  # the next one comes before
    near = messages[np.abs(messages.time_s - key.time_s) <= lasts_s + SLACK_S]
    heard = near[find_received(near, trace, key.agent, walls, how, *drive, str(key.index))]
    reports, sizes = list[BoxReport](), list[int]()
    for number in data.select(scenes=[key.scene], spins=[key.index]) if how.perceived else ():
        agent = data.keys[number].agent
        own = messages[messages.sender == _row(trace, agent)]
        if agent == key.agent or not len(own):
            continue
        boxes = _perceive(network, data, number)
        size = perception_bytes(len(boxes))
        sent = replace(own[np.array([0])], time_s=np.array([key.time_s]), bytes=np.array([size]))
        if find_received(sent, trace, key.agent, walls, how, *drive, str(key.index), "perceived").all():
            report = _report(data, number, boxes, how, *drive)
            away_m = np.linalg.norm(report.boxes.center[:, :2] - data.world_from_agent(i)[:2, 3], axis=1)
            others = away_m > ITSELF_M + 2 * state_deviation(how.position_m)
            reports.append(replace(report, boxes=report.boxes[others]))
            sizes.append(size)
    category = trace.category

    def label(senders: Ints) -> Words:
        known = detection_labels(category[senders], classes)
        return np.where(is_lookalike(category[senders], classes), "Car", known)

    def ground(places: Array) -> Array:
        return town.grounds(*places.T)

    reach_m = math.hypot(*(max(abs(network.config.range_m[k]), abs(network.config.range_m[k + 3])) for k in (0, 1)))
    away_m = np.linalg.norm(heard.front - data.world_from_agent(i)[:2, 3], axis=1)
    known = heard[(label(heard.sender) != "") & (away_m <= reach_m + BESIDE_M)]
    placed = place_senders(known, key.time_s, ground, label)
    told = replace(placed, perceived=tuple(reports))
    return HeardMessages(told, len(heard) + len(sizes), int(heard.bytes.sum()) + sum(sizes))


def _row(trace: Trace, agent: str) -> int:
    """Return the row of an agent among the actors of a trace, -1 for a pole."""
    return trace.actor.tolist().index(agent) if agent in trace.actor else -1


@lru_cache(maxsize=64)
def _perceive(network: Second, data: Dataset, number: int) -> Boxes:
    """Return what a vehicle detects in frame `number`, in its own frame, as its message says it."""
    frame = data.frame(number)
    (found,) = detect_in(network, [frame], score_threshold=LEAST_SCORE)
    boxes = found.transform(frame.assumed.agent_from_sensor[choose_lidar(frame)])
    assert boxes.score is not None
    center, size = np.round(boxes.center * 100) / 100, np.maximum(np.round(boxes.size * 10), 1) / 10
    yaw, quality = np.radians(np.round(np.degrees(boxes.yaw) * 10) / 10), np.round(boxes.score * 15) / 15
    return replace(boxes, center=center, size=size, yaw=yaw, score=quality)


def _report(data: Dataset, number: int, boxes: Boxes, how: MessageSettings, *drive: str) -> BoxReport:
    """Return the boxes of a vehicle's frame in the world, by the position and heading that it announces."""
    key, known = data.keys[number], data.world_from_agent(number)
    rng = stream(0, "perceived", *drive, str(key.index), key.agent)
    announced = known @ pose(0, 0, 0, float(np.radians(how.heading_deg) * rng.standard_normal()))
    white = how.position_m * WHITE * rng.standard_normal(2)
    announced[:2, 3] = known[:2, 3] + draw_bias(how.position_m, *drive, key.agent) + white
    stated = state_accuracy(state_deviation(how.position_m), float(np.radians(how.heading_deg)))
    return report_boxes(Sighting(key.agent, key.time_s, announced, boxes, navigation=stated))


@lru_cache(maxsize=16)
def _send(data: Dataset, scene: str, settings: str) -> tuple[Trace, AwarenessMessages]:
    """Return the traffic of a scene and all messages of its vehicles; settings: `MessageSettings` as JSON."""
    how, trace = MessageSettings.model_validate_json(settings), data.trace(scene)
    if trace is None:
        raise _lacking(data)
    names = (str(data.manifest.recipe.get("seed")), scene)
    return trace, send_messages(trace, draw_connected(trace, how, *names), how, *names)


@lru_cache(maxsize=4)
def _raise_town(data: Dataset, environment: str) -> tuple[Town, Assembly | None]:
    """Return the town of a dataset, and its buildings; None where it has none, or the radio is a highway's."""
    town = DatasetGround(data).town
    if town is None:
        raise _lacking(data)
    return town, raise_walls(town) if environment == "urban" and len(town.buildings) else None


def _lacking(data: Dataset) -> InputError:
    return InputError(
        f"{data.folder}: labels by messages need the traffic of a simulated town, whose vehicles send them, and this "
        "dataset has none; take other labels"
    )
