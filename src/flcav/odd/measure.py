"""Measurement of a domain's attributes in a recording, by ground truth and as perceived by a vehicle.

By ground truth all frames are measured at once, without reading sweeps.

As perceived, the weather network classifies each picture; rain, visibility, clouds and sun are then in the region of
that class. Where a limit of the domain lies within the region, the class does not decide, and the value is missing.
Road users are counted from tracked detections to all sides: pedestrians and moving vehicles. Scenery (from the map at
the vehicle's pose) and ego speed (from odometry) are as recorded.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flcav.config import InputError, parse_config
from flcav.dataset.store import Dataset
from flcav.dataset.tables import WEATHER_COLUMNS
from flcav.geometry import Array
from flcav.interface.progress import Report, ignore_progress
from flcav.interface.wording import plural
from flcav.odd.domain import Domain, Value
from flcav.odd.scenery import Column, Scenery
from flcav.perception.agents import frame_reader
from flcav.perception.objects.model import Second
from flcav.perception.objects.predict import detect_in, look_around
from flcav.perception.objects.truth import choose_lidar
from flcav.perception.tracking import Tracked, Tracker
from flcav.perception.weather.evaluate import predict_probabilities
from flcav.perception.weather.model import Classifier
from flcav.perception.weather.samples import reduce_picture
from flcav.sensors.rig import Rig
from flcav.storage.records import Record
from flcav.world.weather import NIGHT_DEG, WEATHER_CLASSES, Weather

AROUND_M = 50.0  # within which road users count
LOW_LIGHT_DEG = 10.0  # sun elevation below which the light is low
WET = 0.25  # wetness from which the road is wet
STANDING = 0.9  # wetness from which there is standing water
SLOWEST_S = 2.0  # greatest time between two poses that give a speed
PARKED = "parked"  # prefix of the tracks of parked vehicles


@dataclass(frozen=True)
class Measurements:
    """Measured columns of F frames; missing values are NaN in columns of numbers, "" in columns of words."""

    frames: tuple[int, ...]  # (F,) indices in the recording
    columns: Mapping[str, Column]  # arrays (F,) by column of the binding

    def __len__(self) -> int:
        return len(self.frames)

    def rows(self) -> list[dict[str, Value]]:
        """Return the values by frame and column; None where missing."""
        names = list(self.columns)
        plain = [_plain(column) for column in self.columns.values()]
        return [dict(zip(names, row, strict=True)) for row in zip(*plain, strict=True)]


@dataclass(frozen=True)
class Span(Record):
    """Range or word counts of one attribute in a recording."""

    attribute: str
    low: float | None  # least number; None for words, and where all values are missing
    high: float | None  # greatest number
    words: Mapping[str, int]  # number of frames by word
    missing: int  # number of frames without a value

    @property
    def sentence(self) -> str:
        """Return the span in words."""
        missing = f" ({plural(self.missing, 'frame')} unknown)" if self.missing else ""
        if self.words:
            return ", ".join(f"{word}: {count}" for word, count in self.words.items()) + missing
        return "unknown" if self.low is None else f"{self.low:g} to {self.high:g}{missing}"


def summarise_measurements(measured: Measurements) -> tuple[Span, ...]:
    """Return the range or word counts of each measured column."""
    spans = []
    for name, column in measured.columns.items():
        if column.dtype.kind == "U":
            words, counts = np.unique(column[column != ""], return_counts=True)
            known = {str(word): int(count) for word, count in zip(words, counts, strict=True)}
            spans.append(Span(name, None, None, known, len(column) - sum(known.values())))
            continue
        numbers = column[~np.isnan(column.astype(np.float64))].astype(np.float64)
        ends = (float(numbers.min()), float(numbers.max())) if len(numbers) else (None, None)
        spans.append(Span(name, *ends, {}, len(column) - len(numbers)))
    return tuple(spans)


def select_vehicles(data: Dataset) -> tuple[int, ...]:
    """Return the frames of vehicles, which domains are about; raises `InputError` where there are none."""
    frames = tuple(i for i, key in enumerate(data.keys) if not key.agent.startswith("pole"))
    if not frames:
        raise InputError(f"{data.folder}: has no frames of vehicles, which domains are of")
    return frames


def measure_domain(data: Dataset, frames: Sequence[int] | None = None, scenery: Scenery | None = None) -> Measurements:
    """Return the measured attributes of `frames` (None: all frames of vehicles) by ground truth.

    `scenery` is that of the recording's town, if already read. Attributes that a recording lacks are missing values.
    """
    chosen = select_vehicles(data) if frames is None else tuple(frames)
    pose = _poses(data)[list(chosen)]
    place = scenery or scenery_of(data)
    weather = _weather(data)
    recorded = data.manifest.imported is None
    columns: dict[str, Column] = (
        {} if place is None else place.measure(pose[:, :2, 3], np.arctan2(pose[:, 1, 0], pose[:, 0, 0]))
    )
    columns |= {"surface_type": np.full(len(chosen), "asphalt" if recorded else "")}
    columns |= {name: column[list(chosen)] for name, column in describe_weather(weather).items()}
    columns |= {"ego_speed": _speeds(data)[list(chosen)]}
    columns |= {name: column[list(chosen)] for name, column in _count_agents(data).items()}
    columns |= {name: np.full(len(chosen), number) for name, number in describe_reach(data.manifest.recipe).items()}
    return Measurements(chosen, columns)


def scenery_of(data: Dataset) -> Scenery | None:
    """Return the scenery of a recording's town; None where the town is unknown."""
    town = data.town()
    return None if town is None else Scenery(town)


