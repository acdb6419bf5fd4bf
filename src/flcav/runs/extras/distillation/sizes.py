"""Sizes of what vehicles send to have their samples labelled by the road average, by dry runs of the messages.

Sensors are placed after the plan, and detections follow from training: so boxes are those of annotated targets, in
frames of a drive before, near the poles with most traffic.
"""

from collections.abc import Sequence

import numpy as np

from flcav.fusion.average import NavigationErrors, Sighting
from flcav.fusion.distillation import Distillation, pack_sighting
from flcav.network.ledger import BYTES_PER_MB
from flcav.perception.objects.model import SecondConfig
from flcav.perception.objects.truth import asked_of
from flcav.runs.frames import Frames, list_window
from flcav.runs.labels.pseudo_labels import select_frames_near
from flcav.runs.labels.sightings import find_told_posts
from flcav.runs.poles import find_sites, read_traces
from flcav.runs.training.updates import RegionDrive, Sensors
from flcav.world.map.census import measure_traffic_density


def measure_messages(
    regions: Sequence[RegionDrive], sensors: Sensors, how: Distillation, config: SecondConfig
) -> float:
    """Return what a vehicle sends to have its samples labelled once by the road average [MB], in the mean.

    A recorded region has in its windows what it has. In a town one more spin is recorded before each frame and after;
    where a spin lies between two frames it is sent once, and this is more than is sent.
    """
    sent, vehicles = 0.0, 0
    for region in regions:
        drive = region.drive
        near = select_frames_near(drive, _expect_sensors(region, sensors), sensors.near_m)
        told = list_window(drive, near, how.window_s) if region.recorded else near
        spins = 3 if how.window_s and not region.recorded else 1
        each = sum(_sighting_bytes(drive, i, how, config) for i in told) / len(drive.vehicles)
        sent += region.training_frames * spins * each
        vehicles += region.vehicles
    return sent / vehicles / BYTES_PER_MB


def _expect_sensors(region: RegionDrive, sensors: Sensors) -> np.ndarray:
    """Return the places (S, 2) of a region's sensors, world [m]: on named poles, and those with most traffic."""
    sites = find_sites(region.drive, region.drive if region.recorded else None)
    named = np.flatnonzero(np.isin(sites.number, sensors.poles))
    traces = read_traces(region.drive.data, region.drive.vehicles)
    actors = measure_traffic_density(sites.position, traces, sensors.traffic_m)
    densest = np.argsort(-actors, kind="stable")[: sensors.count]
    return sites.position[np.union1d(named, densest).astype(int), :2]


def _sighting_bytes(drive: Frames, i: int, how: Distillation, config: SecondConfig) -> int:
    """Return the size of a vehicle's message on a frame, with its annotated boxes for detections [bytes]."""
    frame, key = drive.data.frame(i), drive.data.keys[i]
    boxes = asked_of(frame, config).targets
    posts, accuracy = find_told_posts(frame, how), NavigationErrors().stated
    return len(pack_sighting(Sighting(key.agent, key.time_s, frame.world_from_agent, boxes, posts, accuracy)))
