"""Observations of vehicles and road sensors in recorded scenes, and the ground truth of these."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from flcav.dataset.store import Dataset
from flcav.fusion.average import Navigation, Sighting
from flcav.fusion.pose_graph import segment_posts
from flcav.fusion.road import load_road_network, road_detector
from flcav.geometry import Boxes, concatenate, inverse, transform_points
from flcav.interface.progress import Report, ignore_progress
from flcav.perception.agents import POLE, kind_of
from flcav.perception.networks import resolve_network
from flcav.perception.objects.model import SecondConfig
from flcav.perception.objects.predict import detect
from flcav.perception.objects.task import OBJECTS
from flcav.perception.objects.truth import choose_lidar, ground_truth
from flcav.sensors.frame import Frame

SCORE = 0.1  # lowest score of a detection that an agent tells of
EXACT = Navigation(0.01, 0.001)
CAR = "Car"


@dataclass(frozen=True)
class Truth:
    """Cars at one spin, world frame: those that the sensors could see, and neutral ones."""

    targets: Boxes
    neutral: Boxes


@dataclass(frozen=True)
class SightedScene:
    """The sightings of all agents in one scene, in the order of their spins, and the truth at each spin."""

    sightings: tuple[Sighting, ...]
    spin: tuple[int, ...]  # of each sighting
    truth: Mapping[int, Truth]  # by spin
    time_s: Mapping[int, float]


def read_scenes(data: Dataset, progress: Report = ignore_progress) -> dict[str, SightedScene]:
    """Return the scenes of a dataset by name: detections by the package's networks, posts segmented from sweeps.

    Cars count as targets where one of the sensors has them in its network's range with five returns or more.
    """
    vehicles = resolve_network(OBJECTS, None)
    find, road = road_detector(data, SCORE), load_road_network().config
    rows: dict[str, list[tuple[int, Sighting]]] = {}
    there: dict[tuple[str, int], dict[str, tuple[Boxes, bool]]] = {}
    times: dict[tuple[str, int], float] = {}
    for number, key in enumerate(data.keys):
        frame = data.frame(number)
        if kind_of(key.agent) == POLE:
            found = find(number)
            found = replace(found, label=np.full(len(found), CAR))
            own = found.transform(inverse(frame.world_from_agent))
            told = Sighting(key.agent, key.time_s, frame.world_from_agent, own)
        else:
            lidar = choose_lidar(frame)
            agent_from_lidar = frame.agent_from_sensor[lidar]
            found = detect(vehicles, frame.lidar[lidar], score_threshold=SCORE)
            posts = segment_posts(transform_points(agent_from_lidar, frame.lidar[lidar][:, :3]), 0.0)
            own = found[found.label == CAR].transform(agent_from_lidar)
            told = Sighting(key.agent, key.time_s, frame.world_from_agent, own, posts, EXACT)
        rows.setdefault(key.scene, []).append((key.index, told))
        times[key.scene, key.index] = key.time_s
        seen = there.setdefault((key.scene, key.index), {})
        _add_truth(seen, frame, road if kind_of(key.agent) == POLE else vehicles.config)
        progress(number + 1, len(data), "")
    return {
        scene: SightedScene(
            tuple(told for _, told in own),
            tuple(spin for spin, _ in own),
            {spin: _truth(seen) for (name, spin), seen in there.items() if name == scene},
            {spin: time_s for (name, spin), time_s in times.items() if name == scene},
        )
        for scene, own in rows.items()
    }


def _add_truth(seen: dict[str, tuple[Boxes, bool]], frame: Frame, config: SecondConfig) -> None:
    """Add the cars of a frame by track, world frame, each with whether some agent so far could find it."""
    truth = ground_truth(frame, config)
    for row in np.flatnonzero((truth.boxes.label == CAR) | truth.lookalike):
        track = str(frame.annotations.track[row])
        box = replace(frame.annotations.boxes[[row]], label=np.array([CAR]))
        target = bool(truth.target[row])
        if track not in seen or target:
            seen[track] = box, target


def _truth(seen: Mapping[str, tuple[Boxes, bool]]) -> Truth:
    return Truth(
        concatenate([box for box, target in seen.values() if target]),
        concatenate([box for box, target in seen.values() if not target]),
    )
