"""Sizes of the messages by which vehicles have their samples labelled by the road average, measured by dry runs.

Sensors are placed after the plan, and detections follow from training: the boxes are therefore annotated targets, in
frames of an earlier drive, near the poles with most traffic.
"""

from collections.abc import Sequence

import numpy as np

from flcav.fusion.average import NavigationErrors, Sighting
from flcav.fusion.distillation import Distillation, pack_sighting
from flcav.network.ledger import BYTES_PER_MB
from flcav.perception.objects.config import SecondConfig
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
    """Return the mean size of a vehicle's messages for one labelling of its samples by the road average [MB].

    In a recorded region the windows contain what was recorded. In a town one more spin is recorded before and after a
    frame; the size is an upper bound there, since a spin between two frames is sent once.
    """
    sent = 0.0
    vehicles = 0
    for region in regions:
        drive = region.drive
        near = select_frames_near(drive, _expect_sensors(region, sensors), sensors.near_m)
        reported = list_window(drive, near, how.window_s) if region.recorded else near
        spins = 3 if how.window_s and not region.recorded else 1
        per_vehicle = sum(_sighting_bytes(drive, i, how, config) for i in reported) / len(drive.vehicles)
        sent += region.training_frames * spins * per_vehicle
        vehicles += region.vehicles
    return sent / vehicles / BYTES_PER_MB


def _expect_sensors(region: RegionDrive, sensors: Sensors) -> np.ndarray:
    """Return the expected positions (S, 2) of a region's sensors, world frame [m]: named poles, and most traffic."""
    sites = find_sites(region.drive, region.drive if region.recorded else None)
    named = np.flatnonzero(np.isin(sites.number, sensors.poles))
    traces = read_traces(region.drive.data, region.drive.vehicles)
    actors = measure_traffic_density(sites.position, traces, sensors.traffic_m)
    densest = np.argsort(-actors, kind="stable")[: sensors.count]
    return sites.position[np.union1d(named, densest).astype(int), :2]


def _sighting_bytes(drive: Frames, i: int, how: Distillation, config: SecondConfig) -> int:
    """Return the size of a vehicle's message about a frame [bytes], with annotated boxes in place of detections."""
    frame, key = drive.data.frame(i), drive.data.keys[i]
    boxes = asked_of(frame, config).targets
    posts = find_told_posts(frame, how)
    accuracy = NavigationErrors().stated
    return len(pack_sighting(Sighting(key.agent, key.time_s, frame.world_from_agent, boxes, posts, accuracy)))