def describe_weather(weather: Mapping[str, Array]) -> dict[str, Column]:
    """Return the columns (F,) of environmental conditions from fields of `Weather` (F,); NaN is missing."""
    sun, wet = weather["sun_elevation_deg"], weather["wetness"]
    light = np.select([np.isnan(sun), sun < NIGHT_DEG, sun <= LOW_LIGHT_DEG], ["", "night", "low_light"], "day")
    surface = np.select([np.isnan(wet), wet < WET, wet < STANDING], ["", "dry", "wet"], "standing_water")
    return {
        "rainfall": weather["rain_mm_h"],
        "visibility": weather["visibility_m"],
        "cloud_cover": 100 * weather["cloud_cover"],
        "sun_elevation": sun,
        "light": light,
        "surface_condition": surface,
    }


def describe_reach(recipe: Mapping[str, object]) -> dict[str, float]:
    """Return the field of view [deg] and range [m] of the vehicle rig in a recipe; NaN where it has none."""
    if "vehicle_rig" not in recipe:
        return {"field_of_view": np.nan, "sensing_range": np.nan}
    return reach_of(parse_config(Rig, recipe["vehicle_rig"], "the rig of the recording"))


def reach_of(rig: Rig) -> dict[str, float]:
    """Return the horizontal field of view [deg] and the greatest range [m] of a rig; the range is NaN without LiDAR."""
    ranges = [lidar.settings.range_m for lidar in rig.lidars.values()]
    views = [np.degrees(2 * np.arctan2(lens.width / 2, lens.intrinsics()[0, 0]))
             for lens in (camera.settings for camera in rig.cameras.values())]  # fmt: skip
    return {
        "field_of_view": 360.0 if ranges else float(min(sum(views), 360.0)),
        "sensing_range": max(ranges, default=np.nan),
    }


def _poses(data: Dataset) -> Array:
    """Return the poses of the agents in all frames (frames, 4, 4) [m]."""
    table, _ = data.rows("poses")
    return table["world_from_agent"].combine_chunks().flatten().to_numpy().reshape(-1, 4, 4)


def _weather(data: Dataset) -> dict[str, Array]:
    """Return the fields of the weather of all frames (frames,); NaN where a frame has none."""
    table, frame = data.rows("weather")
    out = {name: np.full(len(data), np.nan) for name in WEATHER_COLUMNS}
    for name, column in out.items():
        column[frame] = table[name].to_numpy()
    return out


