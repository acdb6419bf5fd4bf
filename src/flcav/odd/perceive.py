"""Measurement of a domain's attributes as a vehicle perceives them: by its networks, its tracks and its map.

The weather network names the class of each picture. Of rain, sight, clouds and sun it says that they are in the region
of that class; where a limit of the domain lies within the region, the value is missing: the class does not decide.
Detections to all sides are tracked: pedestrians, and vehicles that move, are the road users around. Scenery is the
map's at the vehicle's own pose, and its speed that of its odometry: both as recorded.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from flcav.config import InputError
from flcav.dataset.store import Dataset
from flcav.interface.progress import Report, ignore_progress
from flcav.odd.domain import Domain
from flcav.odd.measure import AROUND_M, Measurements, describe_weather, measure
from flcav.odd.scenery import Column
from flcav.perception.agents import frame_reader
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in, look_around
from flcav.perception.objects.truth import choose_lidar
from flcav.perception.tracking import Tracked, Tracker
from flcav.perception.weather.evaluate import predict_probabilities
from flcav.perception.weather.model import Classifier
from flcav.perception.weather.samples import reduce_picture
from flcav.world.weather import WEATHER_CLASSES, Weather

Array = NDArray[np.float64]

SCORE = 0.3  # lowest score of a detection that is tracked
MOVING_MPS = 1.0  # a slower vehicle is taken for parked
PEDESTRIAN = "Pedestrian"


def perceive(
    domain: Domain,
    data: Dataset,
    frames: Sequence[int],
    weather: Classifier | None,
    objects: Second | None,
    progress: Report = ignore_progress,
) -> Measurements:
    """Return the attributes as a vehicle perceives them in its `frames`; those of a network that is None are missing.

    Raises `InputError` where a frame lacks the camera of the weather network, or the LiDAR of the detector.
    """
    known = measure(data, frames)
    unseen = np.full(len(frames), np.nan)
    columns: dict[str, Column] = dict(known.columns)
    columns |= describe_weather(dict.fromkeys(Weather.model_fields, unseen))
    columns |= {"agents": unseen, "pedestrians": unseen}
    if weather is not None:
        columns |= _narrow(domain, *map(describe_weather, _see_weather(weather, data, frames)))
    if objects is not None:
        columns |= _track_agents(look_around(objects), data, frames, progress)
    return Measurements(tuple(frames), columns)


def _narrow(domain: Domain, low: Mapping[str, Column], high: Mapping[str, Column]) -> dict[str, Column]:
    """Return the columns (F,) of values between `low` and `high`; missing where a limit lies between these."""
    limits = {column: domain.limits.get(name, ()) for name, column in domain.bound.items()}
    out: dict[str, Column] = {}
    for name, one in low.items():
        other = high[name]
        if one.dtype.kind == "U":
            out[name] = np.where(one == other, one, "")
            continue
        least, most = np.minimum(one, other), np.maximum(one, other)
        straddles = [(least < limit) & (limit < most) for limit in limits.get(name, ())]
        out[name] = np.where(np.any([np.zeros(len(one), np.bool_), *straddles], axis=0), np.nan, (least + most) / 2)
    return out


def _see_weather(
    network: Classifier, data: Dataset, frames: Sequence[int]
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the least and the largest fields (F,) of the class that the network sees in each frame's first camera."""
    blind = [i for i in frames if not data.cameras(i)]
    if blind:
        raise InputError(f"{data.folder}: frame '{data.name(blind[0])}' has no camera, which the weather network needs")
    pictures = [reduce_picture(data.plane(i, data.cameras(i)[0], "rgb")) for i in frames]
    likeliest = predict_probabilities(network, pictures).argmax(axis=1)
    regions = [WEATHER_CLASSES[network.config.classes[number]] for number in likeliest]
    free = (np.nan, np.nan)
    ends = {name: np.array([region.get(name, free) for region in regions]) for name in Weather.model_fields}
    return {name: both[:, 0] for name, both in ends.items()}, {name: both[:, 1] for name, both in ends.items()}


def _track_agents(network: Second, data: Dataset, frames: Sequence[int], progress: Report) -> dict[str, Array]:
    """Return how many moving road users, and pedestrians, are tracked within `AROUND_M` in each frame."""
    sequences: dict[tuple[str, str], list[int]] = {}
    for i in frames:
        sequences.setdefault((data.keys[i].scene, data.keys[i].agent), []).append(i)
    read, counts = frame_reader(data, network.config.foreground), dict[int, tuple[int, int]]()
    for sequence in sequences.values():
        tracker = Tracker(confirm=1)
        for i in sorted(sequence, key=lambda number: data.keys[number].time_s):
            frame = read(i)
            (found,) = detect_in(network, [frame], score_threshold=SCORE)
            tracked = tracker.step(found.transform(frame.world_from_sensor(choose_lidar(frame))), frame.time_s)
            counts[i] = _count(tracked, frame.world_from_agent[:2, 3])
            progress(len(counts), len(frames), "")
    agents, walking = np.array([counts[i] for i in frames], dtype=np.float64).reshape(-1, 2).T
    return {"agents": agents, "pedestrians": walking}


def _count(tracked: Tracked, here: Array) -> tuple[int, int]:
    near = np.linalg.norm(tracked.boxes.center[:, :2] - here, axis=1) <= AROUND_M
    walking = tracked.boxes.label == PEDESTRIAN
    moving = np.linalg.norm(tracked.velocity, axis=1) > MOVING_MPS
    return int((near & (walking | moving)).sum()), int((near & walking).sum())