def _speeds(data: Dataset) -> Array:
    """Return the agents' speeds [km/h] from the poses before and after each frame; NaN without a pose in `SLOWEST_S`.

    Imported recordings without poses (all identity) have no speeds.
    """
    poses = _poses(data)
    if data.manifest.imported and (poses == np.eye(4)).all():
        return np.full(len(data), np.nan)
    place = poses[:, :3, 3]
    time = np.array([key.time_s for key in data.keys])
    scenes = np.array([key.scene for key in data.keys])
    agents = np.array([key.agent for key in data.keys])
    order = np.lexsort((time, agents, scenes))
    same = (scenes[order][1:] == scenes[order][:-1]) & (agents[order][1:] == agents[order][:-1])
    apart = np.diff(time[order])
    pace = np.full(len(data) + 1, np.nan)
    near = same & (apart > 0) & (apart <= SLOWEST_S)
    pace[1:-1][near] = np.linalg.norm(np.diff(place[order], axis=0)[near], axis=1) / apart[near]
    both = np.stack((pace[:-1], pace[1:]))
    known = ~np.isnan(both)
    speed = np.full(len(data), np.nan)
    some = known.any(axis=0)
    speed[order[some]] = 3.6 * np.where(known, both, 0.0).sum(axis=0)[some] / known.sum(axis=0)[some]
    return speed


def _count_agents(data: Dataset) -> dict[str, Array]:
    """Return the numbers of road users that are not parked, and of pedestrians, within `AROUND_M` in each frame."""
    table, frame = data.rows("annotations")
    if data.manifest.imported and "objects" not in data.manifest.labels:
        missing = np.full(len(data), np.nan)
        return {"agents": missing, "pedestrians": missing}
    place = np.column_stack((table["x"].to_numpy(), table["y"].to_numpy()))
    near = np.linalg.norm(place - _poses(data)[frame, :2, 3], axis=1) <= AROUND_M
    moving = ~np.char.startswith(table["track"].to_numpy(zero_copy_only=False).astype(np.str_), PARKED)
    walking = table["category"].to_numpy(zero_copy_only=False).astype(np.str_) == "pedestrian"
    return {
        name: np.bincount(frame[near & kind], minlength=len(data)).astype(np.float64)
        for name, kind in (("agents", moving), ("pedestrians", moving & walking))
    }


def _plain(column: Column) -> list[Value]:
    values = column.tolist()
    if column.dtype.kind == "U":
        return [value or None for value in values]
    return [None if value != value else value for value in values]


TRACKED_SCORE = 0.3  # least score of tracked detections
MOVING_MPS = 1.0  # slower vehicles count as parked
PEDESTRIAN = "Pedestrian"


def perceive(
    domain: Domain,
    data: Dataset,
    frames: Sequence[int],
    weather: Classifier | None,
    objects: Second | None,
    progress: Report = ignore_progress,
) -> Measurements:
    """Return the attributes as perceived by vehicles in `frames`; without a network, its attributes are missing.

    Raises `InputError` where a frame lacks the camera of the weather network, or the LiDAR of the detector.
    """
    known = measure_domain(data, frames)
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
    """Return the midpoints (F,) of intervals from `low` to `high`; missing where a limit lies within the interval."""
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
    """Return the bounds (F,) of weather fields for the class that the network predicts from each first camera."""
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
    """Return the numbers of moving road users, and of pedestrians, tracked within `AROUND_M` in each frame."""
    sequences: dict[tuple[str, str], list[int]] = {}
    for i in frames:
        sequences.setdefault((data.keys[i].scene, data.keys[i].agent), []).append(i)
    read = frame_reader(data, network.config.foreground)
    counts = dict[int, tuple[int, int]]()
    for sequence in sequences.values():
        tracker = Tracker(confirm=1)
        for i in sorted(sequence, key=lambda number: data.keys[number].time_s):
            frame = read(i)
            (boxes,) = detect_in(network, [frame], score_threshold=TRACKED_SCORE)
            tracked = tracker.step(boxes.transform(frame.world_from_sensor(choose_lidar(frame))), frame.time_s)
            counts[i] = _count_tracked(tracked, frame.world_from_agent[:2, 3])
            progress(len(counts), len(frames), "")
    agents, walking = np.array([counts[i] for i in frames], dtype=np.float64).reshape(-1, 2).T
    return {"agents": agents, "pedestrians": walking}


def _count_tracked(tracked: Tracked, here: Array) -> tuple[int, int]:
    near = np.linalg.norm(tracked.boxes.center[:, :2] - here, axis=1) <= AROUND_M
    walking = tracked.boxes.label == PEDESTRIAN
    moving = np.linalg.norm(tracked.velocity, axis=1) > MOVING_MPS
    return int((near & (walking | moving)).sum()), int((near & walking).sum())
